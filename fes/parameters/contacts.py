"""Foot off (FO) and initial contact (IC) of slow walks, set right by the way that the foot really went.

The off-line events (:mod:`fes.estimation.events_offline`) look at the mediolateral rate: FO is about the peak of
push-off, IC where the foot stops turning toe-up. In slow and in paretic gait these come apart from the ground's
contact: the foot stops turning long before it lands, and a weak foot that has been lifted turns toe-down once more as
it falls. The path of the stride shows both, and moves the event only where it clearly does:

- FO: a foot that rolls slowly over its forefoot hardly accelerates. Where that quiet lasted for ``QUIET_S`` and a jolt
  ends it shortly before the off-line FO, the jolt is FO. A brisk push-off is never that quiet, and keeps its event.
- IC: the heel falls faster and faster until the ground stops it: contact is its fastest descent after the off-line IC.
  A shoe gives way for a few hundredths of a second, so up to ``GIVES_WAY_S`` apart the off-line event (which agrees
  with optical markers) stays, beyond twice that the descent is believed, and in between the two are mixed.

No paper. The constants were chosen on virtual walks (benchmarks/parameters.py measures them on others, too). Against
the markers of one healthy adult (same benchmark) they add 1 ms to IC's mean and SD, and nothing to FO; of slow real
feet no true contacts were at hand.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fes.estimation.clearance import FootArms, FootPath
from fes.estimation.events_offline import GaitEvents
from fes.signals import NS_PER_S, FloatArray

JOLT_S = 0.04
JOLT_MPS2 = 1.5  # a change of the acceleration within JOLT_S that a foot does not show while it rolls over its forefoot
MOST_MPS2 = 2.0  # … and what it accelerates by at most
QUIET_S = 0.08  # it has to have done so for this long
EARLIER_S = 0.1  # and the jolt comes no earlier than this before the off-line FO
SMOOTH_S = 0.03  # mean of the acceleration: skin and shoe ring
GIVES_WAY_S = 0.02
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
        path: the stride's way at its own samples.
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
    """Where the quiet roll over the forefoot ends with a jolt, if it does so shortly before the off-line FO."""
    t = 1e-9 * (path.t_ns - path.t_ns[0])
    period_s = float(np.median(np.diff(t)))
    width, reach = max(round(SMOOTH_S / period_s), 1) | 1, max(round(0.5 * JOLT_S / period_s), 1)
    acceleration = np.gradient(np.gradient(path.position_m, t, axis=0), t, axis=0)
    smooth = np.column_stack([np.convolve(column, np.ones(width) / width, "same") for column in acceleration.T])
    change = np.zeros(len(t))
    change[reach:-reach] = np.linalg.norm(smooth[2 * reach :] - smooth[: -2 * reach], axis=1)
    jolted, brisk = change > JOLT_MPS2, np.linalg.norm(smooth, axis=1) > MOST_MPS2
    off_s = 1e-9 * (off_ns - int(path.t_ns[0]))
    first, last = (int(k) for k in np.searchsorted(t, (off_s - EARLIER_S, off_s)))
    if not jolted[first:last].any():
        return off_ns
    at = first + int(np.argmax(jolted[first:last]))
    before = slice(max(at - round(QUIET_S / period_s), 0), at)
    if jolted[before].any() or brisk[before].any():
        return off_ns
    # a difference over JOLT_S first sees a jolt that is about to come, by a quarter of it on average
    return min(int(path.t_ns[0]) + round((float(t[at]) + 0.25 * JOLT_S) * NS_PER_S), off_ns)


def _contact(path: FootPath, arms: FootArms, contact_ns: int) -> int:
    """Where the heel falls fastest, if that is well after the off-line IC."""
    t = 1e-9 * (path.t_ns - contact_ns)
    fall = descent(path, arms)
    first, last = (int(k) for k in np.searchsorted(t, DESCENT_S))
    if last - first < 3:
        return contact_ns
    at = first + int(np.argmin(fall[first:last]))
    late_s = float(t[at])
    if fall[at] > -LEAST_DESCENT_MPS or late_s <= GIVES_WAY_S:
        return contact_ns
    return contact_ns + round(late_s * min(late_s / GIVES_WAY_S - 1.0, 1.0) * NS_PER_S)


def descent(path: FootPath, arms: FootArms) -> FloatArray:
    """Vertical velocity of the heel (N,) in m/s, upward positive."""
    heel_m = path.position_m[:, 2] + path.tilt @ np.array(arms.heel_m)
    return np.asarray(np.gradient(heel_m, 1e-9 * (path.t_ns - path.t_ns[0])))
