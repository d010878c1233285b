"""Compiled covariance of the off-line ZUPT filter over one step of ``fes.estimation.zupt_steps``.

The error state is that of ``fes.estimation.zupt_covariance``. Over a step that lasts T, with its push ``b``, its shift
``a``, ``c = b - a/T`` and the integral ``R`` of the orientation, all in the world::

    dp' = dp + T dv + psi × a - T/2 R b_a,  dv' = dv + psi × b - R b_a + c × R b_g,  dpsi' = dpsi - R b_g

where ``c`` is how much of the push comes after a turn that grows evenly.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from fes.estimation.compiled import jit
from fes.estimation.zupt_covariance import BIASES, DIAGONAL, STATES, WIDTH
from fes.estimation.zupt_kernel import ZuptSettings
from fes.signals import G_MPS2


def carrier(
    along: int, across: int, out_along: int, out_across: int, count: int
) -> Callable[[Any, Any, Any, Any, float], None]:
    """Compile ``Φ x`` for ``count`` vectors ``x`` in flat storage, as ``fes.estimation.zupt_covariance.carrier``.

    ``r`` (3, 3) is ``R``, and the rows of ``f`` (3, 3) are ``b``, ``a`` and ``c``.
    """

    @jit
    def carry(x: Any, out: Any, r: Any, f: Any, dt: float) -> None:
        b0, b1, b2 = f[0, 0], f[0, 1], f[0, 2]
        a0, a1, a2 = f[1, 0], f[1, 1], f[1, 2]
        c0, c1, c2 = f[2, 0], f[2, 1], f[2, 2]
        r00, r01, r02 = r[0, 0], r[0, 1], r[0, 2]
        r10, r11, r12 = r[1, 0], r[1, 1], r[1, 2]
        r20, r21, r22 = r[2, 0], r[2, 1], r[2, 2]
        for i in range(count):
            k, o = i * across, i * out_across
            v0, v1, v2 = x[k + 3 * along], x[k + 4 * along], x[k + 5 * along]
            s0, s1, s2 = x[k + 6 * along], x[k + 7 * along], x[k + 8 * along]
            g0, g1, g2 = x[k + 9 * along], x[k + 10 * along], x[k + 11 * along]
            d0, d1, d2 = x[k + 12 * along], x[k + 13 * along], x[k + 14 * along]
            e0 = r00 * d0 + r01 * d1 + r02 * d2
            e1 = r10 * d0 + r11 * d1 + r12 * d2
            e2 = r20 * d0 + r21 * d1 + r22 * d2
            h0 = r00 * g0 + r01 * g1 + r02 * g2
            h1 = r10 * g0 + r11 * g1 + r12 * g2
            h2 = r20 * g0 + r21 * g1 + r22 * g2
            out[o] = x[k] + dt * (v0 - 0.5 * e0) + (s1 * a2 - s2 * a1)
            out[o + out_along] = x[k + along] + dt * (v1 - 0.5 * e1) + (s2 * a0 - s0 * a2)
            out[o + 2 * out_along] = x[k + 2 * along] + dt * (v2 - 0.5 * e2) + (s0 * a1 - s1 * a0)
            out[o + 3 * out_along] = v0 - e0 + (s1 * b2 - s2 * b1) + (c1 * h2 - c2 * h1)
            out[o + 4 * out_along] = v1 - e1 + (s2 * b0 - s0 * b2) + (c2 * h0 - c0 * h2)
            out[o + 5 * out_along] = v2 - e2 + (s0 * b1 - s1 * b0) + (c0 * h1 - c1 * h0)
            out[o + 6 * out_along] = s0 - h0
            out[o + 7 * out_along] = s1 - h1
            out[o + 8 * out_along] = s2 - h2

    return carry


carry_one = carrier(1, STATES, 1, STATES, 1)
_carry_columns = carrier(WIDTH, 1, WIDTH, 1, WIDTH)
_carry_rows = carrier(1, WIDTH, WIDTH, 1, BIASES)  # what goes in as a row comes out as a column


@jit
def predict(P: Any, half: Any, r: Any, f: Any, dt: float) -> None:
    """``P ← Φ P Φᵀ`` for a symmetric ``P``, 15 rows of 16 in flat storage; ``half`` (9, 16), flat, is scratch."""
    _carry_columns(P, half, r, f, dt)
    _carry_rows(half, P, r, f, dt)
    for b in range(BIASES):  # rounding makes the halves differ, and nothing would ever bring them together
        for a in range(b):
            P[b * WIDTH + a] = P[a * WIDTH + b]
    for b in range(BIASES, STATES):
        for a in range(BIASES):
            P[a * WIDTH + b] = P[b * WIDTH + a] = half[a * WIDTH + b]


@jit
def step_noise(k: int, steps: Any, m: Any, f: Any, dt: float, p: ZuptSettings, out: Any) -> None:
    """Covariance that the noise of step ``k`` adds.

    ``out`` (16,): of the place, of place with velocity, of the turn, of velocity with the turn (3), of the velocity
    (9), and 0, for what a filter that is lost adds. ``m`` (3, 3) is the orientation where the step begins, ``f`` (3, 3)
    as for :func:`carrier`, biases out.
    """
    g, noise = G_MPS2, steps.noise
    white, share = p.acc_noise_mps2_rthz**2, p.acc_scale_noise**2
    twice = m[2, 0] * noise[k, 7] + m[2, 1] * noise[k, 8] + m[2, 2] * noise[k, 9]
    # the acceleration squared is that of the force less gravity
    v = white * dt + share * (noise[k, 0] - 2.0 * g * f[0, 2] + g * g * dt) + noise[k, 3]
    out[1] = 0.5 * white * dt * dt + share * (noise[k, 1] - 2.0 * g * f[1, 2] + 0.5 * g * g * dt * dt) + noise[k, 4]
    out[0] = white * dt**3 / 3.0 + share * (noise[k, 2] - 2.0 * g * twice + g * g * dt**3 / 3.0) + noise[k, 5]
    out[2] = noise[k, 6]
    for a in range(3):
        out[3 + a] = m[a, 0] * noise[k, 10] + m[a, 1] * noise[k, 11] + m[a, 2] * noise[k, 12]
    trace = noise[k, 13] + noise[k, 16] + noise[k, 18]
    for a in range(3):
        x = m[a, 0] * noise[k, 13] + m[a, 1] * noise[k, 14] + m[a, 2] * noise[k, 15]
        y = m[a, 0] * noise[k, 14] + m[a, 1] * noise[k, 16] + m[a, 2] * noise[k, 17]
        z = m[a, 0] * noise[k, 15] + m[a, 1] * noise[k, 17] + m[a, 2] * noise[k, 18]
        for b in range(3):
            out[6 + 3 * a + b] = (v + trace if a == b else 0.0) - (x * m[b, 0] + y * m[b, 1] + z * m[b, 2])
    out[15] = 0.0


@jit
def add_noise(P: Any, q: Any, dt: float, p: ZuptSettings) -> None:
    """Add what ``step_noise`` found."""
    for a in range(3):
        P[a * DIAGONAL] += q[0]
        P[a * WIDTH + 3 + a] += q[1]
        P[(3 + a) * WIDTH + a] += q[1]
        P[(6 + a) * DIAGONAL] += q[2]
        P[(9 + a) * DIAGONAL] += p.rate_walk_radps_rts**2 * dt
        P[(12 + a) * DIAGONAL] += p.acc_walk_mps2_rts**2 * dt
        for b in range(3):
            P[(3 + a) * WIDTH + 3 + b] += q[6 + 3 * a + b]
        b, c = (a + 1) % 3, (a + 2) % 3
        P[(3 + b) * WIDTH + 6 + c] += q[3 + a]
        P[(6 + c) * WIDTH + 3 + b] += q[3 + a]
        P[(3 + c) * WIDTH + 6 + b] -= q[3 + a]
        P[(6 + b) * WIDTH + 3 + c] -= q[3 + a]


@jit
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
