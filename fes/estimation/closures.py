"""What a sound sensor on a walking foot must give: from stance to stance, strapdown integration closes.

Between the quiet instants of two stances the orientation carries gravity to gravity, the velocity comes back to rest,
and the height to the ground (zero-velocity updates: Foxlin 2005; Skog et al. 2010). What is left over are a stride's
residuals; how they depend on what is assumed of the sensor tells what is wrong with it.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from fes.estimation.numerics.jit import inlined, jit
from fes.signals import G_MPS2, FloatArray, IntArray

LAG, GAIN, BIAS, SCALE = 0, 1, slice(2, 5), 5  # of a sensor's six assumed properties:
SOUND: Final = (0.0, 1.0, 0.0, 0.0, 0.0, 1.0)  # s, 1, rad/s three times, 1
RESIDUALS: Final = 6  # velocity forward, left, up (m/s), height (m), tilt forward, left (of gravity) at a stride's end
_UPRIGHT_S: Final = 0.0401  # on either side of a border: the mean force there is gravity's direction


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
def _force(t_s: FloatArray, acc: FloatArray, row: int, at_s: float, scale: float) -> tuple[float, float, float]:
    """The force at an instant between a row and the next."""
    share = min(max((at_s - t_s[row]) / (t_s[row + 1] - t_s[row]), 0.0), 1.0)
    x = acc[row, 0] + share * (acc[row + 1, 0] - acc[row, 0])
    y = acc[row, 1] + share * (acc[row + 1, 1] - acc[row, 1])
    z = acc[row, 2] + share * (acc[row + 1, 2] - acc[row, 2])
    return x / scale, y / scale, z / scale


@jit
def _mean_force(t_s: FloatArray, acc: FloatArray, middle: int, lag_s: float) -> tuple[float, float, float]:
    """Direction of the mean force around a border, a unit vector; NaN where it has none."""
    low, high = middle, middle
    while low > 0 and t_s[middle] - t_s[low - 1] <= _UPRIGHT_S:
        low -= 1
    while high < t_s.size - 1 and t_s[high + 1] - t_s[middle] <= _UPRIGHT_S:
        high += 1
    x, y, z, row = 0.0, 0.0, 0.0, low
    for i in range(low, high + 1):
        row = _row_at(t_s, t_s[i] + lag_s, row)
        fx, fy, fz = _force(t_s, acc, row, t_s[i] + lag_s, 1.0)
        x, y, z = x + fx, y + fy, z + fz
    size = math.sqrt(x * x + y * y + z * z)
    if not size > 0.0:
        return math.nan, math.nan, math.nan
    return x / size, y / size, z / size


@jit
def _upright(turn: FloatArray, x: float, y: float, z: float) -> None:
    """World from sensor, up along a unit vector of the sensor's, the heading arbitrary; rows are the world's axes."""
    ax, ay, az = (1.0 - x * x, -x * y, -x * z) if abs(x) < 0.6 else (-x * y, 1.0 - y * y, -y * z)
    size = math.sqrt(ax * ax + ay * ay + az * az)
    ax, ay, az = ax / size, ay / size, az / size
    turn[0, 0], turn[0, 1], turn[0, 2] = ax, ay, az
    turn[1, 0], turn[1, 1], turn[1, 2] = y * az - z * ay, z * ax - x * az, x * ay - y * ax
    turn[2, 0], turn[2, 1], turn[2, 2] = x, y, z


@jit
def _rotate(turn: FloatArray, x: float, y: float, z: float) -> None:
    """Turn on by a rotation vector in the sensor's axes (Rodrigues)."""
    angle2 = x * x + y * y + z * z
    angle = math.sqrt(angle2)
    sine = math.sin(angle) / angle if angle > 1e-9 else 1.0
    rest = (1.0 - math.cos(angle)) / angle2 if angle > 1e-9 else 0.5
    cosine = 1.0 - rest * angle2
    for row in range(3):
        a, b, c = turn[row, 0], turn[row, 1], turn[row, 2]
        along = rest * (a * x + b * y + c * z)
        turn[row, 0] = cosine * a + sine * (b * z - c * y) + along * x
        turn[row, 1] = cosine * b + sine * (c * x - a * z) + along * y
        turn[row, 2] = cosine * c + sine * (a * y - b * x) + along * z


@jit
def _close(
    t_s: FloatArray, acc: FloatArray, gyr: FloatArray, first: int, last: int,
    sensor: FloatArray, axes: FloatArray, turn: FloatArray, found: FloatArray,
) -> None:  # fmt: skip
    """One stride under one assumption; ``turn`` (3, 3) is room to work in."""
    lag_s, gain, scale = sensor[0], sensor[1], sensor[5]
    x, y, z = _mean_force(t_s, acc, first, lag_s)
    _upright(turn, x, y, z)
    px, py, pz, vx, vy, vz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    fx, fy, fz, row = 0.0, 0.0, 0.0, first
    for i in range(first, last + 1):
        step = t_s[i] - t_s[i - 1] if i > first else 0.0
        if i > first:
            p = 0.5 * (gyr[i, 0] + gyr[i - 1, 0]) - sensor[2]
            q = 0.5 * (gyr[i, 1] + gyr[i - 1, 1]) - sensor[3]
            r = 0.5 * (gyr[i, 2] + gyr[i - 1, 2]) - sensor[4]
            share = step / gain
            _rotate(
                turn,
                share * (axes[0, 0] * p + axes[0, 1] * q + axes[0, 2] * r),
                share * (axes[1, 0] * p + axes[1, 1] * q + axes[1, 2] * r),
                share * (axes[2, 0] * p + axes[2, 1] * q + axes[2, 2] * r),
            )
        row = _row_at(t_s, t_s[i] + lag_s, row)
        x, y, z = _force(t_s, acc, row, t_s[i] + lag_s, scale)
        gx = turn[0, 0] * x + turn[0, 1] * y + turn[0, 2] * z
        gy = turn[1, 0] * x + turn[1, 1] * y + turn[1, 2] * z
        gz = turn[2, 0] * x + turn[2, 1] * y + turn[2, 2] * z - G_MPS2
        px += step * (vx + step * (2.0 * fx + gx) / 6.0)
        py += step * (vy + step * (2.0 * fy + gy) / 6.0)
        pz += step * (vz + step * (2.0 * fz + gz) / 6.0)
        vx += 0.5 * step * (fx + gx)
        vy += 0.5 * step * (fy + gy)
        vz += 0.5 * step * (fz + gz)
        fx, fy, fz = gx, gy, gz
    x, y, z = _mean_force(t_s, acc, last, lag_s)
    gx = turn[0, 0] * x + turn[0, 1] * y + turn[0, 2] * z
    gy = turn[1, 0] * x + turn[1, 1] * y + turn[1, 2] * z
    length = math.sqrt(px * px + py * py)
    cosine, sine = (px / length, py / length) if length > 0.0 else (1.0, 0.0)
    found[0], found[1], found[2] = cosine * vx + sine * vy, cosine * vy - sine * vx, vz
    found[3], found[4], found[5] = pz, cosine * gx + sine * gy, cosine * gy - sine * gx


@jit
def _close_all(
    t_s: FloatArray, acc: FloatArray, gyr: FloatArray, first: IntArray, last: IntArray,
    sensors: FloatArray, axes: FloatArray, found: FloatArray,
) -> None:  # fmt: skip
    turn = np.empty((3, 3))
    for p in range(sensors.shape[0]):
        for k in range(first.size):
            _close(t_s, acc, gyr, first[k], last[k], sensors[p, k], axes[p], turn, found[p, k])


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
