"""One sensor from samples to phase changes and strides: what the trackers of feet and shanks have in common.

``Tracker.advance`` takes one sample when live and a whole block in analysis; the results do not depend on where the
blocks are cut.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any, Protocol, TypeAlias

import numpy as np

from fes.estimation.compiled import jit
from fes.estimation.rotation import without
from fes.signals import NS_PER_S, FloatArray, IntArray, StrideResult
from statemachine.guards import Features, Thresholds
from statemachine.machine import GaitPhaseMachine
from statemachine.phases import Phase, PhaseChange, Transition

RESTART_GAP_S = 0.25  # after a longer silence nothing is known of the phase
HISTORY_S = 20.0
BLOCK = 256  # samples taken into the history at a time: most of a longer block would be taken again at the next phase
LONG_AGO_NS, NEVER_NS = -(2**63), 2**63 - 1
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


@jit
def sift(t_ns: Any, acc: Any, gyr: Any, newest_ns: int, keep: Any) -> tuple[int, int]:
    """Mark in ``keep`` (N,) the samples to be used; how many are not finite or too large, and how many not newer.

    An unusable sample's stamp counts for nothing, or it would matter where the blocks are cut.
    """
    not_finite = not_newer = 0
    for i in range(t_ns.shape[0]):
        usable = True
        for j in range(3):  # a comparison with what is not a number is False
            usable = usable and abs(acc[i, j]) < LARGEST_VALUE and abs(gyr[i, j]) < LARGEST_VALUE
        keep[i] = usable and t_ns[i] > newest_ns
        if not usable:
            not_finite += 1
        elif t_ns[i] > newest_ns:
            newest_ns = t_ns[i]
        else:
            not_newer += 1
    return not_finite, not_newer


@jit
def stretch(t_ns: Any, n: int, gap_ns: int, due_ns: int) -> int:
    """How many of the first ``n`` samples to take: up to a silence, or to the first at which a stride is due."""
    for i in range(n):
        if t_ns[i] >= due_ns or (i + 1 < n and t_ns[i + 1] - t_ns[i] > gap_ns):
            return i + 1
    return n


class Strides(Protocol):
    """Follows the phases and closes strides; the arrays are the history up to now, free of bias.

    ``due_ns`` is when the stride under way is closed at the latest, None while there is none. ``trace`` (N, 4) is what
    the core left at each sample.
    """

    due_ns: int | None

    def restart(self, t_ns: int) -> None:
        """Data were lost; stance from now on."""

    def on_phase(self, change: PhaseChange) -> None:
        """Note a phase change, after :meth:`leave_stance` for T1."""

    def leave_stance(
        self, t_ns: IntArray, acc: FloatArray, gyr: FloatArray, trace: FloatArray, /
    ) -> StrideResult | None:
        """T1: close the stride that this stance ended."""

    def close(self, t_ns: IntArray, acc: FloatArray, gyr: FloatArray, trace: FloatArray, /) -> StrideResult | None:
        """Solve the stride that ended with this stance."""


class Tracker(ABC):
    """Phases and strides of one sensor; deterministic, no clock, no I/O."""

    def __init__(
        self,
        sensor: str,
        rate_hz: float,
        acc_bias_mps2: tuple[float, float, float],
        thresholds: Thresholds,
        strides: Strides,
    ) -> None:
        self.foot = sensor
        self.machine = GaitPhaseMachine(sensor)
        self.counts = SampleCounts()
        self._thresholds = thresholds
        self._acc_bias = np.array(acc_bias_mps2)
        self._strides = strides
        self._running = False
        capacity = max(int(HISTORY_S * rate_hz), 64)
        self._t_ns: IntArray = np.zeros(capacity, np.int64)
        self._acc: FloatArray = np.zeros((capacity, 3))
        self._gyr: FloatArray = np.zeros((capacity, 3))
        self._trace: FloatArray = np.zeros((capacity, 4))
        self._filled = 0

    @property
    def phase(self) -> Phase:
        """The gait phase now."""
        return self.machine.phase

    @property
    @abstractmethod
    def newest_t_ns(self) -> int:
        """Time stamp of the newest sample used; 0 before the first."""

    @property
    @abstractmethod
    def gyr_bias_radps(self) -> FloatArray:
        """The gyroscope's bias as estimated now (3,)."""

    @abstractmethod
    def _start(self, t_ns: int, force: FloatArray) -> None:
        """Begin the core in stance at a sample with this bias-free specific force (3,)."""

    @abstractmethod
    def _core(self, begin: int, end: int) -> tuple[int, int]:
        """Advance the core over these rows of the history; where it stopped and which transition fired (0: none)."""

    @abstractmethod
    def _features(self) -> Features:
        """What the guards saw at the newest sample."""

    @abstractmethod
    def _enter(self, phase: Phase, force: FloatArray) -> None:
        """Tell the core of a phase change at the newest sample."""

    def advance(self, t_ns: IntArray, acc_mps2: FloatArray, gyr_radps: FloatArray) -> list[Outcome]:
        """Take samples in; give back what happened, in order.

        Args:
            t_ns: (N,) the sensor's time stamps. Samples not newer than the one before, and samples that are not finite
                or beyond ``LARGEST_VALUE``, are counted and ignored.
            acc_mps2: (N, 3) specific force.
            gyr_radps: (N, 3) angular rate.
        """
        keep = np.empty(len(t_ns), np.bool_)
        newest = self.newest_t_ns if self._running else LONG_AGO_NS
        not_finite, not_newer = sift(t_ns, acc_mps2, gyr_radps, newest, keep)
        if not_finite or not_newer:
            self.counts.not_finite += not_finite
            self.counts.doubled_or_backward += not_newer
            t_ns, acc_mps2, gyr_radps = t_ns[keep], acc_mps2[keep], gyr_radps[keep]
        self.counts.used += len(t_ns)
        outcomes: list[Outcome] = []
        done = 0
        while done < len(t_ns):
            done += self._take(t_ns[done:], acc_mps2[done:], gyr_radps[done:], outcomes)
        return outcomes

    def _take(self, t_ns: IntArray, acc: FloatArray, gyr: FloatArray, outcomes: list[Outcome]) -> int:
        """Advance to the next thing that Python must handle; returns how many samples were taken."""
        if not self._running or t_ns[0] - self.newest_t_ns > RESTART_GAP_S * NS_PER_S:
            self._restart(int(t_ns[0]), acc[0], outcomes)
        if self._filled == len(self._t_ns):
            self._forget_half()
        n = min(len(t_ns), len(self._t_ns) - self._filled, BLOCK)
        due_ns = self._strides.due_ns
        n = stretch(t_ns, n, int(RESTART_GAP_S * NS_PER_S), NEVER_NS if due_ns is None else due_ns)
        begin, end = self._filled, self._filled + n
        self._t_ns[begin:end] = t_ns[:n]
        self._acc[begin:end] = acc[:n]
        self._gyr[begin:end] = gyr[:n]
        reached, number = self._core(begin, end)
        self._filled = reached
        if number:
            self._transition(Transition(number), outcomes)
        if self._strides.due_ns is not None and self.newest_t_ns >= self._strides.due_ns:
            self._stride(outcomes, self._strides.close)
        return int(reached - begin)

    def _transition(self, transition: Transition, outcomes: list[Outcome]) -> None:
        change = self.machine.fire(transition, self.newest_t_ns, self._features(), self._thresholds)
        self._enter(change.destination, self._acc[self._filled - 1] - self._acc_bias)
        if change.transition is Transition.T1:
            self._stride(outcomes, self._strides.leave_stance)
        self._strides.on_phase(change)
        outcomes.append(change)

    def _stride(self, outcomes: list[Outcome], solve: Callable[..., StrideResult | None]) -> None:
        """Hand the history, freed of bias, to the stride maker."""
        n = self._filled
        result = solve(
            self._t_ns[:n],
            without(self._acc[:n], self._acc_bias),
            without(self._gyr[:n], self.gyr_bias_radps),
            self._trace[:n],
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
        self._start(t_ns, acc - self._acc_bias)

    def _forget_half(self) -> None:
        """Make room: the older half of the history goes."""
        half = len(self._t_ns) // 2
        rest = len(self._t_ns) - half
        for column in (self._t_ns, self._acc, self._gyr, self._trace):
            column[:rest] = column[half:].copy()
        self._filled = rest
