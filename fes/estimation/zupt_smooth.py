"""Compiled fixed-interval smoothing of the ZUPT-aided filter's tape.

Source: Bierman (1973), "Fixed interval smoothing with discrete measurements": the modified Bryson-Frazier form. An
adjoint vector and its information run backwards through intervals and measurements; each sample's correction is its own
covariance times the adjoint. The estimates are those of Rauch, Tung and Striebel; nothing is inverted.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from fes.estimation.compiled import jit
from fes.estimation.zupt_kernel import MEASURED, STATES, Tape, turned


@jit
def _carry_back(L: Any, r: Any, f: Any, dt: float) -> None:
    """``L ← Φᵀ L`` row by row; on the transposed view it gives ``L Φ``."""
    for c in range(L.shape[1]):
        u0 = dt * (L[3, c] + 0.5 * dt * L[0, c])
        u1 = dt * (L[4, c] + 0.5 * dt * L[1, c])
        u2 = dt * (L[5, c] + 0.5 * dt * L[2, c])
        for j in range(3):
            L[9 + j, c] -= dt * (r[0, j] * L[6, c] + r[1, j] * L[7, c] + r[2, j] * L[8, c])
            L[12 + j, c] -= r[0, j] * u0 + r[1, j] * u1 + r[2, j] * u2
        L[6, c] += f[1] * u2 - f[2] * u1
        L[7, c] += f[2] * u0 - f[0] * u2
        L[8, c] += f[0] * u1 - f[1] * u0
        for j in range(3):
            L[3 + j, c] += dt * L[j, c]


@jit
def smooth(
    t_ns: Any,
    tape: Tape,
) -> None:
    """Fixed-interval smoothing in place of what :func:`forward` left: states, and the covariance of each sample."""
    n = t_ns.shape[0]
    lam = np.zeros((STATES, 1))  # the adjoint, and its information
    info = np.zeros((STATES, STATES))
    dx = np.empty(STATES)
    work, product = np.empty((STATES, STATES)), np.empty(STATES)
    for i in range(n - 1, -1, -1):
        P = tape.covariance[i]
        for a in range(STATES):
            total = 0.0
            for b in range(STATES):
                total -= P[a, b] * lam[b, 0]
            dx[a] = total
        future = i + 1 < n  # else there is nothing to learn yet
        measured = tape.residual_var[i]
        if future:
            for a in range(STATES):
                for b in range(STATES):
                    total = 0.0
                    for c in range(STATES):
                        total += P[a, c] * info[c, b]
                    work[a, b] = total
        # back through the sample's own measurements, last first, and its interval
        for k in range(MEASURED - 1, -1, -1):
            if measured[k] <= 0.0:
                continue
            j = 2 if k == 3 else 3 + k
            K = tape.gain[i, k]
            along, twice = 0.0, 0.0
            for a in range(STATES):
                along += K[a] * lam[a, 0]
                total = 0.0
                for b in range(STATES):
                    total += info[a, b] * K[b]
                product[a] = total
            for a in range(STATES):
                twice += K[a] * product[a]
            lam[j, 0] -= along + tape.residual[i, k] / measured[k]
            for a in range(STATES):
                info[a, j] -= product[a]
                info[j, a] -= product[a]
            info[j, j] += twice + 1.0 / measured[k]
        if i > 0:
            dt = 1e-9 * (t_ns[i] - t_ns[i - 1])
            _carry_back(lam, tape.rotation[i], tape.force[i], dt)
            _carry_back(info, tape.rotation[i], tape.force[i], dt)
            _carry_back(info.T, tape.rotation[i], tape.force[i], dt)
        for j in range(3):
            tape.position[i, j] += dx[j]
            tape.velocity[i, j] += dx[3 + j]
            tape.gyr_bias[i, j] += dx[9 + j]
            tape.acc_bias[i, j] += dx[12 + j]
        turned(tape.quaternions[i], dx[6], dx[7], dx[8], tape.quaternions[i])
        if future:
            _shrink(P, work)


@jit
def _shrink(P: Any, work: Any) -> None:
    """``P ← P - W P`` with ``W = P Λ``; symmetric by construction but for rounding, which is averaged away."""
    out = np.empty((STATES, STATES))
    for a in range(STATES):
        for b in range(STATES):
            total = P[a, b]
            for c in range(STATES):
                total -= work[a, c] * P[c, b]
            out[a, b] = total
    for a in range(STATES):
        for b in range(STATES):
            P[a, b] = 0.5 * (out[a, b] + out[b, a])
