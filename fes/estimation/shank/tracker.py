"""One shank from samples to phase changes and strides: its own features, the foot's machine and guards.

The same interface as :class:`fes.estimation.foot.tracker.FootTracker`. The phases mean the same: pre-swing begins when
the ankle lifts, swing at foot-off, loading response at contact, stance when the shank turns slowly over a still ankle.
A stride is Wu et al.'s, from the quietest instant of one stance to the next, reset to ``v = w × r`` there.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from fes.estimation.numerics.jit import jit
from fes.estimation.numerics.records import core_type, new_core
from fes.estimation.shank import features as shank_kernel
from fes.estimation.shank.calibration import ShankCalibration
from fes.estimation.shank.features import ShankParameters
from fes.estimation.shank.motion import FINE_WINDOW_PER_STRIDE, FINE_WINDOW_S, StrideSpan
from fes.estimation.shank.strides import ShankIntegrationSettings, solve_shank_stride
from fes.estimation.tracking.history import History
from fes.estimation.tracking.tracker import Tracker, until_due
from fes.signals import NS_PER_S, FloatArray, IntArray, StrideResult
from statemachine.guards import Features, Thresholds
from statemachine.phases import Phase, PhaseChange

STANCE_SEARCH_S = 1.0  # of a long stance only the second next to the swing is searched
MARGIN_NS = NS_PER_S  # before a stride: more than half of any fine window
USUAL_STRIDE_S = 1.2  # before one has been seen
QUIET_LEANS = 1.5  # a stance is quiet when its rate is at most this many times the level of rest
MOST_LEAN_CHANGE_RAD = math.radians(20)  # a leg that leans otherwise than before has been put elsewhere, not stepped
PUT_ELSEWHERE = "the shank leans {0:.0f}° otherwise than at its start: a leg moved, not a stride"


@dataclass(frozen=True, slots=True)
class ShankStrideSettings:
    """How strides of one shank are integrated, and which of them count as walking."""

    ankle: ShankIntegrationSettings
    quiet_radps: float
    rate_hz: float
    most_lean_change_rad: float = MOST_LEAN_CHANGE_RAD

    @staticmethod
    def of(calibration: ShankCalibration, *, equal_height: bool | None = None) -> ShankStrideSettings:
        """The settings that a calibration leads to; ``equal_height`` overrules what it says of the ground."""
        return ShankStrideSettings(
            ShankIntegrationSettings.of(calibration, equal_height=equal_height),
            QUIET_LEANS * calibration.levels.rest_lean_radps,
            calibration.rate_hz,
        )


class ShankStrideMaker:
    """Follows the phases of one shank and closes a stride when the stance after its swing is over, or a second old."""

    def __init__(self, sensor: str, settings: ShankStrideSettings) -> None:
        self.sensor = sensor
        self.due_ns: int | None = None
        self._settings = settings
        self._number = 0
        self._start_ns: int | None = None
        self._stance_ns = 0
        self._stride_s = USUAL_STRIDE_S
        self._times: dict[Phase, int] = {}

    @property
    def since_ns(self) -> int:
        """Of the history only what is newer is asked for: the stride and the stances around it."""
        return (self._stance_ns if self._start_ns is None else min(self._start_ns, self._stance_ns)) - MARGIN_NS

    def restart(self, t_ns: int) -> None:
        """Data were lost: forget the stride under way; stance from now on."""
        self.due_ns, self._start_ns, self._stance_ns, self._times = None, None, t_ns, {}

    def on_phase(self, change: PhaseChange) -> None:
        """Note a phase change (after :meth:`leave_stance` for T1)."""
        if change.destination is not Phase.STANCE:
            self._times[change.destination] = change.t_ns
            return
        self._stance_ns = change.t_ns
        if Phase.SWING in self._times:
            self._times[Phase.STANCE] = change.t_ns
            self.due_ns = change.t_ns + int(STANCE_SEARCH_S * NS_PER_S)
        else:  # the heel was lifted and put back: no stride
            self._times = {}

    def leave_stance(self, t_ns: IntArray, acc: FloatArray, gyr: FloatArray, trace: FloatArray) -> StrideResult | None:
        """T1: close the stride that this stance ended; the next begins at the quietest instant of the stance."""
        result = self.close(t_ns, acc, gyr, trace) if self.due_ns is not None else None
        earliest = max(self._stance_ns, int(t_ns[-1]) - int(STANCE_SEARCH_S * NS_PER_S))
        self._start_ns = int(t_ns[self._quietest(t_ns, gyr, earliest)])
        self._times = {}
        return result

    def close(self, t_ns: IntArray, acc: FloatArray, gyr: FloatArray, trace: FloatArray) -> StrideResult | None:
        """Solve the stride that ended with this stance.

        History up to now: ``t_ns`` (N,); ``acc`` (N, 3) m/s² and ``gyr`` (N, 3) rad/s, free of bias; ``trace`` (N, 4)
        of the core.
        """
        times, self._times, self.due_ns = self._times, {}, None
        start_ns, self._start_ns = self._start_ns, None
        if start_ns is None or Phase.STANCE not in times:
            return None
        half = self._half()
        last = self._quietest(t_ns, gyr, self._stance_ns)
        first = int(np.searchsorted(t_ns, start_ns))
        self._number += 1
        if first < half or first >= last or last + half >= len(t_ns) or t_ns[first] != start_ns:
            return None  # the first stride after a start or a silence has no stance before it
        self._stride_s = min(max(1e-9 * float(t_ns[last] - start_ns), 0.5), 3.0)
        lean = np.abs(trace[:, 0])
        quiet = all(float(lean[k - half : k + half + 1].mean()) <= self._settings.quiet_radps for k in (first, last))
        swing = int(np.searchsorted(t_ns, times[Phase.SWING]))
        result = solve_shank_stride(
            self.sensor, self._number, StrideSpan(first, swing, last, half, quiet), t_ns, acc, gyr, self._settings.ankle
        )
        result = replace(
            result,
            t_pre_swing_ns=times.get(Phase.PRE_SWING),
            t_swing_ns=times.get(Phase.SWING),
            t_loading_response_ns=times.get(Phase.LOADING_RESPONSE),
            t_stance_ns=times.get(Phase.STANCE),
        )
        return self._judged(result)

    def _judged(self, result: StrideResult) -> StrideResult:
        """A leg that is moved while its owner sits is no stride, whatever way its ankle goes."""
        if not result.valid:
            return result
        change = float(result.pitch_rad[-1])
        if abs(change) > self._settings.most_lean_change_rad:
            return replace(result, valid=False, reason=PUT_ELSEWHERE.format(abs(math.degrees(change))))
        return result

    def _half(self) -> int:
        """Half the width of the fine windows, in samples."""
        return max(round(0.5 * self._settings.rate_hz * min(FINE_WINDOW_S, FINE_WINDOW_PER_STRIDE * self._stride_s)), 1)

    def _quietest(self, t_ns: IntArray, gyr: FloatArray, earliest_ns: int) -> int:
        """Index of the middle of the fine window with the least gyroscope energy since a time, as far as it is over."""
        half = self._half()
        begin = max(int(np.searchsorted(t_ns, earliest_ns)), half)
        latest = len(t_ns) - 1 - half
        if latest <= begin:
            return max(min(begin, latest), 0)
        part = gyr[begin - half : latest + half + 1]
        energy = np.cumsum(np.concatenate(([0.0], np.einsum("ij,ij->i", part, part))))
        window = 2 * half + 1
        return int(begin + np.argmin(energy[window:] - energy[:-window]))


CORE = core_type(shank_kernel.STATE, parameters=ShankParameters, thresholds=Thresholds)


@jit
def _advance(
    core: Any, t_ns: Any, acc: Any, gyr: Any, trace: Any, begin: int, end: int, due_ns: int
) -> tuple[int, int]:
    c = core[0]
    end = until_due(t_ns, begin, end, due_ns)
    return shank_kernel.advance(c.state, c.parameters, c.thresholds, t_ns, acc, gyr, begin, end, trace)


@jit
def _features(core: Any) -> Features:
    return shank_kernel.features(core[0].state)


@jit
def _enter(core: Any, phase: int) -> None:
    shank_kernel.enter(core[0].state, phase)


class ShankTracker(Tracker):
    """Phases and strides of one shank; deterministic, no clock, no I/O."""

    def __init__(
        self, calibration: ShankCalibration, strides: ShankStrideMaker, *, swing_at_reversal: bool = False
    ) -> None:
        super().__init__(
            calibration.sensor,
            calibration.rate_hz,
            calibration.acc_bias_mps2,
            calibration.levels.thresholds(swing_at_reversal=swing_at_reversal),
            strides,
        )
        self._gyr_bias = np.array(calibration.gyr_bias_radps)
        self._all = new_core(CORE, parameters=calibration.parameters(), thresholds=self._thresholds)
        self._state = self._all["state"][0]

    @property
    def newest_t_ns(self) -> int:
        """Time stamp of the newest sample used; 0 before the first."""
        return int(self._state["t_ns"])

    @property
    def gyr_bias_radps(self) -> FloatArray:
        """The gyroscope's bias (3,), as calibrated."""
        return self._gyr_bias

    def _start(self, t_ns: int, force: FloatArray) -> None:
        fx, fy, fz = force
        shank_kernel.start(self._state, t_ns, fx, fy, fz)

    def _core(self, history: History, begin: int, end: int, due_ns: int) -> tuple[int, int]:
        return _advance(self._all, history.t_ns, history.acc_mps2, history.gyr_radps, history.trace, begin, end, due_ns)

    def _features(self) -> Features:
        return _features(self._all)

    def _enter(self, phase: Phase, history: History, row: int) -> None:
        _enter(self._all, phase.value)


def shank_tracker(
    calibration: ShankCalibration, *, equal_height: bool | None = None, swing_at_reversal: bool = False
) -> ShankTracker:
    """A tracker with the settings that a calibration leads to."""
    maker = ShankStrideMaker(calibration.sensor, ShankStrideSettings.of(calibration, equal_height=equal_height))
    return ShankTracker(calibration, maker, swing_at_reversal=swing_at_reversal)
