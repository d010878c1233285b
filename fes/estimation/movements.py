"""Movements in a recording, before anything is known of phases: where one begins and ends, and where it leads."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from fes.estimation.compiled import inlined, jit
from fes.estimation.ranks import percentile
from fes.estimation.rotation import from_gravity, to_sensor
from fes.estimation.stride import integrate, orient
from fes.signals import G_MPS2, FloatArray, IntArray

SHORTEST_REST_S = 0.15
QUIET_SHARE = 0.12  # of the briskest rate: below, nothing moves
BACK = 0.3  # share of the tilt found at a movement's end that is taken back where no way is sought


def moving_mean(x: FloatArray, window: int) -> FloatArray:
    """Centred mean over ``window`` samples, (N,) → (N,)."""
    before, after = window // 2, window - window // 2
    total = np.zeros(len(x) + window)  # from ``before`` samples ahead of the first to ``after`` beyond the last
    inside = slice(before + 1, before + 1 + len(x))
    np.cumsum(x, out=total[inside])
    total[inside.stop :] = total[inside.stop - 1]
    index = np.arange(len(x))
    return np.asarray(
        (total[window:] - total[: len(x)]) / (np.minimum(before, index) + np.minimum(after, index[::-1] + 1))
    )


def movements(energy: FloatArray, rate_hz: float, unrest: FloatArray | None = None) -> list[tuple[int, int]]:
    """Movements as long as a swing with its push-off and contact, from quietest instant to quietest instant around it.

    Indices (first, last), both ends included; the quietest instant is sought within a second of the movement: where
    ``unrest`` (N,) is least, or without it the ``energy`` (N,).
    """
    unrest = energy if unrest is None else unrest
    level = QUIET_SHARE * math.sqrt(percentile(energy, 99.0))
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


@inlined
def _up(w: float, x: float, y: float, z: float) -> tuple[float, float, float]:
    """The world's vertical in the sensor frame."""
    return 2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)


@jit
def _left_over(t_ns: Any, acc: Any, gyr: Any, spans: Any, left: Any, effect_sum: Any) -> None:
    """Trapezoids, as in :mod:`fes.estimation.stride`, of the vertical alone."""
    for k in range(spans.shape[0]):
        first, n = spans[k, 0], spans[k, 1] + 1 - spans[k, 0]
        q = np.empty((n, 4))
        _strapdown(t_ns, acc, gyr, first, spans[k, 1], BACK, q)
        x0 = y0 = z0 = a0 = dt_s = 0.0
        speed = height = vx = vy = vz = hx = hy = hz = 0.0  # and what a bias along each axis does to the two
        for i in range(n):
            x, y, z = _up(q[i, 0], q[i, 1], q[i, 2], q[i, 3])
            a = x * acc[first + i, 0] + y * acc[first + i, 1] + z * acc[first + i, 2] - G_MPS2
            if i > 0:
                dt_s = 0.5e-9 * (t_ns[first + i] - t_ns[first + i - 1])
            gained, gx, gy, gz = dt_s * (a0 + a), dt_s * (x0 + x), dt_s * (y0 + y), dt_s * (z0 + z)
            height += dt_s * (2.0 * speed + gained)
            hx, hy, hz = hx + dt_s * (2.0 * vx + gx), hy + dt_s * (2.0 * vy + gy), hz + dt_s * (2.0 * vz + gz)
            speed, vx, vy, vz = speed + gained, vx + gx, vy + gy, vz + gz
            x0, y0, z0, a0 = x, y, z, a
        left[0] += speed
        left[1] += height
        effect_sum[0, 0] += vx
        effect_sum[0, 1] += vy
        effect_sum[0, 2] += vz
        effect_sum[1, 0] += hx
        effect_sum[1, 1] += hy
        effect_sum[1, 2] += hz


@jit
def _contact_jumps(t_ns: Any, acc: Any, gyr: Any, spans: Any, begins: Any, lag: int, out: Any) -> None:
    for k in range(spans.shape[0]):
        first, last = spans[k, 0], spans[k, 1]
        n = last + 1 - first
        quaternions, vertical = np.empty((n, 4)), np.empty(n)
        _strapdown(t_ns, acc, gyr, first, last, BACK, quaternions)
        for i in range(n):
            x, y, z = _up(quaternions[i, 0], quaternions[i, 1], quaternions[i, 2], quaternions[i, 3])
            vertical[i] = x * acc[first + i, 0] + y * acc[first + i, 1] + z * acc[first + i, 2]
        out[k] = math.nan
        for i in range(begins[k] - first + lag, n):
            jump = abs(vertical[i] - vertical[i - lag])
            if not jump <= out[k]:
                out[k] = jump
