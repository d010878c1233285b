"""The compiled core: orientation, features and guards of one foot, sample by sample, stopping where a guard fires.

Live it advances one sample, in analysis a whole block; all that evolves is in one ``STATE`` record, so that cutting a
recording anywhere gives the same result to the last bit.
"""

import math
from typing import NamedTuple

import numpy as np

from fes.estimation.foot.orientation import OrientationSettings, correct_by_gravity, propagate, start_covariance
from fes.estimation.numerics.jit import jit_ieee
from fes.estimation.numerics.records import Mat, Record, Vec, core_type, record_type
from fes.estimation.numerics.rotation import from_gravity, quaternion_step, to_world
from fes.estimation.tracking.phase_features import (
    FIELDS,
    LAGS,
    LONG_AGO_NS,
    dead_reckon,
    features,
    first_transition,
    observe,
    per_second,
    start_phases,
)
from fes.signals import G_MPS2
from statemachine.guards import Thresholds

STANDING_RADPS = (
    0.25,
    1.2,
)  # gravity corrects the orientation while the foot turns no faster than its rest, within these
STANDING_MPS2 = 1.2  # … and its force is this close to gravity …
STANDING_S = 0.03  # … for so long, so that a zero crossing does not count

STATE = record_type(
    [
        *FIELDS,
        ("moving_ns", np.int64),  # last sample at which the foot did not stand
        ("gravity_ns", np.int64),  # last sample at which gravity corrected the orientation
        ("quaternion", np.float64, 4),
        ("bias_radps", np.float64, 3),
        ("covariance", np.float64, (6, 6)),
        ("scratch", np.float64, (6, 12)),
        ("rate_radps", np.float64, 3),  # bias-free, of the last sample
        ("force_mps2", np.float64, (LAGS, 4)),  # ring of the last samples, with its vertical part in the world
    ]
)


class FootParameters(NamedTuple):
    """What the core needs to know about one sensor; fixed while it runs.

    Look-backs are in samples of this sensor's nominal rate; :func:`lags_at` derives them from times.
    """

    toe_down_x: float  # mediolateral axis in the sensor frame, toe-down positive
    toe_down_y: float
    toe_down_z: float
    acc_bias_x_mps2: float
    acc_bias_y_mps2: float
    acc_bias_z_mps2: float
    gyr_bias_x_radps: float
    gyr_bias_y_radps: float
    gyr_bias_z_radps: float
    sample_s: float  # nominal
    jerk_lag: int  # 10 ms: change of the vertical acceleration


CORE = core_type(STATE, parameters=FootParameters, thresholds=Thresholds, settings=OrientationSettings)


def lags_at(rate_hz: float) -> tuple[int, int]:
    """The look-backs of 10 ms and 20 ms in samples: at least one, at most what the rings hold."""
    jerk, change = (min(max(round(span_s * rate_hz), 1), LAGS - 1) for span_s in (0.01, 0.02))
    return jerk, change


@jit_ieee
def start(core: Record, t_ns: int, fx: float, fy: float, fz: float) -> None:
    """Begin in stance, upright as gravity says, at the first sample (bias-free specific force in m/s²).

    ``core`` of ``CORE``.
    """
    state = core.state
    start_phases(core, t_ns)
    quaternion = state.quaternion
    quaternion[0], quaternion[1], quaternion[2], quaternion[3] = from_gravity(fx, fy, fz)
    start_covariance(state.covariance, core.settings)
    state.moving_ns = state.gravity_ns = t_ns - LONG_AGO_NS


@jit_ieee
def advance(core: Record, t_ns: Vec, acc: Mat, gyr: Mat, begin: int, end: int, quaternions: Mat) -> tuple[int, int]:
    """Advance over the samples ``begin`` … ``end - 1``; stop behind the first at which a guard fires.

    ``core`` of ``CORE``; ``t_ns`` (N,) int64 strictly increasing and above ``core.state.t_ns``; ``acc`` (N, 3) m/s²;
    ``gyr`` (N, 3) rad/s; ``quaternions`` (N, 4) receives the orientation at each sample. Returns how far it came and
    the transition's number (0: the block's end). The phase is the caller's to change.
    """
    state, parameters = core.state, core.parameters
    for i in range(begin, end):
        fx, fy = acc[i, 0] - parameters.acc_bias_x_mps2, acc[i, 1] - parameters.acc_bias_y_mps2
        fz = acc[i, 2] - parameters.acc_bias_z_mps2
        wx = gyr[i, 0] - parameters.gyr_bias_x_radps - state.bias_radps[0]
        wy = gyr[i, 1] - parameters.gyr_bias_y_radps - state.bias_radps[1]
        wz = gyr[i, 2] - parameters.gyr_bias_z_radps - state.bias_radps[2]
        dt_s = 1e-9 * (t_ns[i] - state.t_ns)
        rate, q = state.rate_radps, state.quaternion
        if state.samples > 0:
            mx, my, mz = 0.5 * (rate[0] + wx), 0.5 * (rate[1] + wy), 0.5 * (rate[2] + wz)
            q[0], q[1], q[2], q[3] = quaternion_step(q[0], q[1], q[2], q[3], mx * dt_s, my * dt_s, mz * dt_s)
            propagate(state.covariance, mx, my, mz, dt_s, core.settings)
        rate[0], rate[1], rate[2] = wx, wy, wz
        state.t_ns = t_ns[i]
        state.samples += 1
        if _observe(core, fx, fy, fz, dt_s) and state.phase == 0 and dt_s > 0.0:
            correct_by_gravity(
                q, state.bias_radps, state.covariance, state.scratch, fx, fy, fz, dt_s, core.settings
            )  # fmt: skip
            state.gravity_ns = state.t_ns
        quaternions[i, 0], quaternions[i, 1], quaternions[i, 2], quaternions[i, 3] = q[0], q[1], q[2], q[3]
        transition = first_transition(state.phase, features(state), core.thresholds)
        if transition != 0:
            return i + 1, transition
    return end, 0


@jit_ieee
def _observe(core: Record, fx: float, fy: float, fz: float, dt_s: float) -> bool:
    """Turn one sample into what the guards look at: bias-free force (m/s²); its rate is in the state. Does it stand?"""
    state, parameters, thresholds = core.state, core.parameters, core.thresholds
    wx, wy, wz = state.rate_radps[0], state.rate_radps[1], state.rate_radps[2]
    q = state.quaternion
    ax, ay, az = to_world(q[0], q[1], q[2], q[3], fx, fy, fz)
    dead_reckon(state, dt_s, ax, ay, az - G_MPS2)
    now, back = state.samples % LAGS, min(state.samples - 1, parameters.jerk_lag)
    force, then = state.force_mps2[now], state.force_mps2[(state.samples - back) % LAGS]
    force[0], force[1], force[2], force[3] = fx, fy, fz, az
    x, y, z = force[0] - then[0], force[1] - then[1], force[2] - then[2]
    jump = max(abs(force[3] - then[3]), 0.5 * math.sqrt(x * x + y * y + z * z)) if back > 0 else 0.0
    rate = math.sqrt(wx * wx + wy * wy + wz * wz)
    toe_down = parameters.toe_down_x * wx + parameters.toe_down_y * wy + parameters.toe_down_z * wz
    observe(core, toe_down, abs(toe_down), jump * per_second(back, parameters.sample_s), dt_s)
    low, high = STANDING_RADPS
    quick = thresholds.rest_share * max(thresholds.push_off_radps, 0.5 * thresholds.fall_radps)
    if rate >= min(max(quick, low), high) or abs(math.sqrt(fx * fx + fy * fy + fz * fz) - G_MPS2) >= STANDING_MPS2:
        state.moving_ns = state.t_ns
    return bool(state.t_ns - state.moving_ns >= 1e9 * STANDING_S)
