"""Samples gathered into intervals of a few hundredths of a second, integrated at the full rate.

Source: Forster, Carlone, Dellaert and Scaramuzza (2017), "On-manifold preintegration for real-time visual-inertial
odometry": turn, velocity and displacement since an interval began, in the sensor frame of its beginning, do not depend
on where the filter then is, so they are integrated once, with all of the sensor's rate, and serve any number of filters
and settings. Departures:

- the accelerometer's bias adds ``mean`` to the first order, exactly, the gyroscope's through the mean orientation;
- the noise of every sample is kept with its moments in time: what it does to velocity and position by the interval's
  end, and what a false turn does to the velocity that follows it. So a heel strike weighs where it happened, and how
  long the intervals are hardly matters.

An interval ends where zero velocity begins and where it ends, and else when it has lasted long enough.

Settings of the ZUPT-aided filter, and what it knows before the first sample.
"""

import math
from typing import NamedTuple

import numpy as np

from fes.estimation.numerics.jit import inlined, jit_fused
from fes.estimation.numerics.records import Mat, Vec
from fes.estimation.numerics.rotation import turn_by
from fes.signals import BoolArray, FloatArray, IntArray, Vector3


class ZuptSettings(NamedTuple):
    """Noise of the filter; densities and correlation times, so that one setting holds at any sampling rate."""

    acc_noise_mps2_rthz: float = 0.02
    acc_scale_noise: float = 0.003  # share of the acceleration that is noise, per √Hz: scale errors, bandwidth
    rate_noise_radps_rthz: float = 0.002
    rate_scale_noise: float = 0.003  # the same of the rate
    acc_walk_mps2_rts: float = 2e-4
    rate_walk_radps_rts: float = 2e-5
    acc_bias_mps2: float = 0.15  # standard deviation at the start
    rate_bias_radps: float = 0.01
    tilt_rad: float = 0.05  # at the start, in stance …
    tilt_moving_rad: float = 0.4  # … and in movement
    start_speed_mps: float = 0.05  # at the start, in stance
    rest_speed_mps: float = 0.01  # how far the velocity of a resting foot is from the model's
    rest_speed_per_rate_m: float = 0.05  # … and how that grows with its rate
    rest_correlation_s: float = 0.1  # over which time that error stays the same
    rest_height_m: float = 0.01
    outlier_sigmas: float = 4.0  # a slow, even swing looks like rest: not if the foot is that sure to travel, …
    outlier_rest_s: float = 0.5  # … unless it lasts, …
    outlier_lost_s: float = 2.5  # … or nothing was measured for so long that it may be lost
    drift_speed_mps: float = 0.005  # a foot in stance still drifts on in the direction it came from, …
    drift_s: float = 1.0  # … for as long as a stance lasts
    lost_tilt_rad: float = 0.1  # how far the orientation may be off then
    jerk_mps3: float = 4000.0  # a force that changes faster was not followed by the accelerometer


@jit_fused
def start_variances(standing: bool, settings: ZuptSettings, out: Vec) -> None:
    """Variances (15,) of the state's errors before the first sample; heading is the frame's own choice."""
    tilt = settings.tilt_rad if standing else settings.tilt_moving_rad
    for j in range(3):
        out[j] = 0.0
        out[3 + j] = settings.start_speed_mps**2 if standing else 1.0
        out[6 + j] = tilt * tilt if j < 2 else 1e-10
        out[9 + j] = settings.rate_bias_radps * settings.rate_bias_radps
        out[12 + j] = settings.acc_bias_mps2 * settings.acc_bias_mps2


MOVING_NS = 44_500_000  # longest interval of a foot that moves, but for a sample, and …
RESTING_NS = 19_500_000  # … of one in stance: its velocity is measured at every interval's end
NOISES = 19  # columns of ``noise``


class Intervals(NamedTuple):
    """K intervals, the first of no length; vectors in the sensor frame in which one begins, the rate free of its bias.

    ``noise`` has the moments 0, 1, 2 in the time left (s) of the squared force and of what jolts and clipping may have
    missed, (m/s)²; the variance of the turn, rad²; the second moment of the force; the turn's variance times the
    velocity still to come, and times its products (xx, xy, xz, yy, yz, zz).
    """

    ends: IntArray  # (K,) the sample at which an interval ends
    turn: FloatArray  # (K, 4) quaternion from its end to its beginning
    push: FloatArray  # (K, 3) integral of the specific force, m/s
    shift: FloatArray  # (K, 3) and its second, m
    mean: FloatArray  # (K, 3, 3) integral of the orientation, s
    noise: FloatArray  # (K, 19)


def gather_intervals(
    t_ns: IntArray, acc: FloatArray, gyr: FloatArray, acc_sd: FloatArray, gyr_sd: FloatArray, zero_velocity: BoolArray,
    bias_radps: Vector3, *, per_sample: bool = False,
) -> Intervals:  # fmt: skip
    """The intervals of N samples: ``t_ns`` (N,), ``acc`` (N, 3) m/s², ``gyr`` (N, 3) rad/s, ``zero_velocity`` (N,).

    ``acc_sd``, ``gyr_sd`` (N,): extra standard deviation of clipped samples, m/s² and rad/s. ``per_sample``: every
    sample ends an interval.
    """
    longest_ns = (0, 0) if per_sample else (MOVING_NS, RESTING_NS)
    ends = np.empty(len(t_ns), np.int64)
    count = interval_ends(t_ns, zero_velocity, *longest_ns, ends)
    shapes = ((count, 4), (count, 3), (count, 3), (count, 3, 3), (count, NOISES))
    intervals = Intervals(ends[:count].copy(), *(np.empty(shape) for shape in shapes))
    gather(t_ns, acc, gyr, acc_sd, gyr_sd, *bias_radps, ZuptSettings(), intervals)
    return intervals


@jit_fused
def interval_ends(t_ns: Vec, zero_velocity: Vec, moving_ns: int, resting_ns: int, out: Vec) -> int:
    """Fill ``out`` (N,) with the last sample of every interval; how many there are."""
    count, n = 1, t_ns.shape[0]
    out[0] = 0
    for i in range(1, n):
        turns = zero_velocity[i] and (not zero_velocity[i - 1] or (i + 1 < n and not zero_velocity[i + 1]))
        lasted_ns = t_ns[i] - t_ns[out[count - 1]]
        if turns or i == n - 1 or lasted_ns >= (resting_ns if zero_velocity[i] else moving_ns):
            out[count] = i
            count += 1
    return count


@inlined
def matrix(
    w: float, x: float, y: float, z: float
) -> tuple[float, float, float, float, float, float, float, float, float]:
    """The rotation matrix of a quaternion, row by row."""
    a, b, c = 2.0 * x, 2.0 * y, 2.0 * z
    xx, yy, zz, xy, xz, yz, wx, wy, wz = a * x, b * y, c * z, a * y, a * z, b * z, a * w, b * w, c * w
    return 1.0 - (yy + zz), xy - wz, xz + wy, xy + wz, 1.0 - (xx + zz), yz - wx, xz - wy, yz + wx, 1.0 - (xx + yy)


@jit_fused
def gather(
    t_ns: Vec, acc: Mat, gyr: Mat, acc_sd: Vec, gyr_sd: Vec, bx: float, by: float, bz: float, settings: ZuptSettings,
    intervals: Intervals,
) -> None:  # fmt: skip
    """Fill all of the intervals but their ``ends``; arguments as for :func:`gather_intervals`."""
    rate_noise, scale_noise = settings.rate_noise_radps_rthz**2, settings.rate_scale_noise**2
    for k in range(1, intervals.ends.shape[0]):
        begin, end = intervals.ends[k - 1], intervals.ends[k]
        qw, qx, qy, qz = 1.0, 0.0, 0.0, 0.0
        m1 = m2 = m3 = m5 = m6 = m7 = 0.0  # the orientation's integral, by trapezoids
        m0 = m4 = m8 = 0.5e-9 * (t_ns[begin + 1] - t_ns[begin])
        fx0, fy0, fz0 = acc[begin, 0], acc[begin, 1], acc[begin, 2]
        vx = vy = vz = px = py = pz = sx = sy = sz = 0.0
        force_0 = force_1 = force_2 = missed_0 = missed_1 = missed_2 = tx = ty = tz = all_ = 0.0
        xx = xy = xz = yy = yz = zz = 0.0
        for i in range(begin + 1, end + 1):
            dt = 1e-9 * (t_ns[i] - t_ns[i - 1])
            wx = 0.5 * (gyr[i - 1, 0] + gyr[i, 0]) - bx
            wy = 0.5 * (gyr[i - 1, 1] + gyr[i, 1]) - by
            wz = 0.5 * (gyr[i - 1, 2] + gyr[i, 2]) - bz
            qw, qx, qy, qz = turn_by(qw, qx, qy, qz, wx * dt, wy * dt, wz * dt)
            b0, b1, b2, b3, b4, b5, b6, b7, b8 = matrix(qw, qx, qy, qz)
            gx, gy, gz = acc[i, 0], acc[i, 1], acc[i, 2]
            fx1, fy1, fz1 = b0 * gx + b1 * gy + b2 * gz, b3 * gx + b4 * gy + b5 * gz, b6 * gx + b7 * gy + b8 * gz
            fx, fy, fz = 0.5 * (fx0 + fx1), 0.5 * (fy0 + fy1), 0.5 * (fz0 + fz1)
            half = 0.5 * dt
            left = 1e-9 * (t_ns[end] - t_ns[i]) + half
            far = dt * left  # what is pushed goes on until the end
            px, py, pz = px + far * fx, py + far * fy, pz + far * fz
            vx, vy, vz = vx + dt * fx, vy + dt * fy, vz + dt * fz
            around = 0.5e-9 * (t_ns[min(i + 1, end)] - t_ns[i - 1])
            m0, m1, m2 = m0 + around * b0, m1 + around * b1, m2 + around * b2
            m3, m4, m5 = m3 + around * b3, m4 + around * b4, m5 + around * b5
            m6, m7, m8 = m6 + around * b6, m7 + around * b7, m8 + around * b8
            force2 = dt * (fx * fx + fy * fy + fz * fz)
            force_0 += force2
            force_1 += force2 * left
            force_2 += force2 * left * left
            jx, jy, jz = gx - acc[i - 1, 0], gy - acc[i - 1, 1], gz - acc[i - 1, 2]
            jump2, follows = jx * jx + jy * jy + jz * jz, settings.jerk_mps3 * dt
            clipped = acc_sd[i - 1] + acc_sd[i]
            if clipped > 0.0 or jump2 > follows * follows:
                beyond = max(math.sqrt(jump2) - follows, 0.0)
                # a interval somewhere within the interval: the trapezoid errs by up to half of it, evenly distributed
                missed = dt * dt * (0.25 * clipped * clipped + beyond * beyond / 12.0)
                missed_0 += missed
                missed_1 += missed * left
                missed_2 += missed * left * left
            late = far * left
            tx, ty, tz = tx + late * fx, ty + late * fy, tz + late * fz
            turned = (rate_noise + scale_noise * (wx * wx + wy * wy + wz * wz)) * dt
            clipped = gyr_sd[i - 1] + gyr_sd[i]
            if clipped > 0.0:
                turned += 0.25 * clipped * clipped * dt * dt
            all_ += turned
            ux, uy, uz = turned * vx, turned * vy, turned * vz
            sx, sy, sz = sx + ux, sy + uy, sz + uz
            xx, xy, xz = xx + ux * vx, xy + ux * vy, xz + ux * vz
            yy, yz, zz = yy + uy * vy, yz + uy * vz, zz + uz * vz
            fx0, fy0, fz0 = fx1, fy1, fz1
        intervals.turn[k, 0], intervals.turn[k, 1], intervals.turn[k, 2], intervals.turn[k, 3] = qw, qx, qy, qz
        intervals.push[k, 0], intervals.push[k, 1], intervals.push[k, 2] = vx, vy, vz
        intervals.shift[k, 0], intervals.shift[k, 1], intervals.shift[k, 2] = px, py, pz
        intervals.mean[k, 0, 0], intervals.mean[k, 0, 1], intervals.mean[k, 0, 2] = m0, m1, m2
        intervals.mean[k, 1, 0], intervals.mean[k, 1, 1], intervals.mean[k, 1, 2] = m3, m4, m5
        intervals.mean[k, 2, 0], intervals.mean[k, 2, 1], intervals.mean[k, 2, 2] = m6, m7, m8
        o = intervals.noise
        o[k, 0], o[k, 1], o[k, 2] = force_0, force_1, force_2
        o[k, 3], o[k, 4], o[k, 5], o[k, 6] = missed_0, missed_1, missed_2, all_
        o[k, 7], o[k, 8], o[k, 9] = tx, ty, tz
        # the velocity still to come is the whole less what came before
        o[k, 10], o[k, 11], o[k, 12] = vx * all_ - sx, vy * all_ - sy, vz * all_ - sz
        o[k, 13] = vx * vx * all_ - 2.0 * vx * sx + xx
        o[k, 14] = vx * vy * all_ - vx * sy - vy * sx + xy
        o[k, 15] = vx * vz * all_ - vx * sz - vz * sx + xz
        o[k, 16] = vy * vy * all_ - 2.0 * vy * sy + yy
        o[k, 17] = vy * vz * all_ - vy * sz - vz * sy + yz
        o[k, 18] = vz * vz * all_ - 2.0 * vz * sz + zz
