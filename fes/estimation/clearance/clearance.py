"""Clearance of sensor, toe and heel: the height of a point of the foot above where it stood, through its lever arm.

A point that sits ``arm`` away from the sensor (forward, left, up with the foot flat) is ``(R(t) - R(0)) arm`` higher
than the sensor's own path says, roll included: a sensor on the side of the shoe rises when the foot tips sideways.

Definitions. *Minimum toe clearance*: the lowest point between the toe's first peak after foot off and its last before
contact (Winter 1992, Phys. Ther. 72:45-53; Mariani et al. 2012, IEEE Trans. Biomed. Eng. 59:3162-3168, who name the
peaks maximal toe clearance 1 and 2). For a foot that does not dip, as many paretic ones, it is the toe's height at its
greatest horizontal speed, which is where Winter finds the minimum. *Maximal heel clearance*: the heel's greatest height
(Mariani et al.). Heights count from the starting stance.

Double integration leaves millimetres to a centimetre of slow height error in each stride. But at foot off the toe is on
the ground, and at contact the lowest point of the foot is: :class:`ContactLevels` says where a recording sees them then
on the whole, and each stride is shifted to agree, in proportion to time between contacts and stances.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from fes.config import FootGeometry
from fes.estimation.numerics.jit import inlined, jit_fused
from fes.estimation.numerics.records import Mat, Vec
from fes.estimation.numerics.rotation import to_world, up_in_sensor
from fes.estimation.strides.boundaries import UNSEEN_NS, index_at
from fes.signals import FloatArray, IntArray, Vector3

LEAST_DIP_M = 0.001  # shallower than that is no minimum between two peaks


@jit_fused
def reach(quaternion: Mat, arm: Vec, i: int) -> float:
    """How much higher than the sensor the point at ``arm`` (3,), in its frame, is at sample ``i``."""
    x, y, z = up_in_sensor(quaternion[i, 0], quaternion[i, 1], quaternion[i, 2], quaternion[i, 3])
    height: float = x * arm[0] + y * arm[1] + z * arm[2]
    return height


@jit_fused
def contacts_at(t_ns: Vec, begin: int, last: int, off_ns: int, contact_ns: int) -> tuple[int, int]:
    """The samples of foot off and, from there on, of contact; ``begin`` twice where they were not both seen."""
    if off_ns == UNSEEN_NS or contact_ns == UNSEEN_NS:
        return begin, begin
    off = index_at(t_ns, begin, last, off_ns)
    return off, index_at(t_ns, off, last, contact_ns)


@jit_fused
def all_contact_heights(
    t_ns: Vec, position: Mat, quaternion: Mat, spans: Mat, swings: Mat, toe_arm: Vec, heel_arm: Vec, out: Vec
) -> None:
    """Of K strides, rows ``spans``, ``swings`` (K, 2), fill ``out`` (K, 3), NaN where not both contacts were seen.

    That is the toe's height at foot off, that of the lower one of toe and heel at contact over the stance after, and
    the rise. ``toe_arm`` and ``heel_arm`` (3,) are in the sensor's frame.
    """
    for k in range(spans.shape[0]):
        begin, last = spans[k, 0], spans[k, 1] - 1
        off, contact = contacts_at(t_ns, begin, last, swings[k, 0], swings[k, 1])
        out[k, 0] = out[k, 1] = out[k, 2] = math.nan
        if begin < off < contact:
            toe, heel = reach(quaternion, toe_arm, last), reach(quaternion, heel_arm, last)
            toe_off, toe_first = reach(quaternion, toe_arm, off), reach(quaternion, toe_arm, begin)
            lower = min(reach(quaternion, toe_arm, contact) - toe, reach(quaternion, heel_arm, contact) - heel)
            out[k, 0] = position[off, 2] + (toe_off - toe_first)
            out[k, 1] = position[contact, 2] - position[last, 2] + lower
            out[k, 2] = position[last, 2] + 0.5 * (toe - toe_first + heel - reach(quaternion, heel_arm, begin))


@inlined
def drift_at(t: int, begin: int, off: int, contact: int, end: int, a: float, b: float, c: float) -> float:
    """What to add at an instant, in proportion to time between the four; times in ns."""
    if t < off:
        return a * (t - begin) / (off - begin)
    if t < contact:
        return a + (b + c - a) * (t - off) / (contact - off)
    return b + c - b * (t - contact) / (end - contact) if t < end else c


@jit_fused
def deepest(height: Vec, begin: int, end: int, after: Vec) -> tuple[int, float]:
    """Which of the samples ``begin`` … ``end - 1`` lies deepest below the lower of the peaks before and after it, and
    how deep; ``after`` is room for as many numbers as there are heights."""
    greatest = before = depth = -math.inf
    at = begin
    for i in range(end - 1, begin - 1, -1):
        greatest = max(greatest, height[i])
        after[i] = greatest
    for i in range(begin, end):
        before = max(before, height[i])
        below = min(before, after[i]) - height[i]
        if below > depth:
            at, depth = i, below
    return at, depth


@jit_fused
def fastest(t_ns: Vec, begin: int, n: int, level: Mat) -> int:
    """Which of ``n`` samples, in ``t_ns`` from ``begin`` on, has the greatest speed; ``level`` (N, 2): the places."""
    at, speed2 = 0, -math.inf
    for i in range(n):
        p, q = max(i - 1, 0), min(i + 1, n - 1)
        a, b = 1e-9 * (t_ns[begin + i] - t_ns[begin + p]), 1e-9 * (t_ns[begin + q] - t_ns[begin + i])
        total = 0.0
        for j in range(2):  # the parabola through three samples, at the ends the line through two
            back = (level[i, j] - level[p, j]) / a if i > 0 else 0.0
            forth = (level[q, j] - level[i, j]) / b if i < n - 1 else 0.0
            rate = (b * back + a * forth) / (a + b) if 0 < i < n - 1 else back + forth
            total += rate * rate
        if total > speed2:
            at, speed2 = i, total
    return at


@jit_fused
def all_clearances(
    t_ns: Vec, position: Mat, quaternion: Mat, spans: Mat, swings: Mat, toe_arm: Vec, heel_arm: Vec, drifts: Vec,
    toe: Vec, after: Vec, level: Mat, out: Vec,
) -> None:  # fmt: skip
    """Clearances of K strides, rows ``spans``, ``swings`` (K, 2); each fills a row of ``out`` (K, 6).

    That is the toe's minimum, its peaks before and after, the heel's and the sensor's greatest height, and 1 where the
    toe dips. The toe's are NaN without a swing of 3 samples. ``toe_arm`` and ``heel_arm`` (3,) are in the sensor's
    frame; ``drifts`` (K, 3) is what to add at foot off, at contact over the stance after, and there. ``toe``, ``after``
    (N,) and ``level`` (N, 2) are room for the longest stride.
    """
    tx, ty, tz, hx, hy, hz = toe_arm[0], toe_arm[1], toe_arm[2], heel_arm[0], heel_arm[1], heel_arm[2]
    for k in range(spans.shape[0]):
        begin, last = spans[k, 0], spans[k, 1] - 1
        off_ns, contact_ns, begin_ns, end_ns = swings[k, 0], swings[k, 1], t_ns[begin], t_ns[last]
        toe_first, heel_first = reach(quaternion, toe_arm, begin), reach(quaternion, heel_arm, begin)
        off, contact = contacts_at(t_ns, begin, last, off_ns, contact_ns)
        a, b, c = drifts[k, 0], drifts[k, 1], drifts[k, 2]
        shifted = a != 0.0 or b != 0.0 or c != 0.0
        heel_most = sensor_most = -math.inf
        for i in range(begin, last + 1):
            height = position[i, 2]
            if shifted:
                height += drift_at(t_ns[i], begin_ns, off_ns, contact_ns, end_ns, a, b, c)
            x, y, z = up_in_sensor(quaternion[i, 0], quaternion[i, 1], quaternion[i, 2], quaternion[i, 3])
            toe[i - begin] = height + (x * tx + y * ty + z * tz - toe_first)
            heel_most = max(heel_most, height + (x * hx + y * hy + z * hz - heel_first))
            sensor_most = max(sensor_most, height)
        lowest = toe_before = toe_after = math.nan
        dips, first, end = 0.0, off - begin, contact + 1 - begin
        if end - first >= 3:
            at, depth = deepest(toe, first, end, after)
            dips = 1.0 if depth >= LEAST_DIP_M else 0.0
            if depth < LEAST_DIP_M:
                for i in range(off, contact + 1):
                    x, y, _ = to_world(
                        quaternion[i, 0], quaternion[i, 1], quaternion[i, 2], quaternion[i, 3], tx, ty, tz
                    )  # fmt: skip
                    level[i - off, 0], level[i - off, 1] = position[i, 0] + x, position[i, 1] + y
                at = first + fastest(t_ns, off, end - first, level)
            lowest = toe_before = toe_after = toe[at]
            for j in range(first, at):
                toe_before = max(toe_before, toe[j])
            for j in range(at, end):
                toe_after = max(toe_after, toe[j])
        out[k, 0], out[k, 1], out[k, 2] = lowest, toe_before, toe_after
        out[k, 3], out[k, 4], out[k, 5] = heel_most, sensor_most, dips


CONTACT_SPREAD_M = 0.003  # how much the true contact heights differ between strides (markers: 2.6 to 3.3 mm)
MOST_DRIFT_M = 0.05  # what differs by more was no drift: a stumble, a kerb, another kind of step
LEVEL_GROUND_M = 0.01  # ground that rises by less per stride, on the whole, is taken for level
LEAST_STRIDES = 5  # for levels
TOE, BEFORE, AFTER, HEEL, SENSOR, DIPS = range(6)  # columns of :func:`clearances`
TRIM = 0.1  # share of the strides left out at either end when levels are averaged


@dataclass(frozen=True, slots=True, eq=False)
class FootPaths:
    """The paths of one foot's K strides as one: rows ``spans`` (K, 2) of ``t_ns`` (R,), ``position_m``, ``quaternion``.

    ``numbers`` (K,) are the strides', ``swings_ns`` (K, 2) foot off and contact, ``UNSEEN_NS`` for what was not seen.
    ``quaternion`` (R, 4) turns sensor vectors into the world; the columns of ``foot`` (3, 3) are the foot's forward,
    left and up in the sensor frame.
    """

    numbers: IntArray
    spans: IntArray
    swings_ns: IntArray
    t_ns: IntArray
    position_m: FloatArray
    quaternion: FloatArray
    foot: FloatArray

    def __len__(self) -> int:
        return len(self.numbers)

    @property
    def longest(self) -> int:
        """Samples of the longest one."""
        return int((self.spans[:, 1] - self.spans[:, 0]).max(initial=0))

    def places(self, numbers: IntArray) -> IntArray:
        """Where the strides of these numbers (S,), which have to be among them, stand."""
        return np.searchsorted(self.numbers, numbers)

    def chosen(self, places: IntArray) -> "FootPaths":
        """The paths at these places (S,) alone."""
        numbers, spans, swings_ns = (each[places] for each in (self.numbers, self.spans, self.swings_ns))
        return replace(self, numbers=numbers, spans=spans, swings_ns=swings_ns)


@dataclass(frozen=True, slots=True)
class FootArms:
    """Toe and heel seen from the sensor with the foot flat: forward, left, up (m)."""

    toe_m: Vector3
    heel_m: Vector3


def arms_of(geometry: FootGeometry) -> FootArms:
    """The arms of a session's geometry."""
    return FootArms(
        (geometry.toe_forward_m, geometry.toe_left_m, geometry.toe_up_m),
        (geometry.heel_forward_m, geometry.heel_left_m, geometry.heel_up_m),
    )


@dataclass(frozen=True, slots=True)
class ContactLevels:
    """Where a recording sees the toe at foot off and the foot's lowest point at contact, and how much it rises (m).

    Each against the stance that is nearer; ``rise_m`` is from one stance to the next. The weights (0 to 1) say how far
    to trust each: they are the share of the spread between strides that is error rather than gait.
    """

    foot_off_m: float
    contact_m: float
    rise_m: float
    foot_off_weight: float
    contact_weight: float
    rise_weight: float

    def drifts(self, heights: FloatArray) -> FloatArray:
        """What to add to the heights (K, 3) of :func:`contact_heights`; 0 where there are none."""
        off = np.array((self.foot_off_m, self.contact_m, self.rise_m)) - heights
        weights = np.array((self.foot_off_weight, self.contact_weight, self.rise_weight))
        return np.where(np.abs(off) <= MOST_DRIFT_M, weights * off, 0.0)


def contact_heights(paths: FootPaths, arms: FootArms) -> FloatArray:
    """Of each stride (K, 3) what :func:`contact_levels` are found from, NaN where not both contacts were seen.

    The height of the toe at foot off over the stance before; of the lower of toe and heel at contact over the next; and
    of the foot in the stance after over that before. So steps up and down do not make the first two differ.
    """
    toe, heel, out = paths.foot @ np.array(arms.toe_m), paths.foot @ np.array(arms.heel_m), np.empty((len(paths), 3))
    all_contact_heights(paths.t_ns, paths.position_m, paths.quaternion, paths.spans, paths.swings_ns, toe, heel, out)
    return out


def contact_levels(heights: FloatArray) -> ContactLevels | None:
    """Levels of one foot's recording, from all its :func:`contact_heights` (K, 3); None for fewer than five."""
    seen = heights[heights[:, 0] == heights[:, 0]]
    if len(seen) < LEAST_STRIDES:
        return None
    columns, cut = np.sort(seen.T), int(TRIM * len(seen))
    # a stumble or a turn must not shift the rest, and half the strides is too much to waste
    level = columns[:, cut : len(seen) - cut].mean(axis=1)
    spread = 1.4826 * np.median(np.abs(columns - np.median(columns, axis=1, keepdims=True)), axis=1)
    weight = 1.0 - np.minimum(CONTACT_SPREAD_M / np.maximum(spread, 1e-9), 1.0) ** 2
    off, contact, rises = level.tolist()
    return ContactLevels(off, contact, rises if abs(rises) > LEVEL_GROUND_M else 0.0, *weight.tolist())


def clearances(
    paths: FootPaths, arms: FootArms, levels: ContactLevels | None, heights: FloatArray | None = None
) -> FloatArray:
    """Heights of every stride above its starting stance (K, 6), m; the toe's are NaN without foot off or contact.

    The columns ``TOE``: the minimum toe clearance, or where the toe has no minimum between two peaks its height at its
    greatest horizontal speed; ``BEFORE`` and ``AFTER``: its greatest heights before and after that; ``HEEL`` and
    ``SENSOR``: the greatest of the stride; ``DIPS``: 1 where the toe has a minimum, else 0. They are shifted to the
    recording's contact ``levels`` if given. ``heights``: the strides' :func:`contact_heights` where already worked out.
    """
    out, drifts = np.empty((len(paths), 6)), np.zeros((len(paths), 3))
    if levels is not None:
        drifts = levels.drifts(contact_heights(paths, arms) if heights is None else heights)
    toe, heel, longest = paths.foot @ np.array(arms.toe_m), paths.foot @ np.array(arms.heel_m), paths.longest
    room = np.empty(longest), np.empty(longest), np.empty((longest, 2))
    all_clearances(
        paths.t_ns, paths.position_m, paths.quaternion, paths.spans, paths.swings_ns, toe, heel, drifts, *room, out
    )  # fmt: skip
    return out


def mid_swing(t_ns: IntArray, height_m: FloatArray, level_m: FloatArray) -> tuple[int, bool]:
    """The sample of the minimum toe clearance within a swing of at least 3 samples, and whether the toe dips there.

    ``height_m`` (N,) and ``level_m`` (N, 2) are the toe's height and horizontal place. The minimum is the sample that
    lies deepest below the lower of the peaks before and after it; without one, that of the greatest horizontal speed.
    """
    lowest, depth = deepest(np.ascontiguousarray(height_m), 0, len(t_ns), np.empty(len(t_ns)))
    if depth >= LEAST_DIP_M:
        return int(lowest), True
    return int(fastest(np.ascontiguousarray(t_ns), 0, len(t_ns), np.ascontiguousarray(level_m))), False
