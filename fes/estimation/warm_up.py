"""Compile everything before the first sample that matters: a compiler in the loop would cost seconds of stimulation.

Compile what a shank needs before the first sample that matters.
"""

from __future__ import annotations

import math

import numpy as np

from fes.config import FootGeometry
from fes.estimation.foot.calibration import FootCalibration
from fes.estimation.foot.tracker import FootTracker
from fes.estimation.shank.calibration import ShankCalibration
from fes.estimation.shank.lever_arm import ArmEstimate
from fes.estimation.shank.motion import StrideSpan
from fes.estimation.shank.strides import ShankIntegrationSettings, solve_shank_stride
from fes.estimation.shank.tracker import shank_tracker
from fes.estimation.strides.results import StrideMaker, StrideSettings
from fes.estimation.tracking.history import History
from fes.signals import G_MPS2, FloatArray, IntArray


def warm_up_shank(t_ns: IntArray, acc_mps2: FloatArray, gyr_radps: FloatArray) -> None:
    """Run the shank's core sample by sample over made-up steps, and solve one stride of them.

    ``t_ns`` (N,) strictly increasing at about 100 Hz, at least two seconds; ``acc_mps2`` and ``gyr_radps`` (N, 3) with
    z up and y to the left.
    """
    arm = ArmEstimate((0.0, 0.0, 0.3), 0.3, False, "made up", math.inf, math.nan, math.inf, 0, 0)
    calibration = ShankCalibration(
        sensor="left_shank",
        rate_hz=100.0,
        up=(0.0, 0.0, 1.0),
        left=(0.0, 1.0, 0.0),
        acc_bias_mps2=(0.0, 0.0, 0.0),
        gyr_bias_radps=(0.0, 0.0, 0.0),
        arm=arm,
        axis_confidence=1.0,
        strides=0,
        standing=True,
    )
    tracker = shank_tracker(calibration)
    for k in range(len(t_ns)):
        tracker.advance(t_ns[k : k + 1], acc_mps2[k : k + 1], gyr_radps[k : k + 1])
    span = StrideSpan(20, 60, 140, 5, quiet=True)
    solve_shank_stride(
        calibration.sensor, 1, span, t_ns, acc_mps2.copy(), gyr_radps.copy(), ShankIntegrationSettings.of(calibration)
    )


GEOMETRY = FootGeometry(toe_forward_m=0.12, toe_up_m=-0.06, heel_forward_m=-0.1, heel_up_m=-0.06)


def warm_up() -> None:
    """Run the compiled core once on four seconds of made-up steps, through every function that the loop may call."""
    t_ns, acc, gyr = made_up_steps()
    warm_up_foot(t_ns, acc, gyr)
    warm_up_shank(t_ns, acc, gyr)


def made_up_steps() -> tuple[IntArray, FloatArray, FloatArray]:
    """Two steps of a foot at 100 Hz: stamps (N,), specific force (N, 3) and rate (N, 3), z up and y to the left."""
    n = 400
    at = np.arange(n)
    phase = (at % 200) / 200.0
    toe_down = np.where(phase < 0.5, 0.0, np.where(phase < 0.65, 4.0 * np.sin((phase - 0.5) / 0.15 * np.pi), 0.0))
    toe_down = np.where((phase >= 0.65) & (phase < 0.85), -3.0 * np.sin((phase - 0.65) / 0.2 * np.pi), toe_down)
    gyr = np.column_stack((np.zeros(n), toe_down, np.zeros(n)))
    acc = np.column_stack((3.0 * toe_down, np.zeros(n), np.full(n, G_MPS2) + np.where((at % 200) == 172, 60.0, 0.0)))
    return at * 10_000_000, acc, gyr


def warm_up_foot(t_ns: IntArray, acc_mps2: FloatArray, gyr_radps: FloatArray) -> None:
    """Run a foot's core over these steps, sample by sample, with all that a session may ask of its strides."""
    tracker = made_up_foot()
    for t, acc, gyr in zip(t_ns.tolist(), acc_mps2.tolist(), gyr_radps.tolist(), strict=True):
        tracker.step(t, acc, gyr)
    History(100.0).forget_half()  # what happens when its room is full, after many seconds


def made_up_calibration() -> FootCalibration:
    """The calibration of such a foot."""
    return FootCalibration(
        sensor="left_foot",
        rate_hz=100.0,
        up=(0.0, 0.0, 1.0),
        toe_down=(0.0, 1.0, 0.0),
        acc_bias_mps2=(0.0, 0.0, 0.0),
        gyr_bias_radps=(0.0, 0.0, 0.0),
        rest_gyr_radps=0.5,
        min_toe_down_peak_radps=1.0,
        rest_hold_s=0.03,
        contact_jerk_mps3=600.0,
        axis_confidence=1.0,
        strides=0,
        standing=True,
    )


def made_up_foot() -> FootTracker:
    """A tracker of such a foot, with known geometry."""
    calibration = made_up_calibration()
    settings = StrideSettings(forward=calibration.forward(), up=np.array(calibration.up), geometry=GEOMETRY)
    return FootTracker(calibration, StrideMaker(calibration.sensor, settings))
