"""Compiled covariance of the ZUPT-aided filter: prediction and measurement of its fifteen error states.

The error state is p, v, psi, b_g, b_a (15): errors of position and velocity in the world, a small rotation in the world
(``R_true = exp(psi) R``), and of the gyroscope's and accelerometer's bias in the sensor frame. With ``f`` the mean
specific force of a sampling interval in the world and ``R`` the orientation in its middle::

    dp/dt = v,  dv/dt = psi × f - R b_a,  dpsi/dt = -R b_g

so the transition is the identity but for a few 3 × 3 blocks, which the loops below use.

A covariance is kept as 15 rows of 16 in flat storage: a whole number of vector registers, and strides that the compiler
knows, so that most of the work is done for eight elements at a time.

Compiled covariance of the off-line ZUPT filter over one step of ``fes.estimation.zupt.decimated_filter``.

The error state is that of ``fes.estimation.zupt.covariance``. Over a step that lasts T, with its push ``b``, its shift
``a``, ``c = b - a/T`` and the integral ``R`` of the orientation, all in the world::

    dp' = dp + T dv + psi × a - T/2 R b_a,  dv' = dv + psi × b - R b_a + c × R b_g,  dpsi' = dpsi - R b_g

where ``c`` is how much of the push comes after a turn that grows evenly.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from fes.estimation.numerics.jit import jit, jit_fused

STATES = 15
BIASES = 9  # where they begin
WIDTH = 16  # of the covariance's rows: a whole number of vector registers
DIAGONAL = WIDTH + 1  # from one of its diagonal's elements to the next


def carrier(
    along: int, across: int, out_along: int, out_across: int, count: int
) -> Callable[[Any, Any, Any, Any, float], None]:
    """Compile ``Φ x`` for ``count`` vectors ``x`` in flat storage; only p, v, psi go into ``out``, the biases stay.

    A vector's elements lie ``along`` apart and vectors ``across`` apart. The compiler knows these strides, so vectors
    that lie side by side go through its wide registers together.
    """

    @jit
    def carry(x: Any, out: Any, r: Any, f: Any, dt: float) -> None:
        f0, f1, f2 = f[0], f[1], f[2]
        r00, r01, r02 = r[0, 0], r[0, 1], r[0, 2]
        r10, r11, r12 = r[1, 0], r[1, 1], r[1, 2]
        r20, r21, r22 = r[2, 0], r[2, 1], r[2, 2]
        for c in range(count):
            k, o = c * across, c * out_across
            p0, p1, p2 = x[k], x[k + along], x[k + 2 * along]
            v0, v1, v2 = x[k + 3 * along], x[k + 4 * along], x[k + 5 * along]
            s0, s1, s2 = x[k + 6 * along], x[k + 7 * along], x[k + 8 * along]
            g0, g1, g2 = x[k + 9 * along], x[k + 10 * along], x[k + 11 * along]
            b0, b1, b2 = x[k + 12 * along], x[k + 13 * along], x[k + 14 * along]
            d0 = dt * (s1 * f2 - s2 * f1 - (r00 * b0 + r01 * b1 + r02 * b2))
            d1 = dt * (s2 * f0 - s0 * f2 - (r10 * b0 + r11 * b1 + r12 * b2))
            d2 = dt * (s0 * f1 - s1 * f0 - (r20 * b0 + r21 * b1 + r22 * b2))
            out[o] = p0 + dt * (v0 + 0.5 * d0)
            out[o + out_along] = p1 + dt * (v1 + 0.5 * d1)
            out[o + 2 * out_along] = p2 + dt * (v2 + 0.5 * d2)
            out[o + 3 * out_along] = v0 + d0
            out[o + 4 * out_along] = v1 + d1
            out[o + 5 * out_along] = v2 + d2
            out[o + 6 * out_along] = s0 - dt * (r00 * g0 + r01 * g1 + r02 * g2)
            out[o + 7 * out_along] = s1 - dt * (r10 * g0 + r11 * g1 + r12 * g2)
            out[o + 8 * out_along] = s2 - dt * (r20 * g0 + r21 * g1 + r22 * g2)

    return carry


carry_one = carrier(1, STATES, 1, STATES, 1)
_carry_columns = carrier(WIDTH, 1, WIDTH, 1, WIDTH)
_carry_rows = carrier(1, WIDTH, WIDTH, 1, BIASES)  # what goes in as a row comes out as a column


@jit_fused
def predict(P: Any, half: Any, r: Any, f: Any, dt: float) -> None:
    """``P ← Φ P Φᵀ`` for a symmetric ``P``, 15 rows of 16 in flat storage (the last column fills the registers).

    ``half`` (9, 16), flat, receives ``Φ P``, whose columns of the biases are final.
    """
    _carry_columns(P, half, r, f, dt)
    _carry_rows(half, P, r, f, dt)
    for a in range(BIASES):
        for b in range(a + 1, BIASES):  # rounding makes the halves differ, and nothing would ever bring them together
            P[b * WIDTH + a] = P[a * WIDTH + b]
        for b in range(BIASES, STATES):
            P[a * WIDTH + b] = P[b * WIDTH + a] = half[a * WIDTH + b]


@jit_fused
def update(P: Any, x: Any, j: int, residual: float, variance: float, row: Any, gain: Any) -> float:
    """One scalar measurement of state ``j``; returns the residual's variance.

    ``P`` loses ``row rowᵀ / s`` and nothing else, so it stays symmetric and, but for rounding, positive.
    ``row`` (16,) is filled with the row of ``P`` before the measurement, ``gain`` (16,) with the gain.
    """
    s = P[j * WIDTH + j] + variance
    share = 1.0 / s
    for b in range(WIDTH):
        row[b] = P[j * WIDTH + b]
        gain[b] = row[b] * share
    for a in range(STATES):
        x[a] += gain[a] * residual
    for b in range(WIDTH):  # columns outside, rows inside: so the compiler takes columns that lie side by side together
        of_b = gain[b]
        for a in range(STATES):
            P[a * WIDTH + b] -= s * (gain[a] * of_b)
    return float(s)


@jit_fused
def update_velocity(P: Any, x: Any, residual: Any, variance: float, var: Any, gain: Any) -> None:
    """Three measurements of the states 3, 4, 5, as one after the other by :func:`update`, but for rounding.

    ``residual`` (3,) is that of a state of zero, and on return of each measurement that after those before it;
    ``var`` (3,) is filled with their variances, ``gain`` (6, 16), flat, with the gains and then with these times the
    roots of the variances. ``x`` is filled. ``P`` is gone through once.
    """
    j, k, n = 3 * WIDTH, 4 * WIDTH, 5 * WIDTH
    p34, p35 = P[j + 4], P[j + 5]
    s0 = P[j + 3] + variance
    i0 = 1.0 / s0
    l10, l20 = p34 * i0, p35 * i0
    s1 = P[k + 4] + variance - l10 * p34
    i1 = 1.0 / s1
    row15 = P[k + 5] - l10 * p35
    l21 = row15 * i1
    s2 = P[n + 5] + variance - l20 * p35 - l21 * row15
    i2 = 1.0 / s2
    e0 = residual[0]
    e1 = residual[1] - l10 * e0
    e2 = residual[2] - l20 * e0 - l21 * e1
    residual[1], residual[2] = e1, e2
    var[0], var[1], var[2] = s0, s1, s2
    h0, h1, h2 = math.sqrt(i0), math.sqrt(i1), math.sqrt(i2)
    for b in range(WIDTH):
        row0 = P[j + b]
        row1 = P[k + b] - l10 * row0
        row2 = P[n + b] - l20 * row0 - l21 * row1
        gain[b], gain[WIDTH + b], gain[2 * WIDTH + b] = row0 * i0, row1 * i1, row2 * i2
        gain[3 * WIDTH + b], gain[4 * WIDTH + b], gain[5 * WIDTH + b] = row0 * h0, row1 * h1, row2 * h2
    for a in range(STATES):
        x[a] = gain[a] * e0 + gain[WIDTH + a] * e1 + gain[2 * WIDTH + a] * e2
    for b in range(WIDTH):  # as in update
        g0, g1, g2 = gain[3 * WIDTH + b], gain[4 * WIDTH + b], gain[5 * WIDTH + b]
        for a in range(STATES):
            P[a * WIDTH + b] -= gain[3 * WIDTH + a] * g0 + gain[4 * WIDTH + a] * g1 + gain[5 * WIDTH + a] * g2
