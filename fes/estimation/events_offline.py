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

import numpy as np

from fes.estimation.calibration import FootCalibration
from fes.estimation.filters import greatest_of_late, low_pass, peaks_apart
from fes.signals import NS_PER_S, FloatArray, IntArray

SHAPE_HZ = 8.0  # low-pass that leaves one push-off and one mid-swing
FEATURE_HZ = 60.0  # low-pass for the instants of foot off: skin and shoe ring above
TURN_HZ = 40.0  # low-pass for the turn of the rate at contact
FALL_S = 0.35  # push-off's peak lies at most this long before mid-swing
APART_S = 0.4  # no two mid-swings are closer
FALL_SHARE = 0.45  # of this walk's typical fall
NEIGHBOURS = 10  # falls before and after that say what is typical
TOE_DOWN_SHARE = 0.2  # of the fall is push-off's toe-down rate; less, and the swing before goes on
PAUSE_SHARE = 0.5  # … and of the whole recording's at least this: in a pause all falls are small
SMALL_FALL_SHARE = 0.15  # of a step between two rests, as in turning on the spot
SMALL_TROUGH_SHARE = 0.08  # … that turns toe-up by this share of a typical fall
SMALL_RATE_SHARE = 0.4  # the same of the greatest rate about any axis
REST_SHARE = 0.06  # of the typical greatest rate: below, the foot rests between two steps …
REST_S = 0.15  # … if for this long
FLAT_SHARE = 0.03  # the same: below, loading is over for certain
FLAT_S = 0.1  # … if for this long: a slow swing turns at about zero
FO_FALL_SHARE = 0.75  # of push-off's peak
HEEL_SHARE = 0.2  # of push-off's peak: a toe-down peak after contact above it is a heel strike
SOFT_SHARE = 0.1  # the same: a swing's rate has died down once it is below
TURN_SHARE = 0.04  # the same: the rate at which it has turned
IMPACT_SHARE = 0.3  # of this walk's typical jump at contact: a jump above it is an impact …
IMPACT_MPS3 = 150.0  # … if above this as well
IMPACT_ONSET_SHARE = 0.3  # of the jump: there the impact begins
JUMP_S = 0.01

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
    if not (np.isfinite(acc_mps2).all() and np.isfinite(gyr_radps).all()):
        raise ValueError(f"{calibration.sensor}: samples that are not finite; leave them out first")
    nothing = np.zeros(0, np.int64)
    if len(t_ns) < calibration.rate_hz:
        return GaitEvents(nothing, nothing, nothing, np.zeros(0, np.bool_))
    rate_hz = (len(t_ns) - 1) * NS_PER_S / float(t_ns[-1] - t_ns[0])
    walk = _Walk(rate_hz, acc_mps2, gyr_radps - np.array(calibration.gyr_bias_radps), np.array(calibration.toe_down))
    swings: list[tuple[float, int, int]] = []  # foot off, push-off's peak, mid-swing
    for push_off, mid_swing in walk.swings():
        off = walk.foot_off(push_off)
        if off < mid_swing and (not swings or off > swings[-1][2] + 2):
            swings.append((off, push_off, mid_swing))
    lead = IC_OFFSET_S * rate_hz
    found = []
    for k, (off, push_off, mid_swing) in enumerate(swings):
        cut_off = k + 1 == len(swings)
        end = len(t_ns) - 1 if cut_off else int(swings[k + 1][0])
        contact = walk.initial_contact(push_off, mid_swing, end, cut_off=cut_off)
        if contact is not None:
            at = contact[0] + (lead if contact[1] else 0.0)
            found.append((off, float(mid_swing), min(max(at, mid_swing + 1.0), end - 0.5), contact[1]))
    index = np.arange(len(t_ns), dtype=float)
    off_at, mid_at, contact_at = (
        np.round(np.interp([row[j] for row in found], index, t_ns - t_ns[0])).astype(np.int64) + t_ns[0]
        for j in range(3)
    )
    return GaitEvents(off_at, mid_at, contact_at, np.array([row[3] for row in found], np.bool_))


class _Walk:
    """The signals of one recording that the rules look at, and the rules; positions are sample indices."""

    def __init__(self, rate_hz: float, acc: FloatArray, gyr: FloatArray, toe_down: FloatArray) -> None:
        self._rate_hz = rate_hz
        rate = gyr @ toe_down
        self._shape = low_pass(rate, rate_hz, SHAPE_HZ)
        self._feature = low_pass(rate, rate_hz, FEATURE_HZ)
        self._turn = low_pass(rate, rate_hz, TURN_HZ)
        window = max(round(0.1 * rate_hz), 3)
        self._energy = np.convolve(np.einsum("ij,ij->i", gyr, gyr), np.ones(window) / window, "same")
        lag = max(round(JUMP_S * rate_hz), 1)
        self._jump = np.zeros(len(rate))  # ends at its sample
        self._jump[lag:] = np.linalg.norm(acc[lag:] - acc[:-lag], axis=1) * rate_hz / lag
        self._peak_rate = 0.0
        self._typical_jump = 0.0

    def swings(self) -> list[tuple[int, int]]:
        """(push-off's peak, mid-swing) of every swing, in order."""
        reach = round(FALL_S * self._rate_hz) | 1
        fall = greatest_of_late(self._shape, reach) - self._shape
        peaks = peaks_apart(fall, max(round(APART_S * self._rate_hz), 1))
        if len(peaks) == 0:
            return []
        near = [fall[peaks[max(k - NEIGHBOURS, 0) : k + NEIGHBOURS + 1]] for k in range(len(peaks))]
        typical = np.maximum([self._typical(falls) for falls in near], PAUSE_SHARE * self._typical(fall[peaks]))
        large = fall[peaks] > FALL_SHARE * typical
        self._peak_rate = float(
            np.sqrt(np.median([self._energy[max(p - reach, 0) : p + 1].max() for p in peaks[large]]))
        )
        small = np.array([self._is_step(p, fall[p] / t, t) for p, t in zip(peaks, typical, strict=True)])
        alone = small & ~large
        alone[alone] = [self._is_alone(p, peaks[large]) for p in peaks[alone]]
        mids = peaks[large | alone]
        # a mid-swing is the first trough that comes near to the greatest fall
        begins = [max(int(m) - reach + 1, 0) for m in mids]
        offs = [b + int(np.argmax(self._shape[b : m + 1])) for b, m in zip(begins, mids, strict=True)]
        self._typical_jump = float(np.median([self._jump[m : m + reach].max() for m in mids]))
        kept: list[tuple[int, int]] = []
        for off, mid in zip(offs, mids.tolist(), strict=True):
            if kept and float(self._shape[kept[-1][1] : mid].max()) < TOE_DOWN_SHARE * float(fall[mid]):
                kept[-1] = kept[-1][0], min(kept[-1][1], mid, key=lambda at: float(self._shape[at]))
            elif off < mid and (not kept or off > kept[-1][1]):
                kept.append((off, mid))
        return kept

    @staticmethod
    def _typical(falls: FloatArray) -> float:
        """The median of the upper third: some of the peaks are not swings."""
        upper = np.sort(falls)[-max(3, len(falls) // 3) :].tolist()
        middle = len(upper) // 2
        return float(upper[middle] if len(upper) % 2 else 0.5 * (upper[middle - 1] + upper[middle]))

    def _is_step(self, mid: int, share: float, fall_radps: float) -> bool:
        """Is a small fall part of a movement as brisk as a step."""
        around = round(FALL_S * self._rate_hz)
        greatest = float(np.sqrt(self._energy[max(mid - around, 0) : mid + around].max()))
        toe_up = -self._shape[mid] > SMALL_TROUGH_SHARE * fall_radps
        return bool(share > SMALL_FALL_SHARE and toe_up and greatest > SMALL_RATE_SHARE * self._peak_rate)

    def _is_alone(self, mid: int, others: IntArray) -> bool:
        """Does the foot rest between this movement and the swings before and after it."""
        after = int(np.searchsorted(others, mid))
        begin = int(others[after - 1]) if after else 0
        end = int(others[after]) if after < len(others) else len(self._energy)
        reach = round(FALL_S * self._rate_hz)
        return self._rests(begin, mid - reach) and (after == len(others) or self._rests(mid, end - reach))

    def _rests(self, begin: int, end: int) -> bool:
        quiet = self._energy[begin : max(begin, end)] < (REST_SHARE * self._peak_rate) ** 2
        edges = np.flatnonzero(np.diff(np.concatenate(([0], quiet.astype(np.int8), [0]))))
        return bool(len(edges)) and int((edges[1::2] - edges[0::2]).max()) >= REST_S * self._rate_hz

    def _first_rest(self, flat: np.ndarray[tuple[int], np.dtype[np.bool_]], quietest: int) -> int:
        """Where the first rest of some length ends its first part; the quietest instant if there is none."""
        run = max(round(FLAT_S * self._rate_hz), 1)
        lasting = np.convolve(flat, np.ones(run), "valid") > run - 0.5
        return int(np.argmax(lasting)) + run - 1 if lasting.any() else quietest

    def foot_off(self, push_off: int) -> float:
        """Half-way between push-off's last peak and the fall to a share of its greatest."""
        x = self._feature
        around = round(0.1 * self._rate_hz)
        begin = max(push_off - around, 1)
        top = begin + int(np.argmax(x[begin : push_off + around]))
        level = FO_FALL_SHARE * x[top]
        below = top
        while below + 1 < len(x) and x[below] > level:
            below += 1
        crossing = below - 1 + _share(x[below - 1] - level, x[below - 1] - x[below])
        last = below - 1
        while last > top and not (x[last] >= x[last - 1] and x[last] >= x[last + 1]):
            last -= 1
        left, here, right = x[last - 1 : last + 2] if 0 < last < len(x) - 1 else (0.0, 0.0, 0.0)
        bend = left - 2.0 * here + right
        peak = last + (min(max(0.5 * (left - right) / bend, -0.5), 0.5) if bend < 0.0 else 0.0)
        return 0.5 * float(peak + crossing)

    def initial_contact(self, push_off: int, mid_swing: int, end: int, *, cut_off: bool) -> tuple[float, bool] | None:
        """IC after this mid-swing and before ``end``, and whether the heel struck first.

        ``cut_off``: the recording ends at ``end``; None where it does so before the contact has been seen.
        """
        energy = self._energy[mid_swing : end + 1]
        least = float(energy.min())
        flat = energy <= max(2.0 * least, (FLAT_SHARE * self._peak_rate) ** 2)
        if cut_off and least > (2.0 * REST_SHARE * self._peak_rate) ** 2:
            return None
        over = mid_swing + self._first_rest(flat, int(np.argmin(energy)))
        loading = mid_swing + int(np.argmax(self._shape[mid_swing : over + 1]))
        if self._shape[loading] > HEEL_SHARE * self._shape[push_off]:
            at = _rising(self._turn[mid_swing : loading + 1] - TURN_SHARE * self._shape[push_off])
            if at is not None:
                return mid_swing + at, True
        impact = mid_swing + int(np.argmax(self._jump[mid_swing : over + 1]))
        if self._jump[impact] > max(IMPACT_SHARE * self._typical_jump, IMPACT_MPS3):
            level = IMPACT_ONSET_SHARE * self._jump[impact]
            while impact > mid_swing + 1 and self._jump[impact - 1] > level:
                impact -= 1
            before, after = self._jump[impact - 1], self._jump[impact]
            return impact - _share(after - level, after - before), False  # between samples: it began before this one
        # a soft contact: the heel begins to drop (or, failing that, the foot has come to rest)
        top = mid_swing
        while top < over and (
            self._shape[top + 1] > self._shape[top] or self._shape[top] < -SOFT_SHARE * self._shape[push_off]
        ):
            top += 1
        at = _rising(-self._turn[top : over + 1], first=True)
        if at is not None:
            return top + at, False
        at = _rising(self._turn[mid_swing : over + 1])
        return (mid_swing + at if at is not None else float(over)), False


def _share(part: float, whole: float) -> float:
    return float(min(max(part / whole, 0.0), 1.0)) if whole > 0.0 else 0.0


def _rising(x: FloatArray, *, first: bool = False) -> float | None:
    """Where ``x`` (N,) last (or first) rises through zero, between samples; None if it does not."""
    crossings = ((x[:-1] < 0.0) & (x[1:] >= 0.0)).nonzero()[0]
    if len(crossings) == 0:
        return None
    i = int(crossings[0 if first else -1])
    return float(i - x[i] / (x[i + 1] - x[i]))
