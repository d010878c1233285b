"""Compile everything before the first sample that matters: a compiler in the loop would cost seconds of stimulation."""

from __future__ import annotations

import numpy as np

from fes.estimation.calibration import FootCalibration
from fes.estimation.foot import FootTracker
from fes.estimation.shank_warm import warm_up_shank
from fes.estimation.strides import StrideMaker, StrideSettings
from fes.signals import G_MPS2


def warm_up() -> None:
    """Run the compiled core once on two seconds of made-up steps, through every function that the loop may call."""
    calibration = FootCalibration(
        sensor="left_foot",
        rate_hz=100.0,
        up=(0.0, 0.0, 1.0),
        toe_down=(0.0, 1.0, 0.0),
        acc_bias_mps2=(0.0, 0.0, 0.0),
        gyr_bias_radps=(0.0, 0.0, 0.0),
        rest_gyr_radps=0.5,
        min_toe_down_peak_radps=1.0,
        rest_hold_s=0.03,
        contact_jump_mps3=600.0,
        axis_confidence=1.0,
        strides=0,
        standing=True,
    )
    settings = StrideSettings(forward=calibration.forward(), up=np.array(calibration.up))
    tracker = FootTracker(calibration, StrideMaker(calibration.sensor, settings))
    n = 400
    at = np.arange(n)
    phase = (at % 200) / 200.0
    toe_down = np.where(phase < 0.5, 0.0, np.where(phase < 0.65, 4.0 * np.sin((phase - 0.5) / 0.15 * np.pi), 0.0))
    toe_down = np.where((phase >= 0.65) & (phase < 0.85), -3.0 * np.sin((phase - 0.65) / 0.2 * np.pi), toe_down)
    gyr = np.column_stack((np.zeros(n), toe_down, np.zeros(n)))
    acc = np.column_stack((3.0 * toe_down, np.zeros(n), np.full(n, G_MPS2) + np.where((at % 200) == 172, 60.0, 0.0)))
    for k in range(n):
        tracker.advance(at[k : k + 1] * 10_000_000, acc[k : k + 1], gyr[k : k + 1])
    warm_up_shank(at * 10_000_000, acc, gyr)
