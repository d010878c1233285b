"""Compiled fixed-interval smoothing of the ZUPT-aided filter's tape.

Source: Bierman (1973), "Fixed interval smoothing with discrete measurements": an adjoint vector runs backwards through
intervals and measurements (the modified Bryson-Frazier form); then Koopman (1993), "Disturbance smoother for state
space models": the start's error and each interval's noise are their own variance times the adjoint, and carrying them
forward gives each sample's correction. The estimates are those of Rauch, Tung and Striebel; nothing is inverted, and no
sample's covariance is needed.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from fes.estimation.compiled import jit
from fes.estimation.zupt_covariance import STATES, carry_one
from fes.estimation.zupt_kernel import MEASURED, Tape, ZuptSettings, start_variances, turned


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
