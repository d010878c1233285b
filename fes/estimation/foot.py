"""One foot from samples to phase changes and strides: the compiled core, the phase machine and the stride solver."""

from __future__ import annotations

from typing import Any

import numpy as np

from fes.estimation import kernel
from fes.estimation.calibration import FootCalibration
from fes.estimation.compiled import jit
from fes.estimation.core import core_type, new_core
from fes.estimation.history import HISTORY_S, LARGEST_VALUE, RESTART_GAP_S, History, SampleCounts
from fes.estimation.kernel import FootParameters
from fes.estimation.orientation import OrientationSettings
from fes.estimation.strides import StrideMaker
from fes.estimation.tracker import Outcome, Tracker, until_due
from fes.signals import FloatArray
from statemachine.guards import Features, Thresholds
from statemachine.phases import Phase

__all__ = ["HISTORY_S", "LARGEST_VALUE", "RESTART_GAP_S", "FootTracker", "Outcome", "SampleCounts"]

CORE = core_type(kernel.STATE, parameters=FootParameters, thresholds=Thresholds, settings=OrientationSettings)


@jit
def _advance(
    core: Any, t_ns: Any, acc: Any, gyr: Any, quaternions: Any, begin: int, end: int, due_ns: int
) -> tuple[int, int]:
    c = core[0]
    end = until_due(t_ns, begin, end, due_ns)
    return kernel.advance(
        c.state, c.parameters, c.thresholds, c.settings, t_ns, acc, gyr, begin, end, quaternions
    )  # fmt: skip


@jit
def _features(core: Any) -> Features:
    return kernel.features(core[0].state)


@jit
def _enter(core: Any, phase: int, acc: Any, row: int) -> None:
    p = core[0].parameters
    fx, fy, fz = acc[row, 0] - p.acc_bias_x_mps2, acc[row, 1] - p.acc_bias_y_mps2, acc[row, 2] - p.acc_bias_z_mps2
    kernel.enter(core[0].state, phase, fx, fy, fz)


class FootTracker(Tracker):
    """Phases and strides of one foot; deterministic, no clock, no I/O. The trace is the orientation."""

    def __init__(self, calibration: FootCalibration, strides: StrideMaker, *, swing_at_reversal: bool = False) -> None:
        super().__init__(
            calibration.sensor,
            calibration.rate_hz,
            calibration.acc_bias_mps2,
            calibration.thresholds(swing_at_reversal=swing_at_reversal),
            strides,
        )
        self._settings = OrientationSettings()
        self._gyr_bias = np.array(calibration.gyr_bias_radps)
        self._all = new_core(
            CORE, parameters=calibration.parameters(), thresholds=self._thresholds, settings=self._settings
        )
        self._state = self._all["state"][0]

    @property
    def newest_t_ns(self) -> int:
        """Time stamp of the newest sample used; 0 before the first."""
        return int(self._state["t_ns"])

    @property
    def gyr_bias_radps(self) -> FloatArray:
        """The gyroscope's bias as estimated now (3,): calibrated plus what the filter has found since."""
        return np.asarray(self._gyr_bias + self._state["bias_radps"])

    def _start(self, t_ns: int, force: FloatArray) -> None:
        fx, fy, fz = force
        kernel.start(self._state, t_ns, fx, fy, fz, self._settings)

    def _core(self, history: History, begin: int, end: int, due_ns: int) -> tuple[int, int]:
        return _advance(self._all, history.t_ns, history.acc_mps2, history.gyr_radps, history.trace, begin, end, due_ns)

    def _features(self) -> Features:
        return _features(self._all)

    def _enter(self, phase: Phase, history: History, row: int) -> None:
        _enter(self._all, phase.value, history.acc_mps2, row)
