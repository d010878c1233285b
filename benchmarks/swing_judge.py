"""Swings found from the raw signals alone, and phases held against them: shares nothing with what is judged.

A swing is one rise of the foot's pitch: while the foot is in the air it turns toe-up, from its steepest (about −60° at
foot off in sound gait) to its greatest pitch (about +20° before contact; Winter 2009, Perry & Burnfield 2010). No peak
of a rate is looked at, no rest, no jerk, and no calibration: a slap at contact is a *fall* of the pitch, a forefoot
landing prolongs the rise, weight shifts turn the foot by a few degrees only.

- *up*: the median specific force of the quietest quarter of the samples;
- *axis*: of the angles about level axes (rates below 5 Hz, integrated, without what is slower than 0.15 Hz) the
  direction with the most variance. Of angles, not of rates: rolling onto an edge is fast, but small;
- *sign*: a foot stands for most of the cycle and then travels fast, so its speed is skewed towards forward;
- *rises*: between turning points of the pitch that are at least 3° apart. A rise of ``SURE`` of the typical one (median
  of the greater two thirds) is a swing; one of ``POSSIBLE`` may be one (a step on the spot, a pivot): it excuses a
  swing phase, but nobody has to find it. *Mid-swing* is where half of the rise is done.

A stride, from mid-swing to mid-swing, is in order when exactly T3, T4, T1, T2 fire in it, so that both mid-swings lie
in a swing phase. A swing phase without a mid-swing is false. The count agrees with +gyr_y of the treadmill runs (40
feet), with the footswitches' swings of the healthy, and between left and right of the walks on the floor.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.integrate import cumulative_trapezoid
from scipy.signal import butter, sosfiltfilt

from fes.signals import FloatArray, IntArray, StrideResult
from statemachine.phases import Phase, PhaseChange, Transition

GRID_HZ = 100.0
TURNING_HZ = 5.0  # the foot's pitch has little above (Winter 2009)
DRIFT_HZ = 0.15  # below the slowest strides, of some 3 s
APART_RAD = np.radians(3.0)
SURE, POSSIBLE = 0.4, 0.15
LEAST_SURE_RAD, LEAST_POSSIBLE_RAD = np.radians(8.0), np.radians(4.0)
STOPPED = 2.5  # usual strides: a longer one holds a stop
SPEED_HZ = 0.3  # as DRIFT_HZ, of the speed, which drifts more
MOST_RADPS = 40.0  # no foot turns faster: a spike
IN_ORDER = (Transition.T3, Transition.T4, Transition.T1, Transition.T2)


@dataclass(frozen=True)
class Swings:
    """Mid-swings (ns): ``sure`` those that must be found, ``possible`` those that may be as well.

    ``begin_ns`` and ``end_ns`` are the recording's.
    """

    sure: IntArray
    possible: IntArray
    begin_ns: int
    end_ns: int

    def whole(self) -> list[int]:
        """Those that must have a length: the recording begins and ends half a usual stride away at least."""
        half_ns = 0.5 * float(np.median(np.diff(self.sure))) if len(self.sure) > 1 else 0.0
        return [at for at in self.sure.tolist() if self.begin_ns + half_ns <= at <= self.end_ns - half_ns]

    def pairs(self) -> list[tuple[int, int]]:
        """From mid-swing to mid-swing, without stops."""
        if len(self.sure) < 2:
            return []
        most_ns = STOPPED * np.median(np.diff(self.sure))
        return [(int(a), int(b)) for a, b in pairwise(self.sure) if b - a <= most_ns]


@dataclass
class Score:
    """Strides of one foot against the judge's; ``swings`` are those that the recording does not cut."""

    strides: int = 0
    in_order: int = 0
    swings: int = 0
    false_swings: int = 0
    answered: int = 0
    explained: int = 0


def pitch_of(t_ns: IntArray, acc_mps2: FloatArray, gyr_radps: FloatArray) -> tuple[IntArray, FloatArray]:
    """Times (N,) of an even grid, ns, and the pitch there (rad, toe-up positive; it drifts)."""
    newer = np.concatenate(([True], t_ns[1:] > np.maximum.accumulate(t_ns)[:-1]))
    sound = newer & np.isfinite(gyr_radps).all(axis=1) & (np.abs(gyr_radps).max(axis=1) < MOST_RADPS)
    t_s = 1e-9 * (t_ns[sound] - t_ns[0])
    grid_s = np.arange(0.0, t_s[-1], 1.0 / GRID_HZ)
    acc, gyr = (
        np.column_stack([np.interp(grid_s, t_s, each) for each in values[sound].T]) for values in (acc_mps2, gyr_radps)
    )
    slow = sosfiltfilt(butter(2, TURNING_HZ, fs=GRID_HZ, output="sos"), gyr, axis=0)
    size = np.linalg.norm(slow, axis=1)
    quiet = size <= np.percentile(size, 25)
    up = np.median(acc[quiet], axis=0)
    up /= np.linalg.norm(up)
    slow -= np.median(slow[quiet], axis=0)
    level = slow - np.outer(slow @ up, up)
    angle = cumulative_trapezoid(level, dx=1.0 / GRID_HZ, axis=0, initial=0.0)
    steady = sosfiltfilt(butter(2, DRIFT_HZ, "highpass", fs=GRID_HZ, output="sos"), angle, axis=0)
    axis = np.linalg.eigh(np.cov(steady.T))[1][:, -1]
    turned = steady @ axis
    pitched = turned - np.median(turned[quiet])
    force = np.cos(pitched) * (acc @ np.cross(up, axis)) - np.sin(pitched) * (acc @ up)  # level, if toe-up is positive
    speed = cumulative_trapezoid(force - force.mean(), dx=1.0 / GRID_HZ, initial=0.0)
    if skewness(sosfiltfilt(butter(2, SPEED_HZ, "highpass", fs=GRID_HZ, output="sos"), speed)) < 0.0:
        axis = -axis
    return t_ns[0] + np.round(1e9 * grid_s).astype(np.int64), angle @ axis


def skewness(values: FloatArray) -> float:
    """Third moment of values (N,), those of the utmost percent cut."""
    cut = np.clip(values, *np.percentile(values, (1.0, 99.0)))
    return float(np.mean((cut - cut.mean()) ** 3) / cut.std() ** 3)


def turning_points(pitch: FloatArray, apart: float) -> list[int]:
    """Indices of troughs and peaks by turns, first a trough, each at least ``apart`` from the one before."""
    found: list[int] = []
    low = high = 0
    rising: bool | None = None
    for k, value in enumerate(pitch.tolist()):
        if rising is not False and value > pitch[high]:
            high = k
        if rising is not True and value < pitch[low]:
            low = k
        if rising is not False and value < pitch[high] - apart:
            if rising:
                found.append(high)
            rising, low = False, k
        elif rising is not True and value > pitch[low] + apart:
            found.append(low)
            rising, high = True, k
    return found


def find_swings(t_ns: IntArray, acc_mps2: FloatArray, gyr_radps: FloatArray) -> Swings:
    """The swings of one foot, from what its sensor measured (N,), (N, 3), (N, 3)."""
    times, pitch = pitch_of(t_ns, acc_mps2, gyr_radps)
    points = turning_points(pitch, APART_RAD)
    spans = list(zip(points[0::2], points[1::2], strict=False))
    if not spans:
        return Swings(np.empty(0, np.int64), np.empty(0, np.int64), int(times[0]), int(times[-1]))
    rises = np.array([pitch[b] - pitch[a] for a, b in spans])
    typical = float(np.median(np.sort(rises)[-(-2 * len(rises) // 3) :])) if len(rises) > 2 else float(rises.max())
    middle = [a + int(np.argmax(pitch[a : b + 1] >= 0.5 * (pitch[a] + pitch[b]))) for a, b in spans]
    at_ns = times[middle]
    sure = rises >= max(SURE * typical, LEAST_SURE_RAD)
    possible = rises >= max(POSSIBLE * typical, LEAST_POSSIBLE_RAD)
    return Swings(at_ns[sure], at_ns[possible], int(times[0]), int(times[-1]))


def fired_between(changes: Sequence[PhaseChange], begin_ns: int, end_ns: int) -> tuple[Transition, ...]:
    """The transitions from one time to another."""
    return tuple(change.transition for change in changes if begin_ns <= change.t_ns < end_ns)


def fired_by_stride(swings: Swings, changes: Sequence[PhaseChange]) -> list[tuple[Transition, ...]]:
    """The transitions of every stride of the judge's."""
    times = np.array([change.t_ns for change in changes], np.int64)
    found = []
    for begin, end in swings.pairs():
        first, last = np.searchsorted(times, (begin, end))
        found.append(tuple(change.transition for change in changes[first:last]))
    return found


def in_order(swings: Swings, changes: Sequence[PhaseChange]) -> list[bool]:
    """Of every stride whether its phases came in order; a possible swing inside may have a cycle of its own."""
    found = []
    for (begin, end), fired in zip(swings.pairs(), fired_by_stride(swings, changes), strict=True):
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
    for at in swings.whole():
        around = [stride for stride in strides if stride.t_start_ns <= at <= stride.t_end_ns]
        if any(stride.valid and np.isfinite(stride.stride_length_m) for stride in around):
            result.answered += 1
        elif any(stride.reason for stride in around):
            result.explained += 1
    return result


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

    def swings(self) -> Swings:
        """The middles of the labelled swings."""
        middle = [
            (self.t_ns[a] + self.t_ns[b]) // 2
            for a, b in runs(self.label)
            if self.label[a] == IN_SWING and self.t_ns[b] - self.t_ns[a] >= 1e9 * LEAST_SWING_S
        ]
        middles = np.array(middle, np.int64)
        return Swings(middles, middles, int(self.t_ns[0]), int(self.t_ns[-1]))

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

    def stimulated_flat_s(self, changes: Sequence[PhaseChange], begin_ns: int, end_ns: int) -> float:
        """Seconds of flat foot between T1 and T4 of the machine: stimulated by a channel for the swing."""
        first, last = np.searchsorted(self.t_ns, (begin_ns, end_ns))
        t_ns = self.t_ns[first : last + 1]
        phases = np.array([Phase.STANCE, *(change.destination for change in changes)])
        phase = phases[np.searchsorted(np.array([c.t_ns for c in changes], np.int64), t_ns[:-1], side="right")]
        on = (phase != Phase.STANCE) & (self.label[first:last] == FLAT)
        return float(1e-9 * np.diff(t_ns)[on].sum())


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
