"""Compiled heights of a foot's points over one stride; :mod:`fes.estimation.clearance` says what they are."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from fes.estimation.compiled import inlined, jit_fused
from fes.estimation.rotation import to_world, up_in_sensor
from fes.estimation.stride_time import UNSEEN_NS

LEAST_DIP_M = 0.001  # shallower than that is no minimum between two peaks


@jit_fused
def index_at(t_ns: Any, begin: int, last: int, at_ns: int) -> int:
    """Of the samples ``begin`` … ``last`` the first at or after a time, the last if there is none."""
    while begin < last:
        middle = (begin + last) >> 1
        if t_ns[middle] < at_ns:
            begin = middle + 1
        else:
            last = middle
    return last


@jit_fused
def reach(quaternion: Any, arm: Any, i: int) -> float:
    """How much higher than the sensor the point at ``arm`` (3,), in its frame, is at sample ``i``."""
    x, y, z = up_in_sensor(quaternion[i, 0], quaternion[i, 1], quaternion[i, 2], quaternion[i, 3])
    height: float = x * arm[0] + y * arm[1] + z * arm[2]
    return height


@jit_fused
def contacts_at(t_ns: Any, begin: int, last: int, off_ns: int, contact_ns: int) -> tuple[int, int]:
    """The samples of foot off and, from there on, of contact; ``begin`` twice where they were not both seen."""
    if off_ns == UNSEEN_NS or contact_ns == UNSEEN_NS:
        return begin, begin
    off = index_at(t_ns, begin, last, off_ns)
    return off, index_at(t_ns, off, last, contact_ns)


@jit_fused
def all_contact_heights(
    t_ns: Any, position: Any, quaternion: Any, spans: Any, swings: Any, toe_arm: Any, heel_arm: Any, out: Any
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
def deepest(height: Any, begin: int, end: int, after: Any) -> tuple[int, float]:
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
def fastest(t_ns: Any, begin: int, n: int, level: Any) -> int:
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
def lowest_in_swing(t_ns: Any, height: Any, level: Any) -> tuple[int, bool]:
    """As :func:`fes.estimation.clearance.mid_swing`."""
    n = t_ns.shape[0]
    at, depth = deepest(height, 0, n, np.empty(n))
    return (at, True) if depth >= LEAST_DIP_M else (fastest(t_ns, 0, n, level), False)


@jit_fused
def all_clear(
    t_ns: Any, position: Any, quaternion: Any, spans: Any, swings: Any, toe_arm: Any, heel_arm: Any, drifts: Any,
    toe: Any, after: Any, level: Any, out: Any,
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
