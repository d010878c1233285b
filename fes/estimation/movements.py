"""Movements in a recording, before anything is known of phases: where one begins and ends, and where it leads."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from fes.estimation.compiled import jit
from fes.estimation.rotation import from_gravity, to_sensor
from fes.estimation.stride import double_integral, effects, integrate, orient
from fes.signals import FloatArray, IntArray

SHORTEST_REST_S = 0.15
QUIET_SHARE = 0.12  # of the briskest rate: below, nothing moves
BACK = 0.3  # share of the tilt found at a movement's end that is taken back where no way is sought


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
    starts, stops = begins[np.append(True, rests)].tolist(), ends[np.append(rests, True)].tolist()
    reach = round(rate_hz)
    spans = []
    for k, (begin, end) in enumerate(zip(starts, stops, strict=True)):
        if not 0.3 * rate_hz <= end - begin <= 3.0 * rate_hz or begin == 0 or end == len(energy):
            continue
        before = max(stops[k - 1] if k else 0, begin - reach)
        after = min(starts[k + 1] if k + 1 < len(starts) else len(energy), end + reach)
        spans.append((before + int(unrest[before:begin].argmin()), end + int(unrest[end:after].argmin())))
    return spans


@jit
def _strapdown(t_ns: Any, acc: Any, gyr: Any, first: int, last: int, end_tilt_gain: float, out: Any) -> None:
    """Fill ``out`` (n, 4) with the orientation in one movement, upright at its start as gravity says."""
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


def travels(t_ns: IntArray, acc: FloatArray, gyr: FloatArray, spans: IntArray) -> FloatArray:
    """Displacements (K, 3) over K movements (K, 2), each in the sensor frame of its beginning."""
    out = np.zeros((len(spans), 3))
    _travels(*_whole(t_ns, acc, gyr, spans), out)
    return out


def left_over(t_ns: IntArray, acc: FloatArray, gyr: FloatArray, spans: IntArray) -> tuple[FloatArray, FloatArray]:
    """What plain integration leaves over at the ends of K movements (K, 2), summed: vertical velocity and height (2,),
    and what a constant bias of the force does to each, (2, 3)."""
    left, effect = np.zeros(2), np.zeros((2, 3))
    _left_over(*_whole(t_ns, acc, gyr, spans), left, effect)
    return left, effect


def contact_jumps(
    t_ns: IntArray, acc: FloatArray, gyr: FloatArray, spans: IntArray, begins: IntArray, lag: int
) -> FloatArray:
    """Greatest change of the vertical force over ``lag`` samples (K,) from ``begins`` (K,) to the end of each movement
    (K, 2); NaN where that is too short."""
    out = np.empty(len(spans))
    _contact_jumps(*_whole(t_ns, acc, gyr, spans), begins, lag, out)
    return out


def _whole(
    t_ns: IntArray, acc: FloatArray, gyr: FloatArray, spans: IntArray
) -> tuple[IntArray, FloatArray, FloatArray, IntArray]:
    """As the compiled code knows them: C-contiguous."""
    contiguous = np.ascontiguousarray
    return contiguous(t_ns), contiguous(acc), contiguous(gyr), contiguous(spans)


@jit
def _travels(t_ns: Any, acc: Any, gyr: Any, spans: Any, out: Any) -> None:
    """Fill ``out`` (K, 3); a row stays as it is where the movement cannot be integrated."""
    still, gamma = np.zeros(3), np.zeros((2, 3))
    for k in range(spans.shape[0]):
        first, last = spans[k, 0], spans[k, 1]
        n = last + 1 - first
        quaternions, velocity, position = np.empty((n, 4)), np.empty((n, 3)), np.empty((n, 3))
        _strapdown(t_ns, acc, gyr, first, last, 1.0, quaternions)
        t, force = t_ns[first : last + 1], acc[first : last + 1]
        if integrate(t, force, quaternions, still, still, True, velocity, position, gamma):
            x, y, z = position[n - 1, 0], position[n - 1, 1], position[n - 1, 2]
            w, qx, qy, qz = quaternions[0, 0], quaternions[0, 1], quaternions[0, 2], quaternions[0, 3]
            out[k, 0], out[k, 1], out[k, 2] = to_sensor(w, qx, qy, qz, x, y, z)


@jit
def _left_over(t_ns: Any, acc: Any, gyr: Any, spans: Any, left: Any, effect_sum: Any) -> None:
    still, gamma = np.zeros(3), np.zeros((2, 3))
    for k in range(spans.shape[0]):
        first, last = spans[k, 0], spans[k, 1]
        n = last + 1 - first
        quaternions, velocity, position = np.empty((n, 4)), np.empty((n, 3)), np.empty((n, 3))
        _strapdown(t_ns, acc, gyr, first, last, BACK, quaternions)
        t, force, effect = t_ns[first : last + 1], acc[first : last + 1], np.zeros((4, 6))
        double_integral(t, force, quaternions, still, gamma, velocity, position)
        effects(t, quaternions, effect)
        left[0] += velocity[n - 1, 2]
        left[1] += position[n - 1, 2]
        for i in range(2):
            for j in range(3):
                effect_sum[i, j] += effect[2 + i, j]


@jit
def _contact_jumps(t_ns: Any, acc: Any, gyr: Any, spans: Any, begins: Any, lag: int, out: Any) -> None:
    for k in range(spans.shape[0]):
        first, last = spans[k, 0], spans[k, 1]
        n = last + 1 - first
        quaternions, vertical = np.empty((n, 4)), np.empty(n)
        _strapdown(t_ns, acc, gyr, first, last, BACK, quaternions)
        for i in range(n):
            w, x, y, z = quaternions[i, 0], quaternions[i, 1], quaternions[i, 2], quaternions[i, 3]
            vertical[i] = (
                2.0 * (x * z - w * y) * acc[first + i, 0]
                + 2.0 * (y * z + w * x) * acc[first + i, 1]
                + (1.0 - 2.0 * (x * x + y * y)) * acc[first + i, 2]
            )
        out[k] = math.nan
        for i in range(begins[k] - first + lag, n):
            jump = abs(vertical[i] - vertical[i - lag])
            if not jump <= out[k]:
                out[k] = jump
