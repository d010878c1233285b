"""What a foot's tracker found in a block of samples, as arrays until it is asked for."""

from __future__ import annotations

from typing import Any

import numpy as np

from fes.estimation.clearance import FootPath
from fes.estimation.stride_course import CHANGES, ROWS, STRIDE, STRIDES, new_out
from fes.estimation.strides import TRAJECTORY_POINTS, Rows, StrideSettings, stride_paths, stride_results
from fes.estimation.tracker import Outcome
from fes.signals import FloatArray, StrideResult
from statemachine.machine import GaitPhaseMachine
from statemachine.phases import PhaseChange

AT_ONCE = (128, 32)  # phase changes and strides for which there is room
CHANGE = np.dtype([("t_ns", np.int64), ("transition", np.int64), ("source", np.int64)], align=True)


class Walked:
    """Phase changes and strides in order, the strides' ways beside them.

    ``room`` and ``out`` are what the compiled core fills; :meth:`keep` takes it over. ``capacity``: rows of the history.
    """

    def __init__(self, foot: str, settings: StrideSettings, capacity: int) -> None:
        self.changes: list[PhaseChange] = []
        self.room: Rows = np.zeros(AT_ONCE[0], CHANGE)
        self.out = new_out(AT_ONCE[1], 2 * capacity, TRAJECTORY_POINTS)
        self._foot, self._settings = foot, settings
        self._rows: list[Rows] = []
        self._shapes: list[FloatArray] = []
        self._paths: list[FootPath] = []

    def append(self, outcome: Outcome) -> None:
        """A restart, which the compiled core knows nothing of."""
        assert isinstance(outcome, PhaseChange)
        self.changes.append(outcome)

    def keep(self, machine: GaitPhaseMachine) -> None:
        """Take over what the core has found, and lead the phase machine after it."""
        strides, _, changes = self.out.filled.tolist()
        if strides:
            rows = self.out.strides[:strides].copy()
            if self._settings.watch is not None:
                self._paths += stride_paths(rows, self.out, self._settings)
            rows["changes"] += len(self.changes)
            self._rows.append(rows)
            self._shapes.append(self.out.shapes[:strides].copy())
        self.changes += machine.follow(self.room[:changes].tolist())
        self.out.filled[:] = 0

    def rows(self) -> Rows:
        """The strides (K,), of ``fes.estimation.stride_course.STRIDE``."""
        return np.concatenate(self._rows) if self._rows else np.zeros(0, STRIDE)

    def shapes(self) -> FloatArray:
        """Their shapes (K, ``TRAJECTORY_POINTS``, 4)."""
        return np.concatenate(self._shapes) if self._shapes else np.zeros((0, TRAJECTORY_POINTS, 4))

    def paths(self) -> list[FootPath]:
        """The ways of the valid strides, where the settings have somebody who watches."""
        return self._paths

    def strides(self) -> list[StrideResult]:
        """The strides' results."""
        return stride_results(self._foot, self.rows(), self.shapes())

    def outcomes(self) -> list[Outcome]:
        """Strides and phase changes in the order in which they came."""
        outcomes: list[Outcome] = []
        told = 0
        for stride, before in zip(self.strides(), self.rows()["changes"].tolist(), strict=True):
            outcomes += self.changes[told:before]
            outcomes.append(stride)
            told = before
        return outcomes + self.changes[told:]
