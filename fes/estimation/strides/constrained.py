"""Constrained, bias-corrected integration of one stride.

Source: Negård et al. (2005), Eq. (14)–(20). Velocity is known at both ends and height is equal at both ends; an
artificial accelerometer bias absorbs the rest. Departures from the print:

- (16) has three unknowns and spends all of them on velocity, so the equal height that the text asks for cannot be met.
  Here the bias may vary linearly in time, ``gamma(tau) = gamma0 + gamma1·(2 tau - 1)``, tau from 0 to 1 over the
  stride, and is the smallest one that meets all four constraints. On stairs and slopes the height constraint is
  switched off
  and the height gained is reported.
- trapezoid sums instead of the rectangles of (15), (17), (18), which lag by half a sample.
- the velocity at the ends need not be zero: the foot is never wholly at rest, and turns about its ground contact there.
- the orientation's tilt is brought towards what gravity says at the end by a constant extra rate, of which only a share
  is applied (``end_tilt_gain``): the accelerometer of a foot that is not wholly at rest does not measure gravity alone.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from fes.estimation.numerics.jit import jit_fused
from fes.estimation.numerics.linear import solve
from fes.estimation.numerics.rotation import axes_in_world, to_sensor, to_world, turn_by
from fes.signals import G_MPS2


@jit_fused
def orient(
    t_ns: Any, gyr: Any, start: Any, end_fx: float, end_fy: float, end_fz: float, end_tilt_gain: float, out: Any
) -> float:
    """Integrate the rates from the orientation ``start`` (4,) into ``out`` (N, 4).

    ``gyr`` (N, 3) bias-free rad/s. ``end_f`` is the direction of gravity that the accelerometer measured at the end, in
    the sensor frame (any length); ``end_tilt_gain`` is the share (0–1) of the tilt found there that is taken back,
    spread evenly over the time. Returns that tilt in rad, pi where no force at all was measured.
    """
    n = t_ns.shape[0]
    _integrate(t_ns, gyr, start, 0.0, 0.0, 0.0, out)
    ux, uy, uz = to_world(out[n - 1, 0], out[n - 1, 1], out[n - 1, 2], out[n - 1, 3], end_fx, end_fy, end_fz)
    norm = math.sqrt(ux * ux + uy * uy + uz * uz)
    if norm < 1e-9:
        return math.pi
    # turning the world vector u onto z: about u × z, by the angle between them
    across = math.sqrt(ux * ux + uy * uy) / norm
    tilt = math.atan2(across, uz / norm)
    if end_tilt_gain > 0.0 and across > 1e-9:
        by = end_tilt_gain * tilt / (across * norm)
        _integrate(t_ns, gyr, start, by * uy, -by * ux, 0.0, out)
    return tilt


@jit_fused
def _integrate(t_ns: Any, gyr: Any, start: Any, dx: float, dy: float, dz: float, out: Any) -> None:
    """Trapezoid integration of the rates, plus a turn by the world vector ``d`` (rad) spread evenly over the time."""
    n = t_ns.shape[0]
    span_ns = t_ns[n - 1] - t_ns[0]
    turning = dx != 0.0 or dy != 0.0 or dz != 0.0
    w, x, y, z = start[0], start[1], start[2], start[3]
    out[0, 0], out[0, 1], out[0, 2], out[0, 3] = w, x, y, z
    for i in range(1, n):
        dt_s = 1e-9 * (t_ns[i] - t_ns[i - 1])
        ex = ey = ez = 0.0
        if turning:
            share = (t_ns[i] - t_ns[i - 1]) / span_ns
            ex, ey, ez = to_sensor(w, x, y, z, dx * share, dy * share, dz * share)
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
def integrate(
    t_ns: Any,
    acc: Any,
    quaternions: Any,
    start_velocity: Any,
    end_velocity: Any,
    equal_height: bool,
    velocity: Any,
    position: Any,
    gamma: Any,
) -> bool:
    """Position over one stride from specific force and orientation, meeting the constraints exactly.

    ``acc`` (N, 3) m/s²; ``start_velocity``, ``end_velocity`` (3,) m/s in the world. Fills ``velocity`` (N, 3) in m/s,
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
    count = 4 if equal_height else 3
    # smallest gamma with effect · gamma = residual: gamma = effectᵀ (effect effectᵀ)⁻¹ residual
    system = np.zeros((4, 5))
    for i in range(count):
        for j in range(count):
            for k in range(6):
                system[i, j] += effect[i, k] * effect[j, k]
        system[i, 4] = position[n - 1, 2] if i == 3 else velocity[n - 1, i] - end_velocity[i]
    if not solve(system, count):
        return False
    for k in range(6):
        for i in range(count):
            gamma[k // 3, k % 3] += effect[i, k] * system[i, 4]
    double_integral(t_ns, acc, quaternions, start_velocity, gamma, velocity, position)
    return True


@jit_fused
def double_integral(
    t_ns: Any, acc: Any, quaternions: Any, start_velocity: Any, gamma: Any, velocity: Any, position: Any
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


@jit_fused
def effects(t_ns: Any, quaternions: Any, effect: Any) -> None:
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
