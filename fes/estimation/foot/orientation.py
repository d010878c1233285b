"""Indirect (error-state) Kalman filter for the foot's orientation and gyroscope bias.

Source: Negård et al. (2005), Eq. (4)–(13). The states are the vector part ``e`` of the error quaternion
``q~ = q* ⊗ q^`` (half the rotation error, in the sensor frame) and the gyroscope's remaining bias ``b``, a first-order
Markov process. Departures from the print, both confirmed numerically:

- the error's dynamics are ``de/dt = -S(w) e + b/2`` (the print lacks the first term, which matters in swing);
- for this ``q~`` the correction's axis is ``g^ × g_meas``; with the print's sign the filter runs away.

Instead of axis and angle (11)–(13) the update takes the difference ``g^ - f = 2 S(f) e`` itself: linear, without the
singularity at zero error. Gravity says nothing about heading, so the gain's component along gravity is removed and the
covariance updated in Joseph's form, which stays right for any gain: the heading's variance never shrinks.
"""

import math
from typing import NamedTuple

from fes.estimation.numerics.jit import by_number, jit, jit_ieee
from fes.estimation.numerics.records import Mat, Vec
from fes.estimation.numerics.rotation import half_turn, quaternion_step, to_sensor
from fes.signals import G_MPS2


class OrientationSettings(NamedTuple):
    """Noise of the orientation filter; densities, so that they hold at any sampling rate."""

    rate_noise_radps_rthz: float = 0.002  # angular random walk, with some for what scale errors do
    rate_scale_noise: float = 0.01  # share of the rate that is noise per √Hz: scale error and clipping in swing
    bias_walk_radps2_rthz: float = 2e-5  # drives the Markov bias
    bias_time_s: float = 600.0  # T_beta of Eq. (9)
    acc_noise_mps2: float = 0.35  # how far the resting foot's specific force is from gravity
    acc_correlation_s: float = 0.1  # over which time that error stays the same
    start_tilt_rad: float = 0.05
    start_bias_radps: float = 0.005


@jit
def start_covariance(covariance: Mat, settings: OrientationSettings) -> None:
    """Fill the 6 × 6 covariance for a start at rest."""
    for i in range(6):
        for j in range(6):
            covariance[i, j] = 0.0
    for i in range(3):
        covariance[i, i] = (0.5 * settings.start_tilt_rad) ** 2
        covariance[i + 3, i + 3] = settings.start_bias_radps**2


@by_number
@jit_ieee
def propagate(covariance: Mat, wx: float, wy: float, wz: float, dt_s: float, settings: OrientationSettings) -> None:
    """Carry the covariance over one sample: ``P ← Φ P Φᵀ + Q``, ``Φ = [[exp(-S(w)dt), dt/2], [0, exp(-dt/T)]]``.

    ``covariance`` (6, 6) changes in place, and stays symmetrical to the bit; ``w`` in rad/s.
    """
    p = covariance
    rx, ry, rz = wx * dt_s, wy * dt_s, wz * dt_s
    cosine, sine = half_turn(rx * rx + ry * ry + rz * rz)
    s, c = 2.0 * sine * cosine, 2.0 * sine * sine
    # rotation by -w dt (Rodrigues)
    a00 = 1.0 - c * (ry * ry + rz * rz)
    a11 = 1.0 - c * (rx * rx + rz * rz)
    a22 = 1.0 - c * (rx * rx + ry * ry)
    a01, a10 = c * rx * ry + s * rz, c * rx * ry - s * rz
    a02, a20 = c * rx * rz - s * ry, c * rx * rz + s * ry
    a12, a21 = c * ry * rz + s * rx, c * ry * rz - s * rx
    h = 0.5 * dt_s
    x = dt_s / settings.bias_time_s
    m = 1.0 - x * (1.0 - x * (1 / 2 - x * (1 / 6 - x * (1 / 24)))) if x < 1e-3 else math.exp(-x)
    rate2 = (wx * wx + wy * wy + wz * wz) * settings.rate_scale_noise**2
    q_e = 0.25 * (settings.rate_noise_radps_rthz**2 + rate2) * dt_s
    q_b = settings.bias_walk_radps2_rthz**2 * dt_s
    for j in range(6):  # the upper three rows of Φ P
        p0, p1, p2 = p[0, j], p[1, j], p[2, j]
        p[0, j] = a00 * p0 + a01 * p1 + a02 * p2 + h * p[3, j]
        p[1, j] = a10 * p0 + a11 * p1 + a12 * p2 + h * p[4, j]
        p[2, j] = a20 * p0 + a21 * p1 + a22 * p2 + h * p[5, j]
    for i in range(3):  # that times Φᵀ: of what is symmetrical, the lower half
        d0, d1, d2, b0, b1, b2 = p[i, 0], p[i, 1], p[i, 2], p[i, 3], p[i, 4], p[i, 5]
        p[i, 0] = p[0, i] = a00 * d0 + a01 * d1 + a02 * d2 + h * b0
        if i > 0:
            p[i, 1] = p[1, i] = a10 * d0 + a11 * d1 + a12 * d2 + h * b1
        if i > 1:
            p[i, 2] = a20 * d0 + a21 * d1 + a22 * d2 + h * b2
        p[i, i] += q_e
        p[i, 3] = p[3, i] = m * b0
        p[i, 4] = p[4, i] = m * b1
        p[i, 5] = p[5, i] = m * b2
    m2 = m * m
    for i in range(3, 6):
        for j in range(3, 6):
            p[i, j] *= m2
        p[i, i] += q_b


@jit_ieee
def correct_by_gravity(
    quaternion: Vec,
    bias: Vec,
    covariance: Mat,
    scratch: Mat,
    fx: float,
    fy: float,
    fz: float,
    dt_s: float,
    settings: OrientationSettings,
) -> None:
    """Measurement update with the specific force ``f`` (m/s²) of a resting foot; inject the error and reset it.

    ``quaternion`` (4,), ``bias`` (3,) in rad/s and ``covariance`` (6, 6), symmetrical to the bit, change in place;
    ``scratch`` (6, 12) is working memory.

    Of ``g^ - f = 2 S(g^) e`` the component along ``g^`` says nothing. The others are taken along the world's horizontal
    axes as the sensor sees them, ``t_x`` and ``t_y``, so that ``H = 2 g (-t_y, t_x)ᵀ``. With ``W = P Hᵀ``, ``U`` the
    same without what turns about ``g^``, ``D`` that, and the gain ``K = U S⁻¹``, Joseph's form comes to
    ``P - K Uᵀ - K Dᵀ - D Kᵀ``.
    """
    p, twice = covariance, 2.0 * G_MPS2
    qw, qx, qy, qz = quaternion[0], quaternion[1], quaternion[2], quaternion[3]
    x0, x1, x2 = to_sensor(qw, qx, qy, qz, 1.0, 0.0, 0.0)
    y0, y1, y2 = to_sensor(qw, qx, qy, qz, 0.0, 1.0, 0.0)
    z0, z1, z2 = to_sensor(qw, qx, qy, qz, 0.0, 0.0, 1.0)
    # samples closer than the correlation time carry less than one measurement
    variance = settings.acc_noise_mps2**2 * max(settings.acc_correlation_s / dt_s, 1.0)
    u, v, a, b, d, z = scratch[0], scratch[1], scratch[2], scratch[3], scratch[4], scratch[5]
    for i in range(6):
        p0, p1, p2 = p[0, i], p[1, i], p[2, i]
        u[i] = -twice * (p0 * y0 + p1 * y1 + p2 * y2)
        v[i] = twice * (p0 * x0 + p1 * x1 + p2 * x2)
    u0, u1, u2, v0, v1, v2 = u[0], u[1], u[2], v[0], v[1], v[2]
    s00 = variance - twice * (u0 * y0 + u1 * y1 + u2 * y2)
    s01 = twice * (u0 * x0 + u1 * x1 + u2 * x2)
    s11 = variance + twice * (v0 * x0 + v1 * x1 + v2 * x2)
    along_u, along_v = u0 * z0 + u1 * z1 + u2 * z2, v0 * z0 + v1 * z1 + v2 * z2
    u[0], u[1], u[2] = u0 - along_u * z0, u1 - along_u * z1, u2 - along_u * z2
    v[0], v[1], v[2] = v0 - along_v * z0, v1 - along_v * z1, v2 - along_v * z2
    per = 1.0 / (s00 * s11 - s01 * s01)
    i00, i01, i11 = s11 * per, -s01 * per, s00 * per
    for i in range(6):
        a[i] = u[i] * i00 + v[i] * i01
        b[i] = u[i] * i01 + v[i] * i11
        d[i] = a[i] * along_u + b[i] * along_v
    z[0], z[1], z[2], z[3], z[4], z[5] = z0, z1, z2, 0.0, 0.0, 0.0
    for i in range(6):
        for j in range(i + 1):
            p[i, j] -= (a[i] * u[j] + b[i] * v[j]) + (z[i] * d[j] + d[i] * z[j])
            p[j, i] = p[i, j]
    along_x, along_y = -(fx * x0 + fy * x1 + fz * x2), -(fx * y0 + fy * y1 + fz * y2)
    for i in range(3):
        bias[i] += a[i + 3] * along_x + b[i + 3] * along_y
    # q~ = q* ⊗ q^, so the truth is q^ ⊗ q~*: turn back by 2 e
    along_x, along_y = -2.0 * along_x, -2.0 * along_y
    rx, ry, rz = a[0] * along_x + b[0] * along_y, a[1] * along_x + b[1] * along_y, a[2] * along_x + b[2] * along_y
    quaternion[0], quaternion[1], quaternion[2], quaternion[3] = quaternion_step(qw, qx, qy, qz, rx, ry, rz)
