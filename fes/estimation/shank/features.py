"""The compiled core of a shank sensor: the guards' features from a limb that turns all through stance.

The guards (Negård et al. 2005) ask whether the foot is at rest, how fast it turns toe-down, and whether it jolts. A
shank answers through two stand-ins. A virtual accelerometer at the ankle, ``f − w' × r − w × (w × r)`` with the lever
arm ``r`` of Wu et al. (Eq. (5) differentiated), feels nothing but gravity as long as the ankle stands still: that is
the foot's accelerometer. The rate of lean, forward positive, is slow while the foot is flat, peaks at foot-off, is
negative in swing and returns to zero at contact: that is the foot's toe-down rate.

Live it advances one sample, in analysis a whole block; all that evolves is in one ``STATE`` record.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from fes.estimation.foot.features import LAGS, LONG_AGO_NS, first_transition
from fes.estimation.numerics.jit import jit
from fes.signals import G_MPS2
from statemachine.guards import Features, Thresholds

REST_FOLLOW_S = 0.25  # gravity follows the ankle's force this fast while the foot is flat …
FOLLOW_S = 4.0  # … and this slowly all the time, so that a wrong start heals
SMOOTHING_S = 0.01  # of the rate of lean: less than the guards' look-backs
WOBBLE_S = 0.02  # of the ankle's force: soft tissue rings at some 10–20 Hz

STATE = np.dtype(
    [
        ("samples", np.int64),
        ("t_ns", np.int64),
        ("phase", np.int64),
        ("phase_since_ns", np.int64),
        ("a_moving_ns", np.int64),
        ("g_moving_ns", np.int64),
        ("gravity", np.float64, 3),  # specific force of a sensor that stands still, in the sensor frame
        ("excess", np.float64, 3),  # the ankle's force beyond gravity, smoothed
        ("force", np.float64, (LAGS, 3)),  # rings of the last samples
        ("rate", np.float64, (LAGS, 3)),
        ("lean", np.float64, LAGS),
        ("lean_peak", np.float64),
        ("swing_peak", np.float64),
        ("a_rest", np.bool_),
        ("g_rest", np.bool_),
        ("lean_change", np.float64),
        ("jolt", np.float64),
    ],
    align=True,
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
    jump_lag: int  # 10 ms
    change_lag: int  # 20 ms


@jit
def start(s: Any, t_ns: int, fx: float, fy: float, fz: float) -> None:
    """Begin in stance at the first sample, whose bias-free specific force (m/s²) is taken for gravity's direction."""
    size = max(math.sqrt(fx * fx + fy * fy + fz * fz), 1e-3)
    s.gravity[0], s.gravity[1], s.gravity[2] = G_MPS2 * fx / size, G_MPS2 * fy / size, G_MPS2 * fz / size
    s.samples = 0
    s.t_ns = t_ns
    s.phase = 0
    s.phase_since_ns = t_ns
    s.a_moving_ns = t_ns - LONG_AGO_NS
    s.g_moving_ns = t_ns - LONG_AGO_NS
    s.a_rest = True
    s.g_rest = True
    s.lean_peak = 0.0
    s.swing_peak = 0.0
    s.lean_change = 0.0
    s.jolt = 0.0
    for j in range(3):
        s.excess[j] = 0.0


@jit
def features(s: Any) -> Features:
    """What the guards saw at the newest sample, in the foot's terms."""
    return Features(
        s.a_rest,
        s.g_rest,
        s.lean[s.samples % LAGS],
        s.lean_change,
        s.lean_peak,
        s.swing_peak,
        s.jolt,
        1e-9 * (s.t_ns - s.phase_since_ns),
        1e-9 * (s.t_ns - max(s.a_moving_ns, s.g_moving_ns)),
    )


@jit
def enter(s: Any, phase: int) -> None:
    """The machine has changed phase at the newest sample."""
    s.phase = phase
    s.phase_since_ns = s.t_ns
    if phase == 1:
        s.lean_peak = max(s.lean[s.samples % LAGS], 0.0)
    elif phase == 2:
        s.swing_peak = 0.0


@jit
def advance(
    s: Any,
    p: ShankParameters,
    thresholds: Thresholds,
    t_ns: Any,
    acc: Any,
    gyr: Any,
    begin: int,
    end: int,
    trace: Any,
) -> tuple[int, int]:
    """Advance over the samples ``begin`` … ``end - 1``; stop behind the first at which a guard fires.

    ``t_ns`` (N,) int64 strictly increasing; ``acc`` (N, 3) m/s²; ``gyr`` (N, 3) rad/s; ``trace`` (N, 4) receives rate
    of lean (rad/s), the ankle's force beyond gravity (m/s²), the jolt (m/s³) and 1 where both rest. Returns how far it
    came and the transition's number (0: the block's end). The phase is the caller's to change.
    """
    for i in range(begin, end):
        dt_s = 1e-9 * (t_ns[i] - s.t_ns)
        s.t_ns = t_ns[i]
        s.samples += 1
        now = s.samples % LAGS
        force, rate = s.force[now], s.rate[now]
        force[0], force[1] = acc[i, 0] - p.acc_bias_x_mps2, acc[i, 1] - p.acc_bias_y_mps2
        force[2] = acc[i, 2] - p.acc_bias_z_mps2
        rate[0], rate[1] = gyr[i, 0] - p.gyr_bias_x_radps, gyr[i, 1] - p.gyr_bias_y_radps
        rate[2] = gyr[i, 2] - p.gyr_bias_z_radps
        excess = _ankle(s, p, dt_s)
        _turning(s, p, dt_s)
        _rest(s, thresholds, excess)
        trace[i, 0], trace[i, 1], trace[i, 2] = s.lean[now], excess, s.jolt
        trace[i, 3] = 1.0 if s.a_rest and s.g_rest else 0.0
        transition = first_transition(s.phase, features(s), thresholds)
        if transition != 0:
            return i + 1, transition
    return end, 0


@jit
def _ankle(s: Any, p: ShankParameters, dt_s: float) -> float:
    """The ankle's force beyond gravity (m/s²), as of ``jump_lag`` samples ago, so that both sides of it are known."""
    lag = min((s.samples - 1) // 2, p.jump_lag, (LAGS - 1) // 2)
    now, middle, then = s.samples % LAGS, (s.samples - lag) % LAGS, (s.samples - 2 * lag) % LAGS
    w, f = s.rate[middle], s.force[middle]
    per_second = 1.0 / (2 * lag * p.sample_s) if lag > 0 else 0.0
    ax = (s.rate[now, 0] - s.rate[then, 0]) * per_second
    ay = (s.rate[now, 1] - s.rate[then, 1]) * per_second
    az = (s.rate[now, 2] - s.rate[then, 2]) * per_second
    rx, ry, rz = p.arm_x_m, p.arm_y_m, p.arm_z_m
    vx, vy, vz = w[1] * rz - w[2] * ry, w[2] * rx - w[0] * rz, w[0] * ry - w[1] * rx
    fx = f[0] - (ay * rz - az * ry) - (w[1] * vz - w[2] * vy)
    fy = f[1] - (az * rx - ax * rz) - (w[2] * vx - w[0] * vz)
    fz = f[2] - (ax * ry - ay * rx) - (w[0] * vy - w[1] * vx)
    # gravity stays put while the sensor turns; the ankle's force, which is gravity on average, keeps it there
    g = s.gravity
    gx = g[0] - dt_s * (w[1] * g[2] - w[2] * g[1])
    gy = g[1] - dt_s * (w[2] * g[0] - w[0] * g[2])
    gz = g[2] - dt_s * (w[0] * g[1] - w[1] * g[0])
    resting = s.phase == 0 and s.a_rest and s.g_rest
    follow = min(dt_s / (REST_FOLLOW_S if resting else FOLLOW_S), 1.0)
    gx, gy, gz = gx + follow * (fx - gx), gy + follow * (fy - gy), gz + follow * (fz - gz)
    size = max(math.sqrt(gx * gx + gy * gy + gz * gz), 1e-3)
    g[0], g[1], g[2] = G_MPS2 * gx / size, G_MPS2 * gy / size, G_MPS2 * gz / size
    smooth = dt_s / (dt_s + WOBBLE_S)
    e = s.excess
    e[0] += smooth * (fx - g[0] - e[0])
    e[1] += smooth * (fy - g[1] - e[1])
    e[2] += smooth * (fz - g[2] - e[2])
    return math.sqrt(e[0] * e[0] + e[1] * e[1] + e[2] * e[2])


@jit
def _turning(s: Any, p: ShankParameters, dt_s: float) -> None:
    """Rate of lean, its peaks and its derivative, and the jolt: how far the force has jumped in 10 ms, per second."""
    now, before = s.samples % LAGS, (s.samples - 1) % LAGS
    w, f = s.rate[now], s.force[now]
    lean = p.left_x * w[0] + p.left_y * w[1] + p.left_z * w[2]
    if s.samples > 1:
        lean = s.lean[before] + dt_s / (dt_s + SMOOTHING_S) * (lean - s.lean[before])
    s.lean[now] = lean
    s.lean_peak = max(s.lean_peak, lean)
    s.swing_peak = max(s.swing_peak, -lean)
    back = min(s.samples - 1, p.change_lag)
    s.lean_change = (lean - s.lean[(s.samples - back) % LAGS]) / (back * p.sample_s) if back > 0 else 0.0
    back = min(s.samples - 1, p.jump_lag)
    was = s.force[(s.samples - back) % LAGS]
    dx, dy, dz = f[0] - was[0], f[1] - was[1], f[2] - was[2]
    s.jolt = math.sqrt(dx * dx + dy * dy + dz * dz) / (back * p.sample_s) if back > 0 else 0.0


@jit
def _rest(s: Any, thresholds: Thresholds, excess: float) -> None:
    """Rest as the foot's kernel tells it: leaving takes more than staying, and rest must last."""
    if excess >= thresholds.rest_acc_mps2 * (thresholds.leave_acc if s.a_rest else 1.0):
        s.a_moving_ns = s.t_ns
    limit = thresholds.rest_gyr_radps * (thresholds.leave_gyr if s.g_rest else 1.0)
    if abs(s.lean[s.samples % LAGS]) >= limit:
        s.g_moving_ns = s.t_ns
    hold_ns = 1e9 * thresholds.rest_hold_s
    s.g_rest = s.t_ns - s.g_moving_ns >= hold_ns
    s.a_rest = s.t_ns - s.a_moving_ns >= hold_ns
