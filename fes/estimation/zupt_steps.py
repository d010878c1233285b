"""Samples gathered into the steps of the off-line ZUPT filter: what a Kalman filter needs of every few hundredths of a
second, integrated at the full rate.

Source: Forster, Carlone, Dellaert and Scaramuzza (2017), "On-manifold preintegration for real-time visual-inertial
odometry": turn, velocity and way since a step began, in the sensor frame of its beginning, do not depend on where the
filter then is, so they are integrated once, with all of the sensor's rate, and serve any number of filters and
settings. Departures:

- the accelerometer's bias adds ``mean`` to the first order, exactly, the gyroscope's through the mean orientation;
- the noise of every sample is kept with its moments in time: what it does to velocity and way by the step's end, and
  what a false turn does to the velocity that follows it. So a heel strike weighs where it happened, and how long the
  steps are hardly matters.

A step ends where a rest begins and where it ends, and else when it has lasted long enough.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from fes.estimation.compiled import jit
from fes.estimation.rotation import quaternion_step
from fes.estimation.zupt_kernel import ZuptSettings
from fes.signals import FloatArray, IntArray, Vector3

MOVING_NS = 44_500_000  # longest step of a foot that moves, but for a sample, and …
RESTING_NS = 19_500_000  # … of one that rests: its velocity is measured at every step's end
NOISES = 19  # columns of ``noise``
FORCE, MISSED, TURNED, FORCE_TWICE, CROSS, SQUARE = 0, 3, 6, 7, 10, 13  # where its parts begin


class Steps(NamedTuple):
    """K steps, the first of no length; vectors in the sensor frame in which a step begins, the rate free of ``bias``.

    ``noise`` has the moments 0, 1, 2 in the time left (s) of the squared force and of what jolts and clipping may have
    missed, (m/s)²; the variance of the turn, rad²; the second moment of the force; the turn's variance times the
    velocity still to come, and times its products (xx, xy, xz, yy, yz, zz).
    """

    ends: IntArray  # (K,) the sample at which a step ends
    turn: FloatArray  # (K, 4) quaternion from its end to its beginning
    push: FloatArray  # (K, 3) integral of the specific force, m/s
    shift: FloatArray  # (K, 3) and its second, m
    mean: FloatArray  # (K, 3, 3) integral of the orientation, s
    noise: FloatArray  # (K, 19)


@jit
def step_ends(t_ns: Any, rest: Any, moving_ns: int, resting_ns: int, out: Any) -> int:
    """Fill ``out`` (N,) with the last sample of every step; how many there are."""
    count, n = 1, t_ns.shape[0]
    out[0] = 0
    for i in range(1, n):
        turns = rest[i] and (not rest[i - 1] or (i + 1 < n and not rest[i + 1]))
        lasted_ns = t_ns[i] - t_ns[out[count - 1]]
        if turns or i == n - 1 or lasted_ns >= (resting_ns if rest[i] else moving_ns):
            out[count] = i
            count += 1
    return count


@jit
def matrix(w: float, x: float, y: float, z: float, out: Any) -> None:
    """The rotation matrix (3, 3) of a quaternion."""
    out[0, 0], out[0, 1], out[0, 2] = 1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)
    out[1, 0], out[1, 1], out[1, 2] = 2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)
    out[2, 0], out[2, 1], out[2, 2] = 2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)


@jit
def gather(
    t_ns: Any, acc: Any, gyr: Any, acc_sd: Any, gyr_sd: Any, bx: float, by: float, bz: float, p: ZuptSettings, s: Steps
) -> None:
    """Fill all of the steps but their ``ends``; arguments as for ``fes.estimation.zupt_kernel.forward``."""
    before, now = np.empty((3, 3)), np.empty((3, 3))
    square, mean, o = np.empty(6), np.empty((3, 3)), np.empty(NOISES)
    for k in range(1, s.ends.shape[0]):
        begin, end = s.ends[k - 1], s.ends[k]
        o[:] = 0.0
        mean[:, :] = 0.0
        square[:] = 0.0
        qw, qx, qy, qz = 1.0, 0.0, 0.0, 0.0
        matrix(qw, qx, qy, qz, before)
        fx0, fy0, fz0 = acc[begin, 0], acc[begin, 1], acc[begin, 2]
        vx = vy = vz = px = py = pz = sx = sy = sz = 0.0
        for i in range(begin + 1, end + 1):
            dt = 1e-9 * (t_ns[i] - t_ns[i - 1])
            wx = 0.5 * (gyr[i - 1, 0] + gyr[i, 0]) - bx
            wy = 0.5 * (gyr[i - 1, 1] + gyr[i, 1]) - by
            wz = 0.5 * (gyr[i - 1, 2] + gyr[i, 2]) - bz
            qw, qx, qy, qz = quaternion_step(qw, qx, qy, qz, wx * dt, wy * dt, wz * dt)
            matrix(qw, qx, qy, qz, now)
            gx, gy, gz = acc[i, 0], acc[i, 1], acc[i, 2]
            fx1 = now[0, 0] * gx + now[0, 1] * gy + now[0, 2] * gz
            fy1 = now[1, 0] * gx + now[1, 1] * gy + now[1, 2] * gz
            fz1 = now[2, 0] * gx + now[2, 1] * gy + now[2, 2] * gz
            fx, fy, fz = 0.5 * (fx0 + fx1), 0.5 * (fy0 + fy1), 0.5 * (fz0 + fz1)
            px += dt * (vx + 0.5 * dt * fx)
            py += dt * (vy + 0.5 * dt * fy)
            pz += dt * (vz + 0.5 * dt * fz)
            vx += dt * fx
            vy += dt * fy
            vz += dt * fz
            for a in range(3):
                for b in range(3):
                    mean[a, b] += 0.5 * dt * (before[a, b] + now[a, b])
                    before[a, b] = now[a, b]
            jx, jy, jz = gx - acc[i - 1, 0], gy - acc[i - 1, 1], gz - acc[i - 1, 2]
            beyond = max(math.sqrt(jx * jx + jy * jy + jz * jz) - p.jump_mps3 * dt, 0.0)
            # a step somewhere within the interval: the trapezoid errs by up to half of it, evenly distributed
            missed = dt * dt * (0.25 * (acc_sd[i - 1] + acc_sd[i]) ** 2 + beyond * beyond / 12.0)
            force2 = dt * (fx * fx + fy * fy + fz * fz)
            left = 1e-9 * (t_ns[end] - t_ns[i]) + 0.5 * dt
            o[FORCE] += force2
            o[FORCE + 1] += force2 * left
            o[FORCE + 2] += force2 * left * left
            o[MISSED] += missed
            o[MISSED + 1] += missed * left
            o[MISSED + 2] += missed * left * left
            o[FORCE_TWICE] += dt * left * left * fx
            o[FORCE_TWICE + 1] += dt * left * left * fy
            o[FORCE_TWICE + 2] += dt * left * left * fz
            rate2 = wx * wx + wy * wy + wz * wz
            turned = (p.rate_noise_radps_rthz**2 + p.rate_scale_noise**2 * rate2) * dt
            turned += 0.25 * (gyr_sd[i - 1] + gyr_sd[i]) ** 2 * dt * dt
            o[TURNED] += turned
            sx += turned * vx
            sy += turned * vy
            sz += turned * vz
            square[0] += turned * vx * vx
            square[1] += turned * vx * vy
            square[2] += turned * vx * vz
            square[3] += turned * vy * vy
            square[4] += turned * vy * vz
            square[5] += turned * vz * vz
            fx0, fy0, fz0 = fx1, fy1, fz1
        s.turn[k, 0], s.turn[k, 1], s.turn[k, 2], s.turn[k, 3] = qw, qx, qy, qz
        s.push[k, 0], s.push[k, 1], s.push[k, 2] = vx, vy, vz
        s.shift[k, 0], s.shift[k, 1], s.shift[k, 2] = px, py, pz
        for a in range(3):
            for b in range(3):
                s.mean[k, a, b] = mean[a, b]
        # the velocity still to come is the whole less what came before
        all_ = o[TURNED]
        o[CROSS], o[CROSS + 1], o[CROSS + 2] = vx * all_ - sx, vy * all_ - sy, vz * all_ - sz
        o[SQUARE] = vx * vx * all_ - 2.0 * vx * sx + square[0]
        o[SQUARE + 1] = vx * vy * all_ - vx * sy - vy * sx + square[1]
        o[SQUARE + 2] = vx * vz * all_ - vx * sz - vz * sx + square[2]
        o[SQUARE + 3] = vy * vy * all_ - 2.0 * vy * sy + square[3]
        o[SQUARE + 4] = vy * vz * all_ - vy * sz - vz * sy + square[4]
        o[SQUARE + 5] = vz * vz * all_ - 2.0 * vz * sz + square[5]
        for j in range(NOISES):
            s.noise[k, j] = o[j]


def steps_of(
    t_ns: IntArray,
    acc: FloatArray,
    gyr: FloatArray,
    acc_sd: FloatArray,
    gyr_sd: FloatArray,
    rest: np.ndarray[Any, np.dtype[np.bool_]],
    bias_radps: Vector3,
) -> Steps:
    """The steps of N samples: ``t_ns`` (N,), ``acc`` (N, 3) m/s², ``gyr`` (N, 3) rad/s, ``rest`` (N,).

    ``acc_sd``, ``gyr_sd`` (N,): extra standard deviation of clipped samples, m/s² and rad/s.
    """
    ends = np.empty(len(t_ns), np.int64)
    count = step_ends(t_ns, rest, MOVING_NS, RESTING_NS, ends)
    shapes = ((count, 4), (count, 3), (count, 3), (count, 3, 3), (count, NOISES))
    steps = Steps(ends[:count].copy(), *(np.empty(shape) for shape in shapes))
    gather(t_ns, acc, gyr, acc_sd, gyr_sd, *bias_radps, ZuptSettings(), steps)
    return steps
