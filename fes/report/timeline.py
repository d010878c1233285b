"""When each foot was in which phase, as arrays, and time measured inside chosen phases."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from fes.config import PHASE_ORDER
from fes.config import Phase as PhaseName
from fes.signals import NS_PER_S, FloatArray, IntArray
from statemachine.phases import Phase, PhaseChange


@dataclass(frozen=True)
class PhaseTimeline:
    """The phases of one foot over a session.

    ``start_ns`` (M,) and ``end_ns`` (M,) bound the intervals without gaps, ``phase`` (M,) holds the numbers of
    :class:`statemachine.phases.Phase`; ``change_ns`` (C,) and ``transition`` (C,) are the changes themselves.
    """

    foot: str
    start_ns: IntArray
    end_ns: IntArray
    phase: IntArray
    change_ns: IntArray
    transition: IntArray

    def time_in(self, phases: Sequence[Phase], start_ns: IntArray, end_ns: IntArray) -> FloatArray:
        """Seconds of each span [start, end) (N,) that the foot spent in one of ``phases``."""
        if self.start_ns.size == 0:
            return np.zeros(np.shape(start_ns))
        origin = int(self.start_ns[0])
        inside = np.isin(self.phase, [int(phase) for phase in phases])
        spent_s = np.concatenate([[0.0], np.cumsum(np.where(inside, self.end_ns - self.start_ns, 0))]) / NS_PER_S
        border_s = np.append(self.start_ns - origin, self.end_ns[-1] - origin) / NS_PER_S
        until = np.interp((end_ns - origin) / NS_PER_S, border_s, spent_s)
        return np.asarray(until - np.interp((start_ns - origin) / NS_PER_S, border_s, spent_s), dtype=np.float64)


def build_timeline(changes: Iterable[PhaseChange], foot: str, start_ns: int, end_ns: int) -> PhaseTimeline:
    """Lay the phase changes of ``foot`` end to end between the session's first and last instant.

    Before its first change a foot is in that change's source phase (stance when there is none at all).
    """
    own = sorted((change for change in changes if change.foot == foot), key=lambda change: change.t_ns)
    change_ns = np.array([change.t_ns for change in own], dtype=np.int64)
    first = own[0].source if own else Phase.STANCE
    starts = np.concatenate([np.array([min([start_ns, *change_ns[:1].tolist()])], dtype=np.int64), change_ns])
    last = max(end_ns, int(starts[-1]))
    return PhaseTimeline(
        foot=foot,
        start_ns=starts,
        end_ns=np.append(starts[1:], last),
        phase=np.array([int(first), *(int(change.destination) for change in own)], dtype=np.int64),
        change_ns=change_ns,
        transition=np.array([int(change.transition) for change in own], dtype=np.int64),
    )


def phases_between(start: PhaseName, stop: PhaseName) -> tuple[Phase, ...]:
    """The phases from ``start`` through ``stop``, both included, in the order in which a stride passes them."""
    at = PHASE_ORDER.index(start)
    count = (PHASE_ORDER.index(stop) - at) % len(PHASE_ORDER) + 1
    return tuple(Phase((at + step) % len(PHASE_ORDER)) for step in range(count))
