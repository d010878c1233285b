"""What a foot's tracker found in a block of samples, as arrays until it is asked for."""

from __future__ import annotations

import numpy as np

from fes.estimation.clearance.clearance import FootPaths
from fes.estimation.strides.integration import stride_shapes
from fes.estimation.strides.results import TRAJECTORY_POINTS, Rows, StrideSettings, stride_paths, stride_results
from fes.estimation.strides.segmentation import CHANGES, STRIDES, new_out
from fes.estimation.tracking.tracker import Outcome
from fes.signals import FloatArray, StrideResult
from statemachine.machine import GaitPhaseMachine, changes_of
from statemachine.phases import Phase, PhaseChange, Transition
from statemachine.table import TABLE

CHANGE = np.dtype([("t_ns", np.int64), ("transition", np.int64), ("source", np.int64)], align=True)
_DESTINATIONS = np.full((len(Phase), len(Transition)), -1)
for _row in TABLE:
    _DESTINATIONS[_row.source.value, _row.transition.value] = _row.destination.value
USUAL_STRIDES = 25  # in a history of twenty seconds


class TrackedBlock:
    """Phase changes and strides in order, the strides' ways beside them.

    ``room`` and ``out`` are what the compiled core fills from ``samples`` samples, after a history of ``capacity``
    (twenty seconds); where it stops for want of room, :meth:`keep` makes more.
    """

    def __init__(self, foot: str, settings: StrideSettings, samples: int, capacity: int) -> None:
        strides = USUAL_STRIDES * samples // capacity + 2
        self.room: Rows = np.empty(6 * strides, CHANGE)
        self.longer: FloatArray | None = None  # than by itself (K,) is each stride, where more is known of its length
        self.out = new_out(strides, samples + 2 * capacity, TRAJECTORY_POINTS, shaped=False)
        self._foot, self._settings = foot, settings
        self._taken, self._led, self._capacity = 0, 0, capacity

    def append(self, outcome: Outcome) -> None:
        """A restart, which the compiled core knows nothing of."""
        assert isinstance(outcome, PhaseChange)
        self.room[self._taken] = outcome.t_ns, outcome.transition, outcome.source
        self._taken += 1
        self._led = self._taken
        self.out.filled[CHANGES] = self._taken
        if self._taken == len(self.room):
            self.room = _twice(self.room)

    def lead(self, machine: GaitPhaseMachine) -> None:
        """Lead the phase machine after what the core has found since; errors as of ``GaitPhaseMachine.follow``."""
        found = self.room[self._led : self._taken]
        self._led = self._taken
        if not len(found):
            return
        source = found["source"]
        destination = _DESTINATIONS[source, found["transition"]]
        if (destination >= 0).all() and source[0] == machine.phase and (source[1:] == destination[:-1]).all():
            found = found[-1:]  # the table allows each of them, so that the last is all that is left to do
            machine.resume(Phase(int(source[-1])))
        machine.follow(found.tolist())

    def keep(self) -> None:
        """Take over what the core has found, and make room for more."""
        strides, rows, self._taken = self.out.filled.tolist()
        out = self.out
        if self._taken >= len(self.room):
            self.room = _twice(self.room)
        if strides == len(out.strides):
            self.out = out._replace(strides=_twice(out.strides))
        if rows > len(out.t_ns) - self._capacity:
            ways = {name: _twice(getattr(out, name)) for name in ("t_ns", "position", "quaternion")}
            self.out = self.out._replace(**ways)

    @property
    def changes(self) -> list[PhaseChange]:
        """The phase changes, made anew at every call."""
        return changes_of(self._foot, self.room[: self._taken].tolist())

    @property
    def rows(self) -> Rows:
        """The strides (K,), of ``fes.estimation.strides.schema.STRIDE``."""
        rows: Rows = self.out.strides[: self.out.filled[STRIDES]]
        return rows

    @property
    def shapes(self) -> FloatArray:
        """Their shapes (K, ``TRAJECTORY_POINTS``, 4), made anew at every call; of those not solved nothing to go by."""
        rows, out = self.rows, self.out
        shapes = np.zeros((len(rows), TRAJECTORY_POINTS, 4))
        firsts, counts = rows["first"].copy(), rows["rows"].copy()
        fx, fy, fz = self._settings.forward.tolist()
        stride_shapes(firsts, counts, out.t_ns, out.quaternion, out.position, fx, fy, fz, shapes)
        if self.longer is not None:
            shapes[:, :, 0] *= self.longer[:, None]
        return shapes

    def paths(self) -> FootPaths:
        """The ways of the valid strides."""
        return stride_paths(self.rows, self.out, self._settings)

    def strides(self) -> list[StrideResult]:
        """The strides' results."""
        return stride_results(self._foot, self.rows, self.shapes)

    def outcomes(self) -> list[Outcome]:
        """Strides and phase changes in the order in which they came."""
        outcomes: list[Outcome] = []
        changes, told = self.changes, 0
        for stride, before in zip(self.strides(), self.rows["changes"].tolist(), strict=True):
            outcomes += changes[told:before]
            outcomes.append(stride)
            told = before
        return outcomes + changes[told:]


def _twice(array: Rows) -> Rows:
    """The same with as much room again."""
    return np.concatenate((array, np.empty_like(array)))
