"""One sensor from samples to phase changes and strides: what the trackers of feet and shanks have in common.

Live takes one sample at a time (:meth:`Tracker.step`), analysis whole blocks (:meth:`Tracker.advance`), by the same
way; the results do not depend on where the blocks are cut.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from struct import Struct
from typing import Any, Protocol, TypeAlias

import numpy as np

from fes.estimation.numerics.jit import jit_ieee
from fes.estimation.numerics.records import record_of
from fes.estimation.numerics.rotation import without
from fes.estimation.strides.boundaries import rows_before
from fes.estimation.tracking.history import HISTORY_S, LARGEST_VALUE, RESTART_GAP_S, History, SampleCounts
from fes.signals import FloatArray, IntArray, StrideResult, Vector3
from statemachine.guards import Features, Thresholds
from statemachine.machine import GaitPhaseMachine
from statemachine.phases import Phase, PhaseChange, Transition

__all__ = [
    "HISTORY_S", "LARGEST_VALUE", "RESTART_GAP_S", "Outcome", "SampleCounts", "Strides", "Tracker", "until_due",
]  # fmt: skip

NEVER_NS = 2**63 - 1
TRANSITIONS = tuple(Transition)  # by number
ONE = np.dtype(  # a sample; where something happens at it also its row, and what the guards saw
    [
        ("t_ns", np.int64),
        ("acc", np.float64, 3),
        ("gyr", np.float64, 3),
        ("row", np.int64),
        ("seen", record_of(Features)),
    ],
    align=True,
)
# by assignment to the fields, or from them, it would take three times as long
PACK_ONE, UNPACK_ONE = Struct("=q6d").pack_into, Struct("=q48xq2?6x7d").unpack_from

Outcome: TypeAlias = PhaseChange | StrideResult


@jit_ieee
def until_due(t_ns: Any, begin: int, end: int, due_ns: int) -> int:
    """Where a run over the rows ``begin`` … ``end - 1`` must stop: behind the first at which a stride is due."""
    if t_ns[end - 1] < due_ns:
        return end
    while t_ns[begin] < due_ns:
        begin += 1
    return begin + 1


def of_one_kind(t_ns: IntArray, acc: FloatArray, gyr: FloatArray) -> tuple[IntArray, FloatArray, FloatArray]:
    """Samples as one kind of array: for any other the core would be compiled once more."""
    return (
        np.require(t_ns, np.int64, ("C", "W")),
        np.require(acc, np.float64, ("C", "W")),
        np.require(gyr, np.float64, ("C", "W")),
    )


class Outcomes(Protocol):
    """Where outcomes go, in order."""

    def append(self, outcome: Outcome, /) -> None:
        """Take one more."""


class Strides(Protocol):
    """Follows the phases and closes strides; the arrays are the history since ``since_ns``, free of bias.

    ``trace`` (N, 4) is what the core left at each sample.
    """

    @property
    def due_ns(self) -> int | None:
        """When the stride under way is closed at the latest, None while there is none."""

    @property
    def since_ns(self) -> int:
        """Of the history only what is newer is asked for."""

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
        self, sensor: str, rate_hz: float, acc_bias_mps2: Vector3, thresholds: Thresholds, strides: Strides
    ) -> None:
        self.foot = sensor
        self.machine = GaitPhaseMachine(sensor)
        self._thresholds = thresholds
        self._acc_bias = np.array(acc_bias_mps2)
        self._strides = strides
        self._history = History(rate_hz)
        self._reached = 0  # rows of the history that the core has seen
        self._restarts = 0
        self._one = np.zeros(1, ONE)
        self._one_bytes = self._one.view(np.uint8).data

    @property
    def phase(self) -> Phase:
        """The gait phase now."""
        return self.machine.phase

    @property
    def counts(self) -> SampleCounts:
        """What became of the samples so far."""
        return self._history.counts(self._restarts)

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
    def _core(self, history: History, begin: int, end: int, due_ns: int) -> tuple[int, int]:
        """Advance the core over these rows, at most to the first at ``due_ns``; where it stopped, which transition
        fired (0: none)."""

    @abstractmethod
    def _features(self) -> Features:
        """What the guards saw at the newest sample."""

    @abstractmethod
    def _enter(self, phase: Phase, history: History, row: int) -> None:
        """Tell the core of a phase change at the newest sample, which is this row."""

    def step(self, t_ns: int, acc_mps2: Vector3, gyr_radps: Vector3) -> list[Outcome]:
        """Take one sample in, as :meth:`advance` does a block of one."""
        PACK_ONE(self._one_bytes, 0, t_ns, *acc_mps2, *gyr_radps)
        outcomes: list[Outcome] = []
        self._take(self._one["t_ns"], self._one["acc"], self._one["gyr"], outcomes)
        return outcomes

    def advance(self, t_ns: IntArray, acc_mps2: FloatArray, gyr_radps: FloatArray) -> list[Outcome]:
        """Take samples in; give back what happened, in order.

        Args:
            t_ns: (N,) the sensor's time stamps. Samples not newer than the one before, and samples that are not finite
                or beyond ``LARGEST_VALUE``, are counted and ignored.
            acc_mps2: (N, 3) specific force.
            gyr_radps: (N, 3) angular rate.
        """
        outcomes: list[Outcome] = []
        self._take(*of_one_kind(t_ns, acc_mps2, gyr_radps), outcomes)
        return outcomes

    def _take(self, t_ns: IntArray, acc: FloatArray, gyr: FloatArray, outcomes: Outcomes) -> None:
        taken, self._reached = 0, self._history.filled
        while taken < len(t_ns):
            taken, filled, silence = self._history.take_in(t_ns, acc, gyr, taken)
            while self._reached < filled:
                self._follow(filled, outcomes)
            if silence:
                self._restart(int(t_ns[taken]), acc[taken], outcomes)
            elif taken < len(t_ns):
                self._reached = self._history.forget_half()

    def _follow(self, filled: int, outcomes: Outcomes) -> None:
        """Advance to the next thing that Python must handle."""
        due_ns = self._strides.due_ns
        latest_ns = NEVER_NS if due_ns is None else due_ns
        self._reached, number = self._core(self._history, self._reached, filled, latest_ns)
        if number:
            self._transition(TRANSITIONS[number], outcomes)
            due_ns = self._strides.due_ns
        if due_ns is not None and self._history.t_ns[self._reached - 1] >= due_ns:
            self._stride(outcomes, self._strides.close)

    def _transition(self, transition: Transition, outcomes: Outcomes) -> None:
        row = self._reached - 1
        change = self.machine.fire(transition, int(self._history.t_ns[row]), self._features(), self._thresholds)
        self._enter(change.destination, self._history, row)
        if transition is Transition.T1:
            self._stride(outcomes, self._strides.leave_stance)
        self._strides.on_phase(change)
        outcomes.append(change)

    def _stride(self, outcomes: Outcomes, solve: Callable[..., StrideResult | None]) -> None:
        """Hand the history, freed of bias, to the stride maker."""
        history = self._history
        rows = slice(rows_before(history.t_ns, self._reached, self._strides.since_ns), self._reached)
        result = solve(
            history.t_ns[rows],
            without(history.acc_mps2[rows], self._acc_bias),
            without(history.gyr_radps[rows], self.gyr_bias_radps),
            history.trace[rows],
        )
        if result is not None:
            outcomes.append(result)

    def _restart(self, t_ns: int, acc: FloatArray, outcomes: Outcomes) -> None:
        """Begin anew in stance; what was under way is dropped."""
        if self._history.restart(t_ns):
            self._restarts += 1
            outcomes.append(self.machine.restart(t_ns))
        self._reached = 0
        self._strides.restart(t_ns)
        self._start(t_ns, acc - self._acc_bias)
