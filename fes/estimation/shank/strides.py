"""Strides from an ankle or shank sensor, which is never at rest: the non-ZUPT reset.

Source: Wu, Wang and Pottie, "A Non-ZUPT Gait Reconstruction Method for Ankle Sensors". In mid-stance the shank turns
about a point near the ankle, ``v = w × r`` in the sensor frame (5); the velocity is reset to that instead of to zero.
Departures from the print, and why:

- The reset meets the velocity at both ends of a stride, with the smallest artificial accelerometer bias that does so
  (``fes.estimation.strides.integration``), instead of a jump at each mid-stance; and equal height on level ground, off
  on stairs.
- ``v = w × r`` is met on average over the fine window, not at its middle: the gyroscope wobbles on the soft tissue
  there while the integrated acceleration does not, and the velocity has its minimum there, so that a mean of the one is
  not to be compared with an instant of the other: that makes the strides of ``stroke_treadmill`` 2.4 % longer.
- The arm points from the centre of rotation to the sensor, that is up the shank. See
  ``fes.estimation.shank.lever_arm``.

On 24 sides of ``stroke_treadmill`` speed over belt is 1.002 ± 0.026 (mean and SD). A centimetre of arm is 0.65 %.

Known limits: the one patient at 1.6 m/s comes out 2.5–5.5 % short, probably as the ankle itself still moves in stance.
The centre learnt is the ankle rocker's: a toe walker, who turns about the ball of the foot, has an arm that is longer
by the height of the ankle. What clearance means here is the rise of the sensor, not of the toe.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from fes.estimation.shank.calibration import ShankCalibration
from fes.estimation.shank.motion import StrideSpan, from_rest, levelled, rotate_each
from fes.estimation.strides.integration import integrate
from fes.signals import FloatArray, IntArray, StrideResult

TRAJECTORY_POINTS = 101
ROUNDS = 2
DURATION_S = (0.4, 5.0)
LONGEST_GAP_S = 0.04
LONGEST_STRIDE_M = 3.0


@dataclass(frozen=True, slots=True)
class ShankIntegrationSettings:
    """How strides of one shank are integrated.

    Attributes:
        up: unit vector along the shank, upward, sensor frame (3,).
        left: unit mediolateral axis to the person's left, sensor frame (3,).
        arm: from the centre of rotation to the sensor, in m, sensor frame (3,); None resets to zero (ZUPT), which is
            there to be compared with.
        incline: what the ground rises per horizontal distance; NaN for stairs and unknown slopes.
    """

    up: FloatArray
    left: FloatArray
    arm: FloatArray | None
    incline: float = 0.0

    @staticmethod
    def for_calibration(calibration: ShankCalibration, *, incline: float | None = None) -> ShankIntegrationSettings:
        """The settings that a calibration leads to; ``incline`` overrules what it says of the ground."""
        up, left, arm = (np.array(v) for v in (calibration.up, calibration.left, calibration.arm.arm_m))
        known = 0.0 if calibration.level else math.nan
        return ShankIntegrationSettings(up, left, arm, known if incline is None else incline)


def solve_shank_stride(
    sensor: str, number: int, span: StrideSpan, t_ns: IntArray, acc: FloatArray, gyr: FloatArray,
    settings: ShankIntegrationSettings,
) -> StrideResult:  # fmt: skip
    """Integrate one stride; ``acc`` (N, 3) m/s² and ``gyr`` (N, 3) rad/s free of bias."""
    first, last, lead = span.first, span.last, span.half

    def unusable(reason: str) -> StrideResult:
        return StrideResult(sensor, number, int(t[0]), int(t[-1]), valid=False, reason=reason)

    t = np.ascontiguousarray(t_ns[first : last + 1])
    duration_s = 1e-9 * float(t[-1] - t[0])
    gaps = np.diff(t_ns[first - lead : last + lead + 1])
    gap_s = 1e-9 * float(gaps.max())
    if not DURATION_S[0] <= duration_s <= DURATION_S[1]:
        return unusable(f"lasts {duration_s:.2f} s")
    if gap_s > max(LONGEST_GAP_S, 3.5e-9 * float(np.median(gaps))):
        return unusable(f"samples missing for {1e3 * gap_s:.0f} ms")
    if not span.quiet:
        return unusable("the shank does not turn slowly at any time of its stance")
    start, end = np.zeros(3), np.zeros(3)
    for _ in range(ROUNDS):  # the change of velocity tilts the mean force, and the tilt turns the velocities
        around = levelled(t_ns, acc, gyr, (first, last), lead, end - start)
        start, end = _end_velocities(t_ns, acc, gyr, span, around, settings.arm)
    quaternion = np.ascontiguousarray(around[lead : len(around) - lead])
    n = len(t)
    velocity, position, gamma = np.empty((n, 3)), np.empty((n, 3)), np.empty((2, 3))
    force = acc[first : last + 1]
    solved = integrate(t, force, quaternion, start, end, settings.incline, velocity, position, gamma)
    length = float(np.hypot(position[-1, 0], position[-1, 1]))
    if not solved:
        return unusable("the constraints cannot be met")
    if not length <= LONGEST_STRIDE_M:
        return unusable(f"{length:.2f} m is no stride length")
    forward = rotate_each(quaternion, np.tile(np.cross(settings.left, settings.up), (n, 1)))
    direction = position[-1, :2] / length if length > 0.05 else forward[0, :2] / np.hypot(*forward[0, :2])
    across = np.array([-direction[1], direction[0]])
    walking = np.column_stack((position[:, :2] @ direction, position[:, :2] @ across, position[:, 2]))
    pitch = np.arcsin(np.clip(forward[:, 2], -1.0, 1.0))
    heading = np.arctan2(forward[[0, -1], 1], forward[[0, -1], 0])
    turn = (heading[1] - heading[0] + math.pi) % (2.0 * math.pi) - math.pi
    at = np.linspace(t[0], t[-1], TRAJECTORY_POINTS)
    return StrideResult(
        sensor, number, int(t[0]), int(t[-1]), length, clearance_m=float(position[:, 2].max()),
        height_gained_m=float(position[-1, 2]), turn_rad=float(turn), speed_mps=length / duration_s,
        trajectory_m=np.column_stack([np.interp(at, t, walking[:, k]) for k in range(3)]),
        pitch_rad=np.interp(at, t, pitch - pitch[0]),
    )  # fmt: skip


def _end_velocities(
    t_ns: IntArray, acc: FloatArray, gyr: FloatArray, span: StrideSpan, quaternions: FloatArray, arm: FloatArray | None
) -> tuple[FloatArray, FloatArray]:
    """Velocity in the world (3,) at the first and the last sample: Eq. (5), met on average over each fine window.

    ``quaternions`` are of the samples ``first − half`` … ``last + half``.
    """
    if arm is None:
        return np.zeros(3), np.zeros(3)
    lead, part = span.half, slice(span.first - span.half, span.last + span.half + 1)
    raw, _ = from_rest(t_ns[part], acc[part], quaternions)
    turning = rotate_each(quaternions, np.cross(gyr[part], arm))
    start, end = (
        raw[at] + (turning - raw)[at - lead : at + lead + 1].mean(axis=0) for at in (lead, len(raw) - 1 - lead)
    )
    return start, end
