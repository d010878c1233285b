"""Movements in a recording, before anything is known of phases: where one begins and ends, and where it leads."""

from __future__ import annotations

import numpy as np

from fes.estimation.rotation import from_gravity, rotate
from fes.estimation.stride import integrate, orient
from fes.signals import FloatArray, IntArray

SHORTEST_REST_S = 0.15
QUIET_SHARE = 0.12  # of the briskest rate: below, nothing moves


def moving_mean(x: FloatArray, window: int) -> FloatArray:
    """Centred mean over ``window`` samples, (N,) → (N,)."""
    total = np.cumsum(np.concatenate(([0.0], x)))
    index = np.arange(len(x))
    begin = np.maximum(index - window // 2, 0)
    end = np.minimum(index - window // 2 + window, len(x))
    return np.asarray((total[end] - total[begin]) / (end - begin))


def movements(energy: FloatArray, rate_hz: float) -> list[tuple[int, int]]:
    """Movements as long as a swing with its push-off and contact, from quietest instant to quietest instant around it.

    Indices (first, last), both ends included; the quietest instant is sought within a second of the movement.
    """
    level = QUIET_SHARE * np.sqrt(np.percentile(energy, 99))
    moving = np.concatenate(([False], np.sqrt(energy) > level, [False]))
    edges = np.flatnonzero(moving[1:] != moving[:-1])
    if len(edges) == 0:  # a gyroscope that is switched off
        return []
    begins, ends = edges[0::2], edges[1::2]
    rests = begins[1:] - ends[:-1] >= SHORTEST_REST_S * rate_hz  # a shorter one is a turning point of the swing
    begins, ends = begins[np.append(True, rests)], ends[np.append(rests, True)]
    reach = round(rate_hz)
    spans = []
    for k, (begin, end) in enumerate(zip(begins, ends, strict=True)):
        if not 0.3 * rate_hz <= end - begin <= 3.0 * rate_hz or begin == 0 or end == len(energy):
            continue
        before = max(ends[k - 1] if k else 0, begin - reach)
        after = min(begins[k + 1] if k + 1 < len(begins) else len(energy), end + reach)
        spans.append((int(before + np.argmin(energy[before:begin])), int(end + np.argmin(energy[end:after]))))
    return spans


def strapdown(
    t_ns: IntArray, acc: FloatArray, gyr: FloatArray, first: int, last: int, end_tilt_gain: float
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Times, specific force and orientation (n, 4) of one movement, upright at its start as gravity says."""
    around = max((last - first) // 50, 1)
    t = np.ascontiguousarray(t_ns[first : last + 1])
    quaternions = np.empty((len(t), 4))
    start = np.array(from_gravity(*acc[max(first - around, 0) : first + around + 1].mean(axis=0)))
    fx, fy, fz = acc[max(last - around, 0) : last + around + 1].mean(axis=0)
    orient(t, gyr[first : last + 1], start, fx, fy, fz, end_tilt_gain, quaternions)
    return t, acc[first : last + 1], quaternions


def travel(t_ns: IntArray, acc: FloatArray, gyr: FloatArray, first: int, last: int) -> FloatArray:
    """Displacement over one movement, in the sensor frame of its beginning (3,)."""
    t, force, quaternions = strapdown(t_ns, acc, gyr, first, last, 1.0)
    velocity, position, gamma = np.empty((len(t), 3)), np.empty((len(t), 3)), np.zeros((2, 3))
    if not integrate(t, force, quaternions, np.zeros(3), np.zeros(3), True, velocity, position, gamma):
        return np.zeros(3)
    back = quaternions[0] * np.array([1.0, -1.0, -1.0, -1.0])
    return rotate(back, position[-1])


def vertical_of(quaternions: FloatArray, vectors: FloatArray) -> FloatArray:
    """World z components (N,) of sensor vectors (N, 3) at orientations (N, 4)."""
    w, x, y, z = quaternions.T
    return np.asarray(
        2.0 * (x * z - w * y) * vectors[:, 0]
        + 2.0 * (y * z + w * x) * vectors[:, 1]
        + (1.0 - 2.0 * (x * x + y * y)) * vectors[:, 2]
    )
