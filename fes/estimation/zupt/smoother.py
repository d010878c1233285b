"""Compiled fixed-interval smoothing of the ZUPT-aided filter's tape.

Source: Bierman (1973), "Fixed interval smoothing with discrete measurements": an adjoint vector runs backwards through
intervals and measurements (the modified Bryson-Frazier form); then Koopman (1993), "Disturbance smoother for state
space models": the start's error and each interval's noise are their own variance times the adjoint, and carrying them
forward gives each sample's correction. The estimates are those of Rauch, Tung and Striebel; nothing is inverted, and no
sample's covariance is needed.

Compiled fixed-interval smoothing of the off-line ZUPT filter's tape, and its path at any instant.

As ``fes.estimation.zupt.smoother``, after Bierman (1973) and Koopman (1993), from step to step.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from fes.estimation.numerics.jit import jit, jit_fused
from fes.estimation.numerics.rotation import quaternion_step, to_sensor
from fes.estimation.zupt.covariance import STATES, carry_one
from fes.estimation.zupt.decimated_filter import ADDED, IntervalTape, carry_one_interval, spread_noise
from fes.estimation.zupt.filter import MEASURED, Tape, ZuptSettings, start_variances, turned


@jit_fused
def _carry_interval_back(k: int, x: Any, r: Any, f: Any, dt: float) -> None:
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
def _interval_adjoints(t_ns: Any, ends: Any, tape: IntervalTape, out: Any) -> None:
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
            _carry_interval_back(k, x, tape.mean, tape.push, 1e-9 * (t_ns[ends[k]] - t_ns[ends[k - 1]]))


@jit_fused
def smooth_steps(t_ns: Any, ends: Any, at_rest: bool, p: ZuptSettings, tape: IntervalTape) -> None:
    """Smoothing, in place, of position, velocity and orientation that ``forward_steps`` left."""
    count = ends.shape[0]
    adjoint = np.empty((count, STATES))
    _interval_adjoints(t_ns, ends, tape, adjoint)
    dx, start = np.zeros(STATES), np.empty(STATES)
    start_variances(at_rest, p, start)
    for a in range(STATES):
        dx[a] = -start[a] * adjoint[0, a]
    for k in range(count):
        if k > 0:
            dt = 1e-9 * (t_ns[ends[k]] - t_ns[ends[k - 1]])
            carry_one_interval(dx, k, tape.mean, tape.push, dt)
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


@jit
def _carry_back(L: Any, r: Any, f: Any, dt: float) -> None:
    """``L ← Φᵀ L`` for the adjoint (15,)."""
    u0 = dt * (L[3] + 0.5 * dt * L[0])
    u1 = dt * (L[4] + 0.5 * dt * L[1])
    u2 = dt * (L[5] + 0.5 * dt * L[2])
    for j in range(3):
        L[9 + j] -= dt * (r[0, j] * L[6] + r[1, j] * L[7] + r[2, j] * L[8])
        L[12 + j] -= r[0, j] * u0 + r[1, j] * u1 + r[2, j] * u2
    L[6] += f[1] * u2 - f[2] * u1
    L[7] += f[2] * u0 - f[0] * u2
    L[8] += f[0] * u1 - f[1] * u0
    for j in range(3):
        L[3 + j] += dt * L[j]


@jit
def _state(k: int) -> int:
    """The state that a sample's measurement ``k`` is of."""
    return 2 if k == 3 else 3 + k


@jit
def _adjoints(t_ns: Any, tape: Tape, out: Any) -> None:
    """The adjoint (N, 15) before each sample's measurements: what all that follows says of the error there."""
    lam = np.zeros(STATES)
    for i in range(t_ns.shape[0] - 1, -1, -1):
        for k in range(MEASURED - 1, -1, -1):  # last first
            variance = tape.residual_var[i, k]
            if variance > 0.0:
                along = tape.residual[i, k] / variance
                for a in range(STATES):
                    along += tape.gain[i, k, a] * lam[a]
                lam[_state(k)] -= along
        for a in range(STATES):
            out[i, a] = lam[a]
        if i > 0:
            _carry_back(lam, tape.rotation[i], tape.force[i], 1e-9 * (t_ns[i] - t_ns[i - 1]))


@jit
def smooth(t_ns: Any, at_rest: bool, p: ZuptSettings, tape: Tape) -> None:
    """Fixed-interval smoothing, in place, of the states that ``forward`` left; ``at_rest`` at the first sample."""
    n = t_ns.shape[0]
    adjoint = np.empty((n, STATES))
    _adjoints(t_ns, tape, adjoint)
    dx, start = np.zeros(STATES), np.empty(STATES)
    start_variances(at_rest, p, start)
    for a in range(STATES):
        dx[a] = -start[a] * adjoint[0, a]
    for i in range(n):
        lam = adjoint[i]
        if i > 0:
            dt = 1e-9 * (t_ns[i] - t_ns[i - 1])
            carry_one(dx, dx, tape.rotation[i], tape.force[i], dt)
            for j in range(3):
                push = tape.added[i, 0] * (lam[3 + j] + 0.5 * dt * lam[j])
                dx[j] -= 0.5 * dt * push
                dx[3 + j] -= push
                dx[6 + j] -= tape.added[i, 1] * lam[6 + j]
                dx[9 + j] -= p.rate_walk_radps_rts**2 * dt * lam[9 + j]
                dx[12 + j] -= p.acc_walk_mps2_rts**2 * dt * lam[12 + j]
        if tape.added[i, 2] > 0.0:
            for j in range(3):
                dx[3 + j] -= tape.added[i, 2] * lam[3 + j]
                dx[6 + j] -= p.lost_tilt_rad**2 * lam[6 + j]
        for k in range(MEASURED):
            if tape.residual_var[i, k] > 0.0:  # the filter has taken this correction already
                for a in range(STATES):
                    dx[a] -= tape.gain[i, k, a] * tape.residual[i, k]
        for j in range(3):
            tape.position[i, j] += dx[j]
            tape.velocity[i, j] += dx[3 + j]
            tape.gyr_bias[i, j] += dx[9 + j]
            tape.acc_bias[i, j] += dx[12 + j]
        turned(tape.quaternions[i], dx[6], dx[7], dx[8], tape.quaternions[i])
