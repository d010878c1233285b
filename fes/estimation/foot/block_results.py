"""What a foot's tracker found in a block of samples, as arrays until it is asked for."""

from collections.abc import Iterable
from typing import Any

import numpy as np

from fes.estimation.clearance.clearance import FootPaths
from fes.estimation.numerics.records import record_of, record_type
from fes.estimation.strides.integration import stride_shapes
from fes.estimation.strides.results import (
    TRAJECTORY_POINTS,
    Rows,
    StrideSettings,
    columns_of_rows,
    stride_paths,
    stride_results,
    toe_out_rad,
)
from fes.estimation.strides.segmentation import CHANGES, STRIDES, new_out
from fes.estimation.tracking.tracker import Outcome
from fes.signals import FloatArray, IntArray, StrideResult
from statemachine.guards import Features, Thresholds
from statemachine.machine import GaitPhaseMachine, GuardDisagreement
from statemachine.phases import Phase, PhaseChange, Transition
from statemachine.table import TABLE

CHANGE = record_type(  # and what the guard saw
    [
        ("t_ns", np.int64),
        ("transition", np.int64),  # 0: a restart
        ("features", np.float64, len(Features._fields)),
        ("thresholds", record_of(Thresholds)),
    ]
)
USUAL_STRIDES = 25  # in a history of twenty seconds
_PHASES = {row.transition: (row.source, row.destination) for row in TABLE}
SOURCES, DESTINATIONS = np.array([_PHASES.get(which, (Phase.STANCE,) * 2) for which in Transition], np.int64).T


class TrackedBlock:
    """Phase changes and strides in order, the strides' trajectories beside them.

    ``transitions`` and ``out`` are what the compiled core fills from ``samples`` samples, after a history of
    ``capacity`` (twenty seconds), from ``phase`` on; where it stops for want of room, :meth:`store` makes more.
    """

    def __init__(self, foot: str, phase: Phase, settings: StrideSettings, samples: int, capacity: int) -> None:
        strides = USUAL_STRIDES * samples // capacity + 2
        self.transitions: Rows = np.empty(6 * strides, CHANGE)
        self.longer: FloatArray | None = None  # than by itself (K,) is each stride, where more is known of its length
        self.out = new_out(strides, samples + 2 * capacity, TRAJECTORY_POINTS, shaped=False)
        self._foot, self._phase, self._settings = foot, phase, settings
        self._stored, self._capacity = 0, capacity

    def add_restart(self, changes: Iterable[PhaseChange]) -> None:
        """Add the changes of a restart, which the compiled core knows nothing of."""
        for change in changes:
            row = self.transitions[self._stored]
            row["t_ns"], row["transition"] = change.t_ns, change.transition
            self.out.filled[CHANGES] = self._stored + 1
            self.store()

    def store(self) -> None:
        """Take over what the core has found, and make room for more."""
        strides, rows, self._stored = self.out.filled.tolist()
        out = self.out
        if self._stored >= len(self.transitions):
            self.transitions = _twice(self.transitions)
        if strides == len(out.strides):
            self.out = out._replace(strides=_twice(out.strides))
        if rows > len(out.t_ns) - self._capacity:
            longer = {name: _twice(getattr(out, name)) for name in ("t_ns", "position", "quaternion")}
            self.out = self.out._replace(**longer)

    @property
    def changes(self) -> list[PhaseChange]:
        """The phase changes, made anew at every call by a machine that goes through them.

        Raises:
            GuardDisagreement: see :meth:`GaitPhaseMachine.fire`.
        """
        if not self._stored:
            return []
        machine = GaitPhaseMachine(self._foot, self._phase)
        return [
            machine.fire(Transition(number), t_ns, Features._make(seen.tolist()), Thresholds._make(limits))
            if number
            else machine.restart(t_ns)
            for t_ns, number, seen, limits in self.transitions[: self._stored].tolist()
        ]

    def change_columns(self) -> tuple[IntArray, IntArray, IntArray, IntArray]:
        """Of the C phase changes the times, the transitions, from where and to where they led: (C,) of numbers each.

        Raises:
            GuardDisagreement: one of them leaves another phase than the one before has led to.
        """
        found = self.transitions[: self._stored]
        number = found["transition"].copy()
        to = DESTINATIONS[number]
        source = np.concatenate(([int(self._phase)], to))[: len(to)]
        if ((number != Transition.NONE) & (source != SOURCES[number])).any():
            raise GuardDisagreement(f"{self._foot}: a transition leaves a phase in which the foot was not")
        return found["t_ns"].copy(), number, source, to

    @property
    def rows(self) -> Rows:
        """The strides (K,), of ``fes.estimation.strides.schema.STRIDE``."""
        rows: Rows = self.out.strides[: self.out.filled[STRIDES]]
        return rows

    @property
    def shapes(self) -> FloatArray:
        """Their shapes (K, ``TRAJECTORY_POINTS``, 5), made anew at every call; of those not solved nothing to go by."""
        rows, out = self.rows, self.out
        shapes = np.zeros((len(rows), TRAJECTORY_POINTS, 5))
        firsts, counts = rows["first"].copy(), rows["rows"].copy()
        (fx, fy, fz), (ux, uy, uz) = self._settings.forward.tolist(), self._settings.up.tolist()
        toe_out = toe_out_rad(self._foot)
        stride_shapes(firsts, counts, out.t_ns, out.quaternion, out.position, fx, fy, fz, ux, uy, uz, toe_out, shapes)
        if self.longer is not None:
            shapes[:, :, 0] *= self.longer[:, None]
        return shapes

    def paths(self) -> FootPaths:
        """The trajectories of the valid strides."""
        return stride_paths(self.rows, self.out, self._settings)

    def columns(self) -> dict[str, np.ndarray[Any, Any]]:
        """The strides' numbers as columns (K,), see ``fes.estimation.strides.schema.result_columns``."""
        return columns_of_rows(self._foot, self.rows)

    def strides(self) -> list[StrideResult]:
        """The strides' results."""
        return stride_results(self._foot, self.rows, self.shapes)

    def outcomes(self) -> list[Outcome]:
        """Strides and phase changes in the order in which they came."""
        outcomes: list[Outcome] = []
        changes, done = self.changes, 0
        for stride, before in zip(self.strides(), self.rows["changes"].tolist(), strict=True):
            outcomes += changes[done:before]
            outcomes.append(stride)
            done = before
        return outcomes + changes[done:]


def _twice(array: Rows) -> Rows:
    """The same with as much room again."""
    return np.concatenate((array, np.empty_like(array)))
