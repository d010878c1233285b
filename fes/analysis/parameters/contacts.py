"""Foot off (FO) and initial contact (IC) of slow walks, set right by the path that the foot really took.

In slow and in paretic gait the off-line events (:mod:`fes.estimation.events.offline`) come apart from the ground's
contact: the foot stops turning long before it lands, and a weak foot that has been lifted turns toe-down as it falls.

- FO: a foot that rolls slowly over its forefoot turns evenly and hardly accelerates. Where that lasted for ``QUIET_S``
  and ends shortly before the off-line FO, be it in its turning (a weak foot drops) or in its acceleration upward (it is
  pulled up), the end is FO. A brisk push-off is never that quiet, and keeps its event.
- IC: the heel falls faster and faster until the ground stops it: its fastest descent after the off-line IC. Up to
  ``SHOE_YIELDS_S`` apart the off-line event stays, beyond twice that the descent is believed, in between a mixture.

No paper; constants chosen on virtual walks (benchmarks/accuracy/parameters.py measures them on others, too). Against
the markers of one healthy adult they add 1 ms to IC's mean and SD; of slow real feet no true contacts were at hand.
"""

from typing import NamedTuple

import numpy as np

from fes.estimation.clearance.clearance import FootArms, FootPaths, reach
from fes.estimation.events.offline import GaitEvents
from fes.estimation.numerics.jit import jit_ieee
from fes.estimation.numerics.records import Mat, Vec
from fes.estimation.strides.boundaries import UNSEEN_NS
from fes.signals import NS_PER_S, FloatArray, IntArray

TURNS_RADPS2 = 30.0  # a change of turning that a foot does not show while it rolls over its forefoot
LEAVES_MPS2 = 3.0  # … and an acceleration, …
BEGINS_MPS2 = 2.0  # … which began where it passed this
SLOW_RADPS = 3.0  # the acceleration tells only of a foot that rolls more slowly
QUIET_S = 0.08  # the foot has to have rolled quietly for this long
EARLIER_S = 0.1  # and to stop no earlier than this before the off-line FO
SMOOTH_S = 0.02  # mean of both: skin and shoe ring
SHOE_YIELDS_S = 0.02
DESCENT_S = (-0.02, 0.1)  # around the off-line IC, where the fastest descent is sought
LEAST_DESCENT_MPS = 0.05


class Swings(NamedTuple):
    """Of each of S strides foot off, initial contact, heel rise before and foot flat after them: (S,) each, in ns.

    ``UNSEEN_NS`` where not known; of a stride without exactly one swing none of them is.
    """

    foot_off_ns: IntArray
    contact_ns: IntArray
    heel_rise_ns: IntArray
    foot_flat_ns: IntArray

    @property
    def seen(self) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        """Which strides show their swing (S,)."""
        return np.asarray(self.contact_ns != UNSEEN_NS)


def no_swings(count: int) -> Swings:
    """Of so many strides, none of which shows one."""
    return Swings(*np.full((len(Swings._fields), count), UNSEEN_NS, np.int64))


def swings_of(paths: FootPaths, pitch_rad: FloatArray, events: GaitEvents, arms: FootArms | None) -> Swings:
    """The swing within each of K strides; ``pitch_rad`` (R,) is of :func:`fes.analysis.parameters.motion.pitches`.

    ``events`` are of the same foot's whole recording; without ``arms``, where toe and heel are, IC stays where they put
    it.
    """
    swings, (first_ns, last_ns) = no_swings(len(paths)), paths.t_ns[paths.spans - (0, 1)].T
    at = np.searchsorted(events.mid_swing_ns, first_ns, side="right")
    k = np.flatnonzero(np.searchsorted(events.mid_swing_ns, last_ns) - at == 1)
    off_ns, contact_ns = events.fo_ns[at[k]], events.ic_ns[at[k]]
    k = k[(first_ns[k] <= off_ns) & (off_ns < contact_ns) & (contact_ns <= last_ns[k])]
    found = (events.fo_ns, events.ic_ns, events.heel_rise_ns, events.foot_flat_ns)
    for own, every in zip(swings, found, strict=True):
        own[k] = UNSEEN_NS if every is None else every[at[k]]
    falls = np.zeros(len(paths), np.bool_)
    falls[k] = events.heel_strike[at[k]] & (arms is not None)
    heel = paths.foot @ np.array((0.0, 0.0, 0.0) if arms is None else arms.heel_m)
    _settle(
        paths.t_ns, paths.position_m, paths.quaternion, pitch_rad, paths.spans, heel, falls, swings.foot_off_ns,
        swings.contact_ns,
    )  # fmt: skip
    return swings


@jit_ieee
def _settle(
    t_ns: Vec, position: Mat, quaternion: Mat, pitch: Vec, spans: Mat, heel: Vec, falls: Vec, off_ns: Vec,
    contact_ns: Vec,
) -> None:  # fmt: skip
    """Set the events of K strides right by their paths; of those that ``falls`` (K,) marks the contact, too."""
    for k in range(spans.shape[0]):
        if off_ns[k] == UNSEEN_NS:
            continue
        begin, end = spans[k, 0], spans[k, 1]
        own = t_ns[begin:end]
        if falls[k]:
            heights = np.empty(end - begin)
            for i in range(begin, end):
                heights[i - begin] = position[i, 2] + reach(quaternion, heel, i)
            contact_ns[k] = _contact(own, heights, contact_ns[k])
        off_ns[k] = _foot_off(own, pitch[begin:end], position[begin:end], off_ns[k])


@jit_ieee
def _slope(t: Vec, x: Vec) -> Vec:
    """By how much ``x`` (N,) changes with ``t``: the slope of the parabola through three samples, at the ends of the
    line through two."""
    out, last = np.empty(len(t)), len(t) - 1
    out[0], out[last] = (x[1] - x[0]) / (t[1] - t[0]), (x[last] - x[last - 1]) / (t[last] - t[last - 1])
    for i in range(1, last):
        a, b = t[i] - t[i - 1], t[i + 1] - t[i]
        out[i] = (b * ((x[i] - x[i - 1]) / a) + a * ((x[i + 1] - x[i]) / b)) / (a + b)
    return out


@jit_ieee
def _smooth(x: Vec, width: int) -> Vec:
    """Means of ``width`` samples, an odd number; what is beyond the ends counts as 0."""
    out, half = np.zeros(len(x)), width // 2
    for i in range(len(x)):
        for j in range(max(i - half, 0), min(i + half + 1, len(x))):
            out[i] += x[j] / width
    return out


@jit_ieee
def _foot_off(t_ns: Vec, pitch: Vec, position: Mat, off_ns: int) -> int:
    """Where the quiet roll over the forefoot ends, between samples, if it does so shortly before the off-line FO."""
    t, off_s = 1e-9 * (t_ns - t_ns[0]), 1e-9 * (off_ns - t_ns[0])
    width = max(int(np.rint(SMOOTH_S / np.median(np.diff(t)))), 1) | 1
    turning = _slope(t, pitch)
    changes = np.abs(_slope(t, _smooth(turning, width)))
    earlier_s = _quiet_end(t, changes, changes, TURNS_RADPS2, TURNS_RADPS2, off_s)
    if abs(turning[np.searchsorted(t, off_s - EARLIER_S)]) < SLOW_RADPS:  # a fast foot is lifted by its own roll
        upward, square = t, np.zeros(len(t))
        for axis in range(3):
            upward = _smooth(_slope(t, _slope(t, position[:, axis].copy())), width)
            square += upward * upward
        leaves_s = _quiet_end(t, upward, np.sqrt(square), BEGINS_MPS2, LEAVES_MPS2, off_s)
        earlier_s = min(earlier_s, leaves_s)
    return off_ns if earlier_s >= off_s else t_ns[0] + int(np.rint(earlier_s * NS_PER_S))


@jit_ieee
def _quiet_end(t: Vec, x: Vec, size: Vec, begins: float, level: float, off_s: float) -> float:
    """When ``x`` begins to rise to ``level``, if it does so about the last ``EARLIER_S``.

    ``off_s`` if not, or if its size in all directions, ``size``, was not below ``level`` for ``QUIET_S`` before. What
    stays below ``level`` is a bump, and no end of the quiet.
    """
    at, last = np.searchsorted(t, off_s - EARLIER_S), np.searchsorted(t, off_s + SMOOTH_S)
    while at < last and x[at] < level:
        at += 1
    if at == last:
        return off_s
    while at > 0 and x[at - 1] >= begins:
        at -= 1
    if at == 0 or off_s - t[at] > EARLIER_S:
        return off_s
    for i in range(at - 1, -1, -1):
        if t[i] >= t[at] - QUIET_S and size[i] >= level:
            return off_s
    began: float = t[at - 1] + (begins - x[at - 1]) / (x[at] - x[at - 1]) * (t[at] - t[at - 1])
    return began


@jit_ieee
def _contact(t_ns: Vec, heights: Vec, contact_ns: int) -> int:
    """Where the heel, whose heights (N,) these are, falls fastest, if that is well after the off-line IC."""
    t, fall = 1e-9 * (t_ns - contact_ns), _slope(1e-9 * (t_ns - t_ns[0]), heights)  # m/s, upward positive
    first, last = np.searchsorted(t, DESCENT_S[0]), np.searchsorted(t, DESCENT_S[1])
    if last - first < 3:
        return contact_ns
    at = first + np.argmin(fall[first:last])
    late_s = t[at]
    if 0 < at < len(t) - 1:  # between samples: the vertex of the parabola through the least one and its neighbours
        bend = fall[at - 1] - 2.0 * fall[at] + fall[at + 1]
        shift = 0.5 * (fall[at - 1] - fall[at + 1]) / bend if bend > 0.0 else 0.0
        late_s += min(max(shift, -0.5), 0.5) * (t[at + 1] - t[at])
    if fall[at] > -LEAST_DESCENT_MPS or late_s <= SHOE_YIELDS_S:
        return contact_ns
    return contact_ns + int(np.rint(late_s * min(late_s / SHOE_YIELDS_S - 1.0, 1.0) * NS_PER_S))
