"""How the sensor sits and how this person moves, from a recording: gravity, biases, mediolateral axis, levels.

Nothing is assumed of the mounting, of rests, of cadence or of the side; of the walk, that it goes forward. Where the
strides lead, each seen from its own foot, is forward up to toe-out. The *fall* of the mediolateral rate from push-off
to mid-swing tells the axis more precisely: heel rise and the flexion of hip and knee are sagittal even where a foot
lands on its edge or drags. But some feet roll obliquely over their toes. So the two are joined, each as sure as it is,
and the falls move the axis from the travel by no more than one standard deviation of what the two are apart (Huber,
*Ann Math Stat* 35, 1964). That the foot tilts further toe-down than toe-up tells forward from backward.

Gravity shows at the quietest instants between two falls. There the accelerometer's magnitude differs from gravity by a
bias. The gyroscope's bias follows from gravity's closure: from quiet instant to quiet instant the integrated turn must
carry gravity to gravity.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from fes.estimation.foot.features import FootParameters, lags_at
from fes.estimation.foot.movements import closures, contact_jumps, follow, peaks_before, quiet_ends
from fes.estimation.numerics.filters import falls_apart, moving_mean
from fes.estimation.numerics.rotation import cross, without
from fes.estimation.tracking.phase_features import usual_swing_s
from fes.estimation.zupt.detectors import ACC_TOLERANCE_MPS2, RATE_TOLERANCE_RADPS, squared_lengths, window_variances
from fes.signals import G_MPS2, NS_PER_S, FloatArray, IntArray, Vector3
from statemachine.guards import Thresholds

SMOOTH_S = 0.04  # the mean over this, twice, is a low-pass of 8 Hz: it leaves one push-off and one mid-swing
FALL_S = 0.35  # push-off's peak lies at most this long before mid-swing
APART_S = 0.4  # no two mid-swings are closer
FALL_SHARE = 0.45  # of this walk's typical fall
TROUGH_SHARE = 0.3  # of its typical toe-up rate: a foot that slaps down falls as far, but only back to zero
TYPICAL_SHARE = 1.0 / 3.0
STRIDE_S = (0.35, 3.0)  # between two anchors; a longer one stands still in between
MOVING_RADPS, STILL_BEFORE_S = 1.5, 3.0
LONGEST_GAP_S = 0.04
REACH_S = 2.0  # how far from a swing its quiet instants are sought
QUIET_WINDOW_S = 0.1
QUIET_PERCENT = 15
QUIET_PASSES = 3  # the force at rest is that of the quietest samples, and these are found by it; it settles at once
STANDING_S = 1.0
STANDING_RATE_RADPS = 0.08  # standing still: no window of a second exceeds this spread
MIN_STRIDES = 2
MIN_TRAVEL_M = 0.15
LEAST_FALL_RADPS = 1.0  # of any swing; a foot that shuffles falls by 2.4
LEAST_LIVELY_MPS2 = 0.01  # mean departure from gravity in strides: a slow foot's is 0.5, a sensor's noise is more
START_TURNS_RAD = (0.0, 0.25 * np.pi, -0.25 * np.pi)  # from the axis of most rotation, to either side
PASSES = 3
SAME_AXIS = 0.996  # within 5°
RESTLESS_PERCENT = 85.0
MOST_RESTLESS, LEAST_UNREST = 30.0, 0.1  # times the typical end's unrest, or this: a stride that ends so is cut
FARTHER_S = 0.7  # unrest counts double so far from the swing, for drift grows with time
QUIET_WEIGHT = 0.25  # in the score, of half the unrest at the quiet instants or twice the time that strides take up
TRAVEL_SD_RAD = 0.21  # how far a foot points from where it goes: a toe-out of 7 ± 6°, of some more
FALLS_SD_RAD = 0.087  # of the falls, where the foot does not roll obliquely, beside their scatter
SD_OF_MEDIAN = 1.483  # standard deviation over the median of what is normally distributed, without its sign
MOST_AXIS_SD_RAD = 0.33  # 19°; of 135 real feet 13° at most, in 20 s 19°; so far off, a twentieth of the pitch is lost
BACKWARD_RAD = 0.35  # tilted toe-up by so much more than toe-down: backward; of 138 real feet that go forward 0.19
SIDEWAYS = 1.6  # times as much tilt about the way as across it; of these feet 1.2 (1.5 in 20 s), carried sideways 1.8
ASTRAY_RAD, MOST_ASTRAY = 0.7, 1.0 / 3.0  # strides that lead so far from where all do; of these feet a sixth (in 20 s
# a third), of a sensor shaken by hand 36–81 % (5–95 %)
REST_RADPS = 0.4  # gravity shows where the foot turns no faster at its quietest
GYR_BIAS_SD_RADPS = 0.05
CLOSURE_SD_RAD = 0.02
AGREE_RADPS = 0.026  # a standing second's bias and the closure's
DEGREES_RADPS, DEGREES_SHARE = 40.0, 0.005  # no leg turns so fast; degrees taken for radians do in most of a walk
LYING_MPS2, LYING_SHARE = 2.0, 0.15  # at rest so much of the time may be so far off gravity; of sound sensors 5 %
ACC_BIAS_SD_MPS2 = 0.1  # prior of the accelerometer's bias per axis
SCALE_ERROR = 0.004  # of the accelerometer, and what clipping and sampling add
HUBER = 2.5
USUAL_STRIDE_S = 1.2
LEAST_JUMP_MPS3 = 500.0  # of a soft contact: what counts as one is a share of it


class CalibrationError(ValueError):
    """The recording does not show what is needed; the message says what to record."""


@dataclass(frozen=True, slots=True)
class FootCalibration:
    """What is known of one foot sensor; frames: ``toe_down`` and ``up`` are unit vectors in the sensor frame.

    ``push_off_radps``, ``fall_radps``, ``stride_s`` and ``contact_jerk_mps3`` are this person's typical push-off (peak
    toe-down rate), fall from there to mid-swing, stride time and jump of the force at contact: the guards' measures.
    ``axis_confidence`` (0–1) is the share of the travel that is along forward, ``axis_sd_rad`` the uncertainty of
    ``toe_down``. ``strides`` is how many the result rests on, ``standing`` whether the
    gyroscope's bias is that of a still second (if not, that by which gravity closes over the strides, or where the foot
    never comes to rest the calibrated zero, left to the orientation filter).
    """

    sensor: str
    rate_hz: float
    up: Vector3
    toe_down: Vector3
    acc_bias_mps2: Vector3
    gyr_bias_radps: Vector3
    push_off_radps: float
    fall_radps: float
    stride_s: float
    contact_jerk_mps3: float
    axis_confidence: float
    strides: int
    standing: bool
    axis_sd_rad: float = 0.0

    def parameters(self) -> FootParameters:
        """For the compiled core."""
        return FootParameters(
            *self.toe_down, *self.acc_bias_mps2, *self.gyr_bias_radps, 1.0 / self.rate_hz, lags_at(self.rate_hz)[0]
        )

    def thresholds(self, *, swing_at_reversal: bool = False) -> Thresholds:
        """The guards' thresholds for this person; all others at their defaults."""
        return Thresholds(
            push_off_radps=self.push_off_radps,
            fall_radps=self.fall_radps,
            stride_s=self.stride_s,
            swing_s=usual_swing_s(self.stride_s),
            contact_jerk_mps3=self.contact_jerk_mps3,
            swing_at_reversal=swing_at_reversal,
        )

    def forward(self) -> FloatArray:
        """Unit vector towards the toe in the sensor frame (3,): toe-down × up."""
        return cross(self.toe_down, self.up)

    def along_gravity(self) -> FootCalibration:
        """The same from uneven ground: with its accelerometer bias along gravity only.

        What lies across comes from strides that end as high as they began; a climb would pass for it.
        """
        up, bias = np.array(self.up), np.array(self.acc_bias_mps2)
        x, y, z = (up * (up @ bias)).tolist()
        return replace(self, acc_bias_mps2=(x, y, z))

    def to_dict(self) -> dict[str, Any]:
        """For the session log."""
        return asdict(self)

    @staticmethod
    def from_dict(data: dict[str, Any]) -> FootCalibration:
        """Back from the session log or a calibration file."""
        values: dict[str, Any] = {key: tuple(v) if isinstance(v, list) else v for key, v in data.items()}
        return FootCalibration(**values)


class _Walk(NamedTuple):
    """The strides of a recording, K of them, and the axis they show."""

    axis: FloatArray  # (3,) unit, level, toe-down
    axis_sd_rad: float
    confidence: float  # share of the travel along forward
    push_offs: IntArray  # (K,) rows
    mids: IntArray  # (K,) rows
    spans: IntArray  # (K, 2) rows, from quiet to quiet instant


def calibrate_foot(
    sensor: str,
    rate_hz: float,
    t_ns: IntArray,
    acc_mps2: FloatArray,
    gyr_radps: FloatArray,
    *,
    incline: float = 0.0,
) -> FootCalibration:
    """Find a foot sensor's calibration from a stretch of walking forward; 5 s suffice, any of a walk.

    Args:
        sensor: its name, for messages.
        rate_hz: nominal sampling rate.
        t_ns: (N,) strictly increasing time stamps.
        acc_mps2: (N, 3) specific force.
        gyr_radps: (N, 3) angular rate.
        incline: what the ground rises per horizontal distance; NaN on stairs and unknown slopes: then the
            accelerometer's bias across gravity is left at zero, for a climb would pass for it.

    Raises:
        CalibrationError: too short, never at rest, too few strides, backward, sideways or to and fro, an uncertain
            axis, a foot that hardly turns, rates in degrees, or an accelerometer that cannot be right.
    """
    window = max(round(QUIET_WINDOW_S * rate_hz), 2)
    if len(t_ns) < 20 * window:
        raise CalibrationError(
            f"{sensor}: {len(t_ns) / rate_hz:.1f} s is too short to calibrate. Record five strides or more."
        )
    refuse_degrees(sensor, gyr_radps)
    rate_bias, standing = _standing(rate_hz, acc_mps2, gyr_radps)
    gyr = without(gyr_radps, rate_bias)
    energy = moving_mean(squared_lengths(gyr), window)
    unrest, rest_force, rest_norm = _rest(energy, acc_mps2, window)
    if not 0.7 * G_MPS2 < rest_norm < 1.3 * G_MPS2:
        raise CalibrationError(
            f"{sensor}: at its quietest the accelerometer reads {rest_norm:.2f} m/s² instead of about 9.81. "
            "Check acc_unit, and that the foot rests at times."
        )
    if energy.max() > MOVING_RADPS**2:
        _refuse_lying(sensor, (moving_mean(_sizes(acc_mps2), window) - rest_norm)[energy < REST_RADPS**2])
    up = rest_force / np.linalg.norm(rest_force)
    acc = without(acc_mps2, up * (rest_norm - G_MPS2))
    walk = _find_walk(sensor, rate_hz, t_ns, acc, gyr, unrest, up)
    quiet = np.unique(walk.spans)
    quiet = quiet[energy[quiet] < REST_RADPS**2]
    if 2 * len(quiet) > len(walk.spans):
        more = _bias_by_closure(t_ns, acc, gyr, walk.spans)
        more -= (more @ up) * up  # gravity does not show that part
        if not standing or np.linalg.norm(more) > AGREE_RADPS:
            rate_bias, gyr, standing = rate_bias + more, without(gyr, more), False
    moved = follow(t_ns, acc, gyr, walk.spans)
    acc_bias = up * (rest_norm - G_MPS2)
    if not math.isnan(incline):
        acc_bias = acc_bias + _acc_bias_across(t_ns, walk.spans, moved, up, incline)
    toe_down, around = gyr @ walk.axis, max(round(SMOOTH_S * rate_hz), 1)
    push_off = _around(np.maximum, toe_down, walk.push_offs, around)
    fall_radps = np.median(push_off - _around(np.minimum, toe_down, walk.mids, around))
    if fall_radps < LEAST_FALL_RADPS:
        raise CalibrationError(
            f"{sensor}: too slow to turn: its rate falls by {fall_radps:.1f} rad/s from push-off to mid-swing; a foot "
            f"that shuffles, by {LEAST_FALL_RADPS:g} at least. Walk straight ahead, as briskly as is safe."
        )
    between_s = 1e-9 * np.diff(t_ns[walk.mids]).astype(np.float64)
    between_s = between_s[between_s < STRIDE_S[1]]
    lag, _ = lags_at(rate_hz)
    jumps = contact_jumps(t_ns, without(acc_mps2, acc_bias), gyr, walk.spans, moved["turn"], toe_down, lag)
    jumps = jumps[~np.isnan(jumps)] * rate_hz / lag
    return FootCalibration(
        sensor=sensor,
        rate_hz=rate_hz,
        up=_vector(up),
        toe_down=_vector(walk.axis),
        acc_bias_mps2=_vector(acc_bias),
        gyr_bias_radps=_vector(rate_bias),
        push_off_radps=np.median(push_off),
        fall_radps=fall_radps,
        stride_s=np.median(between_s) if len(between_s) else USUAL_STRIDE_S,
        contact_jerk_mps3=max(np.median(jumps) if len(jumps) else 0.0, LEAST_JUMP_MPS3),
        axis_confidence=walk.confidence,
        strides=len(walk.spans),
        standing=standing,
        axis_sd_rad=walk.axis_sd_rad,
    )


def _find_walk(
    sensor: str, rate_hz: float, t_ns: IntArray, acc: FloatArray, gyr: FloatArray, unrest: FloatArray, up: FloatArray
) -> _Walk:
    """The strides as the falls about the best of some axes part them, and the axis that they and the travel show.

    Strides are parted the better, the more of their ways agree, the quieter the instants between them are and the more
    of the time they take up. The falls' sign does not matter yet: a slow foot that slaps down falls further after its
    swing than before.
    """
    window = max(round(SMOOTH_S * rate_hz), 1)
    smooth = np.stack([moving_mean(moving_mean(column, window), window) for column in gyr.T], axis=1)
    gaps = np.cumsum(np.append(0, np.diff(t_ns) > NS_PER_S * max(LONGEST_GAP_S, 3.5 / rate_hz)))
    parted = [spans for spans in _parted(rate_hz, smooth, unrest, gaps, up) if len(spans)]
    least = min((_restless(unrest, spans) for spans in parted), default=0.0)
    longest = max((float(np.diff(spans).sum()) for spans in parted), default=0.0)
    most, best, spans, travel, lively = 0, -np.inf, np.zeros((0, 2), np.int64), np.zeros((0, 3)), np.zeros(0)
    for each in parted:
        moved = follow(t_ns, acc, gyr, each)
        ways = _turned_back(moved["way"], moved["turn"], up)
        ends = unrest[each].max(axis=1)
        usual = max(np.percentile(ends, 25.0), LEAST_UNREST)
        far = (_sizes(ways) > MIN_TRAVEL_M) & (ends <= MOST_RESTLESS * usual)
        ways *= (usual / (usual + ends))[:, None]  # what a foot that does not rest leaves in the way is no travel
        most = max(most, int(far.sum()))
        if far.sum() < MIN_STRIDES:
            continue
        quiet = max(least, 1e-9) / max(_restless(unrest, each), 1e-9)
        covered = float(np.diff(each[far]).sum()) / longest
        score = _agreement(ways[far]) + QUIET_WEIGHT * math.log2(quiet * covered)
        if score > best:
            best, spans, travel = score, each[far], ways[far]
            lively = moved["lively"][far] / (1 + spans[:, 1] - spans[:, 0])
    if len(spans) < MIN_STRIDES:
        raise CalibrationError(
            f"{sensor}: {most} strides found, {MIN_STRIDES} are needed to find the mediolateral axis. "
            "Record at least five strides of walking straight ahead."
        )
    if lively.mean() < LEAST_LIVELY_MPS2:
        raise CalibrationError(
            f"{sensor}: the accelerometer shows gravity and nothing else while the foot swings, so it has stopped "
            "measuring. Restart or exchange the sensor, and record again."
        )
    left = _unit(np.cross(up, travel.sum(axis=0)))
    ahead = cross(_vector(left), _vector(up))
    if astray := _other_way(rate_hz, gyr, spans, travel, left, ahead):
        raise CalibrationError(f"{sensor}: {astray} Walk straight ahead, forward, at least five strides.")
    walk = _joined(rate_hz, smooth, spans, travel, left, up)
    if not walk.axis_sd_rad <= MOST_AXIS_SD_RAD:
        raise CalibrationError(
            f"{sensor}: the mediolateral axis is uncertain by ±{math.degrees(walk.axis_sd_rad):.0f}° "
            f"({math.degrees(MOST_AXIS_SD_RAD):.0f}° are allowed): the {len(spans)} strides are too few or too "
            "unlike, or the foot turns about another axis. Walk straight ahead, ten strides or more."
        )
    return walk


def _other_way(
    rate_hz: float, gyr: FloatArray, spans: IntArray, travel: FloatArray, left: FloatArray, ahead: FloatArray
) -> str:
    """What else than walking forward the strides' ways (K, 3) and the tilts from rest to rest show; "" if nothing."""
    astray = travel @ ahead < math.cos(ASTRAY_RAD) * _sizes(travel)
    if astray.mean() > MOST_ASTRAY:
        return (
            f"no one way forward: {astray.sum()} of {len(travel)} movements lead more than "
            f"{math.degrees(ASTRAY_RAD):.0f}° away from where all together lead, seen from the foot."
        )
    angle = np.stack([np.cumsum(gyr @ axis) / rate_hz for axis in (left, ahead)])
    tilts, steps = np.empty((len(spans), 4)), np.arange(1.0 + np.diff(spans).max())
    for k, (first, last) in enumerate(spans.tolist()):
        own = angle[:, first : last + 1] - angle[:, first, None]
        tilt = own - own[:, -1:] / (last - first) * steps[: last + 1 - first]
        tilts[k] = *tilt.max(axis=1), *-tilt.min(axis=1)
    toe_down, one_side, toe_up, other_side = np.degrees(np.median(tilts, axis=0)).tolist()
    if toe_up - toe_down > math.degrees(BACKWARD_RAD):
        seen = f"on its way the foot tilts toe-up by {toe_up:.0f}° and toe-down by {toe_down:.0f}°"
        return f"it walked backward: {seen}; or the sensor's axes are left-handed, or one has the wrong sign."
    across, along = max(toe_down, toe_up), max(one_side, other_side)
    if along > SIDEWAYS * across:
        return (
            f"it walked sideways: the foot tilts by {along:.0f}° about the line that it is carried along, "
            f"and by {across:.0f}° across it."
        )
    return ""


def _joined(
    rate_hz: float, smooth: FloatArray, spans: IntArray, travel: FloatArray, left: FloatArray, up: FloatArray
) -> _Walk:
    """The axis by the falls, the largest of each stride, and by the travel, each as sure as it is.

    Which minimises a square of the angle to the travel and Huber's loss of that to the falls.
    """
    agreement, axis, var = _agreement(travel), left, np.inf
    travel_var = TRAVEL_SD_RAD**2 + (1.0 / agreement**2 - 1.0) / len(travel)
    push_offs = mids = kept = np.zeros(0, np.int64)
    for _ in range(PASSES):
        toe_down, mids, falls = _falls(rate_hz, smooth, axis)
        of = np.searchsorted(spans[:, 0], mids) - 1
        order = np.lexsort((falls, of))
        order = order[(of[order] >= 0) & (mids[order] <= spans[of[order], 1])]
        if len(order) < MIN_STRIDES:  # the foot hardly turns across its way
            return _Walk(left, math.pi, 0.0, push_offs, mids, spans)
        order = order[np.append(np.diff(of[order]) > 0, True)]
        if len(order) < MIN_STRIDES:
            return _Walk(left, math.pi, 0.0, push_offs, mids, spans)
        mids, kept = mids[order], of[order]
        push_offs = peaks_before(toe_down, mids, round(FALL_S * rate_hz) | 1)
        vectors = _level(smooth[push_offs] - smooth[mids], up)
        mean = _typical(vectors, up)
        falls_var = FALLS_SD_RAD**2 + (SD_OF_MEDIAN * np.median(_angles(vectors, mean))) ** 2
        apart = float(np.arctan2(np.cross(left, mean) @ up, left @ mean))
        sum_var = falls_var + travel_var
        toe_out = math.copysign(min(abs(apart) * travel_var / sum_var, math.sqrt(sum_var)), apart)
        axis = np.asarray(math.cos(toe_out) * left + math.sin(toe_out) * np.cross(up, left))
        var = max(apart**2 / sum_var, 1.0) * falls_var * travel_var / sum_var
    confidence = float((travel @ cross(_vector(axis), _vector(up))).sum() / _sizes(travel).sum())
    return _Walk(axis, math.sqrt(var), confidence, push_offs, mids, spans[kept])


def _parted(
    rate_hz: float, smooth: FloatArray, unrest: FloatArray, gaps: IntArray, up: FloatArray
) -> Iterator[IntArray]:
    """Spans (K, 2) of strides as the large falls about each of some axes part them."""
    start, axes = _mediolateral(smooth.T @ smooth, up), list[FloatArray]()
    across = cross(_vector(up), _vector(start))
    for angle in START_TURNS_RAD:
        for sign in (1.0, -1.0):
            axis = sign * (np.cos(angle) * start + np.sin(angle) * across)
            for _ in range(PASSES):
                toe_down, mids, falls = _falls(rate_hz, smooth, axis)
                mids = mids[_large(falls, FALL_SHARE) & _large(-toe_down[mids], TROUGH_SHARE)]
                if len(mids) < MIN_STRIDES:
                    break
                push_offs = peaks_before(toe_down, mids, round(FALL_S * rate_hz) | 1)
                axis = _typical(smooth[push_offs] - smooth[mids], up)
            if len(mids) >= MIN_STRIDES and all(float(axis @ other) < SAME_AXIS for other in axes):
                axes.append(axis)
                yield _spans(push_offs, mids, unrest, gaps, rate_hz)


def _falls(rate_hz: float, smooth: FloatArray, axis: FloatArray) -> tuple[FloatArray, IntArray, FloatArray]:
    """The rate about an axis (N,), the mid-swings in which it has fallen farthest (K,), and how far (K,)."""
    toe_down = np.ascontiguousarray(smooth @ axis)
    return toe_down, *falls_apart(toe_down, round(FALL_S * rate_hz) | 1, max(round(APART_S * rate_hz), 1))


def _spans(push_offs: IntArray, mids: IntArray, unrest: FloatArray, gaps: IntArray, rate_hz: float) -> IntArray:
    """From the quietest instant before to the quietest after each swing (K, 2), without spans that hold a gap;
    ``gaps`` (N,) counts them."""
    limits = round(REACH_S * rate_hz), FARTHER_S * rate_hz, STRIDE_S[0] * rate_hz
    return quiet_ends(push_offs, mids, unrest, gaps, *limits)


def _agreement(travel: FloatArray) -> float:
    """How much of the ways (K, 3) leads one way: 1 where all do, 0 where they come to nothing."""
    return float(np.linalg.norm(travel.sum(axis=0)) / _sizes(travel).sum())


def _turned_back(travel: FloatArray, turn: FloatArray, up: FloatArray) -> FloatArray:
    """Ways (K, 3) as the foot in the middle of the stride sees them: turned back by half its turn about gravity."""
    half = np.arctan2(turn[:, 1:] @ up, turn[:, 0])  # half of the whole turn's angle
    half = (half + 0.5 * np.pi) % np.pi - 0.5 * np.pi
    level = _level(travel, up)
    across = np.cross(up, level)
    return np.asarray(np.cos(half)[:, None] * level - np.sin(half)[:, None] * across)


def _bias_by_closure(t_ns: IntArray, acc: FloatArray, gyr: FloatArray, spans: IntArray) -> FloatArray:
    """The gyroscope's bias (3,) in rad/s by which gravity is carried to gravity over the strides.

    Least squares with a prior of zero; strides that fit badly count less.
    """
    missed, effect = closures(t_ns, acc, gyr, spans)
    weight, bias = np.ones(len(missed)), np.zeros(3)
    for _ in range(3):
        known = np.einsum("k,kji,kjl->il", weight, effect, effect) / CLOSURE_SD_RAD**2
        told = np.einsum("k,kji,kj->i", weight, effect, missed) / CLOSURE_SD_RAD**2
        bias = np.linalg.solve(known + np.eye(3) / GYR_BIAS_SD_RADPS**2, told)
        off = _sizes(missed - effect @ bias)
        weight = np.minimum(1.0, HUBER * np.median(off) / np.maximum(off, 1e-9))
    return np.asarray(bias)


def refuse_degrees(sensor: str, gyr_radps: FloatArray) -> None:
    """Raises CalibrationError where rates (N, 3) are so great that they must be in °/s, if only in a part of them."""
    sizes = _sizes(gyr_radps)
    if float((sizes > DEGREES_RADPS).mean()) > DEGREES_SHARE:
        raise CalibrationError(
            f"{sensor}: the gyroscope's peaks of {np.percentile(sizes, 99.0):.0f} rad/s are more than any leg turns: "
            "is its unit °/s? Check gyr_unit, or the sensor's own settings."
        )


def _refuse_lying(sensor: str, off_mps2: FloatArray) -> None:
    """Raises CalibrationError where the force in too much of the rest is so far from gravity (N,)."""
    share = float((np.abs(off_mps2) > LYING_MPS2).mean()) if len(off_mps2) else 0.0
    if share > LYING_SHARE:
        raise CalibrationError(
            f"{sensor}: in {share:.0%} of the time that the foot rests the accelerometer is more "
            f"than {LYING_MPS2:g} m/s² off gravity, so it does not measure right. Exchange or recalibrate the sensor."
        )


def _around(of: np.ufunc, values: FloatArray, at: IntArray, around: int) -> FloatArray:
    """Greatest or least (K,) of ``values`` (N,) within so many rows of some."""
    rows = at[:, None] + np.arange(-around, around + 1)
    return np.asarray(of.reduce(values[np.clip(rows, 0, len(values) - 1)], axis=1))


def _restless(unrest: FloatArray, spans: IntArray) -> float:
    """How much unrest there is at the strides' ends, but for the worst of them."""
    return np.percentile(unrest[spans.ravel()], RESTLESS_PERCENT) if len(spans) else np.inf


def _large(values: FloatArray, share: float) -> npt.NDArray[np.bool_]:
    """Which of the values (K,) exceed a share of that at which the greatest hold a third of the sum: some are not
    swings', and standing adds none."""
    ranked = np.sort(np.maximum(values, 0.0))[::-1]
    held = np.cumsum(ranked)
    return np.asarray(values > share * ranked[np.searchsorted(held, TYPICAL_SHARE * held[-1:])])


def _level(vectors: FloatArray, up: FloatArray) -> FloatArray:
    """Vectors (K, 3) without what is along gravity."""
    return np.asarray(vectors - (vectors @ up)[:, None] * up)


def _typical(vectors: FloatArray, up: FloatArray) -> FloatArray:
    """The level direction (3,) of their medians."""
    return _unit(_level(np.median(_level(vectors, up), axis=0)[None], up)[0])


def _vector(v: FloatArray) -> Vector3:
    return float(v[0]), float(v[1]), float(v[2])


def _standing(rate_hz: float, acc: FloatArray, gyr: FloatArray) -> tuple[FloatArray, bool]:
    """Gyroscope bias from the stillest second, zero where nobody stood still."""
    n = round(STANDING_S * rate_hz)
    step = max(n // 4, 1)
    turning, shaking = (np.sqrt(window_variances(np.ascontiguousarray(x), n, step).max(axis=1)) for x in (gyr, acc))
    spread = turning + 0.1 * shaking
    begin = step * int(np.argmin(spread))
    bias = np.median(gyr[begin : begin + n], axis=0)
    standing = bool(spread.min() < STANDING_RATE_RADPS and np.linalg.norm(bias) < 0.2)
    return (bias if standing else np.zeros(3)), standing


def _rest(energy: FloatArray, acc: FloatArray, window: int) -> tuple[FloatArray, FloatArray, float]:
    """How far from rest each sample is (N,), and at the quietest of them the force (3,) and its size, in m/s².

    The statistic is the rate's and the force's, each in the tolerance of the zero-velocity detectors
    (:mod:`fes.estimation.zupt.detectors`), after Skog et al., IEEE Trans Biomed Eng 57, 2010; of the force its mean
    over the window, for that is what moves the foot. ``energy`` (N,) is the rate's square over the window.
    """
    size = _sizes(acc)
    force, turning = moving_mean(size, window), energy / RATE_TOLERANCE_RADPS**2
    unrest = turning
    for _ in range(QUIET_PASSES + 1):
        quiet = unrest <= np.percentile(unrest, QUIET_PERCENT)
        norm = np.median(size[quiet])
        unrest = turning + ((force - norm) / ACC_TOLERANCE_MPS2) ** 2
    return unrest, np.median(acc[quiet], axis=0), norm


def _angles(vectors: FloatArray, unit: FloatArray) -> FloatArray:
    """Between vectors (K, 3) and a unit vector (3,), in rad (K,)."""
    return np.asarray(np.arccos(np.clip(vectors @ unit / np.maximum(_sizes(vectors), 1e-9), -1.0, 1.0)))


def _unit(vector: FloatArray) -> FloatArray:
    """The direction of a vector (3,)."""
    return np.asarray(vector / max(float(np.linalg.norm(vector)), 1e-9))


def _sizes(vectors: FloatArray) -> FloatArray:
    """Lengths (N,) of vectors (N, 3)."""
    return np.asarray(np.sqrt(squared_lengths(vectors)))


def _acc_bias_across(
    t_ns: IntArray, spans: IntArray, moved: np.ndarray[Any, np.dtype[Any]], up: FloatArray, incline: float
) -> FloatArray:
    """The accelerometer's bias across gravity (3,) in m/s², as far as walking shows it.

    Rest shows only the part along gravity. In swing the foot pitches, and the other parts appear in the vertical: the
    mean vertical velocity and height left over at the strides' ends speak of them. How loudly depends on how brisk the
    walk is, for scale errors leave something over too; so each is weighed against a share of the stride's acceleration.
    """
    span_s = 1e-9 * (t_ns[spans[:, 1]] - t_ns[spans[:, 0]])
    briskness = span_s * moved["lively"] / (spans[:, 1] + 1 - spans[:, 0])
    scale = SCALE_ERROR * np.stack((briskness, 0.5 * briskness * span_s), axis=1)
    across = np.eye(3) - np.outer(up, up)
    rows = moved["effect"] @ across / scale[:, :, None]
    left = moved["left"].copy()
    left[:, 1] -= incline * _sizes(moved["way"])
    left, weight, bias = left / scale, np.ones(len(spans)), np.zeros(3)
    for _ in range(3):
        # errors of strides add up like one another's, as scale errors do, not at random: the mean stride's count
        row, mean = (weight[:, None, None] * rows).sum(axis=0), (weight[:, None] * left).sum(axis=0)
        row, mean = row / weight.sum(), mean / weight.sum()
        bias = np.linalg.solve(row.T @ row + np.eye(3) / ACC_BIAS_SD_MPS2**2, row.T @ mean)
        off = np.hypot(*(left - rows @ bias).T)
        weight = np.minimum(1.0, HUBER * np.median(off) / np.maximum(off, 1e-9))
    return np.asarray(across @ bias)


def _mediolateral(moment: FloatArray, up: FloatArray) -> FloatArray:
    """The horizontal axis that most of the rotation is about, by its ``moment`` (3, 3): unit (3,), sign open."""
    level = np.eye(3) - np.outer(up, up)
    _, vectors = np.linalg.eigh(level @ moment @ level)
    return _unit(vectors[:, -1])


def stretch_for_calibration(t_ns: IntArray, gyr_radps: FloatArray, longest_s: float = 60.0) -> slice:
    """The samples to calibrate on: a minute from where the foot first moves, not the whole recording, as a live session
    would; with a few seconds before, which may show the gyroscope's bias.
    """
    moving = np.argmax(np.abs(gyr_radps.ravel()) > MOVING_RADPS) // 3
    begin_ns = t_ns[moving] - int(STILL_BEFORE_S * NS_PER_S)
    begin, end = np.searchsorted(t_ns, (begin_ns, max(begin_ns, t_ns[0]) + int(longest_s * NS_PER_S)), side="left")
    return slice(int(begin), int(end))
