"""Settings of the ZUPT-aided filter, and what it knows before the first sample."""

from __future__ import annotations

from typing import NamedTuple

from fes.estimation.numerics.jit import jit_fused
from fes.estimation.numerics.records import Vec


class ZuptSettings(NamedTuple):
    """Noise of the filter; densities and correlation times, so that one setting holds at any sampling rate."""

    acc_noise_mps2_rthz: float = 0.02
    acc_scale_noise: float = 0.003  # share of the acceleration that is noise, per √Hz: scale errors, bandwidth
    rate_noise_radps_rthz: float = 0.002
    rate_scale_noise: float = 0.003  # the same of the rate
    acc_walk_mps2_rts: float = 2e-4
    rate_walk_radps_rts: float = 2e-5
    acc_bias_mps2: float = 0.15  # standard deviation at the start
    rate_bias_radps: float = 0.01
    tilt_rad: float = 0.05  # at the start, in stance …
    tilt_moving_rad: float = 0.4  # … and in movement
    start_speed_mps: float = 0.05  # at the start, in stance
    rest_speed_mps: float = 0.01  # how far the velocity of a resting foot is from the model's
    rest_speed_per_rate_m: float = 0.05  # … and how that grows with its rate
    rest_correlation_s: float = 0.1  # over which time that error stays the same
    rest_height_m: float = 0.01
    outlier_sigmas: float = 4.0  # a slow, even swing looks like rest: not if the foot is that sure to travel, …
    outlier_rest_s: float = 0.5  # … unless it lasts, …
    outlier_lost_s: float = 2.5  # … or nothing was measured for so long that it may be lost
    drift_speed_mps: float = 0.005  # a foot in stance still drifts on in the direction it came from, …
    drift_s: float = 1.0  # … for as long as a stance lasts
    lost_tilt_rad: float = 0.1  # how far the orientation may be off then
    jump_mps3: float = 4000.0  # a force that changes faster was not followed by the accelerometer


@jit_fused
def start_variances(standing: bool, settings: ZuptSettings, out: Vec) -> None:
    """Variances (15,) of the state's errors before the first sample; heading is the frame's own choice."""
    tilt = settings.tilt_rad if standing else settings.tilt_moving_rad
    for j in range(3):
        out[j] = 0.0
        out[3 + j] = settings.start_speed_mps**2 if standing else 1.0
        out[6 + j] = tilt * tilt if j < 2 else 1e-10
        out[9 + j] = settings.rate_bias_radps * settings.rate_bias_radps
        out[12 + j] = settings.acc_bias_mps2 * settings.acc_bias_mps2
