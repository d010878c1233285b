"""Movements in a recording, before anything is known of phases: where one begins and ends, and where it leads."""

from __future__ import annotations

from typing import Any

import numpy as np

from fes.estimation.compiled import jit
from fes.estimation.rotation import from_gravity, to_sensor
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


def movements(energy: FloatArray, rate_hz: float, unrest: FloatArray | None = None) -> list[tuple[int, int]]:
    """Movements as long as a swing with its push-off and contact, from quietest instant to quietest instant around it.

    Indices (first, last), both ends included; the quietest instant is sought within a second of the movement: where
    ``unrest`` (N,) is least, or without it the ``energy`` (N,).
    """
    unrest = energy if unrest is None else unrest
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
        spans.append((int(before + np.argmin(unrest[before:begin])), int(end + np.argmin(unrest[end:after]))))
    return spans


def strapdown(
    t_ns: IntArray, acc: FloatArray, gyr: FloatArray, first: int, last: int, end_tilt_gain: float
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Times, specific force and orientation (n, 4) of one movement, upright at its start as gravity says."""
    quaternions = np.empty((last + 1 - first, 4))
    _strapdown(t_ns, acc, gyr, first, last, end_tilt_gain, quaternions)
    return t_ns[first : last + 1], acc[first : last + 1], quaternions


@jit
def _strapdown(t_ns: Any, acc: Any, gyr: Any, first: int, last: int, end_tilt_gain: float, out: Any) -> None:
    """Fill ``out`` (n, 4) as :func:`strapdown` says."""
    around = max((last - first) // 50, 1)
    x, y, z = _mean_force(acc, first - around, first + around + 1)
    start = np.array(from_gravity(x, y, z))
    x, y, z = _mean_force(acc, last - around, last + around + 1)
    orient(t_ns[first : last + 1], gyr[first : last + 1], start, x, y, z, end_tilt_gain, out)


@jit
def _mean_force(acc: Any, begin: int, end: int) -> tuple[float, float, float]:
    """Mean of the rows ``begin`` … ``end - 1``, as far as there are such rows."""
    begin, end = max(begin, 0), min(end, acc.shape[0])
    x = y = z = 0.0
    for i in range(begin, end):
        x += acc[i, 0]
        y += acc[i, 1]
        z += acc[i, 2]
    return x / (end - begin), y / (end - begin), z / (end - begin)


def travel(t_ns: IntArray, acc: FloatArray, gyr: FloatArray, first: int, last: int) -> FloatArray:
    """Displacement over one movement, in the sensor frame of its beginning (3,)."""
    out = np.zeros(3)
    _travel(t_ns, acc, gyr, first, last, True, out)
    return out


@jit
def _travel(t_ns: Any, acc: Any, gyr: Any, first: int, last: int, equal_height: bool, out: Any) -> None:
    """Fill ``out`` (3,) as :func:`travel` says; as it is where the movement cannot be integrated."""
    n = last + 1 - first
    quaternions, velocity, position, gamma = np.empty((n, 4)), np.empty((n, 3)), np.empty((n, 3)), np.zeros((2, 3))
    _strapdown(t_ns, acc, gyr, first, last, 1.0, quaternions)
    still, t, force = np.zeros(3), t_ns[first : last + 1], acc[first : last + 1]
    if integrate(t, force, quaternions, still, still, equal_height, velocity, position, gamma):
        x, y, z = position[n - 1, 0], position[n - 1, 1], position[n - 1, 2]
        w, qx, qy, qz = quaternions[0, 0], quaternions[0, 1], quaternions[0, 2], quaternions[0, 3]
        out[0], out[1], out[2] = to_sensor(w, qx, qy, qz, x, y, z)


def vertical_of(quaternions: FloatArray, vectors: FloatArray) -> FloatArray:
    """World z components (N,) of sensor vectors (N, 3) at orientations (N, 4)."""
    w, x, y, z = quaternions.T
    return np.asarray(
        2.0 * (x * z - w * y) * vectors[:, 0]
        + 2.0 * (y * z + w * x) * vectors[:, 1]
        + (1.0 - 2.0 * (x * x + y * y)) * vectors[:, 2]
    )
