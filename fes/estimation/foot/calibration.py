"""How the sensor sits and how this person moves, from a recording: gravity, biases, mediolateral axis, rest level.

Nothing about the mounting is assumed. At rest the accelerometer shows which way is up; its magnitude there differs from
gravity by a bias (a scale fits real sensors worse). Rest is where both sensors are still: a foot goes on sinking into
its sole after contact, and while it does it stops turning for an instant, which the gyroscope alone takes for rest.
Walking shows the mediolateral axis as the one that most of the rotation is about; which of its two directions is
toe-down follows from where the foot travels: forward is where each swing carries it.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from fes.estimation.foot.features import FootParameters, lags_at
from fes.estimation.foot.movements import contact_jumps, follow, movements, moving_mean
from fes.estimation.numerics.ranks import median, percentile
from fes.estimation.numerics.rotation import cross, without
from fes.estimation.zupt.detectors import ACC_TOLERANCE_MPS2, RATE_TOLERANCE_RADPS, least_spread
from fes.signals import G_MPS2, NS_PER_S, FloatArray, IntArray, Vector3
from statemachine.guards import FORMER_NAMES, Thresholds

QUIET_WINDOW_S = 0.1
QUIET_PERCENT = 15
QUIET_PASSES = 3  # the force at rest is that of the quietest samples, and these are found by it; it settles at once
STANDING_S = 1.0
STANDING_RATE_RADPS = 0.08  # standing still: no window of a second exceeds this spread
MIN_STRIDES = 3
MIN_TRAVEL_M = 0.15
LEAST_LIVELY_MPS2 = 0.01  # mean departure from gravity in strides: a slow foot's is 0.5, a sensor's noise is more
REST_PER_PEAK = 0.1  # the rest threshold as a share of the push-off's peak rate …
REST_PER_FLOOR = 1.6  # … but this far above what the foot does at its quietest …
REST_BOUNDS_RADPS = (0.25, 1.2)  # … and within these
SHORTEST_STRIDE_S = 0.5
REST_HOLD_PER_STRIDE = 0.045  # of what a stride takes longer than the shortest: 0.03 s at 1 s, 0.09 s at 2 s
REST_HOLD_BOUNDS_S = (0.03, 0.1)
ACC_BIAS_SD_MPS2 = 0.1  # prior of the accelerometer's bias per axis
SCALE_ERROR = 0.004  # of the accelerometer, and what clipping and sampling add
CONTACT_SHARE = 0.3  # of the typical jump at contact
CONTACT_JERK_BOUNDS_MPS3 = (150.0, 600.0)
MOST_PUSH_OFF_RADPS = 12.0  # real feet's typical peaks are 5–11; a toe that catches turns the foot faster
PUSH_OFF_SHARE = 0.4  # the least peak that counts as a push-off, as a share of this person's


class CalibrationError(ValueError):
    """The recording does not show what is needed; the message says what to record."""


@dataclass(frozen=True, slots=True)
class FootCalibration:
    """What is known of one foot sensor; frames: ``toe_down`` and ``up`` are unit vectors in the sensor frame.

    ``axis_confidence`` (0–1) is the share of the travel that agrees on which way the toe points. ``strides`` is how
    many the result rests on, ``standing`` whether a still second was found (if not, the gyroscope's
    bias is taken as zero and left to the orientation filter).
    """

    sensor: str
    rate_hz: float
    up: Vector3
    toe_down: Vector3
    acc_bias_mps2: Vector3
    gyr_bias_radps: Vector3
    rest_gyr_radps: float
    min_toe_down_peak_radps: float
    rest_hold_s: float
    contact_jerk_mps3: float
    axis_confidence: float
    strides: int
    standing: bool

    def parameters(self) -> FootParameters:
        """For the compiled core."""
        return FootParameters(
            *self.toe_down, *self.acc_bias_mps2, *self.gyr_bias_radps, 1.0 / self.rate_hz, *lags_at(self.rate_hz)
        )

    def thresholds(self, *, swing_at_reversal: bool = False) -> Thresholds:
        """The guards' thresholds for this person; all others at their defaults."""
        return Thresholds(
            rest_gyr_radps=self.rest_gyr_radps,
            min_toe_down_peak_radps=self.min_toe_down_peak_radps,
            rest_hold_s=self.rest_hold_s,
            contact_jerk_mps3=self.contact_jerk_mps3,
            swing_at_reversal=swing_at_reversal,
        )

    def forward(self) -> FloatArray:
        """Unit vector towards the toe in the sensor frame (3,): toe-down × up."""
        return cross(self.toe_down, self.up)

    def to_dict(self) -> dict[str, Any]:
        """For the session log."""
        return asdict(self)

    @staticmethod
    def from_dict(data: dict[str, Any]) -> FootCalibration:
        """Back from the session log or a calibration file, of former versions too."""
        values: dict[str, Any] = {
            FORMER_NAMES.get(key, key): tuple(v) if isinstance(v, list) else v for key, v in data.items()
        }
        return FootCalibration(**values)


def calibrate_foot(
    sensor: str, rate_hz: float, t_ns: IntArray, acc_mps2: FloatArray, gyr_radps: FloatArray
) -> FootCalibration:
    """Find a foot sensor's calibration from a stretch with at least a few strides of walking forward.

    Args:
        sensor: its name, for messages.
        rate_hz: nominal sampling rate.
        t_ns: (N,) strictly increasing time stamps.
        acc_mps2: (N, 3) specific force.
        gyr_radps: (N, 3) angular rate.

    Raises:
        CalibrationError: too short, never at rest, too few strides, or the direction of travel is ambiguous.
    """
    window = max(round(QUIET_WINDOW_S * rate_hz), 2)
    if len(t_ns) < 20 * window:
        raise CalibrationError(
            f"{sensor}: {len(t_ns) / rate_hz:.1f} s is too short to calibrate. Record a still second and five strides."
        )
    rate_bias, standing = _standing(rate_hz, acc_mps2, gyr_radps)
    gyr = without(gyr_radps, rate_bias)
    energy = moving_mean(_squares(gyr), window)
    unrest, rest_force, rest_norm = _rest(energy, acc_mps2, window)
    if not 0.7 * G_MPS2 < rest_norm < 1.3 * G_MPS2:
        raise CalibrationError(
            f"{sensor}: at its quietest the accelerometer reads {rest_norm:.2f} m/s² instead of about 9.81. "
            "Check acc_unit, and that the foot rests at times."
        )
    up = rest_force / np.linalg.norm(rest_force)
    acc = without(acc_mps2, up * (rest_norm - G_MPS2))
    spans = np.array(movements(energy, rate_hz, unrest), np.int64).reshape(-1, 2)
    moved = follow(t_ns, acc, gyr, spans)
    far = _sizes(moved["way"]) > MIN_TRAVEL_M
    swings, moved = spans[far], moved[far]
    if len(swings) < MIN_STRIDES:
        raise CalibrationError(
            f"{sensor}: {len(swings)} strides found, {MIN_STRIDES} are needed to find the mediolateral axis. "
            "Record at least five strides of walking straight ahead."
        )
    if moved["lively"].sum() < LEAST_LIVELY_MPS2 * (swings[:, 1] + 1 - swings[:, 0]).sum():
        raise CalibrationError(
            f"{sensor}: the accelerometer shows gravity and nothing else while the foot swings, so it has stopped "
            "measuring. Restart or exchange the sensor, and record again."
        )
    axis = _mediolateral(moved["moment"].sum(axis=0), up)
    along = moved["way"] @ cross(_vector(axis), _vector(up))
    confidence = abs(along.sum()) / np.abs(along).sum()
    if confidence < 0.6:
        raise CalibrationError(
            f"{sensor}: the strides do not agree on a direction of travel ({confidence:.0%}). Calibrate on a stretch "
            "of walking straight ahead."
        )
    if along.sum() < 0:
        axis = -axis
    acc_bias = up * (rest_norm - G_MPS2)
    acc_bias += _acc_bias_across(t_ns, swings, moved, up)
    toe_down = gyr @ axis
    peak, floor = _levels(toe_down, energy, swings)
    low, high = REST_BOUNDS_RADPS
    return FootCalibration(
        sensor=sensor,
        rate_hz=rate_hz,
        up=_vector(up),
        toe_down=_vector(axis),
        acc_bias_mps2=_vector(acc_bias),
        gyr_bias_radps=_vector(rate_bias),
        rest_gyr_radps=float(min(max(REST_PER_PEAK * peak, REST_PER_FLOOR * floor, low), high)),
        min_toe_down_peak_radps=float(PUSH_OFF_SHARE * min(peak, MOST_PUSH_OFF_RADPS)),
        rest_hold_s=_rest_hold_s(1e-9 * t_ns[swings[:, 0]].astype(np.float64)),
        contact_jerk_mps3=_contact_jump(
            t_ns, without(acc_mps2, acc_bias), gyr, swings, moved["turn"], toe_down, rate_hz
        ),
        axis_confidence=float(confidence),
        strides=len(swings),
        standing=standing,
    )


def _vector(v: FloatArray) -> Vector3:
    return float(v[0]), float(v[1]), float(v[2])


def _standing(rate_hz: float, acc: FloatArray, gyr: FloatArray) -> tuple[FloatArray, bool]:
    """Gyroscope bias from the stillest second, zero where nobody stood still."""
    n = round(STANDING_S * rate_hz)
    begin, best = least_spread(np.ascontiguousarray(acc), np.ascontiguousarray(gyr), n, max(n // 4, 1), 0.1)
    bias = _medians(gyr[begin : begin + n]) if begin >= 0 else np.zeros(3)
    standing = best < STANDING_RATE_RADPS and float(np.linalg.norm(bias)) < 0.2
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
        quiet = unrest <= percentile(unrest, QUIET_PERCENT)
        norm = median(size[quiet])
        unrest = turning + ((force - norm) / ACC_TOLERANCE_MPS2) ** 2
    return unrest, _medians(acc[quiet]), norm


def _medians(vectors: FloatArray) -> FloatArray:
    """Of each column (3,) of vectors (N, 3)."""
    return np.array([median(column) for column in vectors.T])


def _sizes(vectors: FloatArray) -> FloatArray:
    """Lengths (N,) of vectors (N, 3)."""
    return np.asarray(np.sqrt(_squares(vectors)))


def _squares(vectors: FloatArray) -> FloatArray:
    """Squared lengths (N,) of vectors (N, 3)."""
    x, y, z = vectors.T
    return np.asarray(x * x + y * y + z * z)


def _of_each(of: np.ufunc, values: FloatArray, spans: IntArray) -> FloatArray:
    """Sum, greatest … (K,) of ``values`` over spans (K, 2), both ends included; one value stands after the last."""
    return np.asarray(of.reduceat(values, (spans + np.array((0, 1))).ravel())[::2])


def _acc_bias_across(
    t_ns: IntArray, spans: IntArray, moved: np.ndarray[Any, np.dtype[Any]], up: FloatArray
) -> FloatArray:
    """The accelerometer's bias across gravity (3,) in m/s², as far as walking shows it.

    Rest shows only the part along gravity. In swing the foot pitches, and the other parts appear in the vertical: the
    mean vertical velocity and height left over at the strides' ends speak of them. How loudly depends on how brisk the
    walk is, for scale errors leave something over too; so each is weighed against a share of the stride's acceleration.
    """
    left, effect_sum = moved["left"].sum(axis=0), moved["effect"].sum(axis=0)
    span_s = 1e-9 * (t_ns[spans[:, 1]] - t_ns[spans[:, 0]])
    briskness = span_s * moved["lively"] / (spans[:, 1] + 1 - spans[:, 0])
    floor = SCALE_ERROR * np.array((briskness.sum(), 0.5 * (briskness * span_s).sum()))
    across = np.eye(3) - np.outer(up, up)
    rows = (effect_sum @ across) / floor[:, None]
    known = rows.T @ rows + np.eye(3) / ACC_BIAS_SD_MPS2**2
    return np.asarray(across @ np.linalg.solve(known, rows.T @ (left / floor)))


def _mediolateral(moment: FloatArray, up: FloatArray) -> FloatArray:
    """The horizontal axis that most of the rotation is about, by its ``moment`` (3, 3): unit (3,), sign open."""
    level = np.eye(3) - np.outer(up, up)
    _, vectors = np.linalg.eigh(level @ moment @ level)
    axis = vectors[:, -1]
    return np.asarray(axis / np.linalg.norm(axis))


def _levels(toe_down: FloatArray, energy: FloatArray, spans: IntArray) -> tuple[float, float]:
    """Typical peak of the toe-down rate per stride, and the rate at the quietest instant between strides (rad/s)."""
    peaks = _of_each(np.maximum, np.append(toe_down, 0.0), spans)
    return median(peaks), median(np.sqrt(energy[spans[:, 1]]))


def _rest_hold_s(starts_s: FloatArray) -> float:
    """How long rest must last to count: slow walkers pause between contact and foot flat, fast ones hardly rest."""
    between = np.diff(starts_s)
    usual = between[between < 4.0]
    stride_s = median(usual) if len(usual) else 1.0
    low, high = REST_HOLD_BOUNDS_S
    return min(max(REST_HOLD_PER_STRIDE * (stride_s - SHORTEST_STRIDE_S), low), high)


def _contact_jump(
    t_ns: IntArray,
    acc: FloatArray,
    gyr: FloatArray,
    spans: IntArray,
    turns: FloatArray,
    toe_down: FloatArray,
    rate_hz: float,
) -> float:
    """Threshold (m/s³) for this person's first contacts: a share of the greatest jump after the toe-up peak."""
    lag, _ = lags_at(rate_hz)
    jumps = contact_jumps(t_ns, acc, gyr, spans, turns, toe_down, lag)
    jumps = jumps[~np.isnan(jumps)] * rate_hz / lag
    low, high = CONTACT_JERK_BOUNDS_MPS3
    return min(max(CONTACT_SHARE * median(jumps), low), high) if len(jumps) else high


def stretch_for_calibration(t_ns: IntArray, longest_s: float = 60.0) -> int:
    """How many samples from the start to calibrate on: a minute, not the whole recording, as a live session would."""
    return int(np.searchsorted(t_ns, t_ns[0] + int(longest_s * NS_PER_S), side="right"))
