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

Compiled core of the off-line ZUPT filter: forwards over the steps of ``fes.estimation.zupt.decimated_filter``.

What is measured, when it is believed and with which noise is as in ``fes.estimation.zupt.filter``, which goes from
sample to sample; only that the covariance goes from step to step here, a few hundredths of a second at a time, and that
the velocity of a resting foot is measured once a step, for the time from the middle of one to that of the next.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from fes.estimation.numerics.jit import inlined, jit_fused
from fes.estimation.numerics.rotation import from_gravity, to_world, turn_by
from fes.estimation.zupt.covariance import BIASES, DIAGONAL, STATES, WIDTH, update, update_velocity
from fes.estimation.zupt.filter import MEASURED, ZuptSettings, drift_velocity, start_variances, turned
from fes.signals import G_MPS2, FloatArray, IntArray, Vector3

pass


MOVING_NS = 44_500_000  # longest step of a foot that moves, but for a sample, and …
RESTING_NS = 19_500_000  # … of one that rests: its velocity is measured at every step's end
NOISES = 19  # columns of ``noise``


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


@jit_fused
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


@jit_fused
def mean_at_rest(x: Any, rest: Any, out: Any) -> bool:
    """Fill ``out`` (3,) with the mean of the rows of ``x`` (N, 3) at ``rest`` (N,); False, and 0, if none is."""
    count, a, b, c = 0, 0.0, 0.0, 0.0
    for i in range(rest.shape[0]):
        if rest[i]:
            count += 1
            a, b, c = a + x[i, 0], b + x[i, 1], c + x[i, 2]
    per = 1.0 / max(count, 1)
    out[0], out[1], out[2] = a * per, b * per, c * per
    return count > 0


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
    t_ns: Any, acc: Any, gyr: Any, acc_sd: Any, gyr_sd: Any, bx: float, by: float, bz: float, p: ZuptSettings, s: Steps
) -> None:
    """Fill all of the steps but their ``ends``; arguments as for ``fes.estimation.zupt.filter.forward``."""
    rate_noise, scale_noise = p.rate_noise_radps_rthz**2, p.rate_scale_noise**2
    for k in range(1, s.ends.shape[0]):
        begin, end = s.ends[k - 1], s.ends[k]
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
            jump2, follows = jx * jx + jy * jy + jz * jz, p.jump_mps3 * dt
            clipped = acc_sd[i - 1] + acc_sd[i]
            if clipped > 0.0 or jump2 > follows * follows:
                beyond = max(math.sqrt(jump2) - follows, 0.0)
                # a step somewhere within the interval: the trapezoid errs by up to half of it, evenly distributed
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
        s.turn[k, 0], s.turn[k, 1], s.turn[k, 2], s.turn[k, 3] = qw, qx, qy, qz
        s.push[k, 0], s.push[k, 1], s.push[k, 2] = vx, vy, vz
        s.shift[k, 0], s.shift[k, 1], s.shift[k, 2] = px, py, pz
        s.mean[k, 0, 0], s.mean[k, 0, 1], s.mean[k, 0, 2] = m0, m1, m2
        s.mean[k, 1, 0], s.mean[k, 1, 1], s.mean[k, 1, 2] = m3, m4, m5
        s.mean[k, 2, 0], s.mean[k, 2, 1], s.mean[k, 2, 2] = m6, m7, m8
        o = s.noise
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


ADDED = 16  # of a step's noise, as step_noise leaves it


class IntervalTape(NamedTuple):
    """What the filter leaves behind at the ends of K steps; all from ``push`` on is for the smoother."""

    position: FloatArray  # (K, 3) m
    velocity: FloatArray  # (K, 3) m/s
    quaternions: FloatArray  # (K, 4)
    push: FloatArray  # (K, 3, 3) in the world, biases out: push, shift, and how much of the push is late
    mean: FloatArray  # (K, 3, 3) integral of the orientation in the world, s
    added: FloatArray  # (K, 16) what step_noise says
    slot: IntArray  # (K,) row of the measurement, -1: none
    residual: FloatArray  # (M, 4) of velocity and height
    residual_var: FloatArray  # (M, 4), 0: not measured
    gain: FloatArray  # (M, 4, 15)


def new_step_tape(steps: int, resting: int) -> IntervalTape:
    """An unwritten tape for K steps of which M end at rest: 0.4 kB a step, 0.5 kB more for one at rest."""
    k, m = steps, resting
    return IntervalTape(
        position=np.empty((k, 3)),
        velocity=np.empty((k, 3)),
        quaternions=np.empty((k, 4)),
        push=np.empty((k, 3, 3)),
        mean=np.empty((k, 3, 3)),
        added=np.empty((k, ADDED)),
        slot=np.empty(k, np.int64),
        residual=np.empty((m, MEASURED)),
        residual_var=np.empty((m, MEASURED)),
        gain=np.empty((m, MEASURED, STATES)),
    )


@jit_fused
def _carry_state(
    k: int, dt: float, steps: Steps, m: Any, r: Any, f: Any, s: Any, v: Any, q: Any, bg: Any, ba: Any
) -> None:
    """Strapdown over step ``k``: position, velocity and orientation, in place.

    Receive what the errors' way needs, in the world: ``m`` (9,) the orientation before, and rows ``k`` of ``r``
    (K, 3, 3) its integral, ``f`` (K, 3, 3) push, shift, and how much of the push is late.
    """
    w, x, y, z = q[0], q[1], q[2], q[3]
    m0, m1, m2, m3, m4, m5, m6, m7, m8 = matrix(w, x, y, z)
    m[0], m[1], m[2], m[3], m[4], m[5], m[6], m[7], m[8] = m0, m1, m2, m3, m4, m5, m6, m7, m8
    px, py, pz = steps.push[k, 0], steps.push[k, 1], steps.push[k, 2]
    b0, b1, b2 = m0 * px + m1 * py + m2 * pz, m3 * px + m4 * py + m5 * pz, m6 * px + m7 * py + m8 * pz
    px, py, pz = steps.shift[k, 0], steps.shift[k, 1], steps.shift[k, 2]
    a0, a1, a2 = m0 * px + m1 * py + m2 * pz, m3 * px + m4 * py + m5 * pz, m6 * px + m7 * py + m8 * pz
    per = 1.0 / dt
    c0, c1, c2 = b0 - a0 * per, b1 - a1 * per, b2 - a2 * per
    hx = hy = hz = ex = ey = ez = 0.0
    for j in range(3):
        tx, ty, tz = steps.mean[k, 0, j], steps.mean[k, 1, j], steps.mean[k, 2, j]
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
    tw, tx, ty, tz = steps.turn[k, 0], steps.turn[k, 1], steps.turn[k, 2], steps.turn[k, 3]
    q[0] = w * tw - x * tx - y * ty - z * tz
    q[1] = w * tx + x * tw + y * tz - z * ty
    q[2] = w * ty - x * tz + y * tw + z * tx
    q[3] = w * tz + x * ty - y * tx + z * tw
    turned(q, -hx, -hy, -hz, q)


@jit_fused
def forward_steps(
    t_ns: Any,
    gyr: Any,
    rest: Any,
    steps: Steps,
    start_force: Any,
    lever: Any,
    bias: Any,
    level: bool,
    p: ZuptSettings,
    tape: IntervalTape,
) -> None:
    """Filter K steps; every row of the tape then holds the state after the measurement at that step's end.

    ``bias`` (3,) is what the steps' rates were freed of; the others as for ``fes.estimation.zupt.filter.forward``.
    """
    ends = steps.ends
    count = ends.shape[0]
    sample_ns = (t_ns[ends[count - 1]] - t_ns[0]) / (ends[count - 1])
    P = np.zeros(STATES * WIDTH)
    x, row, gain = np.zeros(STATES), np.empty(WIDTH), np.empty(6 * WIDTH)
    error, var = np.empty(3), np.empty(3)
    start_variances(rest[0], p, x)
    for j in range(STATES):
        P[j * DIAGONAL] = x[j]
    q, m, r, f = np.empty(4), np.empty(9), tape.mean, tape.push
    q[0], q[1], q[2], q[3] = from_gravity(start_force[0], start_force[1], start_force[2])
    bg, ba, v, s = np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3)
    anchor, creep = np.zeros(2), np.zeros(2)  # where the last rest ended; how the foot creeps in this one
    rest_began_ns, measured_ns, measured = t_ns[0], t_ns[0], 0
    for k in range(count):
        i = ends[k]
        if k > 0:
            dt = 1e-9 * (t_ns[i] - t_ns[ends[k - 1]])
            _carry_state(k, dt, steps, m, r, f, s, v, q, bg, ba)
            step_noise(k, steps, m, f, dt, p, tape.added)
            if rest[i] and 1e-9 * (t_ns[i] - rest_began_ns) > p.drift_s and measured_ns > rest_began_ns:
                # whoever stands seems to accelerate by noise alone, which tells no heading
                for j in range(3):
                    f[k, j, 0] = f[k, j, 1] = 0.0
            predict_interval(P, k, r, f, dt, tape.added, p)
        else:
            tape.added[k, ADDED - 1] = 0.0
        tape.slot[k] = -1
        believed = False
        if rest[i]:
            if k > 0 and not rest[i - 1]:
                rest_began_ns = t_ns[i]
                drift_velocity(s, anchor, p.drift_speed_mps, creep)
            going = 1.0 if 1e-9 * (t_ns[i] - rest_began_ns) < p.drift_s else 0.0
            ux, uy, uz = gyr[i, 0] - bias[0] - bg[0], gyr[i, 1] - bias[1] - bg[1], gyr[i, 2] - bias[2] - bg[2]
            rate2 = ux * ux + uy * uy + uz * uz
            ex, ey, ez = to_world(
                q[0], q[1], q[2], q[3],
                uy * lever[2] - uz * lever[1], uz * lever[0] - ux * lever[2], ux * lever[1] - uy * lever[0],
            )  # fmt: skip
            ex += going * creep[0]
            ey += going * creep[1]
            spread = p.rest_speed_mps**2 + p.rest_speed_per_rate_m**2 * rate2
            off2 = (ex - v[0]) ** 2 + (ey - v[1]) ** 2 + (ez - v[2]) ** 2
            sure = p.outlier_sigmas**2 * (P[3 * DIAGONAL] + P[4 * DIAGONAL] + P[5 * DIAGONAL] + 3.0 * spread)
            lasted_s, lost_s = 1e-9 * (t_ns[i] - rest_began_ns), 1e-9 * (t_ns[i] - measured_ns)
            believed = off2 < sure or lasted_s > p.outlier_rest_s or lost_s > p.outlier_lost_s
            if believed and off2 >= sure:  # the filter was wrong, and more than it knew
                tape.added[k, ADDED - 1] = off2
                for j in range(3):
                    P[(3 + j) * DIAGONAL] += off2
                    P[(6 + j) * DIAGONAL] += p.lost_tilt_rad**2
        if believed:
            measured_ns = t_ns[i]
            # half of the step before and of the one after; neighbouring samples err alike: their information per
            # second is fixed, whatever the rate
            stands_ns = sample_ns
            if k > 0 and rest[i - 1]:
                stands_ns += t_ns[i] - t_ns[ends[k - 1]]
            if k + 1 < count and rest[i + 1]:
                stands_ns += t_ns[ends[k + 1]] - t_ns[i]
            alike = max(2e9 * p.rest_correlation_s / stands_ns, 1.0)
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
                height, doubt = -s[2] - x[2], alike * p.rest_height_m * p.rest_height_m
                tape.residual[measured, 3] = height
                tape.residual_var[measured, 3] = update(P, x, 2, height, doubt, row, gain)
                for a in range(STATES):
                    tape.gain[measured, 3, a] = gain[a]
            measured += 1
            for j in range(3):
                s[j] += x[j]
                v[j] += x[3 + j]
                bg[j] += x[9 + j]
                ba[j] += x[12 + j]
            turned(q, x[6], x[7], x[8], q)
            anchor[0], anchor[1] = s[0], s[1]
        for j in range(3):
            tape.position[k, j], tape.velocity[k, j] = s[j], v[j]
        for j in range(4):
            tape.quaternions[k, j] = q[j]


@inlined
def _carry(x: Any, out: Any, along: int, across: int, count: int, k: int, r: Any, f: Any, dt: float) -> None:
    """``Φ x`` for ``count`` vectors ``x`` in flat storage, as ``fes.estimation.zupt.covariance.carrier``; what comes
    out is laid out like what goes in.

    Of step ``k``, ``r`` (K, 3, 3) is ``R``, and the rows of ``f`` (K, 3, 3) are ``b``, ``a`` and ``c``.
    """
    b0, b1, b2 = f[k, 0, 0], f[k, 0, 1], f[k, 0, 2]
    a0, a1, a2 = f[k, 1, 0], f[k, 1, 1], f[k, 1, 2]
    c0, c1, c2 = f[k, 2, 0], f[k, 2, 1], f[k, 2, 2]
    r00, r01, r02 = r[k, 0, 0], r[k, 0, 1], r[k, 0, 2]
    r10, r11, r12 = r[k, 1, 0], r[k, 1, 1], r[k, 1, 2]
    r20, r21, r22 = r[k, 2, 0], r[k, 2, 1], r[k, 2, 2]
    for i in range(count):
        o = i * across
        v0, v1, v2 = x[o + 3 * along], x[o + 4 * along], x[o + 5 * along]
        s0, s1, s2 = x[o + 6 * along], x[o + 7 * along], x[o + 8 * along]
        g0, g1, g2 = x[o + 9 * along], x[o + 10 * along], x[o + 11 * along]
        d0, d1, d2 = x[o + 12 * along], x[o + 13 * along], x[o + 14 * along]
        e0 = r00 * d0 + r01 * d1 + r02 * d2
        e1 = r10 * d0 + r11 * d1 + r12 * d2
        e2 = r20 * d0 + r21 * d1 + r22 * d2
        h0 = r00 * g0 + r01 * g1 + r02 * g2
        h1 = r10 * g0 + r11 * g1 + r12 * g2
        h2 = r20 * g0 + r21 * g1 + r22 * g2
        out[o] = x[o] + dt * (v0 - 0.5 * e0) + (s1 * a2 - s2 * a1)
        out[o + along] = x[o + along] + dt * (v1 - 0.5 * e1) + (s2 * a0 - s0 * a2)
        out[o + 2 * along] = x[o + 2 * along] + dt * (v2 - 0.5 * e2) + (s0 * a1 - s1 * a0)
        out[o + 3 * along] = v0 - e0 + (s1 * b2 - s2 * b1) + (c1 * h2 - c2 * h1)
        out[o + 4 * along] = v1 - e1 + (s2 * b0 - s0 * b2) + (c2 * h0 - c0 * h2)
        out[o + 5 * along] = v2 - e2 + (s0 * b1 - s1 * b0) + (c0 * h1 - c1 * h0)
        out[o + 6 * along] = s0 - h0
        out[o + 7 * along] = s1 - h1
        out[o + 8 * along] = s2 - h2


@jit_fused
def carry_one_interval(x: Any, k: int, r: Any, f: Any, dt: float) -> None:
    """``x ← Φ x`` of step ``k`` for an error (15,)."""
    _carry(x, x, 1, STATES, 1, k, r, f, dt)


@jit_fused
def predict_interval(P: Any, k: int, r: Any, f: Any, dt: float, q: Any, p: ZuptSettings) -> None:
    """``P ← Φ P Φᵀ + Q`` for a symmetric ``P``, 15 rows of 16 in flat storage; ``q`` (K, 16) as of ``step_noise``.

    ``Φ P`` is made for a row's elements side by side; of ``(Φ P) Φᵀ``, which cannot be, only what its symmetry leaves.
    """
    _carry(P, P, WIDTH, 1, WIDTH, k, r, f, dt)
    b0, b1, b2 = f[k, 0, 0], f[k, 0, 1], f[k, 0, 2]
    a0, a1, a2 = f[k, 1, 0], f[k, 1, 1], f[k, 1, 2]
    c0, c1, c2 = f[k, 2, 0], f[k, 2, 1], f[k, 2, 2]
    r00, r01, r02 = r[k, 0, 0], r[k, 0, 1], r[k, 0, 2]
    r10, r11, r12 = r[k, 1, 0], r[k, 1, 1], r[k, 1, 2]
    r20, r21, r22 = r[k, 2, 0], r[k, 2, 1], r[k, 2, 2]
    for i in range(BIASES):
        o = i * WIDTH
        s0, s1, s2 = P[o + 6], P[o + 7], P[o + 8]
        g0, g1, g2 = P[o + 9], P[o + 10], P[o + 11]
        h0 = r00 * g0 + r01 * g1 + r02 * g2
        h1 = r10 * g0 + r11 * g1 + r12 * g2
        h2 = r20 * g0 + r21 * g1 + r22 * g2
        if i < 7:
            P[o + 6] = s0 - h0
        if i < 8:
            P[o + 7] = s1 - h1
        P[o + 8] = s2 - h2
        if i < 6:
            v0, v1, v2 = P[o + 3], P[o + 4], P[o + 5]
            d0, d1, d2 = P[o + 12], P[o + 13], P[o + 14]
            e0 = r00 * d0 + r01 * d1 + r02 * d2
            e1 = r10 * d0 + r11 * d1 + r12 * d2
            e2 = r20 * d0 + r21 * d1 + r22 * d2
            if i < 4:
                P[o + 3] = v0 - e0 + (s1 * b2 - s2 * b1) + (c1 * h2 - c2 * h1)
            if i < 5:
                P[o + 4] = v1 - e1 + (s2 * b0 - s0 * b2) + (c2 * h0 - c0 * h2)
            P[o + 5] = v2 - e2 + (s0 * b1 - s1 * b0) + (c0 * h1 - c1 * h0)
            if i < 3:
                if i < 1:
                    P[o] += dt * (v0 - 0.5 * e0) + (s1 * a2 - s2 * a1)
                if i < 2:
                    P[o + 1] += dt * (v1 - 0.5 * e1) + (s2 * a0 - s0 * a2)
                P[o + 2] += dt * (v2 - 0.5 * e2) + (s0 * a1 - s1 * a0)
    _add_noise(P, k, q, dt, p)
    for b in range(STATES):  # also within a block: rounding makes the halves differ, and would for good
        for a in range(min(b, BIASES)):
            P[b * WIDTH + a] = P[a * WIDTH + b]


@jit_fused
def step_noise(k: int, steps: Any, m: Any, f: Any, dt: float, p: ZuptSettings, out: Any) -> None:
    """Covariance that the noise of step ``k`` adds.

    Row ``k`` of ``out`` (K, 16): of the place, of place with velocity, of the turn, of velocity with the turn (3), of
    the velocity (9), and 0, for what a filter that is lost adds. ``m`` (9,) is the orientation where the step begins,
    ``f`` (K, 3, 3) as for :func:`carrier`, biases out.
    """
    g, noise = G_MPS2, steps.noise
    m0, m1, m2, m3, m4, m5, m6, m7, m8 = m[0], m[1], m[2], m[3], m[4], m[5], m[6], m[7], m[8]
    white, share = p.acc_noise_mps2_rthz**2, p.acc_scale_noise**2
    twice = m6 * noise[k, 7] + m7 * noise[k, 8] + m8 * noise[k, 9]
    # the acceleration squared is that of the force less gravity
    v = white * dt + share * (noise[k, 0] - 2.0 * g * f[k, 0, 2] + g * g * dt) + noise[k, 3]
    push = 0.5 * white * dt * dt + share * (noise[k, 1] - 2.0 * g * f[k, 1, 2] + 0.5 * g * g * dt * dt) + noise[k, 4]
    third = dt * dt * dt / 3.0
    out[k, 0] = white * third + share * (noise[k, 2] - 2.0 * g * twice + g * g * third) + noise[k, 5]
    out[k, 1], out[k, 2] = push, noise[k, 6]
    x, y, z = noise[k, 10], noise[k, 11], noise[k, 12]
    out[k, 3] = m0 * x + m1 * y + m2 * z
    out[k, 4] = m3 * x + m4 * y + m5 * z
    out[k, 5] = m6 * x + m7 * y + m8 * z
    xx, xy, xz = noise[k, 13], noise[k, 14], noise[k, 15]
    yy, yz, zz = noise[k, 16], noise[k, 17], noise[k, 18]
    v += xx + yy + zz
    x, y, z = m0 * xx + m1 * xy + m2 * xz, m0 * xy + m1 * yy + m2 * yz, m0 * xz + m1 * yz + m2 * zz
    out[k, 6] = v - (x * m0 + y * m1 + z * m2)
    out[k, 7] = out[k, 9] = -(x * m3 + y * m4 + z * m5)
    out[k, 8] = out[k, 12] = -(x * m6 + y * m7 + z * m8)
    x, y, z = m3 * xx + m4 * xy + m5 * xz, m3 * xy + m4 * yy + m5 * yz, m3 * xz + m4 * yz + m5 * zz
    out[k, 10] = v - (x * m3 + y * m4 + z * m5)
    out[k, 11] = out[k, 13] = -(x * m6 + y * m7 + z * m8)
    x, y, z = m6 * xx + m7 * xy + m8 * xz, m6 * xy + m7 * yy + m8 * yz, m6 * xz + m7 * yz + m8 * zz
    out[k, 14] = v - (x * m6 + y * m7 + z * m8)
    out[k, 15] = 0.0


@inlined
def _add_noise(P: Any, k: int, q: Any, dt: float, p: ZuptSettings) -> None:
    """Add what ``step_noise`` found of step ``k``, ``q`` (K, 16), to the upper half."""
    for a in range(3):
        P[a * DIAGONAL] += q[k, 0]
        P[a * WIDTH + 3 + a] += q[k, 1]
        P[(6 + a) * DIAGONAL] += q[k, 2]
        P[(9 + a) * DIAGONAL] += p.rate_walk_radps_rts**2 * dt
        P[(12 + a) * DIAGONAL] += p.acc_walk_mps2_rts**2 * dt
        for b in range(a, 3):
            P[(3 + a) * WIDTH + 3 + b] += q[k, 6 + 3 * a + b]
        b, c = (a + 1) % 3, (a + 2) % 3
        P[(3 + b) * WIDTH + 6 + c] += q[k, 3 + a]
        P[(3 + c) * WIDTH + 6 + b] -= q[k, 3 + a]


@jit_fused
def spread_noise(k: int, x: Any, q: Any, adjoint: Any, dt: float, p: ZuptSettings) -> None:
    """``x ← x - Q λ`` for what ``step_noise`` found of step ``k``, ``q`` (K, 16), and the adjoint λ (K, 15)."""
    for a in range(3):
        x[a] -= q[k, 0] * adjoint[k, a] + q[k, 1] * adjoint[k, 3 + a]
        x[3 + a] -= q[k, 1] * adjoint[k, a]
        x[6 + a] -= q[k, 2] * adjoint[k, 6 + a]
        x[9 + a] -= p.rate_walk_radps_rts**2 * dt * adjoint[k, 9 + a]
        x[12 + a] -= p.acc_walk_mps2_rts**2 * dt * adjoint[k, 12 + a]
        for b in range(3):
            x[3 + a] -= q[k, 6 + 3 * a + b] * adjoint[k, 3 + b]
        b, c = (a + 1) % 3, (a + 2) % 3
        x[3 + b] -= q[k, 3 + a] * adjoint[k, 6 + c]
        x[6 + c] -= q[k, 3 + a] * adjoint[k, 3 + b]
        x[3 + c] += q[k, 3 + a] * adjoint[k, 6 + b]
        x[6 + b] += q[k, 3 + a] * adjoint[k, 3 + c]
