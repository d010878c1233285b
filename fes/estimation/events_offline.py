"""Initial contact (IC) and foot off (FO) off-line: exactly one of each between two mid-swings, from 100 Hz to 1 kHz.

Kumar et al. (2015), after Casamassima et al. (2014): between two mid-swing peaks of the mediolateral rate, the first
peak the other way is IC and the second FO. Kept is the frame (mid-swing to mid-swing, one IC, one FO); departures:

- mid-swing is found by the *fall* from push-off's toe-down rate to the swing's toe-up rate, measured against this
  walk's own falls, not by the height of a peak: a dragged foot hardly turns toe-up, a forefoot landing turns toe-up
  twice. Every swing has a push-off of its own: a second fall before which the foot has not turned toe-down belongs to
  the same swing (a stimulated muscle snaps the foot up as it leaves; the swing's own turn comes 0.4 s later);
- IC is where the rate turns from toe-up to toe-down (the foot is at its greatest pitch), not the peak that follows:
  that peak is 55–60 ms late in healthy walks and 50–95 ms in stroke. The turn counts once the rate has reached
  ``TURN_SHARE`` of push-off's peak, some 3 ms later, for a foot may stop turning before it lands. What is left is a
  constant (``IC_OFFSET_S``). A foot that lands flat or on its forefoot is not thrown toe-down; there IC is where the
  impact begins, or, without one, where the heel begins to drop;
- FO is half-way between push-off's last peak and the fall to 75 % of it. The peak alone is early, by 5–17 ms,
  and far too early where push-off has shoulders (turning); the fall alone is 3 ms late where it is abrupt and 20 ms
  where it is gentle.

Rates are smoothed without lag, so the offsets hold at every sampling rate.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from fes.estimation.calibration import FootCalibration
from fes.estimation.events_kernel import (
    REST_SHARE,
    Signals,
    all_greatest_at,
    instants,
    look,
    typical_falls,
)
from fes.estimation.filters import PADDING, falls_apart, low_pass
from fes.estimation.ranks import median
from fes.signals import NS_PER_S, FloatArray, IntArray

SHAPE_HZ = 8.0  # low-pass that leaves one push-off and one mid-swing
FEATURE_HZ = 60.0  # low-pass for the instants of foot off: skin and shoe ring above
TURN_HZ = 40.0  # low-pass for the turn of the rate at contact
FALL_S = 0.35  # push-off's peak lies at most this long before mid-swing
APART_S = 0.4  # no two mid-swings are closer
FALL_SHARE = 0.45  # of this walk's typical fall
PAUSE_SHARE = 0.5  # … and of the whole recording's at least this: in a pause all falls are small
SMALL_FALL_SHARE = 0.15  # of a step between two rests, as in turning on the spot
SMALL_TROUGH_SHARE = 0.08  # … that turns toe-up by this share of a typical fall
SMALL_RATE_SHARE = 0.4  # the same of the greatest rate about any axis
REST_S = 0.15  # … if for this long
JUMP_S = 0.01
ENERGY_S = 0.1
BoolArray = np.ndarray[Any, np.dtype[np.bool_]]
NOT_FINITE = "{}: samples that are not finite; leave them out first"

IC_OFFSET_S = -0.005
"""From the feature to IC, for heel strikes: the same for every sensor and placement.

The feature is 6 ms (left) and 10 ms (right) late against markers on real lateral-shoe sensors, and 0.5 ms early against
the generator's truth on the bundled synthetic insteps; the constant leaves +3 and −5 ms. Real instep sensors (stroke)
have no truth per stride; there the foot-strike angle agrees with Vicon best within 10 ms of the turn. A constant per
placement is not called for."""


@dataclass(frozen=True, slots=True, eq=False)
class GaitEvents:
    """Events of one foot, times in ns on the sensor's clock, all (K,) and in order: FO, mid-swing, IC, next FO, …

    ``heel_strike`` (K,) tells if the foot landed heel first. ``ic_ns`` and ``heel_strike`` of a last swing cut off by
    the recording's end are left out with it.
    """

    fo_ns: IntArray
    mid_swing_ns: IntArray
    ic_ns: IntArray
    heel_strike: np.ndarray[tuple[int], np.dtype[np.bool_]]

    def __len__(self) -> int:
        return len(self.ic_ns)


def find_events(
    t_ns: IntArray, acc_mps2: FloatArray, gyr_radps: FloatArray, calibration: FootCalibration
) -> GaitEvents:
    """All swings' FO, mid-swing and IC of one foot.

    Args:
        t_ns: (N,) strictly increasing time stamps, nearly evenly spaced (gaps below some ms).
        acc_mps2: (N, 3) specific force.
        gyr_radps: (N, 3) angular rate.
        calibration: of this foot; gives axis and sign (``toe_down``) and the gyroscope's bias.

    Raises:
        ValueError: arrays of different length, or not finite.
    """
    if not len(t_ns) == len(acc_mps2) == len(gyr_radps):
        raise ValueError(f"{calibration.sensor}: {len(t_ns)} times, {len(acc_mps2)} forces, {len(gyr_radps)} rates")
    if len(t_ns) < calibration.rate_hz:
        if not (np.isfinite(acc_mps2).all() and np.isfinite(gyr_radps).all()):
            raise ValueError(NOT_FINITE.format(calibration.sensor))
        nothing = np.zeros(0, np.int64)
        return GaitEvents(nothing, nothing, nothing, np.zeros(0, np.bool_))
    rate_hz = (len(t_ns) - 1) * NS_PER_S / float(t_ns[-1] - t_ns[0])
    walk = _Walk(rate_hz, acc_mps2, gyr_radps, calibration)
    at_ns, heels = walk.instants(t_ns)
    off_ns, mid_ns, contact_ns = at_ns.T.copy()
    return GaitEvents(off_ns, mid_ns, contact_ns, heels)


class _Walk:
    """The signals of one recording that the rules look at, and the rules; positions are sample indices."""

    def __init__(self, rate_hz: float, acc: FloatArray, gyr: FloatArray, calibration: FootCalibration) -> None:
        if len(acc) <= PADDING:
            raise ValueError(f"{len(acc)} samples are too few to filter: more than {PADDING} are needed")
        self._rate_hz = rate_hz
        energy, jump, turning = np.empty(len(acc)), np.empty(len(acc)), np.empty((3, len(acc) + 2 * PADDING))
        if not look(
            np.ascontiguousarray(acc), np.ascontiguousarray(gyr),
            np.array(calibration.gyr_bias_radps), np.array(calibration.toe_down),
            rate_hz, max(round(JUMP_S * rate_hz), 1), max(round(ENERGY_S * rate_hz), 3),
            low_pass(rate_hz, SHAPE_HZ), low_pass(rate_hz, FEATURE_HZ), low_pass(rate_hz, TURN_HZ),
            turning, energy, jump,
        ):  # fmt: skip
            raise ValueError(NOT_FINITE.format(calibration.sensor))
        shape, feature, turn = turning[:, PADDING:-PADDING]
        self._signals = Signals(shape, feature, turn, energy, jump)
        self._peak_rate = 0.0
        self._typical_jump = 0.0

    def instants(self, t_ns: IntArray) -> tuple[IntArray, BoolArray]:
        """Times (K, 3) of FO, mid-swing and IC, and whether the heel struck first (K,)."""
        falls, peaks, mids = self._swings()
        swings, offs, out = np.empty((len(mids), 2), np.int64), np.empty(len(mids)), np.empty((len(mids), 3), np.int64)
        heels, lead = np.empty(len(mids), np.bool_), IC_OFFSET_S * self._rate_hz
        count = instants(
            np.ascontiguousarray(t_ns, np.int64), self._signals, falls, peaks, mids, self._rate_hz, lead,
            self._peak_rate, self._typical_jump, swings, offs, out, heels,
        )  # fmt: skip
        return out[:count], heels[:count]

    def _swings(self) -> tuple[FloatArray, IntArray, IntArray]:
        """The fall, push-off's peak and mid-swing of what may be swings (K,), in order."""
        s, reach = self._signals, round(FALL_S * self._rate_hz) | 1
        peaks, falls = falls_apart(s.shape, reach, max(round(APART_S * self._rate_hz), 1))
        if len(peaks) == 0:
            return falls, peaks, peaks
        typical = np.empty(len(peaks))
        typical_falls(falls, typical)
        typical = np.maximum(typical, PAUSE_SHARE * _typical(falls))
        large = falls > FALL_SHARE * typical
        self._peak_rate = float(
            np.sqrt(median(_greatest(s.energy, np.maximum(peaks[large] - reach, 0), peaks[large] + 1)))
        )
        # of a small fall: is it part of a movement as brisk as a step
        small = (falls / typical > SMALL_FALL_SHARE) & (-s.shape[peaks] > SMALL_TROUGH_SHARE * typical) & ~large
        (doubtful,), around, either = np.nonzero(small), round(FALL_S * self._rate_hz), large.copy()
        brisk = np.sqrt(_greatest(s.energy, np.maximum(peaks[doubtful] - around, 0), peaks[doubtful] + around))
        for k in doubtful[brisk > SMALL_RATE_SHARE * self._peak_rate].tolist():
            either[k] = self._is_alone(int(peaks[k]), peaks[large])
        mids = peaks[either]
        # a mid-swing is the first trough that comes near to the greatest fall
        offs = _greatest_at(s.shape, np.maximum(mids - reach + 1, 0), mids + 1)
        self._typical_jump = median(_greatest(s.jump, mids, mids + reach))
        return falls[either], offs, mids

    def _is_alone(self, mid: int, others: IntArray) -> bool:
        """Does the foot rest between this movement and the swings before and after it."""
        after = int(np.searchsorted(others, mid))
        begin = int(others[after - 1]) if after else 0
        end = int(others[after]) if after < len(others) else len(self._signals.energy)
        reach = round(FALL_S * self._rate_hz)
        return self._rests(begin, mid - reach) and (after == len(others) or self._rests(mid, end - reach))

    def _rests(self, begin: int, end: int) -> bool:
        quiet = self._signals.energy[begin : max(begin, end)] < (REST_SHARE * self._peak_rate) ** 2
        edges = np.flatnonzero(np.diff(np.concatenate(([0], quiet.astype(np.int8), [0]))))
        return bool(len(edges)) and int((edges[1::2] - edges[0::2]).max()) >= REST_S * self._rate_hz


def _greatest_at(x: FloatArray, begins: IntArray, ends: IntArray) -> IntArray:
    """Where the greatest of ``x`` lies in each of K spans."""
    at = np.empty(len(begins), np.int64)
    all_greatest_at(x, begins, ends, at)
    return at


def _greatest(x: FloatArray, begins: IntArray, ends: IntArray) -> FloatArray:
    """The greatest of ``x`` in each of K spans."""
    return np.asarray(x[_greatest_at(x, begins, ends)])


def _typical(falls: FloatArray) -> float:
    """The median of the upper third: some of the peaks are not swings."""
    return median(np.sort(falls)[-max(3, len(falls) // 3) :])
