"""The most likely stride: strapdown integration whose every error is weighed, solved in one step.

Negård et al. (2005) let an artificial accelerometer bias absorb all that is left over at a stride's end. But what is
left over has several causes: tilt at the start, biases of gyroscope and accelerometer, noise of both, which grows where
the sensor is jolted or turned fast, and a foot that is not quite at rest at the ends. This module gives each its size
and finds the most likely set of errors that explains what is known at the ends: velocity (3), height (1) and the
direction of gravity (2). Six equations, solved in their dual form; the inputs are corrected and integrated again.

A jump of the specific force by more than ``jolt_mps3`` between samples is a contact that clips the sensor, or that it
is too slow for: what it measured there is nearly worthless, and the correction goes there first.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from fes.estimation.compiled import jit
from fes.estimation.linear import solve
from fes.estimation.rotation import quaternion_step, to_sensor, to_world
from fes.signals import G_MPS2


class StrideNoise(NamedTuple):
    """Standard deviations of what can be wrong; one setting for all sensors and walkers."""

    start_tilt_rad: float = 0.015  # of the orientation filter at mid-stance
    gyr_bias_radps: float = 0.004  # what is left after calibration and filter
    acc_bias_mps2: float = 0.1
    gyr_noise_radps_rthz: float = 0.0005
    gyr_scale: float = 0.002  # share of the rate that is wrong, per √s: scale, clipping, non-orthogonality
    acc_noise_mps2_rthz: float = 0.05
    jolt_mps3: float = 8000.0
    jolt_share: float = 0.5  # of the excess jump that may be wrong
    end_velocity_mps: float = 0.005
    end_velocity_per_rate_m: float = 0.03  # the lever arm's uncertainty, times the rate at the end
    end_height_m: float = 0.01
    end_tilt_rad: float = 0.015
    end_tilt_per_rate_s: float = 0.1  # a foot that turns at the end also accelerates


@jit
def _strapdown(t_ns: Any, acc: Any, gyr: Any, quaternion: Any, velocity: Any, position: Any) -> None:
    """Trapezoid strapdown from row 0 of ``quaternion`` (N, 4) and ``velocity`` (N, 3); fills all rows."""
    n = t_ns.shape[0]
    w, x, y, z = quaternion[0, 0], quaternion[0, 1], quaternion[0, 2], quaternion[0, 3]
    position[0, 0], position[0, 1], position[0, 2] = 0.0, 0.0, 0.0
    ax0, ay0, az0 = to_world(w, x, y, z, acc[0, 0], acc[0, 1], acc[0, 2])
    for i in range(1, n):
        dt_s = 1e-9 * (t_ns[i] - t_ns[i - 1])
        w, x, y, z = quaternion_step(
            w,
            x,
            y,
            z,
            0.5 * (gyr[i - 1, 0] + gyr[i, 0]) * dt_s,
            0.5 * (gyr[i - 1, 1] + gyr[i, 1]) * dt_s,
            0.5 * (gyr[i - 1, 2] + gyr[i, 2]) * dt_s,
        )
        quaternion[i, 0], quaternion[i, 1], quaternion[i, 2], quaternion[i, 3] = w, x, y, z
        ax, ay, az = to_world(w, x, y, z, acc[i, 0], acc[i, 1], acc[i, 2])
        velocity[i, 0] = velocity[i - 1, 0] + 0.5 * dt_s * (ax0 + ax)
        velocity[i, 1] = velocity[i - 1, 1] + 0.5 * dt_s * (ay0 + ay)
        velocity[i, 2] = velocity[i - 1, 2] + dt_s * (0.5 * (az0 + az) - G_MPS2)
        for j in range(3):
            position[i, j] = position[i - 1, j] + 0.5 * dt_s * (velocity[i - 1, j] + velocity[i, j])
        ax0, ay0, az0 = ax, ay, az


@jit
def _turn_effect(i: int, last: int, left_s: float, velocity: Any, position: Any, out: Any) -> None:
    """What a small turn of the world by e_j at sample ``i`` does at the end, columns j of ``out`` (6, 3).

    Rows: velocity (3), height, tilt about x and y. A turn by θ changes all later specific force by θ × (R f).
    """
    # first and second integral of R f from sample i to the end
    dx = velocity[last, 0] - velocity[i, 0]
    dy = velocity[last, 1] - velocity[i, 1]
    dz = velocity[last, 2] - velocity[i, 2] + G_MPS2 * left_s
    ex = position[last, 0] - position[i, 0] - velocity[i, 0] * left_s
    ey = position[last, 1] - position[i, 1] - velocity[i, 1] * left_s
    out[0, 0], out[0, 1], out[0, 2] = 0.0, dz, -dy
    out[1, 0], out[1, 1], out[1, 2] = -dz, 0.0, dx
    out[2, 0], out[2, 1], out[2, 2] = dy, -dx, 0.0
    out[3, 0], out[3, 1], out[3, 2] = ey, -ex, 0.0
    out[4, 0], out[4, 1], out[4, 2] = 1.0, 0.0, 0.0
    out[5, 0], out[5, 1], out[5, 2] = 0.0, 1.0, 0.0


@jit
def _variances(i: int, t_ns: Any, acc: Any, gyr: Any, noise: StrideNoise) -> tuple[float, float]:
    """Variance of sample ``i``'s turn (rad²) over its interval, and of its velocity increment ((m/s)²)."""
    dt_s = 1e-9 * (t_ns[i] - t_ns[i - 1])
    rate2 = gyr[i, 0] ** 2 + gyr[i, 1] ** 2 + gyr[i, 2] ** 2
    turn = (noise.gyr_noise_radps_rthz**2 + noise.gyr_scale**2 * rate2) * dt_s
    jx, jy, jz = acc[i, 0] - acc[i - 1, 0], acc[i, 1] - acc[i - 1, 1], acc[i, 2] - acc[i - 1, 2]
    excess = math.sqrt(jx * jx + jy * jy + jz * jz) - noise.jolt_mps3 * dt_s
    push = noise.acc_noise_mps2_rthz**2 * dt_s
    if excess > 0.0:
        push += (noise.jolt_share * excess * dt_s) ** 2
    return turn, push


@jit
def most_likely(
    t_ns: Any,
    acc: Any,
    gyr: Any,
    start: Any,
    start_velocity: Any,
    end_velocity: Any,
    end_force: Any,
    end_rate_radps: float,
    equal_height: bool,
    noise: StrideNoise,
    quaternion: Any,
    velocity: Any,
    position: Any,
) -> bool:
    """Integrate one stride with the most likely errors taken out.

    Args:
        t_ns: (N,) time stamps.
        acc: (N, 3) specific force in m/s², free of calibrated bias.
        gyr: (N, 3) rad/s, free of calibrated bias.
        start: (4,) orientation at the first sample.
        start_velocity: (3,) m/s in the world, as the lever arm says.
        end_velocity: the same at the end.
        end_force: (3,) mean specific force around the end.
        end_rate_radps: how fast the foot turns at its ends.
        equal_height: whether the end is as high as the start.
        noise: the sizes of all errors.
        quaternion: (N, 4) to be filled.
        velocity: (N, 3) to be filled, m/s.
        position: (N, 3) to be filled, m from the start.

    Returns:
        False where there is nothing to integrate.
    """
    n = t_ns.shape[0]
    if n < 3 or t_ns[n - 1] <= t_ns[0]:
        return False
    last = n - 1
    for j in range(4):
        quaternion[0, j] = start[j]
    for j in range(3):
        velocity[0, j] = start_velocity[j]
    _strapdown(t_ns, acc, gyr, quaternion, velocity, position)

    system = np.zeros((6, 7))  # S + R, and the residual
    by_gyr = np.zeros((6, 3))  # effect of a constant gyroscope bias
    by_acc = np.zeros((6, 3))
    effect = np.zeros((6, 3))
    span_s = 1e-9 * (t_ns[last] - t_ns[0])
    for i in range(1, n):
        left_s = 1e-9 * (t_ns[last] - t_ns[i])
        dt_s = 1e-9 * (t_ns[i] - t_ns[i - 1])
        q0, q1, q2, q3 = quaternion[i, 0], quaternion[i, 1], quaternion[i, 2], quaternion[i, 3]
        _turn_effect(i, last, left_s, velocity, position, effect)
        turn, push = _variances(i, t_ns, acc, gyr, noise)
        for a in range(6):
            for b in range(6):
                system[a, b] += turn * (
                    effect[a, 0] * effect[b, 0] + effect[a, 1] * effect[b, 1] + effect[a, 2] * effect[b, 2]
                )
        for a in range(3):
            system[a, a] += push
        system[2, 3] += push * left_s
        system[3, 2] += push * left_s
        system[3, 3] += push * left_s * left_s
        for k in range(3):
            rx, ry, rz = to_world(
                q0, q1, q2, q3, 1.0 if k == 0 else 0.0, 1.0 if k == 1 else 0.0, 1.0 if k == 2 else 0.0
            )
            by_acc[0, k] += rx * dt_s
            by_acc[1, k] += ry * dt_s
            by_acc[2, k] += rz * dt_s
            by_acc[3, k] += rz * dt_s * left_s
            for a in range(6):
                by_gyr[a, k] += (effect[a, 0] * rx + effect[a, 1] * ry + effect[a, 2] * rz) * dt_s
    at_start = np.zeros((6, 3))
    _turn_effect(0, last, span_s, velocity, position, at_start)
    slip = noise.end_velocity_mps**2 + (noise.end_velocity_per_rate_m * end_rate_radps) ** 2
    tilt_variance = noise.end_tilt_rad**2 + (noise.end_tilt_per_rate_s * end_rate_radps) ** 2
    for a in range(6):
        for b in range(6):
            total = 0.0
            for k in range(3):
                total += noise.gyr_bias_radps**2 * by_gyr[a, k] * by_gyr[b, k]
                total += noise.acc_bias_mps2**2 * by_acc[a, k] * by_acc[b, k]
                if k < 2:
                    total += noise.start_tilt_rad**2 * at_start[a, k] * at_start[b, k]
            system[a, b] += total
    for a in range(3):
        system[a, a] += 2.0 * slip  # of the start, carried along, and of the end
    system[2, 3] += slip * span_s
    system[3, 2] += slip * span_s
    system[3, 3] += slip * span_s * span_s + (noise.end_height_m**2 if equal_height else 1e6)
    system[4, 4] += tilt_variance
    system[5, 5] += tilt_variance

    ux, uy, uz = to_world(
        quaternion[last, 0],
        quaternion[last, 1],
        quaternion[last, 2],
        quaternion[last, 3],
        end_force[0],
        end_force[1],
        end_force[2],
    )
    across = math.sqrt(ux * ux + uy * uy)
    tilt = math.atan2(across, uz)
    per = tilt / across if across > 1e-12 else 0.0
    for a in range(3):
        system[a, 6] = end_velocity[a] - velocity[last, a]
    system[3, 6] = -position[last, 2]
    system[4, 6] = per * uy
    system[5, 6] = -per * ux
    if not solve(system, 6):
        return False
    _apply(t_ns, acc, gyr, noise, slip, span_s, system, by_gyr, by_acc, at_start, quaternion, velocity, position)
    return True


@jit
def _apply(
    t_ns: Any,
    acc: Any,
    gyr: Any,
    noise: StrideNoise,
    slip: float,
    span_s: float,
    system: Any,
    by_gyr: Any,
    by_acc: Any,
    at_start: Any,
    quaternion: Any,
    velocity: Any,
    position: Any,
) -> None:
    """Correct the inputs by their share of the dual solution (column 6) and integrate again."""
    n = t_ns.shape[0]
    last = n - 1
    gyr_bias, acc_bias, tilt = np.zeros(3), np.zeros(3), np.zeros(3)
    for k in range(3):
        for a in range(6):
            gyr_bias[k] += noise.gyr_bias_radps**2 * by_gyr[a, k] * system[a, 6]
            acc_bias[k] += noise.acc_bias_mps2**2 * by_acc[a, k] * system[a, 6]
            if k < 2:
                tilt[k] += noise.start_tilt_rad**2 * at_start[a, k] * system[a, 6]
    rates, forces = np.empty((n, 3)), np.empty((n, 3))
    effect = np.zeros((6, 3))
    for i in range(n):
        q0, q1, q2, q3 = quaternion[i, 0], quaternion[i, 1], quaternion[i, 2], quaternion[i, 3]
        wx = wy = wz = px = py = pz = 0.0
        if i > 0:
            left_s = 1e-9 * (t_ns[last] - t_ns[i])
            dt_s = 1e-9 * (t_ns[i] - t_ns[i - 1])
            _turn_effect(i, last, left_s, velocity, position, effect)
            turn, push = _variances(i, t_ns, acc, gyr, noise)
            for a in range(6):
                share = turn * system[a, 6] / dt_s
                wx += effect[a, 0] * share
                wy += effect[a, 1] * share
                wz += effect[a, 2] * share
            px = push * system[0, 6] / dt_s
            py = push * system[1, 6] / dt_s
            pz = push * (system[2, 6] + system[3, 6] * left_s) / dt_s
        wx, wy, wz = to_sensor(q0, q1, q2, q3, wx, wy, wz)
        px, py, pz = to_sensor(q0, q1, q2, q3, px, py, pz)
        rates[i, 0], rates[i, 1], rates[i, 2] = (
            gyr[i, 0] + gyr_bias[0] + wx,
            gyr[i, 1] + gyr_bias[1] + wy,
            gyr[i, 2] + gyr_bias[2] + wz,
        )
        forces[i, 0], forces[i, 1], forces[i, 2] = (
            acc[i, 0] + acc_bias[0] + px,
            acc[i, 1] + acc_bias[1] + py,
            acc[i, 2] + acc_bias[2] + pz,
        )
    q0, q1, q2, q3 = quaternion[0, 0], quaternion[0, 1], quaternion[0, 2], quaternion[0, 3]
    tx, ty, tz = to_sensor(q0, q1, q2, q3, tilt[0], tilt[1], 0.0)
    quaternion[0, 0], quaternion[0, 1], quaternion[0, 2], quaternion[0, 3] = quaternion_step(q0, q1, q2, q3, tx, ty, tz)
    velocity[0, 0] += slip * system[0, 6]
    velocity[0, 1] += slip * system[1, 6]
    velocity[0, 2] += slip * (system[2, 6] + system[3, 6] * span_s)
    _strapdown(t_ns, forces, rates, quaternion, velocity, position)
