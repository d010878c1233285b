"""A stride's whole solution in one compiled call: its ends, its orientation, its trajectory, and their numbers.

Constrained, bias-corrected integration of one stride: Negård et al. (2005), Eq. (14)–(20). Velocity is known at both
ends and height is equal at both; an artificial accelerometer bias absorbs the rest. Departures from the print:

- (16) has three unknowns and spends all on velocity, so the equal height cannot be met. Here the bias may vary linearly
  in time, ``gamma(tau) = gamma0 + gamma1·(2 tau - 1)``, and is the smallest one that meets all four constraints. On an
  incline the end is higher by what the ground rises; on stairs and unknown slopes the height is left free.
- trapezoid sums instead of the rectangles of (15), (17), (18), which lag by half a sample.
- the velocity at the ends need not be zero: the foot turns about its ground contact there.
- the orientation's tilt is brought towards what gravity says at the end by a constant extra rate, of which only a share
  is applied (``end_tilt_gain``): a foot that is not wholly at rest does not measure gravity alone.
"""

import math

import numpy as np

from fes.estimation.numerics.filters import solve
from fes.estimation.numerics.jit import by_number, inlined, jit_fused
from fes.estimation.numerics.records import Mat, Vec
from fes.estimation.numerics.rotation import axes_in_world, quaternion_step, to_sensor, to_world
from fes.estimation.strides.boundaries import NO_REST_RADPS, around_ends, mean_and_variance
from fes.estimation.strides.maximum_likelihood import (
    HeightNoise,
    StrideNoise,
    end_variances,
    integrate_rates,
    maximum_likelihood,
    settle_height,
)
from fes.signals import G_MPS2


@jit_fused
def orient(
    t_ns: Vec, gyr: Mat, start: Vec, end_fx: float, end_fy: float, end_fz: float, end_tilt_gain: float, out: Mat
) -> float:
    """Integrate the rates from the orientation ``start`` (4,) into ``out`` (N, 4).

    ``gyr`` (N, 3) bias-free rad/s. ``end_f`` is the direction of gravity that the accelerometer measured at the end, in
    the sensor frame (any length); ``end_tilt_gain`` is the share (0–1) of the tilt found there that is taken back,
    spread evenly over the time. Returns that tilt in rad, pi where no force at all was measured.
    """
    n = t_ns.shape[0]
    integrate_rates(t_ns, gyr, start[0], start[1], start[2], start[3], 0.0, 0.0, out)
    tilt, dx, dy = _tilt(out[n - 1], end_fx, end_fy, end_fz)
    if end_tilt_gain > 0.0 and tilt < math.pi:
        dx, dy = end_tilt_gain * dx, end_tilt_gain * dy
        integrate_rates(t_ns, gyr, start[0], start[1], start[2], start[3], dx, dy, out)
    return tilt


@inlined
def _tilt(q: Vec, fx: float, fy: float, fz: float) -> tuple[float, float, float]:
    """How far ``f`` in the sensor frame is from upright in rad (pi: no force), and the turn by world x and y to it."""
    ux, uy, uz = to_world(q[0], q[1], q[2], q[3], fx, fy, fz)
    norm = math.sqrt(ux * ux + uy * uy + uz * uz)
    if norm < 1e-9:
        return math.pi, 0.0, 0.0
    # turning the world vector u onto z: about u × z, by the angle between them
    across = math.sqrt(ux * ux + uy * uy) / norm
    tilt = math.atan2(across, uz / norm)
    by = tilt / (across * norm) if across > 1e-9 else 0.0
    return tilt, by * uy, -by * ux


@jit_fused
def integrate(
    t_ns: Vec,
    acc: Mat,
    quaternions: Mat,
    start_velocity: Vec,
    end_velocity: Vec,
    incline: float,
    velocity: Mat,
    position: Mat,
    gamma: Mat,
) -> bool:
    """Position over one stride from specific force and orientation, meeting the constraints exactly.

    ``acc`` (N, 3) m/s²; ``start_velocity``, ``end_velocity`` (3,) m/s in the world; ``incline``:
    what the ground rises per horizontal distance, NaN where nobody knows. Fills ``velocity`` (N, 3) in m/s,
    ``position`` (N, 3) in m from the start, and ``gamma`` (2, 3) in m/s² (constant and linear part of the artificial
    bias, sensor frame). Returns False where the constraints cannot be met (fewer than 3 samples, no time passes).
    """
    n = t_ns.shape[0]
    if n < 3 or t_ns[n - 1] <= t_ns[0]:
        return False
    for j in range(3):
        gamma[0, j] = 0.0
        gamma[1, j] = 0.0
    double_integral(t_ns, acc, quaternions, start_velocity, gamma, velocity, position)
    effect = np.zeros((4, 6))  # of the six unknowns on the end's velocity (3) and height (1)
    effects(t_ns, quaternions, effect)
    count = 3 if math.isnan(incline) else 4
    rise_m = 0.0 if count == 3 else incline * math.hypot(position[n - 1, 0], position[n - 1, 1])
    # smallest gamma with effect · gamma = residual: gamma = effectᵀ (effect effectᵀ)⁻¹ residual
    system = np.zeros((4, 5))
    for i in range(count):
        for j in range(count):
            for k in range(6):
                system[i, j] += effect[i, k] * effect[j, k]
        system[i, 4] = position[n - 1, 2] - rise_m if i == 3 else velocity[n - 1, i] - end_velocity[i]
    if not solve(system, count):
        return False
    for k in range(6):
        for i in range(count):
            gamma[k // 3, k % 3] += effect[i, k] * system[i, 4]
    double_integral(t_ns, acc, quaternions, start_velocity, gamma, velocity, position)
    return True


@jit_fused
def double_integral(
    t_ns: Vec, acc: Mat, quaternions: Mat, start_velocity: Vec, gamma: Mat, velocity: Mat, position: Mat
) -> None:
    """Eq. (17) and (18) in trapezoids."""
    n = t_ns.shape[0]
    span_ns = t_ns[n - 1] - t_ns[0]
    ax0 = ay0 = az0 = 0.0
    for i in range(n):
        tau = 2.0 * (t_ns[i] - t_ns[0]) / span_ns - 1.0
        ax, ay, az = to_world(
            quaternions[i, 0],
            quaternions[i, 1],
            quaternions[i, 2],
            quaternions[i, 3],
            acc[i, 0] - gamma[0, 0] - gamma[1, 0] * tau,
            acc[i, 1] - gamma[0, 1] - gamma[1, 1] * tau,
            acc[i, 2] - gamma[0, 2] - gamma[1, 2] * tau,
        )
        az -= G_MPS2
        if i == 0:
            for j in range(3):
                velocity[0, j] = start_velocity[j]
                position[0, j] = 0.0
        else:
            dt_s = 1e-9 * (t_ns[i] - t_ns[i - 1])
            velocity[i, 0] = velocity[i - 1, 0] + 0.5 * dt_s * (ax0 + ax)
            velocity[i, 1] = velocity[i - 1, 1] + 0.5 * dt_s * (ay0 + ay)
            velocity[i, 2] = velocity[i - 1, 2] + 0.5 * dt_s * (az0 + az)
            for j in range(3):
                position[i, j] = position[i - 1, j] + 0.5 * dt_s * (velocity[i - 1, j] + velocity[i, j])
        ax0, ay0, az0 = ax, ay, az


@inlined
def effects(t_ns: Vec, quaternions: Mat, effect: Mat) -> None:
    """Integrate what each unknown of gamma does: columns 0–2 constant, 3–5 linear part; rows as in `integrate`."""
    n = t_ns.shape[0]
    span_ns = t_ns[n - 1] - t_ns[0]
    before = np.zeros((3, 6))
    now = np.zeros((3, 6))
    for i in range(n):
        tau = 2.0 * (t_ns[i] - t_ns[0]) / span_ns - 1.0
        q0, q1, q2, q3 = quaternions[i, 0], quaternions[i, 1], quaternions[i, 2], quaternions[i, 3]
        first, second, third = axes_in_world(q0, q1, q2, q3)
        now[0, 0], now[1, 0], now[2, 0] = first
        now[0, 1], now[1, 1], now[2, 1] = second
        now[0, 2], now[1, 2], now[2, 2] = third
        for j in range(3):
            for k in range(3):
                now[j, k + 3] = now[j, k] * tau
        if i > 0:
            dt_s = 1e-9 * (t_ns[i] - t_ns[i - 1])
            for k in range(6):
                height_rate = effect[2, k]
                for j in range(3):
                    effect[j, k] += 0.5 * dt_s * (before[j, k] + now[j, k])
                effect[3, k] += 0.5 * dt_s * (height_rate + effect[2, k])
        for j in range(3):  # not as slices: their check of shapes would take seconds to compile
            for k in range(6):
                before[j, k] = now[j, k]


LEAST_BACKWARD_M, MOST_BACKWARD_TURN_RAD = 0.15, 0.5 * math.pi
MOST_OFF_AXIS_RAD = math.radians(40.0)  # beyond it a stride goes sideways
SHORTEST_M = 0.05  # a stride shorter than that has no direction but the foot's


LEAST_RISE_M = 0.02  # between stances on the spot
MOST_INCLINE = 0.25  # what rises more steeply from stance to stance is a stair: no line tells where the ground is


@inlined
def line_of(position: Mat, first: int, last: int) -> tuple[float, float]:
    """What to add per metre of x and of y so that heights (m) count from the line between two stances.

    ``position`` (N, 3) m; NaN where that line is too steep to be the ground.
    """
    x, y = position[last, 0] - position[first, 0], position[last, 1] - position[first, 1]
    z, level2 = position[last, 2] - position[first, 2], x * x + y * y
    if z * z > MOST_INCLINE * MOST_INCLINE * level2:
        return (0.0, 0.0) if abs(z) < LEAST_RISE_M else (math.nan, math.nan)
    return (-z * x / level2, -z * y / level2) if level2 > 0.0 else (0.0, 0.0)


@by_number
@inlined
def height_and_turn(quaternion: Mat, position: Mat, fx: float, fy: float, fz: float) -> tuple[float, float]:
    """The greatest height of a stride over the line from its start to its end (on stairs above its start) in m, and
    by how much the foot turned in rad, left positive, within half a turn.

    Args:
        quaternion: (N, 4) orientations, sensor to world.
        position: (N, 3) in m from the start.
        fx: unit vector towards the toe in the sensor frame, with ``fy`` and ``fz``.
        fy: see ``fx``.
        fz: see ``fx``.
    """
    peak_height = -math.inf
    nx, ny = line_of(position, 0, position.shape[0] - 1)
    if math.isnan(nx):
        nx = ny = 0.0
    for i in range(position.shape[0]):
        peak_height = max(peak_height, position[i, 2] + nx * position[i, 0] + ny * position[i, 1])
    ahead, left, _ = _pointing(quaternion, 0, fx, fy, fz)
    turn = -math.atan2(left, ahead)
    ahead, left, _ = _pointing(quaternion, position.shape[0] - 1, fx, fy, fz)
    turn += math.atan2(left, ahead)
    return peak_height, (turn + math.pi) % (2.0 * math.pi) - math.pi


@inlined
def goes_backward(quaternion: Mat, position: Mat, turn: float, fx: float, fy: float, fz: float) -> bool:
    """Whether a stride leads to where the heel points (within 60°), and is no turn; args of :func:`height_and_turn`."""
    last = position.shape[0] - 1
    x, y = position[last, 0] - position[0, 0], position[last, 1] - position[0, 1]
    ahead, left, _ = _pointing(quaternion, 0, fx, fy, fz)
    ahead_then, left_then, _ = _pointing(quaternion, last, fx, fy, fz)
    ahead, left = ahead + ahead_then, left + left_then
    length = math.hypot(x, y)
    if length < LEAST_BACKWARD_M or abs(turn) > MOST_BACKWARD_TURN_RAD:
        return False
    return bool(x * ahead + y * left < -0.5 * length * math.hypot(ahead, left))


@by_number
@jit_fused
def stride_shape(
    t_ns: Vec, quaternion: Mat, position: Mat, fx: float, fy: float, fz: float, ux: float, uy: float, uz: float,
    toe_out: float, out: Mat,
) -> None:  # fmt: skip
    """Fill ``out`` (K, 5): ahead, left and up (m) in the direction of the stride, pitch and tilt (rad) since its start.

    Pitch is the angle of the foot's long axis against the horizontal, toe up, tilt that of its mediolateral axis, left
    side up: asin of the axis's vertical component. Neither feels the heading, and a foot that turns about its
    mediolateral axis alone keeps its tilt, however steep it stands. ``t_ns`` (N,) are the time stamps; the K rows of
    ``out`` are evenly spaced from the first to the last, linear in between. ``u`` is the unit vector up, foot flat, in
    the sensor frame, at right angles to ``f``. ``toe_out`` is how far left of the stride's direction the foot's long
    axis lies (rad): its mediolateral axis is at right angles to that, :func:`_off_axis`. The others are as for
    :func:`height_and_turn`.
    """
    n, count = t_ns.shape[0], out.shape[0]
    off = _off_axis(quaternion, position, fx, fy, fz, toe_out)
    c, s = math.cos(off), math.sin(off)
    lx, ly, lz = (
        c * (uy * fz - uz * fy) - s * fx,
        c * (uz * fx - ux * fz) - s * fy,
        c * (ux * fy - uy * fx) - s * fz,
    )
    pitch, tilt = np.empty(n), np.empty(n)
    for i in range(n):
        _, _, up = _pointing(quaternion, i, fx, fy, fz)
        pitch[i] = math.asin(min(max(up, -1.0), 1.0))
        _, _, up = _pointing(quaternion, i, lx, ly, lz)
        tilt[i] = math.asin(min(max(up, -1.0), 1.0))
    dx, dy = position[n - 1, 0], position[n - 1, 1]
    length = math.sqrt(dx * dx + dy * dy)
    if length <= SHORTEST_M:
        dx, dy, _ = _pointing(quaternion, 0, fx, fy, fz)
        length = math.sqrt(dx * dx + dy * dy)
    dx, dy = (dx / length, dy / length) if length > 0.0 else (1.0, 0.0)
    i, step = 0, (t_ns[n - 1] - t_ns[0]) / (count - 1)
    for k in range(count):
        at = k * step  # ns since the start
        while i < n - 2 and t_ns[i + 1] - t_ns[0] <= at:
            i += 1
        share = min((at - (t_ns[i] - t_ns[0])) / (t_ns[i + 1] - t_ns[i]), 1.0)
        x = position[i, 0] + share * (position[i + 1, 0] - position[i, 0])
        y = position[i, 1] + share * (position[i + 1, 1] - position[i, 1])
        out[k, 0] = x * dx + y * dy
        out[k, 1] = y * dx - x * dy
        out[k, 2] = position[i, 2] + share * (position[i + 1, 2] - position[i, 2])
        out[k, 3] = pitch[i] + share * (pitch[i + 1] - pitch[i]) - pitch[0]
        out[k, 4] = tilt[i] + share * (tilt[i + 1] - tilt[i]) - tilt[0]


@inlined
def _off_axis(quaternion: Mat, position: Mat, fx: float, fy: float, fz: float, toe_out: float) -> float:
    """How far left of ``f`` the foot's long axis points, rad; 0 where the stride says nothing of it.

    ``f`` is at right angles to the axis about which the foot swings, which the leg's turn bends off the foot's own; the
    foot points ``toe_out`` left of where its stride leads, the headings of both its stances meaned.
    """
    last = position.shape[0] - 1
    dx, dy = position[last, 0] - position[0, 0], position[last, 1] - position[0, 1]
    if math.hypot(dx, dy) < LEAST_BACKWARD_M:
        return 0.0
    ahead, left, _ = _pointing(quaternion, 0, fx, fy, fz)
    ahead_then, left_then, _ = _pointing(quaternion, last, fx, fy, fz)
    ahead, left = ahead + ahead_then, left + left_then
    off = math.atan2(ahead * dy - left * dx, ahead * dx + left * dy) + toe_out
    return off if abs(off) < MOST_OFF_AXIS_RAD else 0.0


@jit_fused
def stride_shapes(
    firsts: Vec, counts: Vec, t_ns: Vec, quaternion: Mat, position: Mat,
    fx: float, fy: float, fz: float, ux: float, uy: float, uz: float, toe_out: float, out: Mat,
) -> None:  # fmt: skip
    """As :func:`stride_shape` of S strides, of each ``counts`` rows from ``firsts`` on, (S,); ``out`` (S, K, 5)."""
    for k in range(firsts.shape[0]):
        a, b = firsts[k], firsts[k] + counts[k]
        if b > a:
            stride_shape(t_ns[a:b], quaternion[a:b], position[a:b], fx, fy, fz, ux, uy, uz, toe_out, out[k])


@inlined
def _pointing(quaternion: Mat, i: int, x: float, y: float, z: float) -> tuple[float, float, float]:
    """An axis of the sensor in the world at sample ``i``."""
    return to_world(quaternion[i, 0], quaternion[i, 1], quaternion[i, 2], quaternion[i, 3], x, y, z)


NOISE, HEIGHT_NOISE = StrideNoise(), HeightNoise()
# Forward, of an instep in mid-stance beyond w × r: the shorter a foot stands, the more it gives way and rolls on, which
# the spread of the rate there shows. The constrained method, which cannot tell a velocity from an acceleration error,
# needs more of it on the same recordings, at every pace.
DRIFT_PER_SPREAD_M, DRIFT_FROM_RADPS, DRIFT_CONSTRAINED_MPS = 0.05, 0.04, 0.005
END_TILT_GAIN = 0.15
MOST_TILT_RAD = math.radians(30)
MOST_PUSHED_MPS2 = 3.5  # from rest to rest: neither bias nor tilt explains a greater mean of the level specific force
MOST_GUESSED_RAD = 0.2  # a tilt that is measured no better is a guess
LONGEST_STRIDE_M = 3.0
LENGTH_SHARE = 0.013  # of a stride's length, one SD: with it errors against markers scatter as stated
SOLVED, NO_SOLUTION, TILTED, NO_LENGTH, NO_REST, BACKWARD = range(6)  # what came of it
TILT, RESIDUAL_RATE, LENGTH, PEAK_HEIGHT, TURN, HEIGHT_CHANGE, LENGTH_SD, FREE_RISE, NUMBERS = range(
    9
)  # where the numbers are


@by_number
@inlined
def _speed_gained(t_ns: Vec, acc: Mat, quaternion: Mat) -> float:
    """By how much the horizontal velocity differs between the ends, as measured (m/s): little from rest to rest."""
    vx = vy = ax0 = ay0 = 0.0
    for i in range(t_ns.shape[0]):
        w, x, y, z = quaternion[i, 0], quaternion[i, 1], quaternion[i, 2], quaternion[i, 3]
        ax, ay, _ = to_world(w, x, y, z, acc[i, 0], acc[i, 1], acc[i, 2])
        if i > 0:
            half_s = 0.5e-9 * (t_ns[i] - t_ns[i - 1])
            vx, vy = vx + half_s * (ax0 + ax), vy + half_s * (ay0 + ay)
        ax0, ay0 = ax, ay
    return math.sqrt(vx * vx + vy * vy)


@inlined
def _length_sd(length_m: float, span_s: float, end_variances: float) -> float:
    """Uncertainty of a stride's length in m, both velocities being known with this sum of variances ((m/s)²).

    What is wrong with them counts for half of the time each. Of white noise of the force the ends leave what is bent, a
    twelfth of the cube of the time. The rest goes with the length: scale, clipping, a foot that is no rigid body.
    """
    noise_m2 = HEIGHT_NOISE.push_mps2_rthz**2 * span_s**3 / 12.0
    return math.sqrt(0.25 * span_s**2 * end_variances + noise_m2 + (LENGTH_SHARE * length_m) ** 2)


@inlined
def end_velocity(
    qw: float, qx: float, qy: float, qz: float, wx: float, wy: float, wz: float,
    fx: float, fy: float, fz: float, height_m: float, drift_speed_mps: float, row: int, out: Mat,
) -> None:  # fmt: skip
    """``w × r`` in the world of a foot that turns about the ground below its sensor, and its drift forward (m/s).

    ``w`` is the rate and ``f`` the unit vector towards the toe, in the sensor frame; fills ``row`` of ``out`` (2, 3).
    """
    wx, wy, _ = to_world(qw, qx, qy, qz, wx, wy, wz)
    fx, fy, _ = to_world(qw, qx, qy, qz, fx, fy, fz)
    drift_speed_mps /= max(math.sqrt(fx * fx + fy * fy), 1e-9)
    out[row, 0], out[row, 1], out[row, 2] = (
        wy * height_m + drift_speed_mps * fx,
        drift_speed_mps * fy - wx * height_m,
        0.0,
    )


@jit_fused
def solve_span(
    t_ns: Vec,
    acc: Mat,
    gyr: Mat,
    first: int,
    last: int,
    start: Vec,
    fx: float,
    fy: float,
    fz: float,
    height_m: float,
    constrained: bool,
    incline: float,
    quaternion: Mat,
    position: Mat,
    numbers: Vec,
) -> int:
    """Solve the rows ``first`` … ``last`` (n of them) of a history.

    Args:
        t_ns: (N,) time stamps.
        acc: (N, 3) specific force in m/s², free of bias.
        gyr: (N, 3) rad/s, free of bias.
        first: row.
        last: row.
        start: (4,) orientation at ``first``; righted where it proves to be far off.
        fx: unit vector towards the toe in the sensor frame, with ``fy`` and ``fz``.
        fy: see ``fx``.
        fz: see ``fx``.
        height_m: of the sensor above the ground contact.
        constrained: not the most likely errors, but Negård et al.'s constraints.
        incline: what the ground rises per horizontal distance; NaN where nobody knows (stairs, ramps).
        quaternion: (n, 4) to be filled.
        position: (n, 3) to be filled, m from the start.
        numbers: (NUMBERS,) to be filled: tilt found at the end (rad), the faster end's rate (rad/s), length, greatest
            height (m), turn (rad), height gained (m), uncertainty of the length (m, one SD), height
            gained by the sensor alone (m).

    Returns:
        ``SOLVED``, or why the stride cannot be used.
    """
    n = last + 1 - first
    t, f, w = t_ns[first : last + 1], acc[first : last + 1], gyr[first : last + 1]
    around = around_ends(t_ns, first, last)
    rates, forces, variances, drifts_mps = np.empty((2, 3)), np.empty((2, 3)), np.empty((2, 2)), np.empty(2)
    residual_rate = unrest_radps = 0.0
    for e in range(2):
        k = last if e else first
        begin, end = max(k - around, 0), min(k + around + 1, t_ns.shape[0])
        r0, r1, r2, s0, s1, s2 = mean_and_variance(gyr, begin, end)
        f0, f1, f2, p0, p1, p2 = mean_and_variance(acc, begin, end)
        rates[e, 0], rates[e, 1], rates[e, 2] = r0, r1, r2
        forces[e, 0], forces[e, 1], forces[e, 2] = f0, f1, f2
        rate = math.sqrt(r0 * r0 + r1 * r1 + r2 * r2)
        spread = math.sqrt(max(p0, p1, p2))
        rate_spread = math.sqrt(s0 + s1 + s2)
        variances[e, 0], variances[e, 1] = end_variances(rate, rate_spread, spread, NOISE)
        drift_mps = DRIFT_PER_SPREAD_M * max(rate_spread - DRIFT_FROM_RADPS, 0.0)
        drifts_mps[e] = DRIFT_CONSTRAINED_MPS if constrained else drift_mps
        residual_rate, unrest_radps = max(residual_rate, rate), max(unrest_radps, math.hypot(rate, rate_spread))
    gain = END_TILT_GAIN if constrained else 0.0
    tilt = orient(t, w, start, forces[1, 0], forces[1, 1], forces[1, 2], gain, quaternion)
    if MOST_TILT_RAD < tilt < math.pi and max(variances[0, 1], variances[1, 1]) < MOST_GUESSED_RAD**2:
        # no gyroscope errs so much in a stride: its start was not known
        _, dx, dy = _tilt(quaternion[n - 1], forces[1, 0], forces[1, 1], forces[1, 2])
        dx, dy, dz = to_sensor(start[0], start[1], start[2], start[3], dx, dy, 0.0)
        start[0], start[1], start[2], start[3] = quaternion_step(start[0], start[1], start[2], start[3], dx, dy, dz)
        orient(t, w, start, forces[1, 0], forces[1, 1], forces[1, 2], gain, quaternion)
        at_start, _, _ = _tilt(start, forces[0, 0], forces[0, 1], forces[0, 2])
        if at_start < MOST_TILT_RAD:
            tilt = 0.0
    span_s = 1e-9 * (t[n - 1] - t[0])
    pushed_mps2 = _speed_gained(t, f, quaternion) / span_s
    ends = np.empty((2, 3))
    for e in range(2):
        k = n - 1 if e else 0
        end_velocity(
            quaternion[k, 0], quaternion[k, 1], quaternion[k, 2], quaternion[k, 3],
            rates[e, 0], rates[e, 1], rates[e, 2], fx, fy, fz, height_m, drifts_mps[e], e, ends,
        )  # fmt: skip
    velocity = np.empty((n, 3))
    if constrained:
        gamma = np.empty((2, 3))
        solved, free_m = integrate(t, f, quaternion, ends[0], ends[1], incline, velocity, position, gamma), math.nan
    else:
        solved, free_m = maximum_likelihood(
            t, f, w, start, ends, forces, variances, incline, NOISE, quaternion, velocity, position, True
        )  # fmt: skip
        if solved and not math.isnan(incline):
            vertical, rise_m = np.empty((n, 2)), incline * math.hypot(position[n - 1, 0], position[n - 1, 1])
            solved = settle_height(t, f, quaternion, ends[:, 2], variances[:, 0], rise_m, HEIGHT_NOISE, vertical)
            for i in range(n):
                position[i, 2] = vertical[i, 1]
    numbers[TILT], numbers[RESIDUAL_RATE] = tilt, residual_rate
    if not solved or (pushed_mps2 > MOST_PUSHED_MPS2 and tilt <= MOST_TILT_RAD):
        return NO_SOLUTION
    length = math.hypot(position[n - 1, 0], position[n - 1, 1])
    numbers[LENGTH], numbers[LENGTH_SD] = length, _length_sd(length, span_s, variances[0, 0] + variances[1, 0])
    if tilt > MOST_TILT_RAD:
        return TILTED
    if not length <= LONGEST_STRIDE_M:
        return NO_LENGTH
    if unrest_radps > NO_REST_RADPS:
        numbers[RESIDUAL_RATE] = unrest_radps
        return NO_REST
    numbers[PEAK_HEIGHT], numbers[TURN] = height_and_turn(quaternion, position, fx, fy, fz)
    if goes_backward(quaternion, position, numbers[TURN], fx, fy, fz):
        return BACKWARD
    numbers[HEIGHT_CHANGE], numbers[FREE_RISE] = position[n - 1, 2], free_m
    return SOLVED
