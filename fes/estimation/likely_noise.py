"""The sizes of what can be wrong in a stride: constants of sensors, and what the quietness of each end says of it.

A foot that still rocks or is still jolted at a stride's end neither stands still nor shows gravity alone. How much so
is measured there, in each stance anew, so that brisk and slow, healthy and dragging gait need no settings of their own.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from fes.estimation.compiled import jit_fused
from fes.signals import G_MPS2


class StrideNoise(NamedTuple):
    """Standard deviations of what can be wrong; one setting for all sensors and walkers."""

    start_tilt_rad: float = 0.018  # of the orientation filter at mid-stance
    gyr_drift_rad: float = 0.011  # gathered evenly over a stride: what a swing does to the gyroscope, not the time
    acc_bias_mps2: float = 0.03
    gyr_noise_radps_rthz: float = 0.0005
    gyr_scale: float = 0.0005  # share of the rate that is wrong, per √s: scale, clipping, non-orthogonality
    acc_noise_mps2_rthz: float = 0.05
    jolt_mps3: float = 8000.0
    jolt_share: float = 0.5  # of the excess jump that may be wrong
    end_velocity_mps: float = 0.003
    end_velocity_per_rate_m: float = 0.01  # the lever arm's uncertainty, times the rate at the end
    end_velocity_per_spread_m: float = 0.05  # times the rate's spread: the end is no single instant
    end_height_m: float = 0.01
    end_tilt_rad: float = 0.011
    end_tilt_per_rate_s: float = 0.1  # a foot that turns at the end also accelerates
    end_tilt_most_rad: float = 0.04  # what is measured beyond that is doubted, by twice the excess
    end_tilt_per_push: float = 0.2  # share of the specific force's spread at the end that may be a steady push


@jit_fused
def variances(i: int, t_ns: Any, acc: Any, gyr: Any, noise: StrideNoise) -> tuple[float, float]:
    """Variance of sample ``i``'s turn (rad²) over its interval, and of its velocity increment ((m/s)²)."""
    dt_s = 1e-9 * (t_ns[i] - t_ns[i - 1])
    wx, wy, wz = gyr[i, 0], gyr[i, 1], gyr[i, 2]
    rate2 = wx * wx + wy * wy + wz * wz
    turn = (noise.gyr_noise_radps_rthz**2 + noise.gyr_scale**2 * rate2) * dt_s
    jx, jy, jz = acc[i, 0] - acc[i - 1, 0], acc[i, 1] - acc[i - 1, 1], acc[i, 2] - acc[i - 1, 2]
    jump2, most = jx * jx + jy * jy + jz * jz, noise.jolt_mps3 * dt_s
    push = noise.acc_noise_mps2_rthz**2 * dt_s
    if jump2 > most * most:
        push += (noise.jolt_share * (math.sqrt(jump2) - most) * dt_s) ** 2
    return turn, push


@jit_fused
def end_variances(
    rate_radps: float, rate_spread_radps: float, force_spread_mps2: float, noise: StrideNoise
) -> tuple[float, float]:
    """Variance of the velocity ((m/s)², per axis) and of the measured tilt (rad², per axis) at one end.

    ``rate`` is the size of the mean angular rate there, the spreads are standard deviations over the same window: of
    the rate (norm of the three axes') and of the specific force (greatest of the three).
    """
    velocity = (
        noise.end_velocity_mps**2
        + (noise.end_velocity_per_rate_m * rate_radps) ** 2
        + (noise.end_velocity_per_spread_m * rate_spread_radps) ** 2
    )
    tilt = (
        noise.end_tilt_rad**2
        + (noise.end_tilt_per_rate_s * rate_radps) ** 2
        + (noise.end_tilt_per_push * force_spread_mps2 / G_MPS2) ** 2
    )
    return velocity, tilt
