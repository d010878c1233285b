"""Compiled fixed-interval smoothing of the off-line ZUPT filter's tape, and its path at any instant.

As ``fes.estimation.zupt_smooth``, after Bierman (1973) and Koopman (1993), from step to step.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from fes.estimation.compiled import jit_fused
from fes.estimation.rotation import quaternion_step, to_sensor
from fes.estimation.zupt_covariance import STATES
from fes.estimation.zupt_kernel import MEASURED, ZuptSettings, start_variances
from fes.estimation.zupt_step_covariance import carry_one, spread_noise
from fes.estimation.zupt_step_filter import ADDED, StepTape


@jit_fused
def _carry_back(k: int, x: Any, r: Any, f: Any, dt: float) -> None:
    """``λ ← Φᵀ λ`` for the adjoint (15,) over step ``k``."""
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


@jit_fused
def _adjoints(t_ns: Any, ends: Any, tape: StepTape, out: Any) -> None:
    """The adjoint (K, 15) before each step's measurement: what all that follows says of the error there."""
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
            _carry_back(k, x, tape.mean, tape.push, 1e-9 * (t_ns[ends[k]] - t_ns[ends[k - 1]]))


@jit_fused
def smooth_steps(t_ns: Any, ends: Any, at_rest: bool, p: ZuptSettings, tape: StepTape) -> None:
    """Smoothing, in place, of position, velocity and orientation that ``forward_steps`` left."""
    count = ends.shape[0]
    adjoint = np.empty((count, STATES))
    _adjoints(t_ns, ends, tape, adjoint)
    dx, start = np.zeros(STATES), np.empty(STATES)
    start_variances(at_rest, p, start)
    for a in range(STATES):
        dx[a] = -start[a] * adjoint[0, a]
    for k in range(count):
        if k > 0:
            dt = 1e-9 * (t_ns[ends[k]] - t_ns[ends[k - 1]])
            carry_one(dx, k, tape.mean, tape.push, dt)
            spread_noise(k, dx, tape.added, adjoint, dt, p)
        lost = tape.added[k, ADDED - 1]
        if lost > 0.0:
            for j in range(3):
                dx[3 + j] -= lost * adjoint[k, 3 + j]
                dx[6 + j] -= p.lost_tilt_rad**2 * adjoint[k, 6 + j]
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


@jit_fused
def path_at(known_ns: Any, position: Any, velocity: Any, asked_ns: Any, out: Any) -> None:
    """Fill ``out`` (M, 3) with the place at instants (M,), best in order: cubic between K places and velocities.

    Before the first and after the last the path stands still.
    """
    k, last = 0, known_ns.shape[0] - 1
    for i in range(asked_ns.shape[0]):
        while k > 0 and known_ns[k] >= asked_ns[i]:
            k -= 1
        while k < last - 1 and known_ns[k + 1] < asked_ns[i]:
            k += 1
        span_s = 1e-9 * (known_ns[k + 1] - known_ns[k])
        u = min(max(1e-9 * (asked_ns[i] - known_ns[k]) / span_s, 0.0), 1.0)
        share, begin, end = u * u * (3.0 - 2.0 * u), u * (1.0 - u) * (1.0 - u) * span_s, u * u * (1.0 - u) * span_s
        for j in range(3):
            way = position[k + 1, j] - position[k, j]
            out[i, j] = position[k, j] + share * way + begin * velocity[k, j] - end * velocity[k + 1, j]


@jit_fused
def turn_path(position: Any, velocity: Any, quaternions: Any, turn: float, shift: Any) -> None:
    """Turn K places, velocities, orientations about the vertical by ``turn`` (rad), then shift the places by (3,)."""
    c, s, w, z = math.cos(turn), math.sin(turn), math.cos(0.5 * turn), math.sin(0.5 * turn)
    for i in range(position.shape[0]):
        x, y = position[i, 0], position[i, 1]
        position[i, 0], position[i, 1] = c * x - s * y + shift[0], s * x + c * y + shift[1]
        position[i, 2] += shift[2]
        x, y = velocity[i, 0], velocity[i, 1]
        velocity[i, 0], velocity[i, 1] = c * x - s * y, s * x + c * y
        q0, q1, q2, q3 = quaternions[i, 0], quaternions[i, 1], quaternions[i, 2], quaternions[i, 3]
        quaternions[i, 0], quaternions[i, 1] = w * q0 - z * q3, w * q1 - z * q2
        quaternions[i, 2], quaternions[i, 3] = w * q2 + z * q1, w * q3 + z * q0
