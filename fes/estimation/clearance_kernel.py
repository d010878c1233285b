"""Compiled heights of a foot's points over one stride; :mod:`fes.estimation.clearance` says what they are."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from fes.estimation.compiled import jit
from fes.estimation.stride_ends import rows_before
from fes.estimation.stride_time import UNSEEN_NS

LEAST_DIP_M = 0.001  # shallower than that is no minimum between two peaks
MOST_DRIFT_M = 0.05  # what differs by more was no drift: a stumble, a kerb, another kind of step


@jit
def index_at(t_ns: Any, at_ns: int) -> int:
    """The sample of (N,) at or after a time, the last if there is none."""
    return rows_before(t_ns, t_ns.shape[0] - 1, at_ns)


@jit
def heights(position: Any, axes: Any, arm: Any, out: Any) -> None:
    """Height (N,) of the point at ``arm`` (3,) above its own start; sensor (N, 3), foot's axes (N, 3, 3), m."""
    x, y, z = axes[0, 2, 0], axes[0, 2, 1], axes[0, 2, 2]
    for i in range(position.shape[0]):
        out[i] = position[i, 2] + (
            (axes[i, 2, 0] - x) * arm[0] + (axes[i, 2, 1] - y) * arm[1] + (axes[i, 2, 2] - z) * arm[2]
        )


@jit
def contacts_of(t_ns: Any, off_ns: int, contact_ns: int, toe: Any, heel: Any, out: Any) -> bool:
    """Fill ``out`` (3,) from the heights of toe and heel (N,): foot off, contact, rise; whether both were seen."""
    if off_ns == UNSEEN_NS or contact_ns == UNSEEN_NS:
        return False
    off, contact, last = index_at(t_ns, off_ns), index_at(t_ns, contact_ns), t_ns.shape[0] - 1
    if not 0 < off < contact:
        return False
    out[0] = toe[off]
    out[1] = min(toe[contact] - toe[last], heel[contact] - heel[last])
    out[2] = 0.5 * (toe[last] + heel[last])
    return True


@jit
def contact_heights(
    t_ns: Any, position: Any, axes: Any, off_ns: int, contact_ns: int, toe_arm: Any, heel_arm: Any, out: Any
) -> bool:
    """As :func:`contacts_of`, from the arms (3,) of toe and heel."""
    toe, heel = np.empty(t_ns.shape[0]), np.empty(t_ns.shape[0])
    heights(position, axes, toe_arm, toe)
    heights(position, axes, heel_arm, heel)
    return contacts_of(t_ns, off_ns, contact_ns, toe, heel, out)


@jit
def all_contact_heights(
    t_ns: Any, position: Any, axes: Any, spans: Any, swings: Any, toe_arm: Any, heel_arm: Any, out: Any, seen: Any
) -> None:
    """As :func:`contact_heights` of K strides: rows ``spans``, ``swings`` (K, 2); ``out`` (K, 3), ``seen`` (K,)."""
    for k in range(spans.shape[0]):
        a, b = spans[k, 0], spans[k, 1]
        off, contact = swings[k, 0], swings[k, 1]
        seen[k] = contact_heights(t_ns[a:b], position[a:b], axes[a:b], off, contact, toe_arm, heel_arm, out[k])


@jit
def drift_correction(t_ns: Any, off_ns: int, contact_ns: int, toe: Any, heel: Any, levels: Any, out: Any) -> None:
    """Fill ``out`` (N,) with what to add to the heights; ``levels`` (6,): of foot off, contact, rise, their weights."""
    seen = np.empty(3)
    if not contacts_of(t_ns, off_ns, contact_ns, toe, heel, seen):
        out[:] = 0.0
        return
    for j in range(3):
        drift = levels[j] - seen[j]
        seen[j] = levels[3 + j] * drift if abs(drift) <= MOST_DRIFT_M else 0.0
    begin, end = t_ns[0], t_ns[t_ns.shape[0] - 1]
    for i in range(t_ns.shape[0]):
        if t_ns[i] < off_ns:
            out[i] = seen[0] * (t_ns[i] - begin) / (off_ns - begin)
        elif t_ns[i] < contact_ns:
            out[i] = seen[0] + (seen[1] + seen[2] - seen[0]) * (t_ns[i] - off_ns) / (contact_ns - off_ns)
        elif t_ns[i] < end:
            out[i] = seen[1] + seen[2] - seen[1] * (t_ns[i] - contact_ns) / (end - contact_ns)
        else:
            out[i] = seen[2]


@jit
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


@jit
def clear(
    t_ns: Any,
    position: Any,
    axes: Any,
    off_ns: int,
    contact_ns: int,
    toe_arm: Any,
    heel_arm: Any,
    levels: Any,
    out: Any,
) -> bool:
    """Fill ``out`` (5,): the toe's minimum, its peaks before and after, the heel's and the sensor's greatest height.

    ``levels`` as for :func:`drift_correction`, or (0,): none. Returns whether the toe dips. The toe's are NaN without
    a swing of 3 samples.
    """
    n = t_ns.shape[0]
    toe, heel, shift = np.empty(n), np.empty(n), np.zeros(n)
    heights(position, axes, toe_arm, toe)
    heights(position, axes, heel_arm, heel)
    if levels.shape[0] > 0:
        drift_correction(t_ns, off_ns, contact_ns, toe, heel, levels, shift)
    out[:3] = math.nan
    out[3] = out[4] = -math.inf
    for i in range(n):
        toe[i] += shift[i]
        out[3] = max(out[3], heel[i] + shift[i])
        out[4] = max(out[4], position[i, 2] + shift[i])
    if off_ns == UNSEEN_NS or contact_ns == UNSEEN_NS:
        return False
    begin, end = index_at(t_ns, off_ns), index_at(t_ns, contact_ns) + 1
    if end - begin < 3:
        return False
    level = np.empty((end - begin, 2))
    for i in range(begin, end):
        for j in range(2):
            level[i - begin, j] = position[i, j] + (
                axes[i, j, 0] * toe_arm[0] + axes[i, j, 1] * toe_arm[1] + axes[i, j, 2] * toe_arm[2]
            )
    lowest, dips = lowest_in_swing(t_ns[begin:end], toe[begin:end], level)
    lowest += begin
    out[0] = out[1] = out[2] = toe[lowest]
    for i in range(begin, lowest + 1):
        out[1] = max(out[1], toe[i])
    for i in range(lowest, end):
        out[2] = max(out[2], toe[i])
    return dips


@jit
def all_clear(
    t_ns: Any, position: Any, axes: Any, spans: Any, swings: Any, toe_arm: Any, heel_arm: Any, levels: Any, out: Any
) -> None:
    """As :func:`clear` of K strides: rows ``spans``, ``swings`` (K, 2); ``out`` (K, 6), last whether it dips."""
    for k in range(spans.shape[0]):
        a, b = spans[k, 0], spans[k, 1]
        off, contact = swings[k, 0], swings[k, 1]
        dips = clear(t_ns[a:b], position[a:b], axes[a:b], off, contact, toe_arm, heel_arm, levels, out[k, :5])
        out[k, 5] = 1.0 if dips else 0.0
