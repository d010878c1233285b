"""Foot off (FO) and initial contact (IC) of slow walks, set right by the path that the foot really took.

The off-line events (:mod:`fes.estimation.events.offline`) look at the mediolateral rate: FO is about the peak of
push-off, IC where the foot stops turning toe-up. In slow and in paretic gait these come apart from the ground's
contact: the foot stops turning long before it lands, and a weak foot that has been lifted turns toe-down once more as
it falls. The path of the stride shows both, and moves the event only where it clearly does:

- FO: a foot that rolls slowly over its forefoot and the tip of its toe turns evenly and hardly accelerates. Where that
  lasted for ``QUIET_S`` and ends shortly before the off-line FO, be it in the foot's turning (a weak foot drops) or in
  its acceleration upward (it is pulled up), nothing holds the toe any more, and the end is FO. Forward the leg drives
  the foot while its toe still holds. A brisk push-off is never that quiet, and keeps its event.
- IC: the heel falls faster and faster until the ground stops it: contact is its fastest descent after the off-line IC.
  A shoe gives way for a few hundredths of a second, so up to ``SHOE_YIELDS_S`` apart the off-line event (which agrees
  with optical markers) stays, beyond twice that the descent is believed, and in between the two are mixed.

No paper. The constants were chosen on virtual walks (benchmarks/parameters.py measures them on others, too). Against
the markers of one healthy adult (same benchmark) they add 1 ms to IC's mean and SD, and nothing to FO; of slow real
feet no true contacts were at hand.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fes.analysis.parameters.motion import Motion
from fes.estimation.clearance.clearance import FootArms, FootPath
from fes.estimation.events.offline import GaitEvents
from fes.signals import NS_PER_S, FloatArray

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


@dataclass(frozen=True, slots=True)
class Swing:
    """One stride's foot off, mid-swing and initial contact (ns), and whether the heel struck first."""

    foot_off_ns: int
    mid_swing_ns: int
    contact_ns: int
    heel_strike: bool


def swing_of(path: FootPath, events: GaitEvents, arms: FootArms | None) -> Swing | None:
    """The swing within a stride; None where the events show none, or more than one.

    Args:
        path: the stride's trajectory at its own samples.
        events: of the same foot's whole recording.
        arms: where toe and heel are; without them IC stays where the events put it.
    """
    first, last = int(path.t_ns[0]), int(path.t_ns[-1])
    inside = np.flatnonzero((events.mid_swing_ns > first) & (events.mid_swing_ns < last))
    if len(inside) != 1:
        return None
    at = int(inside[0])
    off_ns, mid_ns, contact_ns = (int(t[at]) for t in (events.fo_ns, events.mid_swing_ns, events.ic_ns))
    heel_strike = bool(events.heel_strike[at])
    if not first <= off_ns < contact_ns <= last:
        return None
    if heel_strike and arms is not None:
        contact_ns = _contact(path, arms, contact_ns)
    return Swing(_foot_off(path, off_ns), mid_ns, contact_ns, heel_strike)


def _foot_off(path: FootPath, off_ns: int) -> int:
    """Where the quiet roll over the forefoot ends, between samples, if it does so shortly before the off-line FO."""
    t: FloatArray = np.asarray(1e-9 * (path.t_ns - path.t_ns[0]), dtype=np.float64)
    width = max(round(SMOOTH_S / float(np.median(np.diff(t)))), 1) | 1
    mean = np.ones(width) / width
    turning = np.gradient(Motion(path.t_ns, path.position_m, path.axes).pitch_rad(), t)
    changes = np.abs(np.gradient(np.convolve(turning, mean, "same"), t))
    acceleration = np.gradient(np.gradient(path.position_m, t, axis=0), t, axis=0)
    smooth = np.column_stack([np.convolve(column, mean, "same") for column in acceleration.T])
    off_s = 1e-9 * (off_ns - int(path.t_ns[0]))
    ends = (
        _quiet_ends(t, changes, changes, TURNS_RADPS2, TURNS_RADPS2, off_s),
        _quiet_ends(t, smooth[:, 2], np.linalg.norm(smooth, axis=1), BEGINS_MPS2, LEAVES_MPS2, off_s),
    )
    before = int(np.searchsorted(t, off_s - EARLIER_S))
    earlier_s = min(ends) if abs(turning[before]) < SLOW_RADPS else ends[0]  # a fast foot is lifted by its own roll
    return off_ns if earlier_s >= off_s else int(path.t_ns[0]) + round(earlier_s * NS_PER_S)


def _quiet_ends(t: FloatArray, x: FloatArray, size: FloatArray, begins: float, level: float, off_s: float) -> float:
    """When ``x`` begins to rise to ``level``, if it does so about the last ``EARLIER_S``.

    ``off_s`` if not, or if its size in all directions, ``size``, was not below ``level`` for ``QUIET_S`` before. What
    stays below ``level`` is a bump, and no end of the quiet.
    """
    first, last = (int(k) for k in np.searchsorted(t, (off_s - EARLIER_S, off_s + SMOOTH_S)))
    above = np.flatnonzero(x[first:last] >= level)
    if not len(above):
        return off_s
    at = first + int(above[0])
    while at > 0 and x[at - 1] >= begins:
        at -= 1
    if at == 0 or off_s - t[at] > EARLIER_S or (size[(t >= t[at] - QUIET_S) & (t < t[at])] >= level).any():
        return off_s
    share = (begins - float(x[at - 1])) / (float(x[at]) - float(x[at - 1]))
    return float(t[at - 1]) + share * float(t[at] - t[at - 1])


def _contact(path: FootPath, arms: FootArms, contact_ns: int) -> int:
    """Where the heel falls fastest, if that is well after the off-line IC."""
    t: FloatArray = np.asarray(1e-9 * (path.t_ns - contact_ns), dtype=np.float64)
    fall = descent(path, arms)
    first, last = (int(k) for k in np.searchsorted(t, DESCENT_S))
    if last - first < 3:
        return contact_ns
    at = first + int(np.argmin(fall[first:last]))
    late_s = _lowest_between(t, fall, at)
    if fall[at] > -LEAST_DESCENT_MPS or late_s <= SHOE_YIELDS_S:
        return contact_ns
    return contact_ns + round(late_s * min(late_s / SHOE_YIELDS_S - 1.0, 1.0) * NS_PER_S)


def descent(path: FootPath, arms: FootArms) -> FloatArray:
    """Vertical velocity of the heel (N,) in m/s, upward positive."""
    heel_m = path.position_m[:, 2] + path.tilt @ np.array(arms.heel_m)
    return np.asarray(np.gradient(heel_m, 1e-9 * (path.t_ns - path.t_ns[0])))


def _lowest_between(t: FloatArray, x: FloatArray, at: int) -> float:
    """Where ``x`` is least between samples: the vertex of the parabola through its least sample and the neighbours."""
    if not 0 < at < len(x) - 1:
        return float(t[at])
    before, here, after = (float(value) for value in x[at - 1 : at + 2])
    bend = before - 2.0 * here + after
    shift = 0.5 * (before - after) / bend if bend > 0.0 else 0.0
    return float(t[at]) + min(max(shift, -0.5), 0.5) * float(t[at + 1] - t[at])
