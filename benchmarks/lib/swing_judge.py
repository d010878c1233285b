"""Phases and strides held against swings found without them: by ``fes/analysis/swings.py``, or by footswitches.

A stride, from mid-swing to mid-swing, is in order when exactly T3, T4, T1, T2 fire in it, so that both mid-swings lie
in a swing phase. A swing phase without a mid-swing is false. The count of swings agrees with +gyr_y of the treadmill
runs (40 feet), with the footswitches' swings of the healthy, and between left and right of the walks on the floor.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.signal import butter, filtfilt, find_peaks

from fes.analysis.swings import Swings
from fes.signals import FloatArray, IntArray, StrideResult
from statemachine.phases import Phase, PhaseChange, Transition

STOPPED = 2.5  # usual strides: a longer one holds a stop
IN_ORDER = (Transition.T3, Transition.T4, Transition.T1, Transition.T2)


def mid_swings(toe_up_radps: FloatArray, rate_hz: float) -> IntArray:
    """Indices of mid-swing: peaks of the 6 Hz low-passed toe-up rate over half of its 97th percentile."""
    smooth = filtfilt(*butter(2, 6.0 / (0.5 * rate_hz)), toe_up_radps)
    peaks, _ = find_peaks(smooth, height=0.5 * np.percentile(smooth, 97), distance=int(0.5 * rate_hz))
    return np.asarray(peaks, dtype=np.int64)


def pairs(swings: Swings) -> list[tuple[int, int]]:
    """From mid-swing to mid-swing, without stops."""
    if len(swings.sure) < 2:
        return []
    most_ns = STOPPED * np.median(np.diff(swings.sure))
    return [(int(a), int(b)) for a, b in pairwise(swings.sure) if b - a <= most_ns]


@dataclass
class Score:
    """Strides of one foot against the judge's; ``swings`` are those that the recording does not cut."""

    strides: int = 0
    in_order: int = 0
    swings: int = 0
    false_swings: int = 0
    answered: int = 0
    explained: int = 0


def fired_by_stride(swings: Swings, changes: Sequence[PhaseChange]) -> list[tuple[Transition, ...]]:
    """The transitions of every stride of the judge's."""
    times = np.array([change.t_ns for change in changes], np.int64)
    found = []
    for begin, end in pairs(swings):
        first, last = np.searchsorted(times, (begin, end))
        found.append(tuple(change.transition for change in changes[first:last]))
    return found


def in_order(swings: Swings, changes: Sequence[PhaseChange]) -> list[bool]:
    """Of every stride whether its phases came in order; a possible swing inside may have a cycle of its own."""
    found = []
    for (begin, end), fired in zip(pairs(swings), fired_by_stride(swings, changes), strict=True):
        inside = int(np.count_nonzero((swings.possible > begin) & (swings.possible < end)))
        found.append(any(fired == n * IN_ORDER for n in range(1, inside + 2)))
    return found


def swing_phases(changes: Sequence[PhaseChange]) -> list[tuple[int, int]]:
    """Where each swing phase begins and ends (ns)."""
    return [(a.t_ns, b.t_ns) for a, b in pairwise(changes) if a.destination is Phase.SWING]


def score(swings: Swings, changes: Sequence[PhaseChange], strides: Sequence[StrideResult]) -> Score:
    """All counts of one foot. A swing is answered by a stride with a length around it, explained by one that says
    why it has none.
    """
    ordered = in_order(swings, changes)
    result = Score(len(ordered), sum(ordered), len(swings.whole()))
    for begin, end in swing_phases(changes):
        result.false_swings += not ((swings.possible >= begin) & (swings.possible <= end)).any()
    for at in swings.whole().tolist():
        if answered(strides, at):
            result.answered += 1
        elif any(stride.reason for stride in strides if stride.t_start_ns <= at <= stride.t_end_ns):
            result.explained += 1
    return result


def answered(strides: Sequence[StrideResult], at_ns: int) -> bool:
    """Whether a stride with a length lies around a swing."""
    return any(s.t_start_ns <= at_ns <= s.t_end_ns and s.valid and np.isfinite(s.stride_length_m) for s in strides)


def later_ms(found_s: Iterable[float], true_s: Iterable[float], most_ms: float) -> list[float]:
    """How much later than each true instant the nearest of those found is; one farther away belongs to another."""
    times = np.array(list(found_s))
    off = [1e3 * float(min(times - true, key=abs, default=np.inf)) for true in true_s]
    return [ms for ms in off if abs(ms) < most_ms]


# --- footswitches: the labels are the truth ---------------------------------------------------------------------------

LOADING, FLAT, HEEL_OFF, IN_SWING = range(4)  # the labels of the set
SHORT_S = 0.04  # a shorter run of a label is a bouncing switch
LEAST_SWING_S = 0.15
STALL_S, RATE_OFF, WINDOW_S, MARGIN_S = 0.1, 0.4, 0.25, 0.3


@dataclass(frozen=True)
class Labelled:
    """Footswitch labels (N,) at ``t_ns``, free of bouncing; ``sound`` (N,): neither spike nor stall nor burst near."""

    t_ns: IntArray
    label: IntArray
    sound: Any

    def swings(self, seen: Swings) -> Swings:
        """The middles of the labelled swings; possible are those too that the raw signals show and no switch does,
        for a foot that drags keeps one closed.
        """
        middle = [
            (self.t_ns[a] + self.t_ns[b]) // 2
            for a, b in runs(self.label)
            if self.label[a] == IN_SWING and self.t_ns[b] - self.t_ns[a] >= 1e9 * LEAST_SWING_S
        ]
        middles = np.array(middle, np.int64)
        far = np.abs(seen.sure[:, None] - middles).min(axis=1, initial=np.iinfo(np.int64).max)
        possible = np.union1d(middles, seen.sure[far > 0.4 * np.median(np.diff(middles))])
        return Swings(middles, possible, int(self.t_ns[0]), int(self.t_ns[-1]))

    def judged(self, begin_ns: int, end_ns: int) -> bool:
        """Whether the time between can be judged."""
        first, last = np.searchsorted(self.t_ns, (begin_ns, end_ns))
        return bool(self.sound[first : last + 1].all())

    def times(self, begin_ns: int, end_ns: int) -> dict[Transition, int]:
        """When the switches say T3, T4, T1 and T2, of a stride from mid-swing to mid-swing; what is not seen is left
        out.
        """
        first, last = np.searchsorted(self.t_ns, (begin_ns, end_ns))
        label, t_ns = self.label[first:last], self.t_ns[first:last]
        stance = np.flatnonzero(label != IN_SWING)
        if not len(stance):
            return {}
        found = {Transition.T3: int(t_ns[stance[0]])}
        if stance[-1] + 1 < len(label):
            found[Transition.T2] = int(t_ns[stance[-1] + 1])
        flat = np.flatnonzero(label == FLAT)
        if len(flat):
            found[Transition.T4] = int(t_ns[flat[0]])
            if flat[-1] + 1 < len(label) and label[flat[-1] + 1] == HEEL_OFF:
                found[Transition.T1] = int(t_ns[flat[-1] + 1])
        return found

    def flat_and_loading_s(self, changes: Sequence[PhaseChange], begin_ns: int, end_ns: int) -> tuple[float, float]:
        """Seconds of flat foot that a channel from T1 to T4 of the machine stimulates, and of loading that it does not.

        Loading is left where the machine is in stance already, or in pre-swing.
        """
        first, last = np.searchsorted(self.t_ns, (begin_ns, end_ns))
        label, lasts_ns = self.label[first:last], np.diff(self.t_ns[first : last + 1])
        phases = np.array([Phase.STANCE, *(change.destination for change in changes)])
        at = np.searchsorted(np.array([c.t_ns for c in changes], np.int64), self.t_ns[first:last], side="right")
        flat = (label == FLAT) & (phases[at] != Phase.STANCE)
        left = (label == LOADING) & np.isin(phases[at], (Phase.STANCE, Phase.PRE_SWING))
        return 1e-9 * float(lasts_ns[flat].sum()), 1e-9 * float(lasts_ns[left].sum())


def runs(label: IntArray) -> list[tuple[int, int]]:
    """First and last index of every run of equal labels."""
    cuts = np.flatnonzero(np.diff(label)) + 1
    return list(zip([0, *cuts.tolist()], [*(cuts - 1).tolist(), len(label) - 1], strict=True))


def labelled(t_ns: IntArray, label: IntArray, bad: Any) -> Labelled:
    """Labels as recorded → without runs shorter than ``SHORT_S``, and where they can be judged."""
    label = label.astype(np.int64).copy()
    for a, b in runs(label):
        if a > 0 and t_ns[b] - t_ns[a] < 1e9 * SHORT_S:
            label[a : b + 1] = label[a - 1]
    half = round(0.5e9 * WINDOW_S)
    count = np.searchsorted(t_ns, t_ns + half) - np.searchsorted(t_ns, t_ns - half)
    off = np.abs(count / np.median(count) - 1.0) > RATE_OFF
    stalled = np.concatenate(([False], np.diff(t_ns) > 1e9 * STALL_S))
    wrong = np.flatnonzero(off | stalled | np.roll(stalled, -1) | np.asarray(bad, bool))
    sound = np.ones(len(t_ns), bool)
    margin = round(1e9 * MARGIN_S)
    firsts, lasts = np.searchsorted(t_ns, t_ns[wrong] - margin), np.searchsorted(t_ns, t_ns[wrong] + margin)
    for first, last in zip(firsts.tolist(), lasts.tolist(), strict=True):
        sound[first:last] = False
    return Labelled(t_ns, label, sound)
