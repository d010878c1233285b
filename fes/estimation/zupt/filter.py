"""ZUPT-aided navigation: the trajectory of a foot through a whole recording, forward; the smoother follows it back.

Source: Kumar et al., "Applying update using Kalman filter", after Fischer, Talkad Sukumar and Hazas (2013): strapdown
integration, and an error-state filter for which the velocity of a foot in stance is a measurement. Departures:

- fifteen states instead of nine: the biases of gyroscope and accelerometer are estimated too;
- the standing foot turns about where it touches the ground: its velocity is ``w × r``, not zero, with a given arm
  ``r``; and it drifts on in the direction in which it came for the first second, as optical recordings show;
- the measurement's noise grows with the rate, and samples that err alike count as one: neither a looser threshold nor a
  higher sampling rate makes the filter sure of what it cannot know;
- trapezoids; samples that clip, or jump faster than an accelerometer follows, count as noise;
- zero velocity at which the foot is sure to travel (beyond 4 standard deviations) is none: a slow, even swing reads
  like rest. Should it last, or nothing be measured for long, the filter is lost, and takes the measurement;
- the covariance goes from interval to interval (:mod:`fes.estimation.zupt.decimation`), with one measurement each.

Fixed-interval smoothing: Bierman (1973), "Fixed interval smoothing with discrete measurements": an adjoint vector runs
backwards through intervals and measurements; then Koopman (1993), "Disturbance smoother for state space models": the
start's error and each interval's noise are their own variance times the adjoint, carried forward. The estimates are
those of Rauch, Tung and Striebel, but no covariance, which may be nearly singular, is inverted or kept.
"""

import math
from typing import NamedTuple

import numpy as np

from fes.estimation.numerics.jit import inlined, jit_fused
from fes.estimation.numerics.records import Mat, Vec
from fes.estimation.numerics.rotation import from_gravity, quaternion_step, to_sensor, to_world
from fes.estimation.zupt.covariance import (
    ADDED,
    DIAGONAL,
    STATES,
    WIDTH,
    interval_noise,
    predict,
    propagate_error,
    spread_noise,
    update,
    update_velocity,
)
from fes.estimation.zupt.decimation import Intervals, ZuptSettings, matrix, start_variances
from fes.signals import G_MPS2, FloatArray, IntArray

MEASURED = 4  # velocity (3), height
LEAST_DISTANCE_M = 0.15  # of a stride that has a direction


class IntervalTape(NamedTuple):
    """What the filter leaves behind at the ends of K intervals; all from ``push`` on is for the smoother."""

    position: FloatArray  # (K, 3) m
    velocity: FloatArray  # (K, 3) m/s
    quaternions: FloatArray  # (K, 4)
    push: FloatArray  # (K, 3, 3) in the world, biases out: push, shift, and how much of the push is late
    mean: FloatArray  # (K, 3, 3) integral of the orientation in the world, s
    added: FloatArray  # (K, 16) what interval_noise says
    slot: IntArray  # (K,) row of the measurement, -1: none
    residual: FloatArray  # (M, 4) of velocity and height
    residual_var: FloatArray  # (M, 4), 0: not measured
    gain: FloatArray  # (M, 4, 15)


def new_tape(intervals: int, measured: int) -> IntervalTape:
    """An unwritten tape for K intervals, M of which end with a measurement: 0.4 kB each, and 0.5 kB a measurement."""
    k, m = intervals, (measured, MEASURED)
    position, velocity, quaternions = np.empty((k, 3)), np.empty((k, 3)), np.empty((k, 4))
    push, mean, added, slot = np.empty((k, 3, 3)), np.empty((k, 3, 3)), np.empty((k, ADDED)), np.empty(k, np.int64)
    measurements = np.empty(m), np.empty(m), np.empty((*m, STATES))
    return IntervalTape(position, velocity, quaternions, push, mean, added, slot, *measurements)


@jit_fused
def filter_intervals(
    t_ns: Vec, gyr: Mat, zero_velocity: Vec, intervals: Intervals, start_force: Vec, lever: Vec, bias: Vec, level: bool,
    settings: ZuptSettings, tape: IntervalTape,
) -> None:  # fmt: skip
    """Filter K intervals; every row of the tape then holds the state after the measurement at that interval's end.

    ``gyr`` (N, 3) rad/s; ``zero_velocity`` (N,); ``start_force`` (3,) is the specific force that says where up is at
    the first sample; ``lever`` (3,) reaches from the ground to the sensor (m, sensor frame); ``bias`` (3,) is what the
    intervals' rates were freed of; ``level``: the foot always stands at the same height.
    """
    ends = intervals.ends
    count = ends.shape[0]
    sample_ns = (t_ns[ends[count - 1]] - t_ns[0]) / (ends[count - 1])
    whole_ns = sample_ns if ends[count - 1] >= count else 0.0  # an interval of one sample stands for itself
    P = np.zeros(STATES * WIDTH)
    x, row, gain = np.zeros(STATES), np.empty(WIDTH), np.empty(6 * WIDTH)
    error, var = np.empty(3), np.empty(3)
    start_variances(zero_velocity[0], settings, x)
    for j in range(STATES):
        P[j * DIAGONAL] = x[j]
    q, m, r, f = np.empty(4), np.empty(9), tape.mean, tape.push
    q[0], q[1], q[2], q[3] = from_gravity(start_force[0], start_force[1], start_force[2])
    bg, ba, v, s = np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3)
    anchor, drift = np.zeros(2), np.zeros(2)  # where the last stance ended; how the foot drifts in this one
    stance_began_ns, measured_ns, measured = t_ns[0], t_ns[0], 0
    for k in range(count):
        i = ends[k]
        if k > 0:
            dt = 1e-9 * (t_ns[i] - t_ns[ends[k - 1]])
            _integrate(k, dt, intervals, m, r, f, s, v, q, bg, ba)
            interval_noise(k, intervals, m, f, dt, settings, tape.added)
            lasted = 1e-9 * (t_ns[i] - stance_began_ns) > settings.drift_s
            if zero_velocity[i] and lasted and measured_ns > stance_began_ns:
                # whoever stands seems to accelerate by noise alone, which shows no heading
                for j in range(3):
                    f[k, j, 0] = f[k, j, 1] = 0.0
            predict(P, k, r, f, dt, tape.added, settings)
        else:
            tape.added[k, ADDED - 1] = 0.0
        tape.slot[k] = -1
        believed = False
        if zero_velocity[i]:
            if k > 0 and not zero_velocity[i - 1]:
                stance_began_ns = t_ns[i]
                drift_velocity(s, anchor, settings.drift_speed_mps, drift)
            going = 1.0 if 1e-9 * (t_ns[i] - stance_began_ns) < settings.drift_s else 0.0
            ux, uy, uz = gyr[i, 0] - bias[0] - bg[0], gyr[i, 1] - bias[1] - bg[1], gyr[i, 2] - bias[2] - bg[2]
            rate2 = ux * ux + uy * uy + uz * uz
            ex, ey, ez = to_world(
                q[0], q[1], q[2], q[3],
                uy * lever[2] - uz * lever[1], uz * lever[0] - ux * lever[2], ux * lever[1] - uy * lever[0],
            )  # fmt: skip
            ex += going * drift[0]
            ey += going * drift[1]
            spread = settings.rest_speed_mps**2 + settings.rest_speed_per_rate_m**2 * rate2
            off2 = (ex - v[0]) ** 2 + (ey - v[1]) ** 2 + (ez - v[2]) ** 2
            sure = settings.outlier_sigmas**2 * (P[3 * DIAGONAL] + P[4 * DIAGONAL] + P[5 * DIAGONAL] + 3.0 * spread)
            lasted_s, lost_s = 1e-9 * (t_ns[i] - stance_began_ns), 1e-9 * (t_ns[i] - measured_ns)
            believed = off2 < sure or lasted_s > settings.outlier_rest_s or lost_s > settings.outlier_lost_s
            if believed and off2 >= sure:  # the filter was wrong, and more than it knew
                tape.added[k, ADDED - 1] = off2
                for j in range(3):
                    P[(3 + j) * DIAGONAL] += off2
                    P[(6 + j) * DIAGONAL] += settings.lost_tilt_rad**2
        if believed:
            measured_ns = t_ns[i]
            # half of the interval before and of the one after; neighbouring samples err alike: their information per
            # second is fixed, whatever the rate
            stands_ns = whole_ns
            if k > 0 and zero_velocity[i - 1]:
                stands_ns += t_ns[i] - t_ns[ends[k - 1]]
            if k + 1 < count and zero_velocity[i + 1]:
                stands_ns += t_ns[ends[k + 1]] - t_ns[i]
            alike = max(2e9 * settings.rest_correlation_s / max(stands_ns, sample_ns), 1.0)
            spread *= alike
            tape.slot[k] = measured
            error[0], error[1], error[2] = ex - v[0], ey - v[1], ez - v[2]
            update_velocity(P, x, error, spread, var, gain)
            for j in range(3):
                tape.residual[measured, j], tape.residual_var[measured, j] = error[j], var[j]
                for a in range(STATES):
                    tape.gain[measured, j, a] = gain[j * WIDTH + a]
            tape.residual_var[measured, 3] = 0.0
            if level:
                height, height_var = -s[2] - x[2], alike * settings.rest_height_m * settings.rest_height_m
                tape.residual[measured, 3] = height
                tape.residual_var[measured, 3] = update(P, x, 2, height, height_var, row, gain)
                for a in range(STATES):
                    tape.gain[measured, 3, a] = gain[a]
            measured += 1
            for j in range(3):
                s[j] += x[j]
                v[j] += x[3 + j]
                bg[j] += x[9 + j]
                ba[j] += x[12 + j]
            rotate_in_world(q, x[6], x[7], x[8], q)
            anchor[0], anchor[1] = s[0], s[1]
        for j in range(3):
            tape.position[k, j], tape.velocity[k, j] = s[j], v[j]
        for j in range(4):
            tape.quaternions[k, j] = q[j]


@jit_fused
def _integrate(
    k: int, dt: float, intervals: Intervals, m: Vec, r: Mat, f: Mat, s: Vec, v: Vec, q: Vec, bg: Vec, ba: Vec
) -> None:
    """Strapdown over interval ``k``: position, velocity and orientation, in place.

    Receive what the covariance needs, in the world: ``m`` (9,) the orientation before, and rows ``k`` of ``r``
    (K, 3, 3) its integral, ``f`` (K, 3, 3) push, shift, and how much of the push is late.
    """
    w, x, y, z = q[0], q[1], q[2], q[3]
    m0, m1, m2, m3, m4, m5, m6, m7, m8 = matrix(w, x, y, z)
    m[0], m[1], m[2], m[3], m[4], m[5], m[6], m[7], m[8] = m0, m1, m2, m3, m4, m5, m6, m7, m8
    px, py, pz = intervals.push[k, 0], intervals.push[k, 1], intervals.push[k, 2]
    b0, b1, b2 = m0 * px + m1 * py + m2 * pz, m3 * px + m4 * py + m5 * pz, m6 * px + m7 * py + m8 * pz
    px, py, pz = intervals.shift[k, 0], intervals.shift[k, 1], intervals.shift[k, 2]
    a0, a1, a2 = m0 * px + m1 * py + m2 * pz, m3 * px + m4 * py + m5 * pz, m6 * px + m7 * py + m8 * pz
    per = 1.0 / dt
    c0, c1, c2 = b0 - a0 * per, b1 - a1 * per, b2 - a2 * per
    hx = hy = hz = ex = ey = ez = 0.0
    for j in range(3):
        tx, ty, tz = intervals.mean[k, 0, j], intervals.mean[k, 1, j], intervals.mean[k, 2, j]
        tx, ty, tz = m0 * tx + m1 * ty + m2 * tz, m3 * tx + m4 * ty + m5 * tz, m6 * tx + m7 * ty + m8 * tz
        r[k, 0, j], r[k, 1, j], r[k, 2, j] = tx, ty, tz
        hx, hy, hz = hx + tx * bg[j], hy + ty * bg[j], hz + tz * bg[j]
        ex, ey, ez = ex + tx * ba[j], ey + ty * ba[j], ez + tz * ba[j]
    b0, b1, b2 = b0 + (c1 * hz - c2 * hy) - ex, b1 + (c2 * hx - c0 * hz) - ey, b2 + (c0 * hy - c1 * hx) - ez
    half = 0.5 * dt
    a0, a1, a2 = a0 - half * ex, a1 - half * ey, a2 - half * ez
    f[k, 0, 0], f[k, 0, 1], f[k, 0, 2] = b0, b1, b2
    f[k, 1, 0], f[k, 1, 1], f[k, 1, 2] = a0, a1, a2
    f[k, 2, 0], f[k, 2, 1], f[k, 2, 2] = c0, c1, c2
    s[0] += dt * v[0] + a0
    s[1] += dt * v[1] + a1
    s[2] += dt * (v[2] - half * G_MPS2) + a2
    v[0] += b0
    v[1] += b1
    v[2] += b2 - dt * G_MPS2
    tw, tx, ty, tz = intervals.turn[k, 0], intervals.turn[k, 1], intervals.turn[k, 2], intervals.turn[k, 3]
    q[0] = w * tw - x * tx - y * ty - z * tz
    q[1] = w * tx + x * tw + y * tz - z * ty
    q[2] = w * ty - x * tz + y * tw + z * tx
    q[3] = w * tz + x * ty - y * tx + z * tw
    rotate_in_world(q, -hx, -hy, -hz, q)


@inlined
def drift_velocity(s: Vec, anchor: Vec, speed: float, drift: Vec) -> None:
    """Velocity (2,) of a foot that has just come to stand at ``s``, on in the direction from where it stood before."""
    x, y = s[0] - anchor[0], s[1] - anchor[1]
    distance = math.sqrt(x * x + y * y)
    share = speed / distance if distance > LEAST_DISTANCE_M else 0.0
    drift[0], drift[1] = share * x, share * y


@inlined
def rotate_in_world(q: Vec, x: float, y: float, z: float, out: Vec) -> None:
    """``out = exp(psi) q`` for a world rotation vector."""
    rx, ry, rz = to_sensor(q[0], q[1], q[2], q[3], x, y, z)
    out[0], out[1], out[2], out[3] = quaternion_step(q[0], q[1], q[2], q[3], rx, ry, rz)


@jit_fused
def smooth_intervals(t_ns: Vec, ends: Vec, standing: bool, settings: ZuptSettings, tape: IntervalTape) -> None:
    """Smoothing, in place, of position, velocity and orientation that ``filter_intervals`` left."""
    count = ends.shape[0]
    adjoint = np.empty((count, STATES))
    _adjoints(t_ns, ends, tape, adjoint)
    dx, start = np.zeros(STATES), np.empty(STATES)
    start_variances(standing, settings, start)
    for a in range(STATES):
        dx[a] = -start[a] * adjoint[0, a]
    for k in range(count):
        if k > 0:
            dt = 1e-9 * (t_ns[ends[k]] - t_ns[ends[k - 1]])
            propagate_error(dx, k, tape.mean, tape.push, dt)
            spread_noise(k, dx, tape.added, adjoint, dt, settings)
        lost = tape.added[k, ADDED - 1]
        if lost > 0.0:
            for j in range(3):
                dx[3 + j] -= lost * adjoint[k, 3 + j]
                dx[6 + j] -= settings.lost_tilt_rad**2 * adjoint[k, 6 + j]
        m = tape.slot[k]
        if m >= 0:  # the filter has taken this correction already
            for j in range(MEASURED):
                if tape.residual_var[m, j] > 0.0:
                    for a in range(STATES):
                        dx[a] -= tape.gain[m, j, a] * tape.residual[m, j]
        for j in range(3):
            tape.position[k, j] += dx[j]
            tape.velocity[k, j] += dx[3 + j]
        q0, q1, q2, q3 = tape.quaternions[k, 0], tape.quaternions[k, 1], tape.quaternions[k, 2], tape.quaternions[k, 3]
        x, y, z = to_sensor(q0, q1, q2, q3, dx[6], dx[7], dx[8])
        q0, q1, q2, q3 = quaternion_step(q0, q1, q2, q3, x, y, z)
        tape.quaternions[k, 0], tape.quaternions[k, 1] = q0, q1
        tape.quaternions[k, 2], tape.quaternions[k, 3] = q2, q3


@inlined
def _adjoints(t_ns: Vec, ends: Vec, tape: IntervalTape, out: Mat) -> None:
    """The adjoint (K, 15) before each interval's measurement: what all that follows says of the error there."""
    x = np.zeros(STATES)
    for k in range(ends.shape[0] - 1, -1, -1):
        m = tape.slot[k]
        if m >= 0:
            for j in range(MEASURED - 1, -1, -1):  # last first
                variance = tape.residual_var[m, j]
                if variance > 0.0:
                    one = two = three = 0.0  # a third of the sum each, so that they do not wait for one another
                    for a in range(0, STATES, 3):
                        one += tape.gain[m, j, a] * x[a]
                        two += tape.gain[m, j, a + 1] * x[a + 1]
                        three += tape.gain[m, j, a + 2] * x[a + 2]
                    x[2 if j == 3 else 3 + j] -= tape.residual[m, j] / variance + (one + two + three)
        for a in range(STATES):
            out[k, a] = x[a]
        if k > 0:
            _propagate_back(k, x, tape.mean, tape.push, 1e-9 * (t_ns[ends[k]] - t_ns[ends[k - 1]]))


@inlined
def _propagate_back(k: int, x: Vec, r: Mat, f: Mat, dt: float) -> None:
    """``λ ← Φᵀ λ`` for the adjoint (15,) over interval ``k``."""
    p0, p1, p2, v0, v1, v2 = x[0], x[1], x[2], x[3], x[4], x[5]
    e0, e1, e2 = v0 + 0.5 * dt * p0, v1 + 0.5 * dt * p1, v2 + 0.5 * dt * p2
    h0 = x[6] + v2 * f[k, 2, 1] - v1 * f[k, 2, 2]
    h1 = x[7] + v0 * f[k, 2, 2] - v2 * f[k, 2, 0]
    h2 = x[8] + v1 * f[k, 2, 0] - v0 * f[k, 2, 1]
    for j in range(3):
        x[9 + j] -= r[k, 0, j] * h0 + r[k, 1, j] * h1 + r[k, 2, j] * h2
        x[12 + j] -= r[k, 0, j] * e0 + r[k, 1, j] * e1 + r[k, 2, j] * e2
    x[6] += f[k, 1, 1] * p2 - f[k, 1, 2] * p1 + f[k, 0, 1] * v2 - f[k, 0, 2] * v1
    x[7] += f[k, 1, 2] * p0 - f[k, 1, 0] * p2 + f[k, 0, 2] * v0 - f[k, 0, 0] * v2
    x[8] += f[k, 1, 0] * p1 - f[k, 1, 1] * p0 + f[k, 0, 0] * v1 - f[k, 0, 1] * v0
    x[3], x[4], x[5] = v0 + dt * p0, v1 + dt * p1, v2 + dt * p2
