"""The compiled core: orientation, features and guards of one foot, sample by sample, stopping where a guard fires.

Live it advances one sample, in analysis a whole block; all that evolves is in one ``STATE`` record, so that cutting a
recording anywhere gives the same result to the last bit.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from fes.estimation.foot.orientation import OrientationSettings, correct_by_gravity, propagate, start_covariance
from fes.estimation.numerics.jit import jit_ieee
from fes.estimation.numerics.rotation import from_gravity, quaternion_step, to_world
from fes.signals import G_MPS2
from statemachine import guards
from statemachine.guards import Features, Thresholds

LAGS = 64  # longest look-back in samples: 20 ms at over 2 kHz
LONG_AGO_NS = 3_600_000_000_000
LANDED_S = 0.3  # after a contact: no swing goes on for so long once it was seen
STANCE_MEAN_S = 0.25  # over which the stance's mean specific force forgets

STATE = np.dtype(
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
        ("vertical_jump", np.float64),
    ],
    align=True,
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
    jump_lag: int  # 10 ms: jump of the vertical acceleration
    change_lag: int  # 20 ms: derivative of the toe-down rate


def lags_at(rate_hz: float) -> tuple[int, int]:
    """The look-backs of 10 ms and 20 ms in samples: at least one, at most what the rings hold."""
    jump, change = (min(max(round(span_s * rate_hz), 1), LAGS - 1) for span_s in (0.01, 0.02))
    return jump, change


_t1, _t2, _t3 = jit_ieee(guards.t1), jit_ieee(guards.t2), jit_ieee(guards.t3)
_t4, _t5, _t6 = jit_ieee(guards.t4), jit_ieee(guards.t5), jit_ieee(guards.t6)


@jit_ieee
def first_transition(phase: int, x: Features, p: Thresholds) -> int:
    """Number of the transition that fires from ``phase`` (0 stance … 3 loading response), 0 for none.

    The table in ``statemachine.table`` written out for the compiler; a test holds the two together.
    """
    if phase == 0:
        if _t1(x, p):
            return 1
    elif phase == 1:
        if _t2(x, p):
            return 2
        if _t5(x, p):
            return 5
    elif phase == 2:
        if _t3(x, p):
            return 3
        if _t6(x, p):
            return 6
    elif _t4(x, p):
        return 4
    return 0


@jit_ieee
def start(s: Any, t_ns: int, fx: float, fy: float, fz: float, settings: OrientationSettings) -> None:
    """Begin in stance, upright as gravity says, at the first sample (bias-free specific force in m/s²)."""
    w, x, y, z = from_gravity(fx, fy, fz)
    s.quaternion[0], s.quaternion[1], s.quaternion[2], s.quaternion[3] = w, x, y, z
    start_covariance(s.covariance, settings)
    s.samples = 0
    s.t_ns = t_ns
    s.phase = 0
    s.phase_since_ns = t_ns
    s.a_moving_ns = t_ns - LONG_AGO_NS
    s.g_moving_ns = t_ns - LONG_AGO_NS
    s.a_rest = True
    s.g_rest = True
    s.toe_down_peak = 0.0
    s.toe_up_peak = 0.0
    s.peak_speed = 0.0
    for j in range(3):
        s.velocity[j] = 0.0
        s.acceleration[j] = 0.0
    s.stance_force[0], s.stance_force[1], s.stance_force[2] = fx, fy, fz


@jit_ieee
def features(s: Any) -> Features:
    """What the guards saw at the newest sample."""
    return Features(
        s.a_rest,
        s.g_rest,
        s.toe_down[s.samples % LAGS],
        s.toe_down_change,
        s.toe_down_peak,
        s.toe_up_peak,
        s.vertical_jump,
        1e-9 * (s.t_ns - s.phase_since_ns),
        1e-9 * (s.t_ns - max(s.a_moving_ns, s.g_moving_ns)),
    )


@jit_ieee
def advance(
    s: Any,
    p: FootParameters,
    thresholds: Thresholds,
    settings: OrientationSettings,
    t_ns: Any,
    acc: Any,
    gyr: Any,
    begin: int,
    end: int,
    quaternions: Any,
) -> tuple[int, int]:
    """Advance over the samples ``begin`` … ``end - 1``; stop behind the first at which a guard fires.

    ``t_ns`` (N,) int64 strictly increasing and above ``s.t_ns``; ``acc`` (N, 3) m/s²; ``gyr`` (N, 3) rad/s;
    ``quaternions`` (N, 4) receives the orientation at each sample. Returns how far it came and the transition's number
    (0: the block's end). The phase is the caller's to change.
    """
    for i in range(begin, end):
        fx, fy, fz = acc[i, 0] - p.acc_bias_x_mps2, acc[i, 1] - p.acc_bias_y_mps2, acc[i, 2] - p.acc_bias_z_mps2
        wx = gyr[i, 0] - p.gyr_bias_x_radps - s.bias_radps[0]
        wy = gyr[i, 1] - p.gyr_bias_y_radps - s.bias_radps[1]
        wz = gyr[i, 2] - p.gyr_bias_z_radps - s.bias_radps[2]
        dt_s = 1e-9 * (t_ns[i] - s.t_ns)
        if s.samples > 0:
            mx, my, mz = 0.5 * (s.rate_radps[0] + wx), 0.5 * (s.rate_radps[1] + wy), 0.5 * (s.rate_radps[2] + wz)
            q = s.quaternion
            q[0], q[1], q[2], q[3] = quaternion_step(q[0], q[1], q[2], q[3], mx * dt_s, my * dt_s, mz * dt_s)
            propagate(s.covariance, mx, my, mz, dt_s, settings)
        s.rate_radps[0], s.rate_radps[1], s.rate_radps[2] = wx, wy, wz
        s.t_ns = t_ns[i]
        s.samples += 1
        _observe(s, p, thresholds, fx, fy, fz, wx, wy, wz, dt_s)
        resting = s.a_rest and s.g_rest
        if s.phase == 0 and resting and dt_s > 0.0:
            correct_by_gravity(s.quaternion, s.bias_radps, s.covariance, s.scratch, fx, fy, fz, dt_s, settings)
        quaternions[i, 0], quaternions[i, 1] = s.quaternion[0], s.quaternion[1]
        quaternions[i, 2], quaternions[i, 3] = s.quaternion[2], s.quaternion[3]
        transition = first_transition(s.phase, features(s), thresholds)
        if transition != 0:
            return i + 1, transition
    return end, 0


@jit_ieee
def enter(s: Any, phase: int, fx: float, fy: float, fz: float) -> None:
    """The machine has changed phase at the newest sample, whose bias-free specific force is ``f``."""
    s.phase = phase
    if phase == 0:
        s.stance_force[0], s.stance_force[1], s.stance_force[2] = fx, fy, fz
    s.phase_since_ns = s.t_ns
    if phase == 1:
        s.toe_down_peak = max(s.toe_down[s.samples % LAGS], 0.0)
    elif phase == 2:
        s.toe_up_peak = 0.0


@jit_ieee
def _observe(
    s: Any,
    p: FootParameters,
    thresholds: Thresholds,
    fx: float,
    fy: float,
    fz: float,
    wx: float,
    wy: float,
    wz: float,
    dt_s: float,
) -> None:
    """Turn one bias-free sample into the features that the guards look at."""
    now = s.samples % LAGS
    toe_down = p.toe_down_x * wx + p.toe_down_y * wy + p.toe_down_z * wz
    q = s.quaternion
    ax, ay, az = to_world(q[0], q[1], q[2], q[3], fx, fy, fz)
    vertical = az - G_MPS2
    s.vertical_mps2[now] = vertical
    s.toe_down[now] = toe_down
    s.toe_down_peak = max(s.toe_down_peak, toe_down)
    s.toe_up_peak = max(s.toe_up_peak, -toe_down)

    resting_before = s.phase == 0 and s.a_rest and s.g_rest
    speed = _dead_reckon(s, dt_s, ax, ay, vertical, resting_before)

    # what rests counts as moving only above the higher limit, what moves as resting only below the lower
    excess = abs(math.sqrt(fx * fx + fy * fy + fz * fz) - G_MPS2)
    mx, my, mz = s.stance_force[0], s.stance_force[1], s.stance_force[2]
    turned2 = (fx - mx) * (fx - mx) + (fy - my) * (fy - my) + (fz - mz) * (fz - mz)
    turned = turned2 >= thresholds.turned_acc_mps2 * thresholds.turned_acc_mps2
    if s.phase == 0:
        if turned:
            s.a_moving_ns = s.t_ns
        follow = min(p.sample_s / STANCE_MEAN_S, 1.0) if s.g_rest else 0.0
        s.stance_force[0] = mx + follow * (fx - mx)
        s.stance_force[1] = my + follow * (fy - my)
        s.stance_force[2] = mz + follow * (fz - mz)
    if excess >= thresholds.rest_acc_mps2 * (thresholds.leave_acc if s.a_rest else 1.0):
        s.a_moving_ns = s.t_ns
    limit = thresholds.rest_gyr_radps * (thresholds.leave_gyr if s.g_rest else 1.0)
    if wx * wx + wy * wy + wz * wz >= limit * limit:
        s.g_moving_ns = s.t_ns
    # movement counts at once; rest must last, or a zero crossing would be one
    hold_ns = 1e9 * thresholds.rest_hold_s
    s.g_rest = s.t_ns - s.g_moving_ns >= hold_ns
    s.a_rest = s.t_ns - s.a_moving_ns >= hold_ns
    if s.phase != 0 and s.a_rest:
        # a foot that swings slowly and evenly feels no force but gravity: it rests only if it has also come to a stop
        # (and, with the heel lifted, back to where it stood), or if it has been still for long
        travelling = speed > max(thresholds.still_speed_mps, thresholds.still_speed_share * s.peak_speed)
        if s.phase == 3 and s.t_ns - s.phase_since_ns > 1e9 * LANDED_S:
            travelling = False  # what is left is the reckoning's own drift, which nothing would ever take back
        still_ns = s.t_ns - max(s.a_moving_ns, s.g_moving_ns)
        if (travelling or (s.phase == 1 and turned)) and still_ns < 1e9 * thresholds.long_rest_s:
            s.a_rest = False

    back = min(s.samples - 1, p.jump_lag)
    then = (s.samples - back) % LAGS
    s.vertical_jump = (vertical - s.vertical_mps2[then]) * _per_second(back, p.sample_s)
    back = min(s.samples - 1, p.change_lag)
    then = (s.samples - back) % LAGS
    s.toe_down_change = (toe_down - s.toe_down[then]) * _per_second(back, p.sample_s)


@jit_ieee
def _dead_reckon(s: Any, dt_s: float, ax: float, ay: float, az: float, resting: bool) -> float:
    """Speed of the sensor (m/s) integrated from its acceleration in the world since it last rested in stance: good for
    a second or two.
    """
    v, a = s.velocity, s.acceleration
    if resting:
        v[0], v[1], v[2] = 0.0, 0.0, 0.0
        s.peak_speed = 0.0
    else:
        v[0] += 0.5 * dt_s * (a[0] + ax)
        v[1] += 0.5 * dt_s * (a[1] + ay)
        v[2] += 0.5 * dt_s * (a[2] + az)
    a[0], a[1], a[2] = ax, ay, az
    speed = math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    s.peak_speed = max(s.peak_speed, speed)
    return speed


@jit_ieee
def _per_second(back: int, sample_s: float) -> float:
    """One over the time that ``back`` samples span; nothing to compare with gives 0."""
    return 1.0 / (back * sample_s) if back > 0 else 0.0
