"""What a foot's tracker found in a block of samples, as arrays until it is asked for."""

from collections.abc import Iterable

import numpy as np

from fes.estimation.clearance.clearance import FootPaths
from fes.estimation.numerics.records import record_type
from fes.estimation.strides.integration import stride_shapes
from fes.estimation.strides.results import (
    TRAJECTORY_POINTS,
    Rows,
    StrideSettings,
    stride_paths,
    stride_results,
    toe_out_rad,
)
from fes.estimation.strides.segmentation import CHANGES, STRIDES, new_out
from fes.estimation.tracking.tracker import Outcome
from fes.signals import FloatArray, StrideResult
from statemachine.machine import GaitPhaseMachine, changes_of
from statemachine.phases import PhaseChange

CHANGE = record_type([("t_ns", np.int64), ("transition", np.int64), ("source", np.int64)])
USUAL_STRIDES = 25  # in a history of twenty seconds


class TrackedBlock:
    """Phase changes and strides in order, the strides' trajectories beside them.

    ``transitions`` and ``out`` are what the compiled core fills from ``samples`` samples, after a history of
    ``capacity`` (twenty seconds); where it stops for want of room, :meth:`store` makes more.
    """

    def __init__(self, foot: str, settings: StrideSettings, samples: int, capacity: int) -> None:
        strides = USUAL_STRIDES * samples // capacity + 2
        self.transitions: Rows = np.empty(6 * strides, CHANGE)
        self.longer: FloatArray | None = None  # than by itself (K,) is each stride, where more is known of its length
        self.out = new_out(strides, samples + 2 * capacity, TRAJECTORY_POINTS, shaped=False)
        self._foot, self._settings = foot, settings
        self._stored, self._applied, self._capacity = 0, 0, capacity

    def add_restart(self, changes: Iterable[PhaseChange]) -> None:
        """Add the changes of a restart, which the compiled core knows nothing of."""
        for change in changes:
            self.transitions[self._stored] = change.t_ns, change.transition, change.source
            self.out.filled[CHANGES] = self._applied = self._stored + 1
            self.store()

    def apply_transitions(self, machine: GaitPhaseMachine) -> None:
        """Have the machine follow what the core has found since; errors as of ``GaitPhaseMachine.follow``."""
        machine.follow(self.transitions[self._applied : self._stored].tolist())
        self._applied = self._stored

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
        """The phase changes, made anew at every call."""
        return changes_of(self._foot, self.transitions[: self._stored].tolist())

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
