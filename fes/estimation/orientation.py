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

from __future__ import annotations

import math
from typing import Any, NamedTuple

from fes.estimation.compiled import jit
from fes.estimation.rotation import quaternion_step, to_sensor
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
def start_covariance(covariance: Any, settings: OrientationSettings) -> None:
    """Fill the 6 × 6 covariance for a start at rest."""
    for i in range(6):
        for j in range(6):
            covariance[i, j] = 0.0
    for i in range(3):
        covariance[i, i] = (0.5 * settings.start_tilt_rad) ** 2
        covariance[i + 3, i + 3] = settings.start_bias_radps**2


@jit
def propagate(covariance: Any, wx: float, wy: float, wz: float, dt_s: float, settings: OrientationSettings) -> None:
    """Carry the covariance over one sample: ``P ← Φ P Φᵀ + Q``, ``Φ = [[exp(-S(w)dt), dt/2], [0, exp(-dt/T)]]``.

    ``covariance`` (6, 6) changes in place; ``w`` in rad/s.
    """
    rx, ry, rz = wx * dt_s, wy * dt_s, wz * dt_s
    square = rx * rx + ry * ry + rz * rz
    angle = math.sqrt(square)
    s = math.sin(angle) / angle if angle > 1e-6 else 1.0
    c = (1.0 - math.cos(angle)) / square if angle > 1e-6 else 0.5
    # rotation by -w dt (Rodrigues)
    a00 = 1.0 - c * (ry * ry + rz * rz)
    a11 = 1.0 - c * (rx * rx + rz * rz)
    a22 = 1.0 - c * (rx * rx + ry * ry)
    a01, a10 = c * rx * ry + s * rz, c * rx * ry - s * rz
    a02, a20 = c * rx * rz - s * ry, c * rx * rz + s * ry
    a12, a21 = c * ry * rz + s * rx, c * ry * rz - s * rx
    h = 0.5 * dt_s
    m = math.exp(-dt_s / settings.bias_time_s)
    for side in range(2):  # first Φ P, then (Φ P) Φᵀ as Φ (Φ P)ᵀ
        for j in range(6):
            p0, p1, p2 = covariance[0, j], covariance[1, j], covariance[2, j]
            p3, p4, p5 = covariance[3, j], covariance[4, j], covariance[5, j]
            covariance[0, j] = a00 * p0 + a01 * p1 + a02 * p2 + h * p3
            covariance[1, j] = a10 * p0 + a11 * p1 + a12 * p2 + h * p4
            covariance[2, j] = a20 * p0 + a21 * p1 + a22 * p2 + h * p5
            covariance[3, j] = m * p3
            covariance[4, j] = m * p4
            covariance[5, j] = m * p5
        if side == 0:
            for i in range(6):
                for j in range(i):
                    covariance[i, j], covariance[j, i] = covariance[j, i], covariance[i, j]
    _make_symmetric(covariance)
    rate2 = (wx * wx + wy * wy + wz * wz) * settings.rate_scale_noise**2
    q_e = 0.25 * (settings.rate_noise_radps_rthz**2 + rate2) * dt_s
    q_b = settings.bias_walk_radps2_rthz**2 * dt_s
    for i in range(3):
        covariance[i, i] += q_e
        covariance[i + 3, i + 3] += q_b


@jit
def _make_symmetric(covariance: Any) -> None:
    for i in range(6):
        for j in range(i):
            mean = 0.5 * (covariance[i, j] + covariance[j, i])
            covariance[i, j] = mean
            covariance[j, i] = mean


@jit
def correct_by_gravity(
    quaternion: Any,
    bias: Any,
    covariance: Any,
    scratch: Any,
    fx: float,
    fy: float,
    fz: float,
    dt_s: float,
    settings: OrientationSettings,
) -> None:
    """Measurement update with the specific force ``f`` (m/s²) of a resting foot; inject the error and reset it.

    ``quaternion`` (4,), ``bias`` (3,) in rad/s and ``covariance`` (6, 6) change in place; ``scratch`` (6, 12) is
    working memory.
    """
    gx, gy, gz = to_sensor(quaternion[0], quaternion[1], quaternion[2], quaternion[3], 0.0, 0.0, G_MPS2)
    # y = g^ - f = H e, H = 2 S(g^); samples closer than the correlation time carry less than one measurement
    y0, y1, y2 = gx - fx, gy - fy, gz - fz
    variance = settings.acc_noise_mps2**2 * max(settings.acc_correlation_s / dt_s, 1.0)
    ph, gain = scratch[:, 0:3], scratch[:, 3:6]
    for i in range(6):  # P Hᵀ
        p0, p1, p2 = covariance[i, 0], covariance[i, 1], covariance[i, 2]
        ph[i, 0] = 2.0 * (-gz * p1 + gy * p2)
        ph[i, 1] = 2.0 * (gz * p0 - gx * p2)
        ph[i, 2] = 2.0 * (-gy * p0 + gx * p1)
    s00 = 2.0 * (-gz * ph[1, 0] + gy * ph[2, 0]) + variance
    s01 = 2.0 * (-gz * ph[1, 1] + gy * ph[2, 1])
    s02 = 2.0 * (-gz * ph[1, 2] + gy * ph[2, 2])
    s11 = 2.0 * (gz * ph[0, 1] - gx * ph[2, 1]) + variance
    s12 = 2.0 * (gz * ph[0, 2] - gx * ph[2, 2])
    s22 = 2.0 * (-gy * ph[0, 2] + gx * ph[1, 2]) + variance
    i00, i01, i02 = s11 * s22 - s12 * s12, s02 * s12 - s01 * s22, s01 * s12 - s02 * s11
    i11, i12, i22 = s00 * s22 - s02 * s02, s01 * s02 - s00 * s12, s00 * s11 - s01 * s01
    d = 1.0 / (s00 * i00 + s01 * i01 + s02 * i02)
    for i in range(6):  # K = P Hᵀ S⁻¹
        b0, b1, b2 = ph[i, 0] * d, ph[i, 1] * d, ph[i, 2] * d
        gain[i, 0] = b0 * i00 + b1 * i01 + b2 * i02
        gain[i, 1] = b0 * i01 + b1 * i11 + b2 * i12
        gain[i, 2] = b0 * i02 + b1 * i12 + b2 * i22
    for j in range(3):  # no heading from gravity: take out what would turn about g^
        along = (gx * gain[0, j] + gy * gain[1, j] + gz * gain[2, j]) / (G_MPS2 * G_MPS2)
        gain[0, j] -= gx * along
        gain[1, j] -= gy * along
        gain[2, j] -= gz * along
    e0 = gain[0, 0] * y0 + gain[0, 1] * y1 + gain[0, 2] * y2
    e1 = gain[1, 0] * y0 + gain[1, 1] * y1 + gain[1, 2] * y2
    e2 = gain[2, 0] * y0 + gain[2, 1] * y1 + gain[2, 2] * y2
    for i in range(3):
        bias[i] += gain[i + 3, 0] * y0 + gain[i + 3, 1] * y1 + gain[i + 3, 2] * y2
    # q~ = q* ⊗ q^, so the truth is q^ ⊗ q~*: turn back by 2 e
    quaternion[0], quaternion[1], quaternion[2], quaternion[3] = quaternion_step(
        quaternion[0], quaternion[1], quaternion[2], quaternion[3], -2.0 * e0, -2.0 * e1, -2.0 * e2
    )
    # Joseph: A = I - K H;  P ← A P Aᵀ + K R Kᵀ
    product = scratch[:, 6:12]
    for i in range(6):  # A P, with (K H) columns 0..2 only
        kh0 = 2.0 * (gain[i, 1] * gz - gain[i, 2] * gy)
        kh1 = 2.0 * (-gain[i, 0] * gz + gain[i, 2] * gx)
        kh2 = 2.0 * (gain[i, 0] * gy - gain[i, 1] * gx)
        ph[i, 0], ph[i, 1], ph[i, 2] = kh0, kh1, kh2  # P Hᵀ is used up; keep K H in its place
        for j in range(6):
            product[i, j] = covariance[i, j] - (
                kh0 * covariance[0, j] + kh1 * covariance[1, j] + kh2 * covariance[2, j]
            )
    for i in range(6):
        for j in range(6):
            covariance[i, j] = (
                product[i, j]
                - (product[i, 0] * ph[j, 0] + product[i, 1] * ph[j, 1] + product[i, 2] * ph[j, 2])
                + variance * (gain[i, 0] * gain[j, 0] + gain[i, 1] * gain[j, 1] + gain[i, 2] * gain[j, 2])
            )
    _make_symmetric(covariance)
