"""Initial contact (IC) and foot off (FO) off-line: exactly one of each between two mid-swings, from 100 Hz to 1 kHz.

Kumar et al. (2015), after Casamassima et al. (2014): between two mid-swing peaks of the mediolateral rate, the first
peak the other way is IC and the second FO. Kept is the frame; departures:

- mid-swing is found by the *fall* from push-off's toe-down rate to the swing's toe-up rate, measured against this
  walk's own falls: a dragged foot hardly turns toe-up, a forefoot landing turns toe-up twice. A second fall before
  which the foot has not turned toe-down belongs to the same swing;
- IC is where the rate turns from toe-up to toe-down, not the peak that follows, 50–95 ms late. The turn counts once the
  rate has reached ``TURN_SHARE`` of push-off's peak; what is left is a constant (``IC_OFFSET_S``). A foot that lands
  flat or on its forefoot is not thrown toe-down; there IC is where the impact begins, or else where the heel drops;
- FO is half-way between push-off's last peak and the fall to 75 % of it: the peak alone is early, the fall alone late.

Rates are smoothed without lag, so the offsets hold at every sampling rate. In the code positions are sample indices.

Foot-strike angle: pitch at IC relative to mid-stance, toe-up positive, from the mediolateral rate alone, for over some
0.3 s a gyroscope hardly drifts. Mid-stance is the middle *in time* between IC and FO: a brisk foot rolls on all through
stance, and its quietest instant is early (against Vicon means of 13 runs 0.98 and 2.1°, the middle 0.99 and 1.3°).

Foot flat and heel rise, by that pitch. *Foot flat*: from then on until mid-stance the pitch, and the roll about the
foot's long axis (a paretic foot lands on its outer border), are within ``FLAT_RAD`` of mid-stance's and it turns more
slowly than ``FLAT_RADPS``; of a slow forefoot landing no sooner than the heel is down. *Heel rise*: the last instant at
which the foot has not yet turned toe-down by ``RISE_RAD``. After Mariani et al. (2013);
``benchmarks/accuracy/offline_phases.py`` holds both against footswitches, without the walker that is judged.
"""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from fes.estimation.foot.calibration import FootCalibration
from fes.estimation.numerics.filters import (
    PADDING,
    Section,
    biquad_start,
    biquad_step,
    falls_apart,
    filter_backwards,
    greatest_at,
    greatest_at_each,
    low_pass,
    moving_sums,
    runs,
)
from fes.estimation.numerics.jit import jit, jit_ieee
from fes.estimation.numerics.records import Mat, Vec
from fes.estimation.strides.boundaries import UNSEEN_NS
from fes.signals import NS_PER_S, FloatArray, IntArray

NEIGHBOURS = 10  # falls before and after that say what is typical
TOE_DOWN_SHARE = 0.2  # of the fall is push-off's toe-down rate; less, and the swing before goes on
REST_SHARE = 0.06  # of the typical greatest rate: below, the foot rests between two steps …
FLAT_SHARE = 0.03  # the same: below, loading is over for certain
FLAT_S = 0.1  # … if for this long: a slow swing turns at about zero
FO_FALL_SHARE = 0.75  # of push-off's peak
HEEL_SHARE = 0.2  # of push-off's peak: a toe-down peak after contact above it is a heel strike
SOFT_SHARE = 0.1  # the same: a swing's rate has died down once it is below
TURN_SHARE = 0.04  # the same: the rate at which it has turned
IMPACT_SHARE = 0.3  # of this walk's typical jerk at contact: a jerk above it is an impact …
IMPACT_MPS3 = 150.0  # … if above this as well
IMPACT_ONSET_SHARE = 0.3  # of the jerk: there the impact begins
NONE = -1.0  # where there is no instant
LONGEST_GAP_S = 0.04  # between samples of what was seen without a break, as of a stride


class Signals(NamedTuple):
    """What the rules use, (N,) each: the toe-down rate smoothed in three ways, its energy, the force's jerk."""

    shape: Any
    feature: Any
    turn: Any
    energy: Any
    jerk: Any


@jit_ieee
def filter_signals(
    acc: Mat, gyr: Mat, bias: Vec, axis: Vec, rate_hz: float, lag: int, window: int,
    one: Section, two: Section, three: Section, turning: Mat, energy: Vec, jerk: Vec,
) -> bool:  # fmt: skip
    """Of specific force and angular rate (N, 3) the rate about ``axis`` (3,) without ``bias`` (3,), low-passed in three
    ways without lag: ``turning`` (3, N and ``PADDING`` at both ends); the mean of the rate's square over ``window``
    samples; and the change of the force over ``lag`` samples, per second, that ends at a sample.

    False if any of them is not finite.
    """
    n, per, off = jerk.shape[0], rate_hz / lag, 0.0
    bx, by, bz, ux, uy, uz = bias[0], bias[1], bias[2], axis[0], axis[1], axis[2]
    early_u = late_u = early_v = late_v = early_w = late_w = 0.0
    for i in range(-PADDING, n + PADDING):
        if 0 <= i < n:
            x, y, z = gyr[i, 0] - bx, gyr[i, 1] - by, gyr[i, 2] - bz
            rate, energy[i] = x * ux + y * uy + z * uz, x * x + y * y + z * z
            total = (x + y + z) + (acc[i, 0] + acc[i, 1] + acc[i, 2])
            off += total - total  # nothing, if all are finite
            before = max(i - lag, 0)
            x, y, z = acc[i, 0] - acc[before, 0], acc[i, 1] - acc[before, 1], acc[i, 2] - acc[before, 2]
            jerk[i] = math.sqrt(x * x + y * y + z * z) * per if i >= lag else 0.0
        else:  # the ends are padded with their odd reflection
            end, at = (0, -i) if i < 0 else (n - 1, 2 * (n - 1) - i)
            x, y = 2.0 * gyr[end, 0] - gyr[at, 0] - bx, 2.0 * gyr[end, 1] - gyr[at, 1] - by
            z = 2.0 * gyr[end, 2] - gyr[at, 2] - bz
            rate = x * ux + y * uy + z * uz
        if i == -PADDING:
            early_u, late_u = biquad_start(rate, one)
            early_v, late_v = biquad_start(rate, two)
            early_w, late_w = biquad_start(rate, three)
        j = i + PADDING
        turning[0, j], early_u, late_u = biquad_step(rate, one, early_u, late_u)
        turning[1, j], early_v, late_v = biquad_step(rate, two, early_v, late_v)
        turning[2, j], early_w, late_w = biquad_step(rate, three, early_w, late_w)
    filter_backwards(one, two, three, turning)
    moving_sums(energy, window, window - window // 2 - 1, 1.0 / window, energy)
    return not math.isnan(off)


@jit
def typical_falls(falls: Vec, out: Vec) -> None:
    """At each of K falls the median of the upper third of it and its neighbours: some of the peaks are not swings."""
    for k in range(falls.shape[0]):
        near = np.sort(falls[max(k - NEIGHBOURS, 0) : k + NEIGHBOURS + 1])
        out[k] = np.median(near[-min(max(3, near.size // 3), near.size) :])


@jit
def join_swings(shape: Vec, falls: Vec, offs: Vec, mids: Vec, kept: Vec) -> int:
    """Fill ``kept`` (K, 2) with (push-off's peak, mid-swing) of every swing; how many they are.

    A fall before which the foot has not turned toe-down belongs to the swing before.
    """
    count = 0
    for k in range(mids.shape[0]):
        off, mid = offs[k], mids[k]
        if count > 0:
            last, before = kept[count - 1, 1], mid - 1
            while before > last and shape[before] < TOE_DOWN_SHARE * falls[k]:
                before -= 1
            if shape[before] < TOE_DOWN_SHARE * falls[k]:
                if shape[mid] < shape[last]:
                    kept[count - 1, 1] = mid
                continue
            if off <= last:
                continue
        if off < mid:
            kept[count, 0], kept[count, 1] = off, mid
            count += 1
    return count


@jit
def _share(part: float, whole: float) -> float:
    return min(max(part / whole, 0.0), 1.0) if whole > 0.0 else 0.0


@jit
def _foot_off(x: Vec, push_off: int, around: int) -> float:
    """Half-way between push-off's last peak and the fall to a share of its greatest."""
    top = greatest_at(x, max(push_off - around, 1), push_off + around)
    level = FO_FALL_SHARE * x[top]
    below = top
    while below + 1 < x.shape[0] and x[below] > level:
        below += 1
    crossing = below - 1 + _share(x[below - 1] - level, x[below - 1] - x[below])
    last = below - 1
    while last > top and not (x[last] >= x[last - 1] and x[last] >= x[last + 1]):
        last -= 1
    peak = float(last)
    if 0 < last < x.shape[0] - 1:
        left, right = x[last - 1], x[last + 1]
        bend = left - 2.0 * x[last] + right
        if bend < 0.0:
            peak += min(max(0.5 * (left - right) / bend, -0.5), 0.5)
    return 0.5 * (peak + crossing)


@jit
def _rising(x: Vec, sign: float, level: float, begin: int, end: int, first: bool) -> float:
    """Where ``sign · x - level`` last (or first) rises through 0 in ``begin`` … ``end``, or NONE; between samples."""
    at = -1
    for i in range(begin, end):
        if sign * x[i] - level < 0.0 and sign * x[i + 1] - level >= 0.0:
            at = i
            if first:
                break
    if at < 0:
        return NONE
    here, there = sign * x[at] - level, sign * x[at + 1] - level
    before: float = (at - begin) - here / (there - here)
    return begin + before


@jit
def _contact(
    s: Signals, push_off: int, mid: int, end: int, cut_off: bool, run: int, peak_rate: float, typical_jerk: float
) -> tuple[float, bool]:
    """IC after a mid-swing and before ``end``, and whether the heel struck first.

    ``cut_off``: the recording ends at ``end``; NONE where it does so before the contact has been seen. ``run``: samples
    for which rest must last.
    """
    quietest, least = mid, s.energy[mid]
    for i in range(mid, end + 1):
        if s.energy[i] < least:
            quietest, least = i, s.energy[i]
    if cut_off and least > (2.0 * REST_SHARE * peak_rate) ** 2:
        return NONE, False
    over, flat, level = quietest, 0, max(2.0 * least, (FLAT_SHARE * peak_rate) ** 2)
    for i in range(mid, end + 1):  # where the first rest of some length ends its first part
        flat = flat + 1 if s.energy[i] <= level else 0
        if flat >= run:
            over = i
            break
    strongest = s.shape[push_off]
    loading = greatest_at(s.shape, mid, over + 1)
    if s.shape[loading] > HEEL_SHARE * strongest:
        at = _rising(s.turn, 1.0, TURN_SHARE * strongest, mid, loading, False)
        if at != NONE:
            return at, True
    impact = greatest_at(s.jerk, mid, over + 1)
    if s.jerk[impact] > max(IMPACT_SHARE * typical_jerk, IMPACT_MPS3):
        level = IMPACT_ONSET_SHARE * s.jerk[impact]
        while impact > mid + 1 and s.jerk[impact - 1] > level:
            impact -= 1
        before, after = s.jerk[impact - 1], s.jerk[impact]
        return impact - _share(after - level, after - before), False  # between samples: it began before this one
    # a soft contact: the heel begins to drop (or, failing that, the foot has come to rest)
    top = mid
    while top < over and (s.shape[top + 1] > s.shape[top] or s.shape[top] < -SOFT_SHARE * strongest):
        top += 1
    at = _rising(s.turn, -1.0, 0.0, top, over, True)
    if at == NONE:
        at = _rising(s.turn, 1.0, 0.0, mid, over, False)
    return (at if at != NONE else float(over)), False


@jit
def _time_ns(t_ns: Vec, at: float) -> int:
    """The time of a place between samples."""
    before = max(min(int(at), t_ns.shape[0] - 2), 0)
    since: float = np.rint((t_ns[before + 1] - t_ns[before]) * (at - before) + (t_ns[before] - t_ns[0]))
    time_ns: int = int(since) + t_ns[0]
    return time_ns


@jit
def instants(
    t_ns: Vec, s: Signals, falls: Vec, peaks: Vec, mids: Vec, rate_hz: float, lead: float,
    peak_rate: float, typical_jerk: float, swings: Mat, offs: Vec, out: Vec, heels: Vec,
) -> int:  # fmt: skip
    """Fill ``out`` (K, 3) with the times of FO, mid-swing and IC, and ``heels`` (K,) with whether the heel struck
    first; how many of the swings have them.

    ``falls``, ``peaks``, ``mids`` (K,) as for :func:`join_swings`; ``lead`` goes onto the IC of a heel strike;
    ``swings`` (K, 2) and ``offs`` (K,) are worked in.
    """
    joined, count, last = join_swings(s.shape, falls, peaks, mids, swings), 0, s.shape.shape[0] - 1
    around, run = round(0.1 * rate_hz), max(round(FLAT_S * rate_hz), 1)
    for k in range(joined):
        off = _foot_off(s.feature, swings[k, 0], around)
        if off < swings[k, 1] and (count == 0 or off > swings[count - 1, 1] + 2):
            swings[count, 0], swings[count, 1] = swings[k, 0], swings[k, 1]
            offs[count] = off
            count += 1
    found = 0
    for k in range(count):
        cut_off = k + 1 == count
        end = last if cut_off else int(offs[k + 1])
        mid = swings[k, 1]
        at, heel = _contact(s, swings[k, 0], mid, end, cut_off, run, peak_rate, typical_jerk)
        if at != NONE:
            at = min(max(at + (lead if heel else 0.0), mid + 1.0), end - 0.5)
            out[found, 0], out[found, 1], out[found, 2] = _time_ns(t_ns, offs[k]), t_ns[mid], _time_ns(t_ns, at)
            heels[found] = heel
            found += 1
    return found


SHAPE_HZ = 8.0  # low-pass that leaves one push-off and one mid-swing
FEATURE_HZ = 60.0  # low-pass for the instants of foot off: skin and shoe ring above
TURN_HZ = 40.0  # low-pass for the turn of the rate at contact
FALL_S = 0.35  # push-off's peak lies at most this long before mid-swing
APART_S = 0.4  # no two mid-swings are closer
FALL_SHARE = 0.45  # of this walk's typical fall
TROUGH_SHARE = 0.3  # of its typical toe-up rate: a foot that slaps down falls as far, but only back to zero
PAUSE_SHARE = 0.5  # … and of the whole recording's at least this: in a pause all falls are small
SMALL_FALL_SHARE = 0.15  # of a step between two rests, as in turning on the spot
SMALL_TROUGH_SHARE = 0.08  # … that turns toe-up by this share of a typical fall
SMALL_RATE_SHARE = 0.4  # the same of the greatest rate about any axis
REST_S = 0.15  # … if for this long
JERK_S = 0.01
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

    ``heel_strike`` (K,): the foot landed heel first. ``ic_ns`` and ``heel_strike`` of a last swing cut off by
    the recording's end are left out with it. ``heel_rise_ns`` is before each FO, ``foot_flat_ns`` after each IC
    (:func:`stance_instants`): ``UNSEEN_NS`` where it was not seen, None where nobody looked.
    """

    fo_ns: IntArray
    mid_swing_ns: IntArray
    ic_ns: IntArray
    heel_strike: np.ndarray[tuple[int], np.dtype[np.bool_]]
    heel_rise_ns: IntArray | None = None
    foot_flat_ns: IntArray | None = None

    def __repr__(self) -> str:
        return f"GaitEvents: {len(self)} swings; fo_ns, mid_swing_ns, ic_ns and heel_strike have one each"

    def __len__(self) -> int:
        return len(self.ic_ns)


def find_events(
    t_ns: IntArray, acc_mps2: FloatArray, gyr_radps: FloatArray, calibration: FootCalibration
) -> GaitEvents:
    """All swings' FO, mid-swing and IC of one foot, and heel rise and foot flat of the stances between.

    Args:
        t_ns: (N,) strictly increasing time stamps, nearly evenly spaced but for gaps; a swing that holds one is no
            swing, and of a stance that holds one foot flat and heel rise are not seen.
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
        return GaitEvents(nothing, nothing, nothing, np.zeros(0, np.bool_), nothing, nothing)
    gaps = gaps_in(t_ns)
    seen_ns = float(t_ns[-1] - t_ns[0]) - float((t_ns[gaps] - t_ns[gaps - 1]).sum())
    rate_hz = (len(t_ns) - 1 - len(gaps)) * NS_PER_S / seen_ns
    walk = _Walk(rate_hz, acc_mps2, gyr_radps, calibration)
    at_ns, heels = walk.instants(t_ns)
    whole = np.diff(np.searchsorted(t_ns[gaps], at_ns[:, ::2], side="right"), axis=1)[:, 0] == 0
    at_ns, heels = at_ns[whole], heels[whole]
    off_ns, mid_ns, contact_ns = at_ns.T.copy()
    rise_ns, flat_ns = stance_instants(t_ns, gyr_radps, off_ns, contact_ns, calibration)
    return GaitEvents(off_ns, mid_ns, contact_ns, heels, rise_ns, flat_ns)


def gaps_in(t_ns: IntArray) -> IntArray:
    """Which of N samples, at increasing times, come after a gap."""
    steps = np.diff(t_ns)
    longest_ns = NS_PER_S * LONGEST_GAP_S
    if not len(steps) or steps.max() <= longest_ns:
        return np.zeros(0, np.int64)
    return np.flatnonzero(steps > max(longest_ns, 3.5 * float(np.median(steps)))) + 1


class _Walk:
    """The signals of one recording that the rules use, and the rules; positions are sample indices."""

    def __init__(self, rate_hz: float, acc: FloatArray, gyr: FloatArray, calibration: FootCalibration) -> None:
        if len(acc) <= PADDING:
            raise ValueError(f"{len(acc)} samples are too few to filter: more than {PADDING} are needed")
        self._rate_hz = rate_hz
        energy, jerk, turning = np.empty(len(acc)), np.empty(len(acc)), np.empty((3, len(acc) + 2 * PADDING))
        if not filter_signals(
            np.ascontiguousarray(acc), np.ascontiguousarray(gyr),
            np.array(calibration.gyr_bias_radps), np.array(calibration.toe_down),
            rate_hz, max(round(JERK_S * rate_hz), 1), max(round(ENERGY_S * rate_hz), 3),
            low_pass(rate_hz, SHAPE_HZ), low_pass(rate_hz, FEATURE_HZ), low_pass(rate_hz, TURN_HZ),
            turning, energy, jerk,
        ):  # fmt: skip
            raise ValueError(NOT_FINITE.format(calibration.sensor))
        shape, feature, turn = turning[:, PADDING:-PADDING]
        self._signals = Signals(shape, feature, turn, energy, jerk)
        self._peak_rate = 0.0
        self._typical_jerk = 0.0

    def instants(self, t_ns: IntArray) -> tuple[IntArray, BoolArray]:
        """Times (K, 3) of FO, mid-swing and IC, and whether the heel struck first (K,)."""
        falls, peaks, mids = self._swings()
        swings, offs, out = np.empty((len(mids), 2), np.int64), np.empty(len(mids)), np.empty((len(mids), 3), np.int64)
        heels, lead = np.empty(len(mids), np.bool_), IC_OFFSET_S * self._rate_hz
        count = instants(
            np.ascontiguousarray(t_ns, np.int64), self._signals, falls, peaks, mids, self._rate_hz, lead,
            self._peak_rate, self._typical_jerk, swings, offs, out, heels,
        )  # fmt: skip
        return out[:count], heels[:count]

    def _swings(self) -> tuple[FloatArray, IntArray, IntArray]:
        """The fall, push-off's peak and mid-swing of what may be swings (K,), in order."""
        s, reach = self._signals, round(FALL_S * self._rate_hz) | 1
        peaks, falls = falls_apart(s.shape, reach, max(round(APART_S * self._rate_hz), 1))
        if len(peaks) == 0:
            return falls, peaks, peaks
        troughs = -s.shape[peaks]
        typical, typical_trough = np.empty(len(peaks)), np.empty(len(peaks))
        typical_falls(falls, typical)
        typical_falls(troughs, typical_trough)
        typical = np.maximum(typical, PAUSE_SHARE * _typical(falls))
        large = (falls > FALL_SHARE * typical) & (troughs > TROUGH_SHARE * typical_trough)
        if not large.any():
            return falls[large], peaks[large], peaks[large]
        brisk = _greatest(s.energy, np.maximum(peaks[large] - reach, 0), peaks[large] + 1)
        self._peak_rate = math.sqrt(np.median(brisk))
        # of a small fall: is it part of a movement as brisk as a step
        small = (falls / typical > SMALL_FALL_SHARE) & (-s.shape[peaks] > SMALL_TROUGH_SHARE * typical) & ~large
        (doubtful,), around, either = np.nonzero(small), round(FALL_S * self._rate_hz), large.copy()
        brisk = np.sqrt(_greatest(s.energy, np.maximum(peaks[doubtful] - around, 0), peaks[doubtful] + around))
        for k in doubtful[brisk > SMALL_RATE_SHARE * self._peak_rate].tolist():
            either[k] = self._is_alone(int(peaks[k]), peaks[large])
        mids = peaks[either]
        # a mid-swing is the first trough that comes near to the greatest fall
        offs = greatest_at_each(s.shape, np.maximum(mids - reach + 1, 0), mids + 1)
        self._typical_jerk = float(np.median(_greatest(s.jerk, mids, mids + reach)))
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
        return int(np.diff(runs(quiet)).max(initial=0)) >= REST_S * self._rate_hz


def _greatest(x: FloatArray, begins: IntArray, ends: IntArray) -> FloatArray:
    """The greatest of ``x`` in each of K spans."""
    return np.asarray(x[greatest_at_each(x, begins, ends)])


def _typical(falls: FloatArray) -> float:
    """The median of the upper third: some of the peaks are not swings."""
    return float(np.median(np.sort(falls)[-max(3, len(falls) // 3) :]))


FLAT_RAD, FLAT_RADPS, FLAT_OVER_S = np.radians(5.0), 2.0, 0.02  # the rate is the mean over so long on either side
HEEL_DOWN_RAD = np.radians(1.0)
RISE_RAD = np.radians(2.0)
AROUND_S = 0.05  # mid-stance's pitch is the mean over this much before and after
LONGEST_STANCE_S = 3.0  # of a longer one (standing, before and after a walk too) the parts next to the swings count


def pitch_of(t_ns: IntArray, gyr_radps: FloatArray, calibration: FootCalibration) -> tuple[FloatArray, FloatArray]:
    """Seconds since the first sample (N,), and the pitch there: rad since then, toe-up positive; it drifts."""
    seconds, turned = turned_about(np.array(calibration.toe_down), t_ns, gyr_radps, calibration)
    return seconds, -turned


def turned_about(
    axis: FloatArray, t_ns: IntArray, gyr_radps: FloatArray, calibration: FootCalibration
) -> tuple[FloatArray, FloatArray]:
    """Seconds since the first sample (N,), and how far the foot has turned about ``axis`` (3,) since then, rad."""
    seconds, turned = np.empty(len(t_ns)), np.empty(len(t_ns))
    _turn(t_ns, gyr_radps, np.array(calibration.gyr_bias_radps), axis, gaps_in(t_ns), seconds, turned)
    return seconds, turned


@jit_ieee
def _turn(t_ns: Vec, gyr: Mat, bias: Vec, axis: Vec, gaps: Vec, seconds: Vec, turned: Vec) -> None:
    """Fill the last two (N,); what it turned in a gap nobody knows."""
    total, before, gap = 0.0, 0.0, 0
    for i in range(t_ns.shape[0]):
        rate = (gyr[i, 0] - bias[0]) * axis[0] + (gyr[i, 1] - bias[1]) * axis[1] + (gyr[i, 2] - bias[2]) * axis[2]
        seconds[i] = (t_ns[i] - t_ns[0]) / NS_PER_S
        if gap < gaps.shape[0] and gaps[gap] == i:
            gap += 1
        elif i > 0:
            total += 0.5 * (rate + before) * (seconds[i] - seconds[i - 1])
        before, turned[i] = rate, total


def stance_instants(
    t_ns: IntArray, gyr_radps: FloatArray, fo_ns: IntArray, ic_ns: IntArray, calibration: FootCalibration,
    *, flat_rad: float = FLAT_RAD, rise_rad: float = RISE_RAD,
) -> tuple[IntArray, IntArray]:  # fmt: skip
    """Heel rise before each of K foot offs and foot flat after each of K contacts, ns; ``UNSEEN_NS`` where not seen.

    Args:
        t_ns: (N,) strictly increasing time stamps.
        gyr_radps: (N, 3) angular rate.
        fo_ns: (K,) foot off, each before …
        ic_ns: (K,) … its contact.
        calibration: of this foot.
        flat_rad: how near to mid-stance's pitch and roll is flat.
        rise_rad: how far from it the heel has risen.
    """
    rises, flats = (np.full(len(ic_ns), UNSEEN_NS, np.int64) for _ in range(2))
    if not len(ic_ns):
        return rises, flats
    seconds, pitch = pitch_of(t_ns, gyr_radps, calibration)
    _, roll = turned_about(calibration.forward(), t_ns, gyr_radps, calibration)
    gaps = gaps_in(t_ns)
    period_s = (seconds[-1] - float((seconds[gaps] - seconds[gaps - 1]).sum())) / max(len(t_ns) - 1 - len(gaps), 1)
    over, around = (max(round(span_s / period_s), 1) for span_s in (FLAT_OVER_S, AROUND_S))
    longest, slow_rad = round(LONGEST_STANCE_S / period_s), FLAT_RADPS * 2 * over * period_s
    begins, ends = np.empty(len(ic_ns) + 1, np.int64), np.empty(len(ic_ns) + 1, np.int64)
    begins[1:], ends[:-1] = np.searchsorted(t_ns, ic_ns), np.searchsorted(t_ns, fo_ns)
    # before the first swing and after the last the foot has to have stood for so long
    begins[0], ends[-1] = ends[0] - longest, begins[-1] + longest
    inside = (begins >= 0) & (ends < len(t_ns))
    whole = inside & (np.searchsorted(gaps, begins) == np.searchsorted(gaps, ends))
    _in_stances(
        t_ns, pitch, roll, begins, ends, whole, over, around, longest, flat_rad, slow_rad, rise_rad, rises, flats
    )  # fmt: skip
    return rises, flats


@jit_ieee
def _in_stances(
    t_ns: Vec, pitch: Vec, roll: Vec, begins: Vec, ends: Vec, whole: Vec, over: int, around: int, longest: int,
    flat_rad: float, slow_rad: float, rise_rad: float, rises: Vec, flats: Vec,
) -> None:  # fmt: skip
    """Fill heel rises and foot flats (K,) of K + 1 stances, each from the contact before it to the foot off after it.

    ``whole`` (K + 1,): seen without a gap. ``over`` samples before and after say how fast it turns (less than
    ``slow_rad`` in that time), ``around`` before and after are mid-stance; a stance counts up to ``longest`` samples.
    """
    for k in range(begins.shape[0]):
        first, last = begins[k], ends[k]
        half = min(last - first, longest) // 2
        if half <= around + over or first < over or not whole[k]:
            continue
        level, side = _mean(pitch, first + half, around), _mean(roll, first + half, around)
        at = first + half - 1  # back from mid-stance to where it last was tilted or moved
        while at >= first and (
            max(abs(pitch[at] - level), abs(roll[at] - side)) <= flat_rad
            and abs(pitch[at + over] - pitch[at - over]) <= slow_rad
        ):
            at -= 1
        down = first
        while pitch[down] - level < -HEEL_DOWN_RAD:  # it is so no longer at mid-stance
            down += 1
        if k > 0:
            flats[k - 1] = t_ns[max(at + 1, down)]
        if k + 1 == begins.shape[0]:
            continue
        level, at = _mean(pitch, last - half, around), last - 1
        while at > last - half and pitch[at] <= level - rise_rad:
            at -= 1
        rises[k] = t_ns[at]


@jit_ieee
def _mean(values: Vec, middle: int, around: int) -> float:
    total = 0.0
    for i in range(middle - around, middle + around + 1):
        total += values[i]
    return total / (2 * around + 1)


def foot_strike_angles(
    t_ns: IntArray, gyr_radps: FloatArray, events: GaitEvents, calibration: FootCalibration
) -> FloatArray:
    """Angle (K,) in rad at each IC of ``events``, toe-up positive; NaN where the recording ends before mid-stance.

    Args:
        t_ns: (N,) strictly increasing time stamps, as given to ``find_events``.
        gyr_radps: (N, 3) angular rate.
        events: of this foot.
        calibration: of this foot.
    """
    seconds, pitch = pitch_of(t_ns, gyr_radps, calibration)
    mean_of = np.concatenate(([0.0], np.cumsum(0.5 * (pitch[1:] + pitch[:-1]) * np.diff(seconds))))
    contact = (events.ic_ns - t_ns[0]) / NS_PER_S
    off = np.append((events.fo_ns[1:] - t_ns[0]) / NS_PER_S, np.inf)[: len(contact)]
    middle = contact + 0.5 * np.minimum(off - contact, LONGEST_STANCE_S)
    begin, end = (np.interp(middle + side, seconds, mean_of) for side in (-AROUND_S, AROUND_S))
    angle = np.interp(contact, seconds, pitch) - (end - begin) / (2.0 * AROUND_S)
    at_gap = seconds[gaps_in(t_ns)]
    seen = np.searchsorted(at_gap, contact) == np.searchsorted(at_gap, middle + AROUND_S)
    return np.asarray(np.where(seen & (middle + AROUND_S <= seconds[-1]), angle, np.nan))
