"""Compiled heights of a foot's points over one stride; :mod:`fes.estimation.clearance` says what they are."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from fes.estimation.compiled import inlined, jit_ieee
from fes.estimation.rotation import to_world, up_in_sensor
from fes.estimation.stride_ends import rows_before
from fes.estimation.stride_time import UNSEEN_NS

LEAST_DIP_M = 0.001  # shallower than that is no minimum between two peaks
MOST_DRIFT_M = 0.05  # what differs by more was no drift: a stumble, a kerb, another kind of step


@jit_ieee
def index_at(t_ns: Any, at_ns: int) -> int:
    """The sample of (N,) at or after a time, the last if there is none."""
    return rows_before(t_ns, t_ns.shape[0] - 1, at_ns)


@inlined
def reach(quaternion: Any, arm: Any, i: int) -> float:
    """How much higher than the sensor the point at ``arm`` (3,), in its frame, is at sample ``i``."""
    x, y, z = up_in_sensor(quaternion[i, 0], quaternion[i, 1], quaternion[i, 2], quaternion[i, 3])
    height: float = x * arm[0] + y * arm[1] + z * arm[2]
    return height


@inlined
def height_at(position: Any, quaternion: Any, arm: Any, i: int) -> float:
    """Height at sample ``i`` of that point above its own start; sensor (N, 3), orientations (N, 4)."""
    height: float = position[i, 2] + (reach(quaternion, arm, i) - reach(quaternion, arm, 0))
    return height


@jit_ieee
def contacts_at(t_ns: Any, off_ns: int, contact_ns: int) -> tuple[int, int]:
    """The samples of foot off and contact, 0 and 0 where they were not both seen in this order."""
    if off_ns == UNSEEN_NS or contact_ns == UNSEEN_NS:
        return 0, 0
    off, contact = index_at(t_ns, off_ns), index_at(t_ns, contact_ns)
    return (off, contact) if 0 < off < contact else (0, 0)


@jit_ieee
def all_contact_heights(
    t_ns: Any, position: Any, quaternion: Any, spans: Any, swings: Any, toe_arm: Any, heel_arm: Any, out: Any, seen: Any
) -> None:
    """Of K strides, rows ``spans``, ``swings`` (K, 2), the heights of toe and heel at foot off and at contact, and the
    rise (K, 3), and whether both contacts were ``seen`` (K,)."""
    for k in range(spans.shape[0]):
        a, b = spans[k, 0], spans[k, 1]
        p, r, last = position[a:b], quaternion[a:b], b - a - 1
        off, contact = contacts_at(t_ns[a:b], swings[k, 0], swings[k, 1])
        seen[k] = off > 0
        if off > 0:
            toe, heel = height_at(p, r, toe_arm, last), height_at(p, r, heel_arm, last)
            out[k, 0] = height_at(p, r, toe_arm, off)
            out[k, 1] = min(height_at(p, r, toe_arm, contact) - toe, height_at(p, r, heel_arm, contact) - heel)
            out[k, 2] = 0.5 * (toe + heel)


@inlined
def drifts_of(toe_off: float, lower: float, rise: float, levels: Any) -> tuple[float, float, float]:
    """What to add to foot off, contact and rise; ``levels`` (6,): what they are in the recording, and their weights."""
    a, b, c = levels[0] - toe_off, levels[1] - lower, levels[2] - rise
    return (
        levels[3] * a if abs(a) <= MOST_DRIFT_M else 0.0,
        levels[4] * b if abs(b) <= MOST_DRIFT_M else 0.0,
        levels[5] * c if abs(c) <= MOST_DRIFT_M else 0.0,
    )


@inlined
def drift_at(t: int, begin: int, off: int, contact: int, end: int, a: float, b: float, c: float) -> float:
    """What to add at an instant, in proportion to time between the four; times in ns."""
    if t < off:
        return a * (t - begin) / (off - begin)
    if t < contact:
        return a + (b + c - a) * (t - off) / (contact - off)
    return b + c - b * (t - contact) / (end - contact) if t < end else c


@jit_ieee
def drift_correction(t_ns: Any, off_ns: int, contact_ns: int, toe: Any, heel: Any, levels: Any, out: Any) -> None:
    """Fill ``out`` (N,) with what to add to the heights; ``levels`` (6,): of foot off, contact, rise, their weights."""
    off, contact = contacts_at(t_ns, off_ns, contact_ns)
    a = b = c = 0.0
    last = t_ns.shape[0] - 1
    if off > 0:
        lower = min(toe[contact] - toe[last], heel[contact] - heel[last])
        a, b, c = drifts_of(toe[off], lower, 0.5 * (toe[last] + heel[last]), levels)
    for i in range(t_ns.shape[0]):
        out[i] = drift_at(t_ns[i], t_ns[0], off_ns, contact_ns, t_ns[last], a, b, c) if off > 0 else 0.0


@jit_ieee
def lowest_in_swing(t_ns: Any, height: Any, level: Any) -> tuple[int, bool]:
    """As :func:`fes.estimation.clearance.mid_swing`."""
    n = t_ns.shape[0]
    after = np.empty(n)
    greatest = -math.inf
    for i in range(n - 1, -1, -1):
        greatest = max(greatest, height[i])
        after[i] = greatest
    before, deepest, depth = -math.inf, 0, -math.inf
    for i in range(n):
        before = max(before, height[i])
        if min(before, after[i]) - height[i] > depth:
            deepest, depth = i, min(before, after[i]) - height[i]
    if depth >= LEAST_DIP_M:
        return deepest, True
    fastest, speed2 = 0, -math.inf
    for i in range(n):
        total = 0.0
        for j in range(2):
            if 0 < i < n - 1:  # the parabola through three samples
                a, b = 1e-9 * (t_ns[i] - t_ns[i - 1]), 1e-9 * (t_ns[i + 1] - t_ns[i])
                back, forth = (level[i, j] - level[i - 1, j]) / a, (level[i + 1, j] - level[i, j]) / b
                rate = (b * back + a * forth) / (a + b)
            else:
                k = min(max(i, 1), n - 1)
                rate = (level[k, j] - level[k - 1, j]) / (1e-9 * (t_ns[k] - t_ns[k - 1]))
            total += rate * rate
        if total > speed2:
            fastest, speed2 = i, total
    return fastest, False


@jit_ieee
def clear(
    t_ns: Any,
    position: Any,
    quaternion: Any,
    off_ns: int,
    contact_ns: int,
    toe_arm: Any,
    heel_arm: Any,
    levels: Any,
    out: Any,
) -> bool:
    """Fill ``out`` (5,): the toe's minimum, its peaks before and after, the heel's and the sensor's greatest height.

    ``toe_arm`` and ``heel_arm`` (3,) are in the sensor's frame; ``levels`` as for :func:`drift_correction`, or
    (0,): none. Returns whether the toe dips. The toe's are NaN without a swing of 3 samples.
    """
    n = t_ns.shape[0]
    last, off, contact = n - 1, 0, 0
    a = b = c = 0.0
    if levels.shape[0] > 0:
        off, contact = contacts_at(t_ns, off_ns, contact_ns)
    if off > 0:
        toe_last, heel_last = (
            height_at(position, quaternion, toe_arm, last),
            height_at(position, quaternion, heel_arm, last),
        )
        lower = min(
            height_at(position, quaternion, toe_arm, contact) - toe_last,
            height_at(position, quaternion, heel_arm, contact) - heel_last,
        )
        a, b, c = drifts_of(height_at(position, quaternion, toe_arm, off), lower, 0.5 * (toe_last + heel_last), levels)
    toe, toe_first, heel_first = np.empty(n), reach(quaternion, toe_arm, 0), reach(quaternion, heel_arm, 0)
    (tx, ty, tz), (hx, hy, hz) = (toe_arm[0], toe_arm[1], toe_arm[2]), (heel_arm[0], heel_arm[1], heel_arm[2])
    heel_most = sensor_most = -math.inf
    for i in range(n):
        height = position[i, 2]
        if off > 0:
            height += drift_at(t_ns[i], t_ns[0], off_ns, contact_ns, t_ns[last], a, b, c)
        x, y, z = up_in_sensor(quaternion[i, 0], quaternion[i, 1], quaternion[i, 2], quaternion[i, 3])
        toe[i] = height + (x * tx + y * ty + z * tz - toe_first)
        heel_most = max(heel_most, height + (x * hx + y * hy + z * hz - heel_first))
        sensor_most = max(sensor_most, height)
    out[:3] = math.nan
    out[3], out[4] = heel_most, sensor_most
    if off_ns == UNSEEN_NS or contact_ns == UNSEEN_NS:
        return False
    begin, end = index_at(t_ns, off_ns), index_at(t_ns, contact_ns) + 1
    if end - begin < 3:
        return False
    level = np.empty((end - begin, 2))
    for i in range(begin, end):
        x, y, _ = to_world(quaternion[i, 0], quaternion[i, 1], quaternion[i, 2], quaternion[i, 3], tx, ty, tz)
        level[i - begin, 0], level[i - begin, 1] = position[i, 0] + x, position[i, 1] + y
    lowest, dips = lowest_in_swing(t_ns[begin:end], toe[begin:end], level)
    lowest += begin
    out[0] = out[1] = out[2] = toe[lowest]
    for i in range(begin, lowest + 1):
        out[1] = max(out[1], toe[i])
    for i in range(lowest, end):
        out[2] = max(out[2], toe[i])
    return dips


@jit_ieee
def all_clear(
    t_ns: Any, position: Any, quaternion: Any, spans: Any, swings: Any, toe_arm: Any, heel_arm: Any, levels: Any,
    out: Any,
) -> None:  # fmt: skip
    """As :func:`clear` of K strides: rows ``spans``, ``swings`` (K, 2); ``out`` (K, 6), last whether it dips."""
    for k in range(spans.shape[0]):
        a, b = spans[k, 0], spans[k, 1]
        off, contact = swings[k, 0], swings[k, 1]
        dips = clear(t_ns[a:b], position[a:b], quaternion[a:b], off, contact, toe_arm, heel_arm, levels, out[k, :5])
        out[k, 5] = 1.0 if dips else 0.0
