"""One foot from samples to phase changes and strides: the compiled core, the phase machine and the stride solver."""

from __future__ import annotations

import numpy as np

from fes.estimation import kernel
from fes.estimation.calibration import FootCalibration
from fes.estimation.orientation import OrientationSettings
from fes.estimation.strides import StrideMaker
from fes.estimation.tracker import HISTORY_S, LARGEST_VALUE, RESTART_GAP_S, Outcome, SampleCounts, Tracker
from fes.signals import FloatArray
from statemachine.guards import Features
from statemachine.phases import Phase

__all__ = ["HISTORY_S", "LARGEST_VALUE", "RESTART_GAP_S", "FootTracker", "Outcome", "SampleCounts"]


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
        self._parameters = calibration.parameters()
        self._settings = OrientationSettings()
        self._gyr_bias = np.array(calibration.gyr_bias_radps)
        self._state = np.zeros(1, kernel.STATE)[0]

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

    def _core(self, begin: int, end: int) -> tuple[int, int]:
        return kernel.advance(
            self._state,
            self._parameters,
            self._thresholds,
            self._settings,
            self._t_ns,
            self._acc,
            self._gyr,
            begin,
            end,
            self._trace,
        )

    def _features(self) -> Features:
        return kernel.features(self._state)

    def _enter(self, phase: Phase, force: FloatArray) -> None:
        kernel.enter(self._state, int(phase), *force)
