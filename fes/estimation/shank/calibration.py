"""How a shank or ankle sensor sits, from a stretch of walking: the shank's axis, the way forward, biases, lever arm.

As for the foot (``fes.estimation.foot.calibration``) nothing about the mounting is assumed, and nobody has to stand
still: gravity is the mean specific force over whole strides, the gyroscope's bias follows from how that direction
drifts from stride to stride, and forward is where the swings carry the sensor.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from itertools import pairwise
from typing import Any

import numpy as np

from fes.estimation.foot.calibration import CalibrationError, refuse_degrees
from fes.estimation.foot.features import lags_at
from fes.estimation.numerics.rotation import rotate_all
from fes.estimation.shank.features import ShankParameters
from fes.estimation.shank.lever_arm import ArmEstimate, learn_arm
from fes.estimation.shank.motion import (
    CONJUGATE,
    ShankLevels,
    StrideSpan,
    fit_levels,
    levelled,
    still_spans,
    stride_spans,
    swing_peaks,
    trace_of,
    travelled,
    turned_back,
)
from fes.signals import G_MPS2, FloatArray, IntArray, Vector3

UP = np.array([0.0, 0.0, 1.0])
QUIET_PERCENT = 30
MIN_STRIDES = 3
MIN_TRAVEL_M = 0.15
MIN_AGREEMENT = 0.6
GYR_BIAS_SD_RADPS = 0.01  # prior, where nobody stood still
DRIFT_SD_RAD = 0.02  # of gravity's direction from stride to stride


@dataclass(frozen=True, slots=True)
class ShankCalibration:
    """What is known of one shank sensor.

    Attributes:
        sensor: its name.
        rate_hz: nominal sampling rate.
        up: unit vector, gravity's opposite in mid-stance, which is the shank's long axis upward; sensor frame.
        left: unit mediolateral axis to the person's left; the rate about it is positive when the shank leans forward
            (stance) and negative when it swings forward. Sensor frame.
        acc_bias_mps2: along the mean direction of gravity; the rest does not show.
        gyr_bias_radps: from a still stretch, else from the drift between strides.
        arm: the lever arm, with what there is to say about it.
        axis_confidence: share of the travel that agrees on which way is forward, 0–1.
        strides: how many the result rests on.
        standing: whether a still stretch was found.
        levels: how the shank moves, for the guards.
        level: whether strides end as high as they begin; False for stairs and slopes.
    """

    sensor: str
    rate_hz: float
    up: Vector3
    left: Vector3
    acc_bias_mps2: Vector3
    gyr_bias_radps: Vector3
    arm: ArmEstimate
    axis_confidence: float
    strides: int
    standing: bool
    levels: ShankLevels = field(default_factory=ShankLevels)
    level: bool = True

    def parameters(self) -> ShankParameters:
        """For the compiled core."""
        return ShankParameters(
            *self.left,
            *self.arm.arm_m,
            *self.acc_bias_mps2,
            *self.gyr_bias_radps,
            1.0 / self.rate_hz,
            self.levels.still_mps2,
            lags_at(self.rate_hz)[0],
        )

    def forward(self) -> FloatArray:
        """Unit vector to the front in mid-stance, sensor frame (3,): left × up."""
        return np.cross(np.array(self.left), np.array(self.up))

    def to_dict(self) -> dict[str, Any]:
        """For the session log."""
        return asdict(self)

    @staticmethod
    def from_dict(data: dict[str, Any]) -> ShankCalibration:
        """Back from the session log."""
        arm, levels = ArmEstimate(**_with_tuples(data["arm"])), ShankLevels(**data.get("levels", {}))
        return ShankCalibration(**{**_with_tuples(data), "arm": arm, "levels": levels})


def calibrate_shank(
    sensor: str, rate_hz: float, t_ns: IntArray, acc_mps2: FloatArray, gyr_radps: FloatArray, *,
    level: bool = True,
) -> ShankCalibration:  # fmt: skip
    """Find a shank sensor's calibration from a stretch with at least a few strides of walking forward.

    Args:
        sensor: its name, for messages. rate_hz: nominal sampling rate. t_ns: (N,) strictly increasing time stamps.
        acc_mps2: (N, 3) specific force. gyr_radps: (N, 3) angular rate. level: whether the stretch is on level ground.

    Raises:
        CalibrationError: too short, rates in degrees, too few strides, or the direction of travel is ambiguous.
    """
    if len(t_ns) < 3 * rate_hz:
        raise CalibrationError(
            f"{sensor}: {len(t_ns) / rate_hz:.1f} s is too short to calibrate. Record five strides or more."
        )
    refuse_degrees(sensor, gyr_radps)
    gyr, rests = gyr_radps, still_spans(acc_mps2, gyr_radps, rate_hz)
    if rests:
        first, last = max(rests, key=lambda rest: rest[1] - rest[0])
        gyr = gyr_radps - np.median(gyr_radps[first : last + 1], axis=0)
    energy = np.einsum("ij,ij->i", gyr, gyr)
    vertical = np.median(acc_mps2[energy <= np.percentile(energy, QUIET_PERCENT)], axis=0)
    if not 0.7 * G_MPS2 < np.linalg.norm(vertical) < 1.3 * G_MPS2:
        raise CalibrationError(
            f"{sensor}: at its quietest the accelerometer reads {np.linalg.norm(vertical):.2f} m/s² instead of about "
            "9.81. Check acc_unit."
        )
    left, spans, confidence = _direction(sensor, t_ns, acc_mps2, gyr, vertical / np.linalg.norm(vertical), rate_hz)
    if not rests:
        gyr = gyr - _bias_by_drift(t_ns, acc_mps2, gyr, spans)
    up, excess_mps2 = _gravity(t_ns, acc_mps2, gyr, spans)
    left = left - up * (up @ left)
    left /= np.linalg.norm(left)
    acc_bias = up * excess_mps2
    arm = learn_arm(t_ns, acc_mps2 - acc_bias, gyr, spans, up, left, level=level)
    axes_and_biases = _vector(up), _vector(left), _vector(acc_bias), _vector(gyr_radps[0] - gyr[0])
    found = ShankCalibration(
        sensor, rate_hz, *axes_and_biases, arm, confidence, strides=len(spans), standing=bool(rests), level=level
    )
    trace = trace_of(found.parameters(), t_ns, acc_mps2, gyr_radps)
    return replace(found, levels=fit_levels(trace, spans, rate_hz))


def _with_tuples(data: dict[str, Any]) -> dict[str, Any]:
    return {key: tuple(v) if isinstance(v, list) else v for key, v in data.items()}


def _vector(v: FloatArray) -> Vector3:
    x, y, z = v.tolist()
    return x, y, z


def _direction(
    sensor: str, t_ns: IntArray, acc: FloatArray, gyr: FloatArray, vertical: FloatArray, rate_hz: float
) -> tuple[FloatArray, list[StrideSpan], float]:
    """The axis to the left, the strides, and how well they agree.

    Of the two directions of the axis of most rotation the one is tried first about which the fastest turning is a
    swing. Where travel says otherwise the other is taken and has to stand the same test.
    """
    across = np.eye(3) - np.outer(vertical, vertical)
    _, vectors = np.linalg.eigh(across @ (gyr.T @ gyr) @ across)
    axis = vectors[:, -1]
    low, high = np.percentile(gyr @ axis, (0.5, 99.5))
    if high > -low:
        axis = -axis
    agreement = 0.0
    for left in (axis, -axis):
        spans = stride_spans(gyr, swing_peaks(gyr @ left, rate_hz), rate_hz)
        forward = np.cross(left, vertical)
        travel = np.zeros(len(spans))  # as if at rest at a stride's ends, seen from the sensor at its beginning
        for k, span in enumerate(spans):
            if (found := travelled(t_ns, acc, gyr, (span.first, span.last))) is not None:
                travel[k] = turned_back(found[0][0], found[2][-1]) @ forward
        walked = [span for span, d in zip(spans, travel, strict=True) if abs(d) > MIN_TRAVEL_M]
        if len(walked) < MIN_STRIDES:
            continue
        agreement = float(travel.sum() / np.abs(travel).sum())
        if agreement >= MIN_AGREEMENT:
            return left, walked, agreement
    if agreement == 0.0:
        raise CalibrationError(
            f"{sensor}: fewer than {MIN_STRIDES} strides found. Record at least five strides of walking straight ahead."
        )
    raise CalibrationError(
        f"{sensor}: the strides do not agree on a direction of travel ({abs(agreement):.0%}). Calibrate on a stretch "
        "of walking straight ahead."
    )


def _bias_by_drift(t_ns: IntArray, acc: FloatArray, gyr: FloatArray, spans: list[StrideSpan]) -> FloatArray:
    """The gyroscope's bias (3,) from neighbouring strides: integrated from one into the next, gravity must stay put.

    The part along gravity does not show and comes out near zero.
    """
    rows, values = [np.eye(3) / GYR_BIAS_SD_RADPS], [np.zeros(3)]
    for before, after in pairwise(spans):
        if before.last != after.first:
            continue
        one, two = (levelled(t_ns, acc, gyr, (span.first, span.last)) for span in (before, after))
        # gravity at the instant that both strides share, as each of them has it, in the sensor frame
        g_one, g_two = turned_back(one[-1], UP), turned_back(two[0], UP)
        # a bias turns either stride about its own middle: half a stride's worth at the end of one, minus half in two
        turn = _turn(t_ns[before.first : before.last + 1], one, -1) + _turn(t_ns[after.first : after.last + 1], two, 0)
        level = np.eye(3) - np.outer(g_one, g_one)
        rows.append(level @ (0.5 * turn) / DRIFT_SD_RAD)
        # turning the sensor by b·t turns gravity as seen from it the other way
        values.append(-np.cross(g_two, g_one) / DRIFT_SD_RAD)
    return np.asarray(np.linalg.lstsq(np.concatenate(rows), np.concatenate(values), rcond=None)[0])


def _turn(t_ns: IntArray, quaternions: FloatArray, at: int) -> FloatArray:
    """``∫ R dt`` over a stride in the sensor frame of sample ``at``: (3, 3), rotation per rate of bias."""
    dt_s = 1e-9 * np.gradient(t_ns.astype(float))
    columns = [(rotate_all(quaternions, e) * dt_s[:, None]).sum(axis=0) for e in np.eye(3)]
    return rotate_all(quaternions[at : at + 1 or None] * CONJUGATE, np.array(columns)).T


def _gravity(t_ns: IntArray, acc: FloatArray, gyr: FloatArray, spans: list[StrideSpan]) -> tuple[FloatArray, float]:
    """Up in the sensor frame in mid-stance (3,), and by how much the accelerometer's mean exceeds gravity (m/s²)."""
    ups, forces = [], []
    for span in spans:
        quaternions = levelled(t_ns, acc, gyr, (span.first, span.last))
        ups.append(turned_back(quaternions[0], UP))
        force = rotate_all(quaternions, acc[span.first : span.last + 1])
        forces.append(float((force[1:] + force[:-1]).mean(axis=0)[2]) / 2.0)
    up = np.median(np.array(ups), axis=0)
    return up / np.linalg.norm(up), float(np.median(forces)) - G_MPS2
