"""Compile everything before the first sample that matters: a compiler in the loop would cost seconds of stimulation."""

import math

import numpy as np

from fes.config import FootGeometry
from fes.estimation.foot.calibration import FootCalibration
from fes.estimation.foot.tracker import FootTracker
from fes.estimation.numerics.jit import PLAIN, keep_compiled, signatures
from fes.estimation.shank.calibration import ShankCalibration
from fes.estimation.shank.lever_arm import ArmEstimate
from fes.estimation.shank.motion import StrideSpan
from fes.estimation.shank.tracker import ShankIntegrationSettings, ShankTracker, solve_shank_stride
from fes.estimation.strides.results import StrideMaker, StrideSettings
from fes.estimation.tracking.tracker import History
from fes.signals import G_MPS2, FloatArray, IntArray

GEOMETRY = FootGeometry(toe_forward_m=0.12, toe_up_m=-0.06, heel_forward_m=-0.1, heel_up_m=-0.06)
UP, LEFT, NO_BIAS = (0.0, 0.0, 1.0), (0.0, 1.0, 0.0), (0.0, 0.0, 0.0)

NOT_COMPILED = (
    "nothing is compiled, as numba is not installed: a sample takes about 0.3 ms, the end of a stride 10 ms"
    if PLAIN
    else ""
)
COMPILES = "pip install 'fes-gait[fast]'"


def warm_up() -> None:
    """Run the compiled core on four seconds of made-up steps, through every function that the loop may call.

    Raises:
        RuntimeError: a second run has compiled something once more, so that the loop would too: no session may begin.
    """
    _run_once()
    keep_compiled()
    before = signatures()
    _run_once()
    if signatures() != before:
        raise RuntimeError("The estimation does not stay compiled on this computer; no session may begin.")


def _run_once() -> None:
    t_ns, acc, gyr = made_up_steps()
    foot, calibration = made_up_foot(), _made_up_shank()
    shank = ShankTracker(calibration)
    for sample in zip(t_ns.tolist(), acc.tolist(), gyr.tolist(), strict=True):
        foot.step(*sample)
        shank.step(*sample)
    History(100.0).forget_half()  # what happens when its room is full, after many seconds
    span = StrideSpan(20, 60, 140, 5, quiet=True)
    solve_shank_stride(
        calibration.sensor, 1, span, t_ns, acc, gyr, ShankIntegrationSettings.for_calibration(calibration)
    )


def made_up_steps() -> tuple[IntArray, FloatArray, FloatArray]:
    """Two steps of a foot at 100 Hz: stamps (N,), specific force (N, 3) and rate (N, 3), z up and y to the left."""
    n = 400
    at = np.arange(n)
    phase = (at % 200) / 200.0
    toe_down = np.where((phase >= 0.5) & (phase < 0.65), 4.0 * np.sin((phase - 0.5) / 0.15 * np.pi), 0.0)
    toe_down = np.where((phase >= 0.65) & (phase < 0.85), -3.0 * np.sin((phase - 0.65) / 0.2 * np.pi), toe_down)
    gyr = np.column_stack((np.zeros(n), toe_down, np.zeros(n)))
    acc = np.column_stack((3.0 * toe_down, np.zeros(n), np.full(n, G_MPS2) + np.where((at % 200) == 172, 60.0, 0.0)))
    return at * 10_000_000, acc, gyr


def made_up_calibration() -> FootCalibration:
    """The calibration of such a foot."""
    return FootCalibration(
        "left_foot", 100.0, UP, LEFT, NO_BIAS, NO_BIAS, push_off_radps=4.0, fall_radps=7.0,
        stride_s=2.0, contact_jerk_mps3=2000.0, axis_confidence=1.0, strides=0, standing=True,
    )  # fmt: skip


def made_up_foot() -> FootTracker:
    """A tracker of such a foot, with known geometry."""
    calibration = made_up_calibration()
    settings = StrideSettings(forward=calibration.forward(), up=np.array(calibration.up), geometry=GEOMETRY)
    return FootTracker(calibration, StrideMaker(calibration.sensor, settings))


def _made_up_shank() -> ShankCalibration:
    arm = ArmEstimate((0.0, 0.0, 0.3), 0.3, False, "made up", math.inf, math.nan, math.inf, 0, 0)
    return ShankCalibration(
        "left_shank", 100.0, UP, LEFT, NO_BIAS, NO_BIAS, arm, axis_confidence=1.0, strides=0, standing=True
    )
