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

What one stride's path shows besides is that of Wang et al. (2013), section 4.2, in the stride's own frame: origin and
orientation of its first sample, which is a mid-stance. Their MLR is written as rotation about the vertical; the heel's
lift is a rotation about the mediolateral axis, and that is what is taken here. Two neighbouring strides of one side are
stretched onto each other by dynamic time warping of their path along the walk, normalised to 0 … 1 (Sakoe & Chiba
1978), and PV and OV are the root mean square distances of position and orientation along the common, stretched time.
Orientation is a rotation vector here, so that the result depends on no order of angles.
"""

from dataclasses import dataclass

import numpy as np

from fes.estimation.clearance.clearance import FootArms, FootPath
from fes.estimation.events.offline import GaitEvents
from fes.estimation.numerics.jit import jit
from fes.estimation.strides.boundaries import UNSEEN_NS
from fes.signals import NS_PER_S, FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class Motion:
    """One stride: N samples from mid-stance to mid-stance.

    ``t_ns`` (N,); ``position_m`` (N, 3) of the sensor, z up, origin at the start; ``axes`` (N, 3, 3): columns are the
    foot's forward, left and up in the world.
    """

    t_ns: IntArray
    position_m: FloatArray
    axes: FloatArray

    def pitch_rad(self) -> FloatArray:
        """Rotation (N,) about the axis across the foot since the start, toe up positive; beyond a right angle too."""
        forward = self.axes[:, :, 0]
        level = np.hypot(forward[:, 0], forward[:, 1])
        # a foot whose up axis points down has passed the vertical
        angle = np.arctan2(forward[:, 2], np.where(self.axes[:, 2, 2] < 0.0, -level, level))
        return np.asarray(np.unwrap(angle) - angle[0])

    def own_frame_m(self) -> FloatArray:
        """Positions (N, 3): x along the stride, y to the left, z up; where it goes nowhere x is the toe's direction."""
        direction = self.position_m[-1, :2] - self.position_m[0, :2]
        length = float(np.hypot(*direction))
        if length < 0.05:
            direction, length = self.axes[0, :2, 0], float(np.hypot(*self.axes[0, :2, 0]))
        x, y = direction / max(length, 1e-9)
        turned = np.array([[x, y, 0.0], [-y, x, 0.0], [0.0, 0.0, 1.0]])
        return np.asarray((self.position_m - self.position_m[0]) @ turned.T)

    def orientation_rad(self) -> FloatArray:
        """Rotation vectors (N, 3) from the start, along the foot's own forward, left and up of the start."""
        return _rotation_vectors(np.einsum("ji,njk->nik", self.axes[0], self.axes))

    def deviation_m(self) -> float:
        """MDD: greatest sideways distance from the straight line of the stride."""
        return float(np.abs(self.own_frame_m()[:, 1]).max())

    def circumduction_m(self, side: str) -> float:
        """Greatest outward distance from that line; ``side`` is "left" or "right"."""
        return float((self.own_frame_m()[:, 1] * (1.0 if side == "left" else -1.0)).max())

    def heel_rotation_rad(self) -> float:
        """MLR: greatest toe-down rotation since the start."""
        return float(-self.pitch_rad().min())


def _rotation_vectors(r: FloatArray) -> FloatArray:
    """Axis times angle (N, 3) of rotation matrices (N, 3, 3)."""
    skew = 0.5 * np.stack((r[:, 2, 1] - r[:, 1, 2], r[:, 0, 2] - r[:, 2, 0], r[:, 1, 0] - r[:, 0, 1]), axis=1)
    sine, cosine = np.sqrt((skew * skew).sum(axis=1)), 0.5 * (np.einsum("nii->n", r) - 1.0)
    angle, turned = np.arctan2(sine, cosine), sine > 1e-6
    out = np.asarray(skew * np.where(turned, angle / np.where(turned, sine, 1.0), 1.0)[:, None])
    for k in np.flatnonzero(~turned & (cosine <= 0.0)):  # half a turn: the axis is a column of r + 1
        column = (r[k] + np.eye(3))[:, int(np.argmax(np.diag(r[k])))]
        out[k] = angle[k] * column / np.linalg.norm(column)
    return out


POINTS = 101


def variation(one: Motion, other: Motion) -> tuple[float, float]:
    """PV (m) and OV (rad) of two neighbouring strides of one side."""
    positions = [_resampled(stride.t_ns, stride.own_frame_m()) for stride in (one, other)]
    turns = [_resampled(stride.t_ns, stride.orientation_rad()) for stride in (one, other)]
    i, j = warped(_unit(positions[0][:, 0]), _unit(positions[1][:, 0]))
    position, orientation = (float(np.sqrt(np.mean(np.sum((b[j] - a[i]) ** 2, axis=1)))) for a, b in (positions, turns))
    return position, orientation


def _resampled(t_ns: IntArray, values: FloatArray) -> FloatArray:
    """The same (POINTS, 3) at equal steps of time."""
    t = (t_ns - t_ns[0]).astype(np.float64)
    at = np.linspace(0.0, t[-1], POINTS)
    return np.column_stack([np.interp(at, t, column) for column in values.T])


def _unit(values: FloatArray) -> FloatArray:
    low, high = float(values.min()), float(values.max())
    return np.asarray((values - low) / max(high - low, 1e-9))


def warped(one: FloatArray, other: FloatArray) -> tuple[IntArray, IntArray]:
    """Which sample of each waveform, (N,) and (M,), goes with which of the other, (L,) and (L,), from first to last."""
    pairs = _warp(np.ascontiguousarray(one, np.float64), np.ascontiguousarray(other, np.float64))
    return pairs[:, 0], pairs[:, 1]


@jit
def _warp(one: FloatArray, other: FloatArray) -> IntArray:
    n, m = len(one), len(other)
    cost = np.empty((n, m))
    for i in range(n):
        for j in range(m):
            here = abs(one[i] - other[j])
            if i == 0 and j == 0:
                cost[i, j] = here
            elif i == 0:
                cost[i, j] = here + cost[i, j - 1]
            elif j == 0:
                cost[i, j] = here + cost[i - 1, j]
            else:
                cost[i, j] = here + min(cost[i - 1, j - 1], cost[i - 1, j], cost[i, j - 1])
    pairs = np.empty((n + m, 2), np.int64)
    i, j, k = n - 1, m - 1, n + m - 1
    while True:
        pairs[k, 0], pairs[k, 1] = i, j
        if i == 0 and j == 0:
            break
        k -= 1
        if i == 0:
            j -= 1
        elif j == 0:
            i -= 1
        elif cost[i - 1, j - 1] <= cost[i - 1, j] and cost[i - 1, j - 1] <= cost[i, j - 1]:
            i, j = i - 1, j - 1
        elif cost[i - 1, j] <= cost[i, j - 1]:
            i -= 1
        else:
            j -= 1
    return pairs[k:]


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
    """One stride's foot off, mid-swing and initial contact (ns), and whether the heel struck first.

    ``heel_rise_ns`` is before, ``foot_flat_ns`` after them; ``UNSEEN_NS`` where not known.
    """

    foot_off_ns: int
    mid_swing_ns: int
    contact_ns: int
    heel_strike: bool
    heel_rise_ns: int = UNSEEN_NS
    foot_flat_ns: int = UNSEEN_NS


def swing_of(path: FootPath, events: GaitEvents, arms: FootArms | None) -> Swing | None:
    """The swing within a stride; None where the events show none, or more than one.

    ``events`` are of the same foot's whole recording; without ``arms``, where toe and heel are, IC stays where they put
    it.
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
    rise_ns, flat_ns = (UNSEEN_NS if t is None else int(t[at]) for t in (events.heel_rise_ns, events.foot_flat_ns))
    return Swing(_foot_off(path, off_ns), mid_ns, contact_ns, heel_strike, rise_ns, flat_ns)


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
    heel_m = path.position_m[:, 2] + path.tilt @ np.array(arms.heel_m)
    fall = np.asarray(np.gradient(heel_m, 1e-9 * (path.t_ns - path.t_ns[0])))  # m/s, upward positive
    first, last = (int(k) for k in np.searchsorted(t, DESCENT_S))
    if last - first < 3:
        return contact_ns
    at = first + int(np.argmin(fall[first:last]))
    late_s = _lowest_between(t, fall, at)
    if fall[at] > -LEAST_DESCENT_MPS or late_s <= SHOE_YIELDS_S:
        return contact_ns
    return contact_ns + round(late_s * min(late_s / SHOE_YIELDS_S - 1.0, 1.0) * NS_PER_S)


def _lowest_between(t: FloatArray, x: FloatArray, at: int) -> float:
    """Where ``x`` is least between samples: the vertex of the parabola through its least sample and the neighbours."""
    if not 0 < at < len(x) - 1:
        return float(t[at])
    before, here, after = (float(value) for value in x[at - 1 : at + 2])
    bend = before - 2.0 * here + after
    shift = 0.5 * (before - after) / bend if bend > 0.0 else 0.0
    return float(t[at]) + min(max(shift, -0.5), 0.5) * float(t[at + 1] - t[at])
