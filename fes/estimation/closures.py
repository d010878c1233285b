"""What a sound sensor on a walking foot must give: from stance to stance, strapdown integration closes.

Between the quiet instants of two stances the orientation carries gravity to gravity, the velocity comes back to rest,
and the height to the ground (zero-velocity updates: Foxlin 2005; Skog et al. 2010). What is left over are a stride's
residuals; how they depend on what is assumed of the sensor tells what is wrong with it.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from fes.estimation.numerics.jit import inlined, jit_fused
from fes.estimation.numerics.rotation import from_gravity, to_world, turn_by
from fes.signals import G_MPS2, FloatArray, IntArray

LAG, GAIN, BIAS, SCALE = 0, 1, slice(2, 5), 5  # of a sensor's six assumed properties:
SOUND: Final = (0.0, 1.0, 0.0, 0.0, 0.0, 1.0)  # s, 1, rad/s three times, 1
RESIDUALS: Final = 6  # velocity forward, left, up (m/s), height (m), tilt forward, left (of gravity) at a stride's end
UPRIGHT_S: Final = 0.0401  # on either side of a border: the mean force there is gravity's direction


@inlined
def _row_at(t_s: FloatArray, at_s: float, near: int) -> int:
    """The row before an instant, looked for from a row nearby; the last but one at most."""
    row = min(near, t_s.size - 2)
    while row > 0 and t_s[row] > at_s:
        row -= 1
    while row < t_s.size - 2 and t_s[row + 1] <= at_s:
        row += 1
    return row


@inlined
def _force(t_s: FloatArray, acc: FloatArray, row: int, at_s: float) -> tuple[float, float, float]:
    """The force at an instant between a row and the next."""
    share = min(max((at_s - t_s[row]) / (t_s[row + 1] - t_s[row]), 0.0), 1.0)
    x = acc[row, 0] + share * (acc[row + 1, 0] - acc[row, 0])
    y = acc[row, 1] + share * (acc[row + 1, 1] - acc[row, 1])
    z = acc[row, 2] + share * (acc[row + 1, 2] - acc[row, 2])
    return x, y, z


@jit_fused
def _mean_force(t_s: FloatArray, acc: FloatArray, middle: int, lag_s: float) -> tuple[float, float, float]:
    """Direction of the mean force around a border, a unit vector; NaN where it has none."""
    low, high = middle, middle
    while low > 0 and t_s[middle] - t_s[low - 1] <= UPRIGHT_S:
        low -= 1
    while high < t_s.size - 1 and t_s[high + 1] - t_s[middle] <= UPRIGHT_S:
        high += 1
    x, y, z, row = 0.0, 0.0, 0.0, low
    for i in range(low, high + 1):
        row = _row_at(t_s, t_s[i] + lag_s, row)
        fx, fy, fz = _force(t_s, acc, row, t_s[i] + lag_s)
        x, y, z = x + fx, y + fy, z + fz
    size = math.sqrt(x * x + y * y + z * z)
    if not size > 0.0:
        return math.nan, math.nan, math.nan
    return x / size, y / size, z / size


@jit_fused
def close_stride(
    t_s: FloatArray, acc: FloatArray, gyr: FloatArray, first: int, last: int,
    sensor: FloatArray, axes: FloatArray, found: FloatArray,
) -> None:  # fmt: skip
    """One stride under one assumption; the heading of its start is arbitrary."""
    lag_s, per_gain, per_scale = sensor[0], 1.0 / sensor[1], 1.0 / sensor[5]
    x, y, z = _mean_force(t_s, acc, first, lag_s)
    qw, qx, qy, qz = from_gravity(x, y, z)
    px, py, pz, vx, vy, vz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    fx, fy, fz, row, step = 0.0, 0.0, 0.0, first, 0.0
    for i in range(first, last + 1):
        if i > first:
            step = t_s[i] - t_s[i - 1]
            p = 0.5 * (gyr[i, 0] + gyr[i - 1, 0]) - sensor[2]
            q = 0.5 * (gyr[i, 1] + gyr[i - 1, 1]) - sensor[3]
            r = 0.5 * (gyr[i, 2] + gyr[i - 1, 2]) - sensor[4]
            share = step * per_gain
            x = share * (axes[0, 0] * p + axes[0, 1] * q + axes[0, 2] * r)
            y = share * (axes[1, 0] * p + axes[1, 1] * q + axes[1, 2] * r)
            z = share * (axes[2, 0] * p + axes[2, 1] * q + axes[2, 2] * r)
            qw, qx, qy, qz = turn_by(qw, qx, qy, qz, x, y, z)
        row = _row_at(t_s, t_s[i] + lag_s, row)
        x, y, z = _force(t_s, acc, row, t_s[i] + lag_s)
        gx, gy, gz = to_world(qw, qx, qy, qz, per_scale * x, per_scale * y, per_scale * z)
        gz -= G_MPS2
        px += step * (vx + step * (2.0 * fx + gx) * (1 / 6))
        py += step * (vy + step * (2.0 * fy + gy) * (1 / 6))
        pz += step * (vz + step * (2.0 * fz + gz) * (1 / 6))
        vx += 0.5 * step * (fx + gx)
        vy += 0.5 * step * (fy + gy)
        vz += 0.5 * step * (fz + gz)
        fx, fy, fz = gx, gy, gz
    x, y, z = _mean_force(t_s, acc, last, lag_s)
    gx, gy, _ = to_world(qw, qx, qy, qz, x, y, z)
    length = math.sqrt(px * px + py * py)
    cosine, sine = (px / length, py / length) if length > 0.0 else (1.0, 0.0)
    found[0], found[1], found[2] = cosine * vx + sine * vy, cosine * vy - sine * vx, vz
    found[3], found[4], found[5] = pz, cosine * gx + sine * gy, cosine * gy - sine * gx


@jit_fused
def _close_all(
    t_s: FloatArray, acc: FloatArray, gyr: FloatArray, first: IntArray, last: IntArray,
    sensors: FloatArray, axes: FloatArray, found: FloatArray,
) -> None:  # fmt: skip
    for p in range(sensors.shape[0]):
        for k in range(first.size):
            close_stride(t_s, acc, gyr, first[k], last[k], sensors[p, k], axes[p], found[p, k])


def closures(
    samples: tuple[FloatArray, FloatArray, FloatArray],
    first: IntArray,
    last: IntArray,
    sensors: FloatArray,
    axes: FloatArray | None = None,
) -> FloatArray:
    """Residuals (P, K, 6) of K strides under P assumptions about the sensor.

    Args:
        samples: stamps (N,) in s, increasing; specific force (N, 3), m/s²; rate (N, 3), rad/s.
        first: (K,) row at which each stride begins.
        last: (K,) row at which it ends.
        sensors: (P, 6) or (P, K, 6), as ``SOUND``: the true force at t is what is read at t + lag, over the scale; the
            true rate is what is read less the bias, over the gain.
        axes: (P, 3, 3) takes that rate into the accelerometer's axes; None: they are the same.
    """
    count = len(sensors)
    full = np.empty((count, first.size, len(SOUND)))
    full[:] = sensors[:, None, :] if sensors.ndim == 2 else sensors
    turned = np.empty((count, 3, 3))
    turned[:] = np.eye(3) if axes is None else axes
    found = np.empty((count, first.size, RESIDUALS))
    _close_all(*samples, first, last, full, turned, found)
    return found
