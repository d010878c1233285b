"""IC and FO while walking: causal, sample by sample, thresholds retuned to the walker every fourth stride.

Kumar et al. (2015), after Ferrari et al. (2015), wait for the peaks of the mediolateral rate that *follow* contact and
precede foot off, with heights and distances retuned every fourth stride: ``gyrT = median(peaks)^0.7`` and
``timT = median(peak distance)/3``. The exponent makes the print depend on the unit: it stands for 56 %
of a 7 rad/s peak in rad/s, and 17 % of the same peak in deg/s. Here it reads ``gyrT = u·(median/u)^0.7`` with
``u`` = 1 rad/s (``UNIT_RADPS``), which is what the print does with its own sample data.

Two rules share the machinery (:class:`Rule`):

- ``PEAKS``, the paper's: IC and FO are decided once no higher sample has followed a toe-down peak for ``timT/5``.
  The peak after contact comes 55 ms late as it is; with the wait the decision is over 100 ms late.
- ``INSTANTS``, ours: IC when after mid-swing the rate turns toe-down as if struck (a foot that lands on its forefoot
  turns slowly before it lands), or an impact jolts the accelerometer, or the heel drops after a forefoot landing; FO
  when push-off's rate has fallen from its peak. Heights are shares of medians, hence free of any unit. They are tuned
  at the same times, and durations scale with ``timT``.

The machine goes FO → mid-swing → IC → FO, so that between two decided mid-swings there is exactly one IC and one FO.
The one exception is a heel lifted and put back: nobody can know at the time that no swing will follow, so its FO has
been told, is not taken back, and the next push-off's FO follows.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from fes.estimation.calibration import PUSH_OFF_SHARE, FootCalibration
from fes.estimation.events_rules import IMPACT_SHARE, STATE, Sensor, advance, gyr_threshold
from fes.estimation.kernel import lags_at
from fes.signals import FloatArray, IntArray

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
        s["typical_peak"] = calibration.min_toe_down_peak_radps / PUSH_OFF_SHARE
        s["typical_fall"] = START_FALL * s["typical_peak"]
        s["typical_jump"] = calibration.contact_jump_mps3 / IMPACT_SHARE
        s["gyr_t"] = gyr_threshold(START_TROUGH * s["typical_peak"])
        s["tim_t"] = START_STRIDE_S / 3.0

    @property
    def thresholds(self) -> tuple[float, float]:
        """``gyrT`` (rad/s) and ``timT`` (s) now."""
        return float(self._state["gyr_t"]), float(self._state["tim_t"])

    @property
    def typical_push_off_radps(self) -> float:
        """The toe-down peak that the heights of our rule are shares of."""
        return float(self._state["typical_peak"])

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
