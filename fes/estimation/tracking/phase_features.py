"""What the guards see of a foot or a shank: one toe-down rate and one jump of the force, followed sample by sample.

The state's ``FIELDS`` are part of each core's own. This person's measures follow the strides: each by an eighth of what
a stride shows, within bounds about the calibrated ones.

Which transition fires then is up to the guards of ``statemachine/guards.py``, compiled as they stand.
"""

import math
from typing import Any

import numpy as np

from fes.estimation.numerics.jit import jit_ieee
from fes.estimation.numerics.records import Record, Vec
from statemachine.guards import Features, Thresholds
from statemachine.phases import Phase, Transition
from statemachine.table import TABLE

LAGS = 64  # longest look-back in samples: 10 ms at over 5 kHz
LONG_AGO_NS = 3_600_000_000_000
FOLLOW = 0.125  # of what a stride shows
LEAST, MOST = 0.6, 1.6  # of the calibrated measure
USUAL = 0.5, 2.0  # of the stride time now: what may be one stride
STANCE_S = 0.1  # the dead-reckoned speed of a foot on the ground dies away
STILL_MPS, STILL_SHARE = 0.25, 0.35  # slower than this, or than this share of the swing's greatest, is no travel
LONG_REST_S = 0.4  # what rests for so long does not travel
CALM_MPS2 = 1.5  # the sensor's acceleration while nothing but gravity is upon it
TURNED_S = 0.2  # standing still so long begins the count of how far the foot has turned anew …
FLAT_S = 0.5  # … and so long makes its pitch the flat one
FIRST_PITCH_SD_RAD, LEAST_PITCH_SD_RAD = 0.05, 0.03  # 3°, until strides have shown it; 1.7°
LANDED_S = 0.6  # standing still later after contact says nothing about the pitch at landing
USUAL_SWING, MOST_USUAL_SWING_S = 0.4, 0.6  # of a stride, before this person's own is known

MEASURES = [
    (name, np.float64)
    for name in ("push_off_radps", "fall_radps", "stride_s", "swing_s", "loading_s", "contact_jerk_mps3")
]
FIELDS: list[Any] = [
    ("samples", np.int64),
    ("t_ns", np.int64),
    ("phase", np.int64),
    ("swing_ns", np.int64),  # when swing began
    ("contact_ns", np.int64),
    ("turning_ns", np.int64),  # last sample at which the foot turned
    ("toe_down", np.float64),
    ("toe_down_peak", np.float64),
    ("toe_up_peak", np.float64),
    ("landing_peak", np.float64),
    ("unsettled_ns", np.int64),  # last sample since contact at which the foot did not stand still
    ("lively_ns", np.int64),  # last sample at which more than gravity was upon the sensor
    ("turned_rad", np.float64),
    ("pitch_rad", np.float64),
    ("pitch_sd_rad", np.float64),
    ("contact_jerk", np.float64),
    ("greatest_jerk", np.float64),  # around the last contact
    ("acceleration", np.float64, 3),  # in the world, free of gravity, of the last sample
    ("velocity", np.float64, 3),  # dead-reckoned
    ("speed", np.float64),
    ("peak_speed", np.float64),
    ("lowest_rad", np.float64),  # least pitch since swing began, and greatest since that
    ("highest_rad", np.float64),
    ("calibrated", np.dtype(MEASURES)),
]


def usual_swing_s(stride_s: float) -> float:
    """How long a swing may be taken to last (s) of whom the stride time is known and no swing was seen yet."""
    return min(USUAL_SWING * stride_s, MOST_USUAL_SWING_S)


@jit_ieee
def start_phases(core: Record, t_ns: int) -> None:
    """Begin in stance at the first sample, with this person's measures as calibrated."""
    state, thresholds = core.state, core.thresholds
    if state.calibrated.stride_s == 0.0:
        known = state.calibrated
        known.push_off_radps, known.fall_radps = thresholds.push_off_radps, thresholds.fall_radps
        known.stride_s, known.swing_s, known.loading_s = thresholds.stride_s, thresholds.swing_s, thresholds.loading_s
        known.contact_jerk_mps3 = thresholds.contact_jerk_mps3
    state.samples = 0
    state.lowest_rad = state.highest_rad = 0.0
    state.t_ns = t_ns
    state.phase = 0
    state.swing_ns = t_ns
    state.contact_ns = state.turning_ns = state.unsettled_ns = state.lively_ns = t_ns - LONG_AGO_NS
    state.toe_down_peak = state.toe_up_peak = state.landing_peak = state.turned_rad = state.pitch_rad = 0.0
    state.pitch_sd_rad = FIRST_PITCH_SD_RAD
    state.toe_down = state.contact_jerk = state.greatest_jerk = state.speed = state.peak_speed = 0.0
    for j in range(3):
        state.velocity[j] = state.acceleration[j] = 0.0


@jit_ieee
def features(state: Record) -> Features:
    """What the guards saw at the newest sample."""
    resting_s = 1e-9 * (state.t_ns - state.turning_ns)
    return Features(
        state.toe_down,
        state.toe_down_peak,
        state.toe_up_peak,
        state.landing_peak,
        state.turned_rad,
        state.pitch_rad,
        state.pitch_sd_rad,
        state.contact_jerk,
        1e-9 * (state.t_ns - state.swing_ns),
        1e-9 * (state.t_ns - state.contact_ns),
        resting_s,
        1e-9 * (state.t_ns - state.unsettled_ns),
        1e-9 * (state.t_ns - state.lively_ns),
        state.speed / max(state.peak_speed, STILL_MPS),
        state.pitch_rad - state.lowest_rad,
        state.highest_rad - state.pitch_rad,
        resting_s < LONG_REST_S and state.speed > max(STILL_MPS, STILL_SHARE * state.peak_speed),
    )


@jit_ieee
def features_in(core: Vec) -> Features:
    """The same of a core (1,), for callers that are not compiled: a record by itself takes ten times as long."""
    return features(core[0].state)


@jit_ieee
def per_second(back: int, sample_s: float) -> float:
    """One over the time that ``back`` samples span; nothing to compare with gives 0."""
    return 1.0 / (back * sample_s) if back > 0 else 0.0


@jit_ieee
def observe(core: Record, toe_down: float, rate_radps: float, contact_jerk: float, dt_s: float) -> None:
    """Take in the newest sample: its toe-down rate and the rate that tells rest (rad/s), and the force's jump (m/s³).

    ``core.state.samples`` already counts it; ``dt_s`` is the time since the one before.
    """
    state, thresholds = core.state, core.thresholds
    state.toe_down = toe_down
    level = max(thresholds.push_off_radps, 0.5 * thresholds.fall_radps)
    state.toe_down_peak = max(state.toe_down_peak, toe_down)
    state.toe_up_peak = max(state.toe_up_peak, -toe_down)
    state.contact_jerk = contact_jerk
    state.greatest_jerk = max(state.greatest_jerk, contact_jerk)
    if rate_radps >= thresholds.rest_share * level:
        state.turning_ns = state.t_ns
    _pitch(core, toe_down, rate_radps, thresholds.still_radps, dt_s)


@jit_ieee
def _pitch(core: Record, toe_down: float, rate_radps: float, still_radps: float, dt_s: float) -> None:
    """Follow the pitch. While the foot stands still in stance it becomes the flat one: slowly for T4, for which it is
    this person's own over many stances, quickly for T1, for which it is that of this stance.
    """
    state, thresholds = core.state, core.thresholds
    state.pitch_rad -= toe_down * dt_s
    state.turned_rad += toe_down * dt_s
    if state.pitch_rad < state.lowest_rad:
        state.lowest_rad = state.highest_rad = state.pitch_rad
    state.highest_rad = max(state.highest_rad, state.pitch_rad)
    if state.phase == 3:
        state.landing_peak = max(state.landing_peak, abs(toe_down))
    if state.phase == 3 or state.phase == 0:
        before_s = 1e-9 * (state.t_ns - state.unsettled_ns) - dt_s
        if rate_radps > still_radps:
            state.unsettled_ns = state.t_ns
        elif (
            before_s < thresholds.settled_after_s <= before_s + dt_s and state.t_ns - state.contact_ns < 1e9 * LANDED_S
        ):
            followed = state.pitch_sd_rad + FOLLOW * (abs(state.pitch_rad) - state.pitch_sd_rad)
            state.pitch_sd_rad = max(followed, LEAST_PITCH_SD_RAD)
    if state.phase == 0:
        stillness = dt_s / (1.0 + (toe_down / still_radps) ** 4)
        state.turned_rad -= min(stillness / TURNED_S, 1.0) * state.turned_rad
        state.pitch_rad -= min(stillness / FLAT_S, 1.0) * state.pitch_rad


@jit_ieee
def dead_reckon(state: Record, dt_s: float, ax: float, ay: float, az: float) -> None:
    """Carry on the sensor's speed by its acceleration in the world (m/s²): good for a second or two of swing."""
    v, a = state.velocity, state.acceleration
    v[0] += 0.5 * dt_s * (a[0] + ax)
    v[1] += 0.5 * dt_s * (a[1] + ay)
    v[2] += 0.5 * dt_s * (a[2] + az)
    if state.phase == 0 or state.phase == 3:
        kept = max(1.0 - dt_s / STANCE_S, 0.0)
        v[0], v[1], v[2] = kept * v[0], kept * v[1], kept * v[2]
        state.peak_speed = 0.0
    a[0], a[1], a[2] = ax, ay, az
    if ax * ax + ay * ay + az * az > CALM_MPS2 * CALM_MPS2:
        state.lively_ns = state.t_ns
    state.speed = math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    state.peak_speed = max(state.peak_speed, state.speed)


@jit_ieee
def enter_phase(core: Record, phase: int) -> None:
    """The machine has changed phase at the newest sample."""
    state, thresholds = core.state, core.thresholds
    known = state.calibrated
    if phase == 1:
        state.toe_down_peak = max(state.toe_down, 0.0)
        state.turning_ns = state.t_ns  # the heel rises: whatever rest was before does not count
    elif phase == 2:
        state.toe_up_peak = 0.0
        state.lowest_rad = state.highest_rad = state.pitch_rad
        state.greatest_jerk = 0.0
        state.swing_ns = state.t_ns
    elif phase == 3:
        peak, fall = state.toe_down_peak, state.toe_down_peak + state.toe_up_peak
        stride_s = 1e-9 * (state.t_ns - state.contact_ns)
        thresholds.push_off_radps = _follow(thresholds.push_off_radps, peak, known.push_off_radps)
        thresholds.fall_radps = _follow(thresholds.fall_radps, fall, known.fall_radps)
        if USUAL[0] * thresholds.stride_s < stride_s < USUAL[1] * thresholds.stride_s:
            thresholds.stride_s = _follow(thresholds.stride_s, stride_s, known.stride_s)
        swing_s = 1e-9 * (state.t_ns - state.swing_ns)
        thresholds.swing_s = _follow(thresholds.swing_s, swing_s, known.swing_s)
        state.contact_ns = state.t_ns
        state.greatest_jerk = state.contact_jerk
        state.landing_peak = 0.0
        state.unsettled_ns = state.t_ns
    elif state.phase == 3:
        jerk = _follow(thresholds.contact_jerk_mps3, state.greatest_jerk, known.contact_jerk_mps3)
        thresholds.contact_jerk_mps3 = jerk
        loading_s = 1e-9 * (state.t_ns - state.contact_ns)
        thresholds.loading_s = _follow(thresholds.loading_s, loading_s, known.loading_s)
    state.phase = phase


@jit_ieee
def _follow(measure: float, shown: float, calibrated: float) -> float:
    followed = measure + FOLLOW * (shown - measure)
    return min(max(followed, LEAST * calibrated), MOST * calibrated)


_t1, _t2, _t3, _t4, _t5, _t6 = (jit_ieee(row.guard) for row in TABLE)


@jit_ieee
def first_transition(phase: int, x: Features, p: Thresholds) -> int:
    """The number of the first row of the table that leaves ``phase`` and whose guard holds; 0 for none.

    A compiler does not loop over functions, so the rows stand here one by one; tests hold them to the table.
    """
    if phase == Phase.STANCE.value and _t1(x, p):
        return Transition.T1.value
    if phase == Phase.PRE_SWING.value and _t2(x, p):
        return Transition.T2.value
    if phase == Phase.SWING.value and _t3(x, p):
        return Transition.T3.value
    if phase == Phase.LOADING_RESPONSE.value and _t4(x, p):
        return Transition.T4.value
    if phase == Phase.PRE_SWING.value and _t5(x, p):
        return Transition.T5.value
    if phase == Phase.SWING.value and _t6(x, p):
        return Transition.T6.value
    return 0
