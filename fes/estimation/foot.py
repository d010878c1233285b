"""One foot from samples to phase changes and strides: the compiled core, the phase machine and the stride solver.

``FootTracker.advance`` takes one sample when live and a whole block in analysis; the results do not depend on where the
blocks are cut.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import TypeAlias

import numpy as np

from fes.estimation import kernel
from fes.estimation.calibration import FootCalibration
from fes.estimation.orientation import OrientationSettings
from fes.estimation.strides import StrideMaker
from fes.signals import NS_PER_S, FloatArray, IntArray, StrideResult
from statemachine.machine import GaitPhaseMachine
from statemachine.phases import Phase, PhaseChange, Transition

RESTART_GAP_S = 0.25  # after a longer silence nothing is known of the phase
HISTORY_S = 20.0
LARGEST_VALUE = 1e4  # m/s² and rad/s: beyond any sensor, and one such value would spoil the orientation for good

Outcome: TypeAlias = PhaseChange | StrideResult


@dataclass(slots=True)
class SampleCounts:
    """What became of the samples."""

    used: int = 0
    doubled_or_backward: int = 0
    not_finite: int = 0
    restarts: int = 0

    def to_dict(self) -> dict[str, int]:
        """For the session log."""
        return asdict(self)


class FootTracker:
    """Phases and strides of one foot; deterministic, no clock, no I/O."""

    def __init__(self, calibration: FootCalibration, strides: StrideMaker, *, swing_at_reversal: bool = False) -> None:
        self.foot = calibration.sensor
        self.machine = GaitPhaseMachine(self.foot)
        self.counts = SampleCounts()
        self._parameters = calibration.parameters()
        self._thresholds = calibration.thresholds(swing_at_reversal=swing_at_reversal)
        self._settings = OrientationSettings()
        self._acc_bias = np.array(calibration.acc_bias_mps2)
        self._gyr_bias = np.array(calibration.gyr_bias_radps)
        self._strides = strides
        self._state = np.zeros(1, kernel.STATE)[0]
        self._running = False
        capacity = max(int(HISTORY_S * calibration.rate_hz), 64)
        self._t_ns: IntArray = np.zeros(capacity, np.int64)
        self._acc: FloatArray = np.zeros((capacity, 3))
        self._gyr: FloatArray = np.zeros((capacity, 3))
        self._quaternion: FloatArray = np.zeros((capacity, 4))
        self._filled = 0

    @property
    def phase(self) -> Phase:
        """The gait phase now."""
        return self.machine.phase

    @property
    def newest_t_ns(self) -> int:
        """Time stamp of the newest sample used; 0 before the first."""
        return int(self._state["t_ns"])

    @property
    def gyr_bias_radps(self) -> FloatArray:
        """The gyroscope's bias as estimated now (3,): calibrated plus what the filter has found since."""
        return np.asarray(self._gyr_bias + self._state["bias_radps"])

    def advance(self, t_ns: IntArray, acc_mps2: FloatArray, gyr_radps: FloatArray) -> list[Outcome]:
        """Take samples in; give back what happened, in order.

        Args:
            t_ns: (N,) the sensor's time stamps. Samples not newer than the one before, and samples that are not finite
                or beyond ``LARGEST_VALUE``, are counted and ignored.
            acc_mps2: (N, 3) specific force.
            gyr_radps: (N, 3) angular rate.
        """
        long_ago = np.iinfo(np.int64).min
        newest = self.newest_t_ns if self._running else long_ago
        usable = (np.abs(acc_mps2) < LARGEST_VALUE).all(axis=1) & (np.abs(gyr_radps) < LARGEST_VALUE).all(axis=1)
        # an unusable sample's stamp counts for nothing, or it would matter where the blocks are cut
        stamps = np.where(usable, t_ns, long_ago)
        newer = t_ns > np.maximum.accumulate(np.concatenate(([newest], stamps)))[:-1]
        self.counts.not_finite += int(np.count_nonzero(~usable))
        self.counts.doubled_or_backward += int(np.count_nonzero(usable & ~newer))
        keep = usable & newer
        if not keep.all():
            t_ns, acc_mps2, gyr_radps = t_ns[keep], acc_mps2[keep], gyr_radps[keep]
        self.counts.used += len(t_ns)
        outcomes: list[Outcome] = []
        done = 0
        while done < len(t_ns):
            done += self._take(t_ns[done:], acc_mps2[done:], gyr_radps[done:], outcomes)
        return outcomes

    def _take(self, t_ns: IntArray, acc: FloatArray, gyr: FloatArray, outcomes: list[Outcome]) -> int:
        """Advance to the next thing that Python must handle; returns how many samples were taken."""
        if not self._running or t_ns[0] - self._state["t_ns"] > RESTART_GAP_S * NS_PER_S:
            self._restart(int(t_ns[0]), acc[0], outcomes)
        if self._filled == len(self._t_ns):
            self._forget_half()
        n = min(len(t_ns), len(self._t_ns) - self._filled)
        # stop at silences, and where a stride is due although the stance goes on
        silent = np.flatnonzero(np.diff(t_ns[:n]) > RESTART_GAP_S * NS_PER_S)
        if len(silent):
            n = int(silent[0]) + 1
        due_ns = self._strides.due_ns
        if due_ns is not None:
            n = min(n, int(np.searchsorted(t_ns[:n], due_ns)) + 1)
        begin, end = self._filled, self._filled + n
        self._t_ns[begin:end] = t_ns[:n]
        self._acc[begin:end] = acc[:n]
        self._gyr[begin:end] = gyr[:n]
        reached, number = kernel.advance(
            self._state,
            self._parameters,
            self._thresholds,
            self._settings,
            self._t_ns,
            self._acc,
            self._gyr,
            begin,
            end,
            self._quaternion,
        )
        self._filled = reached
        if number:
            self._transition(Transition(number), outcomes)
        if self._strides.due_ns is not None and self.newest_t_ns >= self._strides.due_ns:
            self._stride(outcomes, self._strides.close)
        return int(reached - begin)

    def _transition(self, transition: Transition, outcomes: list[Outcome]) -> None:
        t_ns = self.newest_t_ns
        change = self.machine.fire(transition, t_ns, kernel.features(self._state), self._thresholds)
        force = self._acc[self._filled - 1] - self._acc_bias
        kernel.enter(self._state, int(change.destination), *force)
        if change.transition is Transition.T1:
            self._stride(outcomes, self._strides.leave_stance)
        self._strides.on_phase(change)
        outcomes.append(change)

    def _stride(self, outcomes: list[Outcome], solve: Callable[..., StrideResult | None]) -> None:
        """Hand the history, freed of bias, to the stride maker."""
        n = self._filled
        result = solve(
            self._t_ns[:n], self._acc[:n] - self._acc_bias, self._gyr[:n] - self.gyr_bias_radps, self._quaternion[:n]
        )
        if result is not None:
            outcomes.append(result)

    def _restart(self, t_ns: int, acc: FloatArray, outcomes: list[Outcome]) -> None:
        """Begin anew in stance; what was under way is dropped."""
        if self._running:
            self.counts.restarts += 1
            outcomes.append(self.machine.restart(t_ns))
        self._running = True
        self._filled = 0
        self._strides.restart(t_ns)
        fx, fy, fz = acc - self._acc_bias
        kernel.start(self._state, t_ns, fx, fy, fz, self._settings)

    def _forget_half(self) -> None:
        """Make room: the older half of the history goes."""
        half = len(self._t_ns) // 2
        rest = len(self._t_ns) - half
        for column in (self._t_ns, self._acc, self._gyr, self._quaternion):
            column[:rest] = column[half:].copy()
        self._filled = rest
