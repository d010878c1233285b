"""Covariance of the ZUPT-aided filter: prediction over an interval, measurements, and the noise in between.

The error state is p, v, psi, b_g, b_a (15): errors of position and velocity in the world, a small rotation in the world
(``R_true = exp(psi) R``), and of the gyroscope's and accelerometer's bias in the sensor frame. Over an interval of
length T (:mod:`fes.estimation.zupt.decimation`), with its push ``b``, its shift ``a``, ``c = b - a/T`` and the integral
``R`` of the orientation, all in the world::

    dp' = dp + T dv + psi × a - T/2 R b_a,  dv' = dv + psi × b - R b_a + c × R b_g,  dpsi' = dpsi - R b_g

where ``c`` is how much of the push comes after a turn that grows evenly.

A covariance is kept as 15 rows of 16 in flat storage: a whole number of vector registers, and strides that the compiler
knows, so that most of the work is done for eight elements at a time.
"""

import math

from fes.estimation.numerics.jit import inlined, jit_fused
from fes.estimation.numerics.records import Mat, Vec
from fes.estimation.zupt.decimation import Intervals, ZuptSettings
from fes.signals import G_MPS2

STATES = 15
BIASES = 9  # where they begin
WIDTH = 16  # of the covariance's rows: a whole number of vector registers
DIAGONAL = WIDTH + 1  # from one of its diagonal's elements to the next
ADDED = 16  # of an interval's noise, as interval_noise leaves it


@inlined
def _propagate(x: Vec, along: int, across: int, count: int, k: int, r: Mat, f: Mat, dt: float) -> None:
    """``x ← Φ x`` in place for ``count`` vectors in flat storage, interval ``k``: ``r`` (K, 3, 3) is ``R``, the rows of
    ``f`` (K, 3, 3) are ``b``, ``a`` and ``c``.

    A vector's elements lie ``along`` apart and vectors ``across`` apart. The compiler knows these strides, so vectors
    that lie side by side go through its wide registers together.
    """
    b0, b1, b2 = f[k, 0, 0], f[k, 0, 1], f[k, 0, 2]
    a0, a1, a2 = f[k, 1, 0], f[k, 1, 1], f[k, 1, 2]
    c0, c1, c2 = f[k, 2, 0], f[k, 2, 1], f[k, 2, 2]
    r00, r01, r02 = r[k, 0, 0], r[k, 0, 1], r[k, 0, 2]
    r10, r11, r12 = r[k, 1, 0], r[k, 1, 1], r[k, 1, 2]
    r20, r21, r22 = r[k, 2, 0], r[k, 2, 1], r[k, 2, 2]
    for i in range(count):
        o = i * across
        v0, v1, v2 = x[o + 3 * along], x[o + 4 * along], x[o + 5 * along]
        s0, s1, s2 = x[o + 6 * along], x[o + 7 * along], x[o + 8 * along]
        g0, g1, g2 = x[o + 9 * along], x[o + 10 * along], x[o + 11 * along]
        d0, d1, d2 = x[o + 12 * along], x[o + 13 * along], x[o + 14 * along]
        e0 = r00 * d0 + r01 * d1 + r02 * d2
        e1 = r10 * d0 + r11 * d1 + r12 * d2
        e2 = r20 * d0 + r21 * d1 + r22 * d2
        h0 = r00 * g0 + r01 * g1 + r02 * g2
        h1 = r10 * g0 + r11 * g1 + r12 * g2
        h2 = r20 * g0 + r21 * g1 + r22 * g2
        x[o] = x[o] + dt * (v0 - 0.5 * e0) + (s1 * a2 - s2 * a1)
        x[o + along] = x[o + along] + dt * (v1 - 0.5 * e1) + (s2 * a0 - s0 * a2)
        x[o + 2 * along] = x[o + 2 * along] + dt * (v2 - 0.5 * e2) + (s0 * a1 - s1 * a0)
        x[o + 3 * along] = v0 - e0 + (s1 * b2 - s2 * b1) + (c1 * h2 - c2 * h1)
        x[o + 4 * along] = v1 - e1 + (s2 * b0 - s0 * b2) + (c2 * h0 - c0 * h2)
        x[o + 5 * along] = v2 - e2 + (s0 * b1 - s1 * b0) + (c0 * h1 - c1 * h0)
        x[o + 6 * along] = s0 - h0
        x[o + 7 * along] = s1 - h1
        x[o + 8 * along] = s2 - h2


@inlined
def propagate_error(x: Vec, k: int, r: Mat, f: Mat, dt: float) -> None:
    """``x ← Φ x`` of interval ``k`` for an error (15,)."""
    _propagate(x, 1, STATES, 1, k, r, f, dt)


@jit_fused
def predict(P: Vec, k: int, r: Mat, f: Mat, dt: float, q: Mat, settings: ZuptSettings) -> None:
    """``P ← Φ P Φᵀ + Q`` for a symmetric ``P``, 15 rows of 16 in flat storage; ``q`` (K, 16) as of ``interval_noise``.

    ``Φ P`` is made for a row's elements side by side; of ``(Φ P) Φᵀ``, which cannot be, only what its symmetry leaves.
    """
    _propagate(P, WIDTH, 1, WIDTH, k, r, f, dt)
    b0, b1, b2 = f[k, 0, 0], f[k, 0, 1], f[k, 0, 2]
    a0, a1, a2 = f[k, 1, 0], f[k, 1, 1], f[k, 1, 2]
    c0, c1, c2 = f[k, 2, 0], f[k, 2, 1], f[k, 2, 2]
    r00, r01, r02 = r[k, 0, 0], r[k, 0, 1], r[k, 0, 2]
    r10, r11, r12 = r[k, 1, 0], r[k, 1, 1], r[k, 1, 2]
    r20, r21, r22 = r[k, 2, 0], r[k, 2, 1], r[k, 2, 2]
    for i in range(BIASES):
        o = i * WIDTH
        s0, s1, s2 = P[o + 6], P[o + 7], P[o + 8]
        g0, g1, g2 = P[o + 9], P[o + 10], P[o + 11]
        h0 = r00 * g0 + r01 * g1 + r02 * g2
        h1 = r10 * g0 + r11 * g1 + r12 * g2
        h2 = r20 * g0 + r21 * g1 + r22 * g2
        if i < 7:
            P[o + 6] = s0 - h0
        if i < 8:
            P[o + 7] = s1 - h1
        P[o + 8] = s2 - h2
        if i < 6:
            v0, v1, v2 = P[o + 3], P[o + 4], P[o + 5]
            d0, d1, d2 = P[o + 12], P[o + 13], P[o + 14]
            e0 = r00 * d0 + r01 * d1 + r02 * d2
            e1 = r10 * d0 + r11 * d1 + r12 * d2
            e2 = r20 * d0 + r21 * d1 + r22 * d2
            if i < 4:
                P[o + 3] = v0 - e0 + (s1 * b2 - s2 * b1) + (c1 * h2 - c2 * h1)
            if i < 5:
                P[o + 4] = v1 - e1 + (s2 * b0 - s0 * b2) + (c2 * h0 - c0 * h2)
            P[o + 5] = v2 - e2 + (s0 * b1 - s1 * b0) + (c0 * h1 - c1 * h0)
            if i < 3:
                if i < 1:
                    P[o] += dt * (v0 - 0.5 * e0) + (s1 * a2 - s2 * a1)
                if i < 2:
                    P[o + 1] += dt * (v1 - 0.5 * e1) + (s2 * a0 - s0 * a2)
                P[o + 2] += dt * (v2 - 0.5 * e2) + (s0 * a1 - s1 * a0)
    _add_noise(P, k, q, dt, settings)
    for b in range(STATES):  # also within a block: rounding makes the halves differ, and would for good
        for a in range(min(b, BIASES)):
            P[b * WIDTH + a] = P[a * WIDTH + b]


@jit_fused
def update(P: Vec, x: Vec, j: int, residual: float, variance: float, row: Vec, gain: Vec) -> float:
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
def update_velocity(P: Vec, x: Vec, residual: Vec, variance: float, var: Vec, gain: Vec) -> None:
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


@inlined
def interval_noise(k: int, intervals: Intervals, m: Vec, f: Mat, dt: float, settings: ZuptSettings, out: Vec) -> None:
    """Covariance that the noise of interval ``k`` adds.

    Row ``k`` of ``out`` (K, 16): of position, of position with velocity, of the turn, of velocity with the turn (3), of
    velocity (9), and 0, for what a filter that is lost adds. ``m`` (9,) is the orientation where the interval begins,
    the rows of ``f`` (K, 3, 3) are ``b``, ``a`` and ``c``, biases out.
    """
    g, noise = G_MPS2, intervals.noise
    m0, m1, m2, m3, m4, m5, m6, m7, m8 = m[0], m[1], m[2], m[3], m[4], m[5], m[6], m[7], m[8]
    white, share = settings.acc_noise_mps2_rthz**2, settings.acc_scale_noise**2
    twice = m6 * noise[k, 7] + m7 * noise[k, 8] + m8 * noise[k, 9]
    # the acceleration squared is that of the force less gravity
    v = white * dt + share * (noise[k, 0] - 2.0 * g * f[k, 0, 2] + g * g * dt) + noise[k, 3]
    push = 0.5 * white * dt * dt + share * (noise[k, 1] - 2.0 * g * f[k, 1, 2] + 0.5 * g * g * dt * dt) + noise[k, 4]
    third = dt * dt * dt / 3.0
    out[k, 0] = white * third + share * (noise[k, 2] - 2.0 * g * twice + g * g * third) + noise[k, 5]
    out[k, 1], out[k, 2] = push, noise[k, 6]
    x, y, z = noise[k, 10], noise[k, 11], noise[k, 12]
    out[k, 3] = m0 * x + m1 * y + m2 * z
    out[k, 4] = m3 * x + m4 * y + m5 * z
    out[k, 5] = m6 * x + m7 * y + m8 * z
    xx, xy, xz = noise[k, 13], noise[k, 14], noise[k, 15]
    yy, yz, zz = noise[k, 16], noise[k, 17], noise[k, 18]
    v += xx + yy + zz
    x, y, z = m0 * xx + m1 * xy + m2 * xz, m0 * xy + m1 * yy + m2 * yz, m0 * xz + m1 * yz + m2 * zz
    out[k, 6] = v - (x * m0 + y * m1 + z * m2)
    out[k, 7] = out[k, 9] = -(x * m3 + y * m4 + z * m5)
    out[k, 8] = out[k, 12] = -(x * m6 + y * m7 + z * m8)
    x, y, z = m3 * xx + m4 * xy + m5 * xz, m3 * xy + m4 * yy + m5 * yz, m3 * xz + m4 * yz + m5 * zz
    out[k, 10] = v - (x * m3 + y * m4 + z * m5)
    out[k, 11] = out[k, 13] = -(x * m6 + y * m7 + z * m8)
    x, y, z = m6 * xx + m7 * xy + m8 * xz, m6 * xy + m7 * yy + m8 * yz, m6 * xz + m7 * yz + m8 * zz
    out[k, 14] = v - (x * m6 + y * m7 + z * m8)
    out[k, 15] = 0.0


@inlined
def _add_noise(P: Vec, k: int, q: Mat, dt: float, settings: ZuptSettings) -> None:
    """Add what ``interval_noise`` found of interval ``k``, ``q`` (K, 16), to the upper half."""
    for a in range(3):
        P[a * DIAGONAL] += q[k, 0]
        P[a * WIDTH + 3 + a] += q[k, 1]
        P[(6 + a) * DIAGONAL] += q[k, 2]
        P[(9 + a) * DIAGONAL] += settings.rate_walk_radps_rts**2 * dt
        P[(12 + a) * DIAGONAL] += settings.acc_walk_mps2_rts**2 * dt
        for b in range(a, 3):
            P[(3 + a) * WIDTH + 3 + b] += q[k, 6 + 3 * a + b]
        b, c = (a + 1) % 3, (a + 2) % 3
        P[(3 + b) * WIDTH + 6 + c] += q[k, 3 + a]
        P[(3 + c) * WIDTH + 6 + b] -= q[k, 3 + a]


@inlined
def spread_noise(k: int, x: Vec, q: Mat, adjoint: Mat, dt: float, settings: ZuptSettings) -> None:
    """``x ← x - Q λ`` for what ``interval_noise`` found of interval ``k``, ``q`` (K, 16), and the adjoint λ (K, 15)."""
    for a in range(3):
        x[a] -= q[k, 0] * adjoint[k, a] + q[k, 1] * adjoint[k, 3 + a]
        x[3 + a] -= q[k, 1] * adjoint[k, a]
        x[6 + a] -= q[k, 2] * adjoint[k, 6 + a]
        x[9 + a] -= settings.rate_walk_radps_rts**2 * dt * adjoint[k, 9 + a]
        x[12 + a] -= settings.acc_walk_mps2_rts**2 * dt * adjoint[k, 12 + a]
        for b in range(3):
            x[3 + a] -= q[k, 6 + 3 * a + b] * adjoint[k, 3 + b]
        b, c = (a + 1) % 3, (a + 2) % 3
        x[3 + b] -= q[k, 3 + a] * adjoint[k, 6 + c]
        x[6 + c] -= q[k, 3 + a] * adjoint[k, 3 + b]
        x[3 + c] += q[k, 3 + a] * adjoint[k, 6 + b]
        x[6 + b] += q[k, 3 + a] * adjoint[k, 3 + c]
