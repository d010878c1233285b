"""The most likely stride: strapdown integration whose every error is weighed, solved in one step.

Negård et al. (2005) let an artificial accelerometer bias absorb all that is left over at a stride's end. But that has
several causes: tilt at the start, biases of gyroscope and accelerometer, noise of both, which grows where the sensor is
jolted or turned fast, and a foot that is not quite at rest at the ends. Each has its size (:class:`StrideNoise`), and
the most likely set of errors is found that explains what is known: velocity (3) and height (1) at the end, gravity's
direction at the end (2) and the start (2): eight equations, in their dual form. How much a foot still rocks or is
jolted at the ends is measured in each stance anew, so that no gait needs settings of its own.

The height is solved by itself once the orientation is settled (:func:`settle_height`): it hangs on the vertical
velocity alone, and what spoils that is mostly the impact at the heel, which clips the sensor and outruns it. The error
that the end shows belongs there, and swing keeps the height that it was lifted to; in the common solution it cannot all
go there, because the same samples also bear on tilt and length. Each sample's noise grows with the fastest change of
the specific force that is not long past; no threshold says what an impact is.
"""

import math
from typing import NamedTuple

import numpy as np

from fes.estimation.numerics.filters import solve
from fes.estimation.numerics.jit import by_number, inlined, jit_fused
from fes.estimation.numerics.records import Mat, Vec
from fes.estimation.numerics.rotation import axes_in_world, quaternion_step, to_sensor, to_world, turn_by
from fes.signals import G_MPS2


class StrideNoise(NamedTuple):
    """Standard deviations of what can be wrong; one setting for all sensors and walkers."""

    start_tilt_rad: float = 0.018  # of the orientation filter at mid-stance
    gyr_drift_rad: float = 0.011  # gathered evenly over a stride: what a swing does to the gyroscope, not the time
    acc_bias_mps2: float = 0.03
    gyr_noise_radps_rthz: float = 0.0005
    gyr_scale: float = 0.0005  # share of the rate that is wrong, per √s: scale, clipping, non-orthogonality
    acc_noise_mps2_rthz: float = 0.05
    jolt_mps3: float = 8000.0
    jolt_share: float = 0.5  # of the excess jump that may be wrong
    end_velocity_mps: float = 0.003
    end_velocity_per_rate_m: float = 0.01  # the lever arm's uncertainty, times the rate at the end
    end_velocity_per_spread_m: float = 0.05  # times the rate's spread: the end is no single instant
    end_height_m: float = 0.01
    end_tilt_rad: float = 0.011
    end_tilt_per_rate_s: float = 0.1  # a foot that turns at the end also accelerates
    end_tilt_most_rad: float = 0.04  # what is measured beyond that is doubted, by twice the excess
    end_tilt_per_push: float = 0.2  # share of the specific force's spread at the end that may be a steady push


@inlined
def variances(i: int, t_ns: Vec, acc: Mat, gyr: Mat, noise: StrideNoise) -> tuple[float, float]:
    """Variance of sample ``i``'s turn (rad²) over its interval, and of its velocity increment ((m/s)²)."""
    dt_s = 1e-9 * (t_ns[i] - t_ns[i - 1])
    wx, wy, wz = gyr[i, 0], gyr[i, 1], gyr[i, 2]
    rate2 = wx * wx + wy * wy + wz * wz
    turn = (noise.gyr_noise_radps_rthz**2 + noise.gyr_scale**2 * rate2) * dt_s
    jx, jy, jz = acc[i, 0] - acc[i - 1, 0], acc[i, 1] - acc[i - 1, 1], acc[i, 2] - acc[i - 1, 2]
    jump2, most = jx * jx + jy * jy + jz * jz, noise.jolt_mps3 * dt_s
    push = noise.acc_noise_mps2_rthz**2 * dt_s
    if jump2 > most * most:
        push += (noise.jolt_share * (math.sqrt(jump2) - most) * dt_s) ** 2
    return turn, push


@jit_fused
def end_variances(
    rate_radps: float, rate_spread_radps: float, force_spread_mps2: float, noise: StrideNoise
) -> tuple[float, float]:
    """Variance of the velocity ((m/s)², per axis) and of the measured tilt (rad², per axis) at one end.

    ``rate`` is the size of the mean angular rate there, the spreads are standard deviations over the same window: of
    the rate (norm of the three axes') and of the specific force (greatest of the three).
    """
    velocity = (
        noise.end_velocity_mps**2
        + (noise.end_velocity_per_rate_m * rate_radps) ** 2
        + (noise.end_velocity_per_spread_m * rate_spread_radps) ** 2
    )
    tilt = (
        noise.end_tilt_rad**2
        + (noise.end_tilt_per_rate_s * rate_radps) ** 2
        + (noise.end_tilt_per_push * force_spread_mps2 / G_MPS2) ** 2
    )
    return velocity, tilt


class HeightNoise(NamedTuple):
    """Standard deviations. Half or twice of each leaves the SD against 53 lifts seen optically at 3.2 to 3.9 mm."""

    push_mps2_rthz: float = 0.02  # of a quiet sensor
    shaken_share: float = 0.3  # of a jump of the specific force between samples that may be wrong, …
    shaken_s: float = 0.03  # … and over which time that dies away
    bias_mps2: float = 0.03  # of the vertical over a stride
    end_height_m: float = 0.005


@by_number
@jit_fused
def settle_height(
    t_ns: Vec, acc: Mat, quaternion: Mat, end_velocities: Vec, end_variances: Vec, rise_m: float, noise: HeightNoise,
    out: Mat,
) -> bool:  # fmt: skip
    """Heights and vertical velocities of a stride that is known to end by ``rise_m`` higher than it began.

    Args:
        t_ns: (N,) time stamps.
        acc: (N, 3) specific force in m/s², free of calibrated bias.
        quaternion: (N, 4) the settled orientation.
        end_velocities: (2,) vertical, m/s, at the start and at the end, as the lever arm says.
        end_variances: (2,) of them, (m/s)².
        noise: sizes of the other errors.
        out: (N, 2) to be filled: vertical velocity in m/s, height in m above the start.

    Returns:
        False where there is nothing to integrate.
    """
    n = t_ns.shape[0]
    if n < 3 or t_ns[n - 1] <= t_ns[0]:
        return False
    last = n - 1
    pushes = np.zeros(n)  # variance of each interval's velocity increment
    shaken, before, fades, fades_s = 0.0, 0.0, 0.0, 0.0
    out[0, 0], out[0, 1] = end_velocities[0], 0.0
    for i in range(n):
        _, _, up = to_world(
            quaternion[i, 0], quaternion[i, 1], quaternion[i, 2], quaternion[i, 3], acc[i, 0], acc[i, 1], acc[i, 2]
        )
        if i > 0:
            dt_s = 1e-9 * (t_ns[i] - t_ns[i - 1])
            jx, jy, jz = acc[i, 0] - acc[i - 1, 0], acc[i, 1] - acc[i - 1, 1], acc[i, 2] - acc[i - 1, 2]
            if dt_s != fades_s:
                fades, fades_s = math.exp(-dt_s / noise.shaken_s), dt_s
            shaken = max(math.sqrt(jx * jx + jy * jy + jz * jz), shaken * fades)
            pushes[i] = noise.push_mps2_rthz**2 * dt_s + (noise.shaken_share * shaken * dt_s) ** 2
            out[i, 0] = out[i - 1, 0] + dt_s * (0.5 * (before + up) - G_MPS2)
            out[i, 1] = out[i - 1, 1] + 0.5 * dt_s * (out[i - 1, 0] + out[i, 0])
        before = up
    span_s = 1e-9 * (t_ns[last] - t_ns[0])
    start, bias = end_variances[0], noise.bias_mps2 * noise.bias_mps2
    vv = start + end_variances[1] + bias * span_s * span_s
    vh = start * span_s + 0.5 * bias * span_s * span_s * span_s
    hh = start * span_s * span_s + 0.25 * bias * span_s**4 + noise.end_height_m**2
    for i in range(1, n):
        left_s = 1e-9 * (t_ns[last] - 0.5 * (t_ns[i - 1] + t_ns[i]))
        vv += pushes[i]
        vh += pushes[i] * left_s
        hh += pushes[i] * left_s * left_s
    determinant = vv * hh - vh * vh
    if not determinant > 0.0:
        return False
    dv, dh = end_velocities[1] - out[last, 0], rise_m - out[last, 1]
    along_v, along_h = (hh * dv - vh * dh) / determinant, (vv * dh - vh * dv) / determinant
    correction = start * (along_v + span_s * along_h)
    per_s = bias * (span_s * along_v + 0.5 * span_s * span_s * along_h)
    out[0, 0] += correction
    for i in range(1, n):
        left_s, dt_s = 1e-9 * (t_ns[last] - 0.5 * (t_ns[i - 1] + t_ns[i])), 1e-9 * (t_ns[i] - t_ns[i - 1])
        correction += pushes[i] * (along_v + left_s * along_h) + per_s * dt_s
        out[i, 0] += correction
        out[i, 1] = out[i - 1, 1] + 0.5 * dt_s * (out[i - 1, 0] + out[i, 0])
    return True


KNOWN = 8  # velocity (3) and height at the end, tilt about x and y at the end and at the start
UNIT, RIGHT = KNOWN, KNOWN + 1  # columns beside the covariance: the height's unit vector, what is left over
# what may be wrong as a whole: tilt (2) and velocity (3) at the start, biases of gyroscope and accelerometer (3, 3)
TILT, VELOCITY, GYR, ACC, CAUSES = 0, 2, 5, 8, 11
UNKNOWN_HEIGHT_M = 1e3


@by_number
@jit_fused
def integrate_rates(
    t_ns: Vec, gyr: Mat, w: float, x: float, y: float, z: float, dx: float, dy: float, out: Mat
) -> None:  # fmt: skip
    """Trapezoid integration of the rates from an orientation into ``out`` (N, 4), plus a turn about the world's level
    axes by ``dx`` and ``dy`` (rad) that is spread evenly over the time."""
    n = t_ns.shape[0]
    span_ns = t_ns[n - 1] - t_ns[0]
    turning = dx != 0.0 or dy != 0.0
    out[0, 0], out[0, 1], out[0, 2], out[0, 3] = w, x, y, z
    for i in range(1, n):
        dt_s = 1e-9 * (t_ns[i] - t_ns[i - 1])
        ex = ey = ez = 0.0
        if turning:
            share = (t_ns[i] - t_ns[i - 1]) / span_ns
            ex, ey, ez = to_sensor(w, x, y, z, dx * share, dy * share, 0.0)
        w, x, y, z = turn_by(
            w,
            x,
            y,
            z,
            0.5 * (gyr[i - 1, 0] + gyr[i, 0]) * dt_s + ex,
            0.5 * (gyr[i - 1, 1] + gyr[i, 1]) * dt_s + ey,
            0.5 * (gyr[i - 1, 2] + gyr[i, 2]) * dt_s + ez,
        )
        out[i, 0], out[i, 1], out[i, 2], out[i, 3] = w, x, y, z


@jit_fused
def _move(t_ns: Vec, acc: Mat, quaternion: Mat, velocity: Mat, position: Mat) -> None:
    """Trapezoid integration of the specific force from row 0 of ``velocity`` (N, 3); fills all rows."""
    vx, vy, vz, sx, sy, sz = velocity[0, 0], velocity[0, 1], velocity[0, 2], 0.0, 0.0, 0.0
    ax0 = ay0 = az0 = 0.0
    for i in range(t_ns.shape[0]):
        w, x, y, z = quaternion[i, 0], quaternion[i, 1], quaternion[i, 2], quaternion[i, 3]
        ax, ay, az = to_world(w, x, y, z, acc[i, 0], acc[i, 1], acc[i, 2])
        if i > 0:
            dt_s = 1e-9 * (t_ns[i] - t_ns[i - 1])
            half = 0.5 * dt_s
            ux, uy, uz = vx, vy, vz
            vx += half * (ax0 + ax)
            vy += half * (ay0 + ay)
            vz += dt_s * (0.5 * (az0 + az) - G_MPS2)
            sx += half * (ux + vx)
            sy += half * (uy + vy)
            sz += half * (uz + vz)
            velocity[i, 0], velocity[i, 1], velocity[i, 2] = vx, vy, vz
        position[i, 0], position[i, 1], position[i, 2] = sx, sy, sz
        ax0, ay0, az0 = ax, ay, az


@jit_fused
def _later(i: int, last: int, left_s: float, velocity: Mat, position: Mat) -> tuple[float, float, float, float, float]:
    """First integral (x, y, z) and second (x, y) of the specific force in the world, from sample ``i`` to the end.

    They say what a small turn θ of the world at ``i`` does at the end, for it changes all later specific force by
    θ × (R f): of columns x, y, z of θ, velocity ``(0, z, -y), (-z, 0, x), (y, -x, 0)``, height ``(y₂, -x₂, 0)``, tilt
    about x and y ``(1, 0, 0), (0, 1, 0)``.
    """
    return (
        velocity[last, 0] - velocity[i, 0],
        velocity[last, 1] - velocity[i, 1],
        velocity[last, 2] - velocity[i, 2] + G_MPS2 * left_s,
        position[last, 0] - position[i, 0] - velocity[i, 0] * left_s,
        position[last, 1] - position[i, 1] - velocity[i, 1] * left_s,
    )


@by_number
@jit_fused
def maximum_likelihood(
    t_ns: Vec,
    acc: Mat,
    gyr: Mat,
    start: Vec,
    end_velocities: Mat,
    end_forces: Mat,
    end_variances: Mat,
    incline: float,
    noise: StrideNoise,
    quaternion: Mat,
    velocity: Mat,
    position: Mat,
    oriented: bool = False,
) -> tuple[bool, float]:
    """Integrate one stride with the most likely errors taken out.

    Args:
        t_ns: (N,) time stamps. acc: (N, 3) specific force in m/s², free of calibrated bias. gyr: (N, 3) rad/s, free of
        calibrated bias. start: (4,) orientation at the first sample. end_velocities: (2, 3) m/s in the world at the
        start and at the end, as the lever arm says. end_forces: (2, 3) mean specific force in m/s² around start and
        end, in the sensor frame there. end_variances: (2, 2) of start and end, each as
        :func:`fes.estimation.strides.maximum_likelihood.end_variances` gives it. incline: what the ground rises per
        horizontal distance, NaN where nobody knows. noise: the sizes of all other errors. quaternion: (N, 4) to be
        filled. velocity: (N, 3) to be filled, m/s. position: (N, 3) to be filled, m from the start. oriented:
        ``quaternion`` holds the rates' integral from ``start`` already.

    Returns:
        False where there is nothing to integrate; and how much higher than the start the end is by the sensor alone, m.
        The second is what all other equations say of the fourth: its own solution over its diagonal of the inverse.
    """
    n = t_ns.shape[0]
    if n < 3 or t_ns[n - 1] <= t_ns[0]:
        return False, math.nan
    last = n - 1
    for j in range(3):
        velocity[0, j] = end_velocities[0, j]
    if not oriented:
        integrate_rates(t_ns, gyr, start[0], start[1], start[2], start[3], 0.0, 0.0, quaternion)
    _move(t_ns, acc, quaternion, velocity, position)

    system = np.zeros((KNOWN, KNOWN + 2))  # covariance of what is left over, and what is left over
    system[3, UNIT] = 1.0
    of_cause = np.zeros((KNOWN, CAUSES))
    noises, corrected = np.empty((n, 2)), np.empty((2, n, 3))
    _gather(t_ns, acc, gyr, noise, quaternion, velocity, position, system, of_cause, noises)
    sizes = np.zeros(CAUSES)
    span_s = 1e-9 * (t_ns[last] - t_ns[0])
    for k in range(3):
        if k < 2:
            sizes[TILT + k] = noise.start_tilt_rad**2
        sizes[VELOCITY + k] = end_variances[0, 0]
        sizes[GYR + k] = (noise.gyr_drift_rad / span_s) ** 2
        sizes[ACC + k] = noise.acc_bias_mps2**2
    for a in range(KNOWN):
        for b in range(a + 1):
            total = system[a, b]
            for k in range(CAUSES):
                total += sizes[k] * of_cause[a, k] * of_cause[b, k]
            system[a, b] = system[b, a] = total
    for a in range(3):
        system[a, a] += end_variances[1, 0]
        system[a, RIGHT] = end_velocities[1, a] - velocity[last, a]
    level = not math.isnan(incline)
    rise_m = incline * math.sqrt(position[last, 0] ** 2 + position[last, 1] ** 2) if level else 0.0
    height_m = noise.end_height_m if level else UNKNOWN_HEIGHT_M
    system[3, 3] += height_m * height_m
    system[3, RIGHT] = rise_m - position[last, 2]
    for end in range(2):
        i = last if end == 1 else 0
        row = 4 if end == 1 else 6
        ux, uy, uz = to_world(
            quaternion[i, 0],
            quaternion[i, 1],
            quaternion[i, 2],
            quaternion[i, 3],
            end_forces[end, 0],
            end_forces[end, 1],
            end_forces[end, 2],
        )
        across = math.sqrt(ux * ux + uy * uy)
        tilt = math.atan2(across, uz)
        per = tilt / across if across > 1e-12 else 0.0
        # more than the gyroscope can have drifted: the ground accelerates, as a belt that starts or stops
        doubt = 2.0 * max(tilt - noise.end_tilt_most_rad, 0.0)
        for a in range(row, row + 2):
            system[a, a] += end_variances[end, 1] + doubt * doubt
        system[row, RIGHT] = per * uy
        system[row + 1, RIGHT] = -per * ux
    if not solve(system, system.shape[0]):
        return False, math.nan
    free_m = rise_m - system[3, RIGHT] / (system[3, UNIT] / system[3, 3])
    cause = np.zeros(CAUSES)
    for k in range(CAUSES):
        for a in range(KNOWN):
            cause[k] += sizes[k] * of_cause[a, k] * system[a, RIGHT]
    _apply(t_ns, acc, gyr, noises, system, cause, quaternion, velocity, position, corrected[0], corrected[1])
    return True, free_m


@by_number
@inlined
def _gather(
    t_ns: Vec, acc: Mat, gyr: Mat, noise: StrideNoise, quaternion: Mat, velocity: Mat, position: Mat, system: Mat,
    of_cause: Mat, noises: Mat,
) -> None:  # fmt: skip
    """Add what the samples' noise does to the covariance, and fill ``of_cause``: what each cause does per unit.

    ``noises`` (N, 2) is filled with each sample's variances.
    """
    last = t_ns.shape[0] - 1
    xx = yy = zz = xy = xz = yz = hx = hy = hz = hh = tx = ty = tz = th = ux = uz = uh = tt = 0.0
    for i in range(1, last + 1):
        left_s = 1e-9 * (t_ns[last] - t_ns[i])
        dt_s = 1e-9 * (t_ns[i] - t_ns[i - 1])
        dx, dy, dz, ex, ey = _later(i, last, left_s, velocity, position)
        turn, push = variances(i, t_ns, acc, gyr, noise)
        noises[i, 0], noises[i, 1] = turn, push
        # only what is not zero of effect · effectᵀ; t and u are the tilts about x and y
        xx = xx + turn * (dz * dz + dy * dy) + push
        yy = yy + turn * (dz * dz + dx * dx) + push
        zz = zz + turn * (dy * dy + dx * dx) + push
        xy -= turn * (dy * dx)
        xz -= turn * (dz * dx)
        yz -= turn * (dz * dy)
        hx -= turn * (dz * ex)
        hy -= turn * (dz * ey)
        hz = hz + turn * (dy * ey + dx * ex) + push * left_s
        hh = hh + turn * (ey * ey + ex * ex) + push * left_s * left_s
        ty -= turn * dz
        tz += turn * dy
        th += turn * ey
        ux += turn * dz
        uz -= turn * dx
        uh -= turn * ex
        tt += turn
        axes = axes_in_world(quaternion[i, 0], quaternion[i, 1], quaternion[i, 2], quaternion[i, 3])
        for k in range(3):
            rx, ry, rz = axes[k]
            of_cause[0, ACC + k] += rx * dt_s
            of_cause[1, ACC + k] += ry * dt_s
            of_cause[2, ACC + k] += rz * dt_s
            of_cause[3, ACC + k] += rz * dt_s * left_s
            of_cause[0, GYR + k] += (dz * ry - dy * rz) * dt_s
            of_cause[1, GYR + k] += (dx * rz - dz * rx) * dt_s
            of_cause[2, GYR + k] += (dy * rx - dx * ry) * dt_s
            of_cause[3, GYR + k] += (ey * rx - ex * ry) * dt_s
    system[0, 0], system[1, 1], system[2, 2], system[3, 3], system[4, 4], system[5, 5] = xx, yy, zz, hh, tt, tt
    system[0, 1], system[0, 2], system[0, 3], system[0, 4], system[0, 5] = xy, xz, hx, tx, ux
    system[1, 2], system[1, 3], system[1, 4], system[1, 5] = yz, hy, ty, 0.0
    system[2, 3], system[2, 4], system[2, 5], system[3, 4], system[3, 5], system[4, 5] = hz, tz, uz, th, uh, 0.0
    for a in range(6):
        for b in range(a):
            system[a, b] = system[b, a]
    span_s = 1e-9 * (t_ns[last] - t_ns[0])
    dx, dy, dz, ex, ey = _later(0, last, span_s, velocity, position)
    of_cause[1, TILT], of_cause[2, TILT], of_cause[3, TILT], of_cause[4, TILT] = -dz, dy, ey, 1.0
    of_cause[0, TILT + 1], of_cause[2, TILT + 1], of_cause[3, TILT + 1], of_cause[5, TILT + 1] = dz, -dx, -ex, 1.0
    of_cause[6, TILT] = of_cause[7, TILT + 1] = 1.0
    for k in range(3):
        of_cause[4, GYR + k], of_cause[5, GYR + k] = of_cause[0, ACC + k], of_cause[1, ACC + k]
        of_cause[k, VELOCITY + k] = 1.0
    of_cause[3, VELOCITY + 2] = span_s


@by_number
@inlined
def _apply(
    t_ns: Vec, acc: Mat, gyr: Mat, noises: Mat, system: Mat, cause: Vec, quaternion: Mat, velocity: Mat, position: Mat,
    rates: Mat, forces: Mat,
) -> None:  # fmt: skip
    """Correct the inputs by the causes and the samples' share of the dual solution, and integrate again.

    ``rates`` and ``forces`` (N, 3) are room for the corrected inputs.
    """
    n = t_ns.shape[0]
    last = n - 1
    along_x, along_y, along_z = system[0, RIGHT], system[1, RIGHT], system[2, RIGHT]
    along_height, along_tx, along_ty = system[3, RIGHT], system[4, RIGHT], system[5, RIGHT]
    for i in range(n):
        q0, q1, q2, q3 = quaternion[i, 0], quaternion[i, 1], quaternion[i, 2], quaternion[i, 3]
        wx = wy = wz = px = py = pz = 0.0
        if i > 0:
            left_s = 1e-9 * (t_ns[last] - t_ns[i])
            dt_s = 1e-9 * (t_ns[i] - t_ns[i - 1])
            dx, dy, dz, ex, ey = _later(i, last, left_s, velocity, position)
            turn, push = noises[i, 0] / dt_s, noises[i, 1] / dt_s
            vx, vy, vz, height = turn * along_x, turn * along_y, turn * along_z, turn * along_height
            wx = dy * vz - dz * vy + ey * height + turn * along_tx
            wy = dz * vx - dx * vz - ex * height + turn * along_ty
            wz = dx * vy - dy * vx
            px, py, pz = push * along_x, push * along_y, push * (along_z + along_height * left_s)
        wx, wy, wz = to_sensor(q0, q1, q2, q3, wx, wy, wz)
        px, py, pz = to_sensor(q0, q1, q2, q3, px, py, pz)
        rates[i, 0] = gyr[i, 0] + cause[GYR] + wx
        rates[i, 1] = gyr[i, 1] + cause[GYR + 1] + wy
        rates[i, 2] = gyr[i, 2] + cause[GYR + 2] + wz
        forces[i, 0] = acc[i, 0] + cause[ACC] + px
        forces[i, 1] = acc[i, 1] + cause[ACC + 1] + py
        forces[i, 2] = acc[i, 2] + cause[ACC + 2] + pz
    q0, q1, q2, q3 = quaternion[0, 0], quaternion[0, 1], quaternion[0, 2], quaternion[0, 3]
    tx, ty, tz = to_sensor(q0, q1, q2, q3, cause[TILT], cause[TILT + 1], 0.0)
    q0, q1, q2, q3 = quaternion_step(q0, q1, q2, q3, tx, ty, tz)
    for k in range(3):
        velocity[0, k] += cause[VELOCITY + k]
    integrate_rates(t_ns, rates, q0, q1, q2, q3, 0.0, 0.0, quaternion)
    _move(t_ns, forces, quaternion, velocity, position)
