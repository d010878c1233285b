"""One sensor from samples to phase changes and strides: what the trackers of feet and shanks have in common.

Live takes one sample at a time (:meth:`Tracker.step`), analysis whole blocks (:meth:`Tracker.advance`); the results do
not depend on where the blocks are cut.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, TypeAlias

import numpy as np

from fes.estimation.numerics.jit import jit_ieee
from fes.estimation.numerics.records import Vec, record_of, record_type, struct_of
from fes.estimation.tracking.history import COUNTERS, History, SampleCounts
from fes.signals import FloatArray, IntArray, StrideResult, Vector3
from statemachine.guards import Features, Thresholds
from statemachine.machine import GaitPhaseMachine
from statemachine.phases import Phase, PhaseChange, Transition

NEVER_NS = 2**63 - 1
TRANSITIONS = tuple(Transition)  # by number
SAMPLE = record_type(  # where something happens at it also its row in the history, and what the guards saw
    [
        ("t_ns", np.int64),
        ("acc", np.float64, 3),
        ("gyr", np.float64, 3),
        ("row", np.int64),
        ("seen", record_of(Features)),
    ]
)
pack_sample = struct_of(SAMPLE, "t_ns", "acc", "gyr").pack_into
unpack_seen = struct_of(SAMPLE, "t_ns", "row", "seen").unpack_from

Outcome: TypeAlias = PhaseChange | StrideResult


def live_type(core: np.dtype[Any], **more: np.dtype[Any]) -> np.dtype[Any]:
    """All that a live step needs beside the history: as arrays of their own it would take twice as long as its work."""
    return record_type([("sample", SAMPLE), ("core", core), ("counters", COUNTERS), *more.items()])


@jit_ieee
def until_due(t_ns: Vec, begin: int, end: int, due_ns: int) -> int:
    """Where a run over the rows ``begin`` … ``end - 1`` must stop: behind the first at which a stride is due."""
    if t_ns[end - 1] < due_ns:
        return end
    while t_ns[begin] < due_ns:
        begin += 1
    return begin + 1


class Tracker(ABC):
    """Phases and strides of one sensor; deterministic, no clock, no I/O.

    ``live`` (1,) of :func:`live_type` is all that evolves beside the history.
    """

    def __init__(self, sensor: str, rate_hz: float, thresholds: Thresholds, live: Vec) -> None:
        self.foot = sensor
        self.machine = GaitPhaseMachine(sensor)
        self._thresholds = thresholds
        self._history = History(rate_hz, live["counters"])
        self._restarts = 0
        self._sample, self._core, self._state = live["sample"], live["core"], live["core"]["state"][0]
        self._bytes = live.view(np.uint8).data

    @property
    def phase(self) -> Phase:
        """The gait phase now."""
        return self.machine.phase

    @property
    def counts(self) -> SampleCounts:
        """What became of the samples so far."""
        return self._history.counts(self._restarts)

    @property
    def newest_t_ns(self) -> int:
        """Time stamp of the newest sample used; 0 before the first."""
        return int(self._state["t_ns"])

    @property
    @abstractmethod
    def gyr_bias_radps(self) -> FloatArray:
        """The gyroscope's bias as estimated now (3,)."""

    @abstractmethod
    def step(self, t_ns: int, acc_mps2: Vector3, gyr_radps: Vector3) -> list[Outcome]:
        """Take one sample in, as :meth:`advance` does a block of one."""

    @abstractmethod
    def advance(self, t_ns: IntArray, acc_mps2: FloatArray, gyr_radps: FloatArray) -> list[Outcome]:
        """Take samples in; give back what happened, in order.

        Args:
            t_ns: (N,) the sensor's time stamps. Samples not newer than the one before, and samples that are not finite
                or beyond ``LARGEST_VALUE``, are counted and ignored.
            acc_mps2: (N, 3) specific force.
            gyr_radps: (N, 3) angular rate.
        """

    def _restart(self, t_ns: int) -> list[PhaseChange]:
        """Begin anew in stance with the sample of this time: the change, if there was anything before."""
        if not self._history.restart(t_ns):
            return []
        self._restarts += 1
        return [self.machine.restart(t_ns)]
