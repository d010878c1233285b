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
from fes.signals import G_MPS2
from statemachine.guards import Features, Thresholds
from statemachine.table import first_transition_function

LAGS = 64  # longest look-back in samples: 20 ms at over 2 kHz
LONG_AGO_NS = 3_600_000_000_000
LANDED_S = 0.3  # after a contact: no swing goes on for so long once it was seen
STANCE_MEAN_S = 0.25  # over which the stance's mean specific force forgets

STATE = record_type(
    [
        ("samples", np.int64),
        ("t_ns", np.int64),
        ("phase", np.int64),
        ("phase_since_ns", np.int64),
        ("a_moving_ns", np.int64),  # last sample at which the accelerometer saw movement
        ("g_moving_ns", np.int64),  # the same of the gyroscope
        ("quaternion", np.float64, 4),
        ("bias_radps", np.float64, 3),
        ("covariance", np.float64, (6, 6)),
        ("scratch", np.float64, (6, 12)),
        ("rate_radps", np.float64, 3),  # bias-free, of the last sample
        ("stance_force", np.float64, 3),  # running mean of the specific force in the last stance
        ("acceleration", np.float64, 3),  # in the world, free of gravity, of the last sample
        ("velocity", np.float64, 3),  # dead-reckoned since the last rest in stance
        ("peak_speed", np.float64),
        ("vertical_mps2", np.float64, LAGS),  # rings of the last samples
        ("toe_down", np.float64, LAGS),
        ("toe_down_peak", np.float64),
        ("toe_up_peak", np.float64),
        ("a_rest", np.bool_),
        ("g_rest", np.bool_),
        ("toe_down_change", np.float64),
        ("vertical_jerk", np.float64),
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
    change_lag: int  # 20 ms: derivative of the toe-down rate


CORE = core_type(STATE, parameters=FootParameters, thresholds=Thresholds, settings=OrientationSettings)
first_transition = first_transition_function(jit_ieee)


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
    quaternion = state.quaternion
    quaternion[0], quaternion[1], quaternion[2], quaternion[3] = from_gravity(fx, fy, fz)
    start_covariance(state.covariance, core.settings)
    state.samples = 0
    state.t_ns = t_ns
    state.phase = 0
    state.phase_since_ns = t_ns
    state.a_moving_ns = t_ns - LONG_AGO_NS
    state.g_moving_ns = t_ns - LONG_AGO_NS
    state.a_rest = True
    state.g_rest = True
    state.toe_down_peak = 0.0
    state.toe_up_peak = 0.0
    state.peak_speed = 0.0
    for j in range(3):
        state.velocity[j] = 0.0
        state.acceleration[j] = 0.0
    state.stance_force[0], state.stance_force[1], state.stance_force[2] = fx, fy, fz


@jit_ieee
def features(state: Record) -> Features:
    """What the guards saw at the newest sample."""
    return Features(
        state.a_rest,
        state.g_rest,
        state.toe_down[state.samples % LAGS],
        state.toe_down_change,
        state.toe_down_peak,
        state.toe_up_peak,
        state.vertical_jerk,
        1e-9 * (state.t_ns - state.phase_since_ns),
        1e-9 * (state.t_ns - max(state.a_moving_ns, state.g_moving_ns)),
    )


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
        _observe(core, fx, fy, fz, dt_s)
        if state.phase == 0 and state.a_rest and state.g_rest and dt_s > 0.0:
            correct_by_gravity(
                q, state.bias_radps, state.covariance, state.scratch, fx, fy, fz, dt_s, core.settings
            )  # fmt: skip
        quaternions[i, 0], quaternions[i, 1], quaternions[i, 2], quaternions[i, 3] = q[0], q[1], q[2], q[3]
        transition = first_transition(state.phase, features(state), core.thresholds)
        if transition != 0:
            return i + 1, transition
    return end, 0


@jit_ieee
def enter(core: Record, phase: int, acc: Mat, row: int) -> None:
    """The machine has changed phase at the newest sample, which is this row of ``acc`` (N, 3).

    ``core`` of ``CORE``.
    """
    state, parameters = core.state, core.parameters
    state.phase = phase
    state.phase_since_ns = state.t_ns
    if phase == 0:
        state.stance_force[0] = acc[row, 0] - parameters.acc_bias_x_mps2
        state.stance_force[1] = acc[row, 1] - parameters.acc_bias_y_mps2
        state.stance_force[2] = acc[row, 2] - parameters.acc_bias_z_mps2
    elif phase == 1:
        state.toe_down_peak = max(state.toe_down[state.samples % LAGS], 0.0)
    elif phase == 2:
        state.toe_up_peak = 0.0


@jit_ieee
def _observe(core: Record, fx: float, fy: float, fz: float, dt_s: float) -> None:
    """Turn one sample into the features that the guards look at: bias-free force (m/s²); its rate is in the state."""
    state, parameters, thresholds = core.state, core.parameters, core.thresholds
    wx, wy, wz = state.rate_radps[0], state.rate_radps[1], state.rate_radps[2]
    now = state.samples % LAGS
    toe_down = parameters.toe_down_x * wx + parameters.toe_down_y * wy + parameters.toe_down_z * wz
    q = state.quaternion
    ax, ay, az = to_world(q[0], q[1], q[2], q[3], fx, fy, fz)
    vertical = az - G_MPS2
    state.vertical_mps2[now] = vertical
    state.toe_down[now] = toe_down
    state.toe_down_peak = max(state.toe_down_peak, toe_down)
    state.toe_up_peak = max(state.toe_up_peak, -toe_down)

    resting_before = state.phase == 0 and state.a_rest and state.g_rest
    speed = _dead_reckon(state, dt_s, ax, ay, vertical, resting_before)

    # what rests counts as moving only above the higher limit, what moves as resting only below the lower
    excess = abs(math.sqrt(fx * fx + fy * fy + fz * fz) - G_MPS2)
    mean = state.stance_force
    mx, my, mz = mean[0], mean[1], mean[2]
    turned2 = (fx - mx) * (fx - mx) + (fy - my) * (fy - my) + (fz - mz) * (fz - mz)
    turned = turned2 >= thresholds.turned_acc_mps2 * thresholds.turned_acc_mps2
    if state.phase == 0:
        if turned:
            state.a_moving_ns = state.t_ns
        follow = min(parameters.sample_s / STANCE_MEAN_S, 1.0) if state.g_rest else 0.0
        mean[0] = mx + follow * (fx - mx)
        mean[1] = my + follow * (fy - my)
        mean[2] = mz + follow * (fz - mz)
    if excess >= thresholds.rest_acc_mps2 * (thresholds.leave_acc if state.a_rest else 1.0):
        state.a_moving_ns = state.t_ns
    limit = thresholds.rest_gyr_radps * (thresholds.leave_gyr if state.g_rest else 1.0)
    if wx * wx + wy * wy + wz * wz >= limit * limit:
        state.g_moving_ns = state.t_ns
    # movement counts at once; rest must last, or a zero crossing would be one
    hold_ns = 1e9 * thresholds.rest_hold_s
    state.g_rest = state.t_ns - state.g_moving_ns >= hold_ns
    state.a_rest = state.t_ns - state.a_moving_ns >= hold_ns
    if state.phase != 0 and state.a_rest:
        # a foot that swings slowly and evenly feels no force but gravity: it rests only if it has also come to a stop
        # (and, with the heel lifted, back to where it stood), or if it has been still for long
        travelling = speed > max(thresholds.still_speed_mps, thresholds.still_speed_share * state.peak_speed)
        if state.phase == 3 and state.t_ns - state.phase_since_ns > 1e9 * LANDED_S:
            travelling = False  # what is left is the reckoning's own drift, which nothing would ever take back
        still_ns = state.t_ns - max(state.a_moving_ns, state.g_moving_ns)
        if (travelling or (state.phase == 1 and turned)) and still_ns < 1e9 * thresholds.long_rest_s:
            state.a_rest = False

    back = min(state.samples - 1, parameters.jerk_lag)
    then = (state.samples - back) % LAGS
    state.vertical_jerk = (vertical - state.vertical_mps2[then]) * _per_second(back, parameters.sample_s)
    back = min(state.samples - 1, parameters.change_lag)
    then = (state.samples - back) % LAGS
    state.toe_down_change = (toe_down - state.toe_down[then]) * _per_second(back, parameters.sample_s)


@jit_ieee
def _dead_reckon(state: Record, dt_s: float, ax: float, ay: float, az: float, resting: bool) -> float:
    """Speed of the sensor (m/s) integrated from its acceleration in the world since it last rested in stance: good for
    a second or two.
    """
    v, a = state.velocity, state.acceleration
    if resting:
        v[0], v[1], v[2] = 0.0, 0.0, 0.0
        state.peak_speed = 0.0
    else:
        v[0] += 0.5 * dt_s * (a[0] + ax)
        v[1] += 0.5 * dt_s * (a[1] + ay)
        v[2] += 0.5 * dt_s * (a[2] + az)
    a[0], a[1], a[2] = ax, ay, az
    speed = math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    state.peak_speed = max(state.peak_speed, speed)
    return speed


@jit_ieee
def _per_second(back: int, sample_s: float) -> float:
    """One over the time that ``back`` samples span; nothing to compare with gives 0."""
    return 1.0 / (back * sample_s) if back > 0 else 0.0
