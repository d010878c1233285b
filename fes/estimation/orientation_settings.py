"""What the orientation filter of a moving body assumes, and what it remembers between samples."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from fes.signals import FloatArray, Vector3

STATES = 8  # errors: orientation in the world (3, heading last), gyroscope's bias (3), level velocity (2)
NO_RANGE = 1e30  # no value reaches it
MEMORY = 23  # numbers in State.memory

START_GIVEN = 0.5  # at STARTED: the quaternion is set already; else 0 before the first sample and 1 from then on

# where each thing lies in ``State.memory``
STARTED, ENERGY, STILL_S, SINCE_TURN_S, SINCE_PUSH_S = 0, 1, 2, 3, 4
RATE, SLOPE, FORCE, MEAN_RATE, MEAN_FORCE, TRUSTED = 5, 8, 11, 14, 17, 20  # three numbers each


class BodySettings(NamedTuple):
    """Noise of the filter; densities and times, so that one setting holds at any sampling rate and on any body."""

    rate_noise_radps_rthz: float = 5e-4  # angular random walk
    rate_scale_noise: float = 0.003  # share of the rate that is noise per √Hz: scale errors, bandwidth
    bias_walk_radps2_rthz: float = 3e-5  # drives the Markov bias: 0.07 °/s in the long run
    bias_time_s: float = 3600.0  # the Markov bias's time constant
    acc_noise_mps2_rthz: float = 0.05
    acc_scale_noise: float = 0.015  # share of the body's acceleration that is noise per √Hz
    movement_s: float = 0.3  # speed is about acceleration × this, and lasts about this long
    energy_s: float = 0.05  # over which time the acceleration is judged
    least_speed_mps: float = 0.005
    speed_memory_s: float = 10.0  # after which a steady speed is forgotten
    rest_speed_mps: float = 0.02  # where rest is known: how far from zero the speed is, …
    rest_speed_per_rate_m: float = 0.05  # … how that grows with the rate, …
    rest_correlation_s: float = 0.1  # … and how long it stays the same
    still_s: float = 1.5  # stillness that long shows the gyroscope's bias, …
    still_mean_s: float = 0.5  # … by means over this time, …
    still_rate_radps: float = 0.035  # … from which rate, …
    still_acc_mps2: float = 0.5  # … and force stay this close, …
    still_mean_radps: float = 0.07  # … while no bias is this large, …
    still_bias_radps_rthz: float = 5e-4  # … to this density
    start_tilt_rad: float = 0.2
    start_bias_radps: float = 0.01
    start_speed_mps: float = 1.0
    extrapolation_s: float = 0.015  # a clipped rate goes on as it rose, for about this long, …
    greatest_excess: float = 1.0  # … by at most this share of the range, …
    clipped_share: float = 0.2  # … and is then off by this share of the range, in rate as in force


class State(NamedTuple):
    """All that evolves; the compiled code changes the arrays in place.

    ``quaternion`` (4,) w, x, y, z, sensor to world; ``bias`` (3,) rad/s; ``velocity`` (2,) m/s, level, of the last
    ``speed_memory_s``; ``covariance`` (8, 8); ``memory`` by the indices above; ``work`` (8,).
    """

    quaternion: FloatArray
    bias: FloatArray
    velocity: FloatArray
    covariance: FloatArray
    memory: FloatArray
    work: FloatArray


def new_state(
    settings: BodySettings, bias_radps: Vector3 = (0.0, 0.0, 0.0), quaternion: FloatArray | None = None
) -> State:
    """A filter that has seen nothing; without a ``quaternion`` (4,) the first sample's force is its upright."""
    sd = [settings.start_tilt_rad] * 3 + [settings.start_bias_radps] * 3 + [settings.start_speed_mps] * 2
    memory = np.zeros(MEMORY)
    if quaternion is not None:
        memory[STARTED] = START_GIVEN
    return State(
        quaternion=np.array([1.0, 0.0, 0.0, 0.0]) if quaternion is None else quaternion.copy(),
        bias=np.array(bias_radps, dtype=np.float64),
        velocity=np.zeros(2),
        covariance=np.diag(np.square(sd)),
        memory=memory,
        work=np.zeros(STATES),
    )
