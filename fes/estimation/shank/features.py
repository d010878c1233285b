"""The compiled core of a shank sensor: the guards' features from a limb that turns all through stance.

The guards (Negård et al. 2005) ask whether the foot is at rest, how fast it turns toe-down, and whether it jolts. For
the foot's accelerometer stands a virtual one at the ankle, ``f − w' × r − w × (w × r)`` with the lever arm ``r`` of Wu
et al. (Eq. (5) differentiated), which feels nothing but gravity as long as the ankle stands still. For its toe-down
rate stands the rate of lean, forward positive: slow while the foot is flat, greatest at foot-off, negative in swing.
"""

import math
from typing import NamedTuple

import numpy as np

from fes.estimation.numerics.jit import jit
from fes.estimation.numerics.records import Mat, Record, Vec, core_type, record_type
from fes.estimation.tracking.phase_features import (
    FIELDS,
    LAGS,
    LONG_AGO_NS,
    features,
    first_transition,
    observe,
    per_second,
    start_phases,
)
from fes.signals import G_MPS2
from statemachine.guards import Thresholds

REST_FOLLOW_S = 0.25  # gravity follows the ankle's force this fast while the foot is flat …
FOLLOW_S = 4.0  # … and this slowly all the time, so that a wrong start heals
SMOOTHING_S = 0.01  # of the rate of lean: less than the guards' look-backs
WOBBLE_S = 0.02  # of the ankle's force: soft tissue rings at some 10–20 Hz
STILL_S = 0.03  # the ankle stands once it has been still for so long

STATE = record_type(
    [
        *FIELDS,
        ("moving_ns", np.int64),  # last sample at which the ankle did not stand
        ("gravity", np.float64, 3),  # specific force of a sensor that stands still, in the sensor frame
        ("excess", np.float64, 3),  # the ankle's force beyond gravity, smoothed
        ("force", np.float64, (LAGS, 3)),  # rings of the last samples
        ("rate", np.float64, (LAGS, 3)),
        ("lean", np.float64),
    ]
)


class ShankParameters(NamedTuple):
    """What the core needs to know about one shank sensor; fixed while it runs. Vectors in the sensor frame."""

    left_x: float  # mediolateral axis to the person's left: the rate of lean is about it
    left_y: float
    left_z: float
    arm_x_m: float  # from the ankle to the sensor
    arm_y_m: float
    arm_z_m: float
    acc_bias_x_mps2: float
    acc_bias_y_mps2: float
    acc_bias_z_mps2: float
    gyr_bias_x_radps: float
    gyr_bias_y_radps: float
    gyr_bias_z_radps: float
    sample_s: float  # nominal
    still_mps2: float  # the ankle stands while its force is this close to gravity
    jerk_lag: int  # 10 ms


CORE = core_type(STATE, parameters=ShankParameters, thresholds=Thresholds)


def start(core: Record, t_ns: int, fx: float, fy: float, fz: float) -> None:
    """Begin in stance at the first sample, whose bias-free specific force (m/s²) is taken for gravity's direction."""
    state, size = core.state, max(math.sqrt(fx * fx + fy * fy + fz * fz), 1e-3)
    start_phases(core, t_ns)
    state.gravity[:] = G_MPS2 * fx / size, G_MPS2 * fy / size, G_MPS2 * fz / size
    state.excess[:] = 0.0
    state.lean = 0.0
    state.moving_ns = t_ns - LONG_AGO_NS


@jit
def advance(core: Record, t_ns: Vec, acc: Mat, gyr: Mat, begin: int, end: int, trace: Mat) -> tuple[int, int]:
    """Advance over the samples ``begin`` … ``end - 1``; stop behind the first at which a guard fires.

    ``core`` of ``CORE``; ``t_ns`` (N,) int64 strictly increasing; ``acc`` (N, 3) m/s²; ``gyr`` (N, 3) rad/s; ``trace``
    (N, 4) receives rate of lean (rad/s), the ankle's force beyond gravity (m/s²), the jolt (m/s³) and 1 where both
    rest. Returns how far it came and the transition's number (0: the block's end). The phase is the caller's to change.
    """
    state, parameters = core.state, core.parameters
    for i in range(begin, end):
        dt_s = 1e-9 * (t_ns[i] - state.t_ns)
        state.t_ns = t_ns[i]
        state.samples += 1
        now = state.samples % LAGS
        force, rate = state.force[now], state.rate[now]
        force[0], force[1] = acc[i, 0] - parameters.acc_bias_x_mps2, acc[i, 1] - parameters.acc_bias_y_mps2
        force[2] = acc[i, 2] - parameters.acc_bias_z_mps2
        rate[0], rate[1] = gyr[i, 0] - parameters.gyr_bias_x_radps, gyr[i, 1] - parameters.gyr_bias_y_radps
        rate[2] = gyr[i, 2] - parameters.gyr_bias_z_radps
        excess = _ankle(state, parameters, dt_s)
        if excess >= parameters.still_mps2:
            state.moving_ns = state.t_ns
        _turning(core, dt_s)
        trace[i, 0], trace[i, 1], trace[i, 2] = state.lean, excess, state.contact_jerk
        trace[i, 3] = 1.0 if _stands(state) else 0.0
        transition = first_transition(state.phase, features(state), core.thresholds)
        if transition != 0:
            return i + 1, transition
    return end, 0


@jit
def _ankle(state: Record, parameters: Record, dt_s: float) -> float:
    """The ankle's force beyond gravity (m/s²), as of ``jerk_lag`` samples ago, so that both sides of it are known."""
    lag = min((state.samples - 1) // 2, parameters.jerk_lag, (LAGS - 1) // 2)
    now, middle, then = state.samples % LAGS, (state.samples - lag) % LAGS, (state.samples - 2 * lag) % LAGS
    w, f = state.rate[middle], state.force[middle]
    per_second = 1.0 / (2 * lag * parameters.sample_s) if lag > 0 else 0.0
    ax = (state.rate[now, 0] - state.rate[then, 0]) * per_second
    ay = (state.rate[now, 1] - state.rate[then, 1]) * per_second
    az = (state.rate[now, 2] - state.rate[then, 2]) * per_second
    rx, ry, rz = parameters.arm_x_m, parameters.arm_y_m, parameters.arm_z_m
    vx, vy, vz = w[1] * rz - w[2] * ry, w[2] * rx - w[0] * rz, w[0] * ry - w[1] * rx
    fx = f[0] - (ay * rz - az * ry) - (w[1] * vz - w[2] * vy)
    fy = f[1] - (az * rx - ax * rz) - (w[2] * vx - w[0] * vz)
    fz = f[2] - (ax * ry - ay * rx) - (w[0] * vy - w[1] * vx)
    # gravity stays put while the sensor turns; the ankle's force, which is gravity on average, keeps it there
    g = state.gravity
    gx = g[0] - dt_s * (w[1] * g[2] - w[2] * g[1])
    gy = g[1] - dt_s * (w[2] * g[0] - w[0] * g[2])
    gz = g[2] - dt_s * (w[0] * g[1] - w[1] * g[0])
    resting = state.phase == 0 and _stands(state)
    follow = min(dt_s / (REST_FOLLOW_S if resting else FOLLOW_S), 1.0)
    gx, gy, gz = gx + follow * (fx - gx), gy + follow * (fy - gy), gz + follow * (fz - gz)
    size = max(math.sqrt(gx * gx + gy * gy + gz * gz), 1e-3)
    g[0], g[1], g[2] = G_MPS2 * gx / size, G_MPS2 * gy / size, G_MPS2 * gz / size
    smooth = dt_s / (dt_s + WOBBLE_S)
    excess = state.excess
    excess[0] += smooth * (fx - g[0] - excess[0])
    excess[1] += smooth * (fy - g[1] - excess[1])
    excess[2] += smooth * (fz - g[2] - excess[2])
    return math.sqrt(excess[0] * excess[0] + excess[1] * excess[1] + excess[2] * excess[2])


@jit
def _stands(state: Record) -> bool:
    return bool(state.t_ns - max(state.moving_ns, state.turning_ns) >= 1e9 * STILL_S)


@jit
def _turning(core: Record, dt_s: float) -> None:
    """The rate of lean, and the jolt: how far the force has jumped in 10 ms, per second."""
    state, parameters = core.state, core.parameters
    now, back = state.samples % LAGS, min(state.samples - 1, parameters.jerk_lag)
    w, f = state.rate[now], state.force[now]
    lean = parameters.left_x * w[0] + parameters.left_y * w[1] + parameters.left_z * w[2]
    if state.samples > 1:
        lean = state.lean + dt_s / (dt_s + SMOOTHING_S) * (lean - state.lean)
    state.lean = lean
    was = state.force[(state.samples - back) % LAGS]
    dx, dy, dz = f[0] - was[0], f[1] - was[1], f[2] - was[2]
    jolt = math.sqrt(dx * dx + dy * dy + dz * dz) * per_second(back, parameters.sample_s)
    still = state.t_ns - state.moving_ns >= 1e9 * STILL_S
    observe(core, lean, abs(lean) if still else math.inf, jolt, dt_s)
    if still and state.phase == 0:
        state.toe_down = 0.0  # a foot does not turn under an ankle that stands
