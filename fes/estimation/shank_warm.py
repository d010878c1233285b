"""Compile what a shank needs before the first sample that matters."""

from __future__ import annotations

import math

from fes.estimation.ankle import AnkleSettings, solve_ankle_stride
from fes.estimation.ankle_arm import ArmEstimate
from fes.estimation.ankle_calibration import ShankCalibration
from fes.estimation.ankle_motion import StrideSpan
from fes.estimation.shank import shank_tracker
from fes.signals import FloatArray, IntArray


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
    solve_ankle_stride(
        calibration.sensor, 1, span, t_ns, acc_mps2.copy(), gyr_radps.copy(), AnkleSettings.of(calibration)
    )
