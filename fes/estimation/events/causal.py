"""IC and FO while walking: causal, sample by sample, thresholds retuned to the walker every fourth stride.

Kumar et al. (2015), after Ferrari et al. (2015), wait for the peaks of the mediolateral rate that *follow* contact and
precede foot off, with ``gyrT = median(peaks)^0.7`` and ``timT = median(peak distance)/3``. The exponent makes the print
depend on the unit; here it reads ``gyrT = u·(median/u)^0.7`` with ``u`` = 1 rad/s, as with its own sample data.

Two rules share the machinery (:class:`Rule`):

- ``PEAKS``, the paper's: IC and FO are decided once no higher sample has followed a toe-down peak for ``timT/5``, over
  100 ms late.
- ``INSTANTS``, ours: IC when after mid-swing the rate turns toe-down as if struck, or an impact jolts the
  accelerometer, or the heel drops after a forefoot landing; FO when push-off's rate has fallen from its peak. Heights
  are shares of medians, durations scale with ``timT``.

The machine goes FO → mid-swing → IC → FO, so that between two decided mid-swings there is exactly one IC and one FO,
but for a heel lifted and put back: its FO has been decided, and the next push-off's FO follows.
"""

import math
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np

from fes.estimation.foot.calibration import FootCalibration
from fes.estimation.foot.features import lags_at
from fes.estimation.numerics.jit import jit
from fes.estimation.numerics.records import Mat, Vec
from fes.estimation.tracking.phase_features import LAGS
from fes.signals import FloatArray, IntArray

UNIT_RADPS = 1.0
EXPONENT = 0.7
RETUNE_STRIDES = 4
MEMORY = 8  # medians over this many strides
LONGEST_STRIDE_S = 5.0  # a longer one is a pause and tunes nothing
SILENCE_NS = 250_000_000  # a longer one hides events
NEGATIVE_SHARE = 0.2  # of gyrT, as printed, for the peaks after contact and before foot off

FALLEN = 0.85  # FO: push-off's rate has fallen to this share of its peak
PUSH_OFF = 0.4  # … which is at least this share of the typical peak
MID_FALL = 0.5  # mid-swing: the rate has fallen from push-off's peak by this share of the typical fall
MID_RISE = 0.3  # contact is looked for once the rate has come back to this share of the swing's extreme …
IMPACT_SHARE = 0.3  # … and an impact counts above this share of the typical one
LEAST_IMPACT_MPS3 = 150.0
TURNING = 0.03  # the rate is past zero, as a share of push-off's peak: contact if it rises like struck …
STRUCK_PER_S = 4.0  # … by so many such peaks in a second; a swing that runs out above the ground turns slowly
TURNED = 0.15  # the same share: contact however it rises
TOE_UP = 0.2  # the same share: a foot that turns toe-up like this swings, if there was a push-off or not
SWING_PER_TIMT = 0.5  # no swing is shorter: a sixth of the stride
LOADED = 0.12  # loading is over when the rate has stayed below this share of push-off's peak for …
LOADED_PER_TIMT = 0.08  # … this share of timT, 30 ms in a stride of 1.1 s, …
LOADING_PER_TIMT = 0.35  # … and not sooner: foot slap comes up to 0.1 s after contact
RESTED_PER_TIMT = 0.4  # after this much rest a swing without contact, or a push-off without swing, is over
STATE = np.dtype(
    [
        ("samples", np.int64),  # since the start or the last silence
        ("newest_ns", np.int64),
        ("stage", np.int64),  # 0 loading, 1 stance, 2 after FO, 3 after mid-swing
        ("last_ns", np.int64),  # the contact before
        ("moving_ns", np.int64),  # last sample faster than rest
        ("off_ns", np.int64),
        ("feature_ns", np.int64),
        ("top", np.float64),  # greatest toe-down rate since the stage began, and when
        ("top_ns", np.int64),
        ("low", np.float64),  # least since FO
        ("low_ns", np.int64),  # when (by peaks)
        ("push_off", np.float64),  # peak of this stride's
        ("high", np.float64),  # greatest since mid-swing
        ("jerk", np.float64),  # the same of the jerk
        ("stride_now_s", np.float64),
        ("acc", np.float64, (LAGS, 3)),  # rings of the last samples
        ("rate", np.float64, LAGS),
        ("strides", np.int64),
        ("peaks", np.float64, MEMORY),
        ("falls", np.float64, MEMORY),
        ("troughs", np.float64, MEMORY),
        ("jerks", np.float64, MEMORY),
        ("stride_s", np.float64, MEMORY),
        ("typical_peak", np.float64),
        ("typical_fall", np.float64),
        ("typical_jerk", np.float64),
        ("gyr_t", np.float64),
        ("tim_t", np.float64),
    ],
    align=True,
)


class Sensor(NamedTuple):
    """What the compiled rule needs to know of one sensor."""

    x: float  # toe-down axis
    y: float
    z: float
    bias_x: float
    bias_y: float
    bias_z: float
    jerk_lag: int  # 10 ms
    change_lag: int  # 20 ms
    sample_s: float


@jit
def _median(values: Vec, n: int) -> float:
    return float(np.median(values[: min(n, MEMORY)]))


@jit
def gyr_threshold(median_radps: float) -> float:
    """``gyrT`` of the paper in rad/s, whatever the unit of the rest of the program."""
    return UNIT_RADPS * math.pow(median_radps / UNIT_RADPS, EXPONENT)


@jit
def _complete_stride(state: Any) -> None:
    """A stride is complete: remember what it was like, and retune after every fourth."""
    if state.stride_now_s > LONGEST_STRIDE_S:
        return
    k = state.strides % MEMORY
    state.peaks[k] = state.push_off
    state.falls[k] = state.push_off - state.low
    state.troughs[k] = max(-state.low, 0.01)
    state.jerks[k] = state.jerk
    state.stride_s[k] = state.stride_now_s
    state.strides += 1
    if state.strides % RETUNE_STRIDES == 0:
        state.typical_peak = _median(state.peaks, state.strides)
        state.typical_fall = _median(state.falls, state.strides)
        state.typical_jerk = _median(state.jerks, state.strides)
        state.gyr_t = gyr_threshold(_median(state.troughs, state.strides))
        state.tim_t = _median(state.stride_s, state.strides) / 3.0


@jit
def _by_instants(state: Any, t_ns: int, rate: float, norm: float, jerk: float, change: float) -> int:
    """Our rule at one sample; the number of the event decided, 0 for none."""
    tim_ns = 1e9 * state.tim_t
    if norm > LOADED * state.typical_peak:
        state.moving_ns = t_ns
    still_ns = t_ns - state.moving_ns
    if state.stage == 0:
        state.jerk = max(state.jerk, jerk)
        # a foot that never comes flat pushes off all the same, but not at once
        flat = still_ns > LOADED_PER_TIMT * tim_ns and t_ns - state.feature_ns > LOADING_PER_TIMT * tim_ns
        if flat or t_ns - state.feature_ns > tim_ns:
            _complete_stride(state)
            state.stage = 1
            state.top = 0.0
    elif state.stage == 1:
        if rate > state.top:
            state.top, state.top_ns = rate, t_ns
        if still_ns > RESTED_PER_TIMT * tim_ns:
            state.top, state.top_ns = 0.0, t_ns
        pushed = state.top > PUSH_OFF * state.typical_peak and rate < FALLEN * state.top
        if pushed or rate < -TOE_UP * state.typical_peak:
            state.push_off = state.top
            state.stage = 2
            state.low = rate
            state.feature_ns = state.top_ns
            return 1
    elif state.stage == 2:
        state.push_off = max(state.push_off, rate)  # it was a shoulder of a larger push-off
        state.low = min(state.low, rate)
        if (
            state.push_off - rate > MID_FALL * state.typical_fall and rate < 0.0
        ) or rate < -TOE_UP * state.typical_peak:
            state.stage = 3
            state.jerk = 0.0
            state.high = -math.inf
            state.off_ns = state.feature_ns
            state.feature_ns = t_ns
            return 2
        if still_ns > RESTED_PER_TIMT * tim_ns:
            state.stage = 1
            state.top = 0.0
    elif state.stage == 3:
        state.low = min(state.low, rate)
        if t_ns - state.off_ns > SWING_PER_TIMT * tim_ns and rate > MID_RISE * state.low:
            state.jerk = max(state.jerk, jerk)
            state.high = max(state.high, rate)
            share = rate / state.typical_peak
            turned = (share > TURNING and change > STRUCK_PER_S * state.typical_peak) or share > TURNED
            dropping = state.high > 0.0 and share < -TURNING
            impact = jerk > max(IMPACT_SHARE * state.typical_jerk, LEAST_IMPACT_MPS3)
            if turned or dropping or impact or still_ns > RESTED_PER_TIMT * tim_ns:
                state.stage = 0
                state.stride_now_s = 1e-9 * (t_ns - state.last_ns)
                state.last_ns = t_ns
                state.feature_ns = t_ns
                return 3
    return 0


@jit
def _by_peaks(state: Any, t_ns: int, rate: float) -> int:
    """The paper's rule at one sample: a peak is one once no higher sample has followed for ``timT/5``."""
    wait_ns = 0.2e9 * state.tim_t
    height = NEGATIVE_SHARE * state.gyr_t
    if state.stage == 2:  # mid-swing: the toe-up peak
        if rate < state.low:
            state.low, state.low_ns = rate, t_ns
        # printed is timT/2, which would decide on mid-swing after contact
        if -state.low > state.gyr_t and t_ns - state.low_ns >= wait_ns:
            state.stage = 3
            state.feature_ns = state.low_ns
            state.top = 0.0
            return 2
    else:
        if rate > state.top:
            state.top, state.top_ns = rate, t_ns
        if state.stage == 0:  # the rate must have come down from the peak before
            if rate < height:
                state.stage = 1
                state.top = 0.0
        elif state.top > height and t_ns - state.top_ns >= wait_ns:
            state.feature_ns = state.top_ns
            if state.stage == 3:
                state.stage = 0
                state.stride_now_s = 1e-9 * (state.top_ns - state.last_ns)
                state.last_ns = state.top_ns
                _complete_stride(state)
                return 3
            state.stage = 2
            state.push_off = state.top
            state.low, state.low_ns = rate, t_ns
            return 1
    return 0


@jit
def _restart(state: Any, t_ns: int) -> None:
    """Nothing is known of the stride under way; what has been tuned stays."""
    state.samples = 0
    state.stage = 1
    state.top = 0.0
    state.top_ns = t_ns
    state.moving_ns = t_ns
    state.last_ns = t_ns - 2 * int(1e9 * LONGEST_STRIDE_S)


@jit
def advance(
    state: Any, sensor: Sensor, rule: int, t_ns: Vec, acc: Mat, gyr: Mat, begin: int, end: int
) -> tuple[int, int]:
    """Advance over the samples ``begin`` … ``end - 1``; stop behind the first at which an event is decided.

    Returns how far it came and the event's number (0: the block's end).
    """
    for i in range(begin, end):
        x, y, z = gyr[i, 0] - sensor.bias_x, gyr[i, 1] - sensor.bias_y, gyr[i, 2] - sensor.bias_z
        rate = sensor.x * x + sensor.y * y + sensor.z * z
        if state.samples == 0 or t_ns[i] - state.newest_ns > SILENCE_NS:
            _restart(state, t_ns[i])
        state.newest_ns = t_ns[i]
        state.samples += 1
        now = state.samples % LAGS
        state.acc[now, 0], state.acc[now, 1], state.acc[now, 2] = acc[i, 0], acc[i, 1], acc[i, 2]
        jerk = 0.0
        if state.samples > sensor.jerk_lag:
            then = (state.samples - sensor.jerk_lag) % LAGS
            dx, dy, dz = acc[i, 0] - state.acc[then, 0], acc[i, 1] - state.acc[then, 1], acc[i, 2] - state.acc[then, 2]
            jerk = math.sqrt(dx * dx + dy * dy + dz * dz) / (sensor.jerk_lag * sensor.sample_s)
        state.rate[now] = rate
        change = 0.0
        if state.samples > sensor.change_lag:
            change = (rate - state.rate[(state.samples - sensor.change_lag) % LAGS]) / (
                sensor.change_lag * sensor.sample_s
            )
        if rule == 0:
            event = _by_peaks(state, t_ns[i], rate)
        else:
            event = _by_instants(state, t_ns[i], rate, math.sqrt(x * x + y * y + z * z), jerk, change)
        if event != 0:
            return i + 1, event
    return end, 0


START_STRIDE_S = 1.2
START_FALL = 1.5  # of push-off's peak, before the first tuning
START_TROUGH = 0.5  # the same, of the swing's toe-up rate


class Rule(IntEnum):
    """Which events the decisions rest on; see the module's text."""

    PEAKS = 0
    INSTANTS = 1


class OnlineEvent(IntEnum):
    """What was decided."""

    NONE = 0
    FO = 1
    MID_SWING = 2
    IC = 3


@dataclass(frozen=True, slots=True)
class Decision:
    """``t_ns`` is the sample at which it was known, ``t_feature_ns`` when the feature itself was (never later)."""

    t_ns: int
    event: OnlineEvent
    t_feature_ns: int


class OnlineEvents:
    """Decisions on one foot's events, whatever the blocks in which its samples come; no clock, no I/O."""

    def __init__(self, calibration: FootCalibration, rule: Rule = Rule.INSTANTS) -> None:
        lags = lags_at(calibration.rate_hz)
        self._sensor = Sensor(*calibration.toe_down, *calibration.gyr_bias_radps, *lags, 1.0 / calibration.rate_hz)
        self._rule = int(rule)
        self._newest_ns = int(np.iinfo(np.int64).min)
        self._state = np.zeros(1, STATE)[0]
        s = self._state
        s["typical_peak"] = calibration.push_off_radps
        s["typical_fall"] = START_FALL * s["typical_peak"]
        s["typical_jerk"] = calibration.contact_jerk_mps3
        s["gyr_t"] = gyr_threshold(START_TROUGH * s["typical_peak"])
        s["tim_t"] = START_STRIDE_S / 3.0

    @property
    def thresholds(self) -> tuple[float, float]:
        """``gyrT`` (rad/s) and ``timT`` (s) now."""
        return float(self._state["gyr_t"]), float(self._state["tim_t"])

    def advance(self, t_ns: IntArray, acc_mps2: FloatArray, gyr_radps: FloatArray) -> list[Decision]:
        """Take samples in, give back what was decided, in order.

        Args:
            t_ns: (N,) the sensor's time stamps; samples not newer than all before them are ignored.
            acc_mps2: (N, 3) specific force; samples that are not finite are ignored.
            gyr_radps: (N, 3) angular rate, likewise.
        """
        finite = np.isfinite(acc_mps2).all(axis=1) & np.isfinite(gyr_radps).all(axis=1)
        stamps = np.where(finite, t_ns, self._newest_ns)
        keep = finite & (t_ns > np.maximum.accumulate(np.concatenate(([self._newest_ns], stamps)))[:-1])
        if not keep.all():
            t_ns, acc_mps2, gyr_radps = t_ns[keep], acc_mps2[keep], gyr_radps[keep]
        decisions = []
        done = 0
        while done < len(t_ns):
            done, number = advance(self._state, self._sensor, self._rule, t_ns, acc_mps2, gyr_radps, done, len(t_ns))
            self._newest_ns = int(t_ns[done - 1])
            if number:
                decisions.append(Decision(self._newest_ns, OnlineEvent(number), int(self._state["feature_ns"])))
        return decisions
