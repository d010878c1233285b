"""One sensor from samples to phase changes and strides: what the trackers of feet and shanks have in common.

Live takes one sample at a time (:meth:`Tracker.step`), analysis whole blocks (:meth:`Tracker.advance`); the results do
not depend on where the blocks are cut.

The last twenty seconds of one sensor: which samples are used, and where strides find them later.
"""

from abc import ABC, abstractmethod
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from fes.estimation.numerics.jit import inlined, jit_ieee
from fes.estimation.numerics.records import Mat, Record, Vec, fill, handed, record_type, struct_of
from fes.estimation.tracking.phase_features import MEASURES, features_in
from fes.signals import FloatArray, IntArray, StrideResult, Vector3
from statemachine.guards import Features, Thresholds
from statemachine.machine import GaitPhaseMachine
from statemachine.phases import Phase, PhaseChange, Transition

RESTART_GAP_S = 0.25  # after a longer silence nothing is known of the phase
RESTART_GAP_NS = round(1e9 * RESTART_GAP_S)
HISTORY_S = 20.0
LARGEST_VALUE = 1e4  # m/s² and rad/s: beyond any sensor, and one such value would spoil the orientation for good
LONG_AGO_NS = -(2**63)

COUNTED = ("newest_ns", "filled", "used", "doubled_or_backward", "not_finite")
COUNTERS = record_type([("running", np.bool_), *((name, np.int64) for name in COUNTED)])


class HistoryArrays(NamedTuple):
    """Samples as measured, oldest first, and beside each what the core left there."""

    t_ns: Vec  # (N,)
    acc: Mat  # (N, 3) m/s²
    gyr: Mat  # (N, 3) rad/s
    trace: Mat  # (N, 4)


class Samples(NamedTuple):
    """Samples as measured, strictly increasing or not."""

    t_ns: Vec  # (N,)
    acc: Mat  # (N, 3) m/s²
    gyr: Mat  # (N, 3) rad/s


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


KEPT, NOT_FINITE, NOT_NEWER, SILENCE, FULL = range(5)  # what became of a sample


@inlined
def sample_outcome(
    running: bool, newest_ns: int, filled: int, room: int, t_ns: int,
    ax: float, ay: float, az: float, gx: float, gy: float, gz: float,
) -> int:  # fmt: skip
    """What becomes of a sample where ``filled`` of ``room`` rows are, the last of ``newest_ns``.

    An unusable sample's stamp counts for nothing, or it would matter where the blocks are cut.
    """
    outcome = KEPT
    usable = (abs(ax) < LARGEST_VALUE) & (abs(ay) < LARGEST_VALUE) & (abs(az) < LARGEST_VALUE)
    usable &= (abs(gx) < LARGEST_VALUE) & (abs(gy) < LARGEST_VALUE) & (abs(gz) < LARGEST_VALUE)
    if not usable:  # a comparison with what is not a number is False
        outcome = NOT_FINITE
    elif running and t_ns <= newest_ns:
        outcome = NOT_NEWER
    elif not running or not 0 < t_ns - newest_ns <= RESTART_GAP_NS:  # stamps so far apart that this overflows
        outcome = SILENCE
    elif filled == room:
        outcome = FULL
    return outcome


@jit_ieee
def store_sample(counters: Record, t_ns: Vec, acc: Mat, gyr: Mat, sample: Record) -> int:
    """Copy one sample into the history (N,), (N, 3), or say why not: ``SILENCE`` and ``FULL`` are the caller's."""
    n, now_ns, f, w = counters.filled, sample.t_ns, sample.acc, sample.gyr
    ax, ay, az, gx, gy, gz = f[0], f[1], f[2], w[0], w[1], w[2]
    outcome = sample_outcome(counters.running, counters.newest_ns, n, t_ns.shape[0], now_ns, ax, ay, az, gx, gy, gz)
    if outcome == KEPT:
        counters.newest_ns = now_ns
        counters.filled = n + 1
        counters.used += 1
        t_ns[n] = now_ns
        acc[n, 0], acc[n, 1], acc[n, 2] = ax, ay, az
        gyr[n, 0], gyr[n, 1], gyr[n, 2] = gx, gy, gz
    elif outcome == NOT_FINITE:
        counters.not_finite += 1
    elif outcome == NOT_NEWER:
        counters.doubled_or_backward += 1
    return outcome


@jit_ieee
def store_samples(counters: Record, history: HistoryArrays, samples: Samples, begin: int) -> tuple[int, int]:
    """Copy the samples from ``begin`` on, as :func:`store_sample` would; see :meth:`History.store`.

    Returns the first sample not yet seen to, and why: ``SILENCE`` and ``FULL`` are the caller's to see to, ``KEPT``
    says that there is no more. What evolves is kept out of the record meanwhile, or it would be written at every
    sample.
    """
    kept_t_ns, kept_acc, kept_gyr, _ = history
    t_ns, acc, gyr = samples
    n, i, outcome = t_ns.shape[0], begin, KEPT
    filled, newest_ns, running, room = counters.filled, counters.newest_ns, counters.running, kept_t_ns.shape[0]
    before = filled
    while i < n:
        now_ns, ax, ay, az, gx, gy, gz = t_ns[i], acc[i, 0], acc[i, 1], acc[i, 2], gyr[i, 0], gyr[i, 1], gyr[i, 2]
        outcome = sample_outcome(running, newest_ns, filled, room, now_ns, ax, ay, az, gx, gy, gz)
        if outcome == KEPT:
            newest_ns = now_ns
            kept_t_ns[filled] = now_ns
            kept_acc[filled, 0], kept_acc[filled, 1], kept_acc[filled, 2] = ax, ay, az
            kept_gyr[filled, 0], kept_gyr[filled, 1], kept_gyr[filled, 2] = gx, gy, gz
            filled += 1
        elif outcome == NOT_FINITE:
            counters.not_finite += 1
        elif outcome == NOT_NEWER:
            counters.doubled_or_backward += 1
        else:
            break
        i += 1
    counters.filled, counters.newest_ns = filled, newest_ns
    counters.used += filled - before
    return i, outcome if i < n else KEPT


@jit_ieee
def forget_half(counters: Record, history: HistoryArrays) -> None:
    """As :meth:`History.forget_half`."""
    t_ns, acc, gyr, trace = history
    n = t_ns.shape[0]
    half = n // 2
    for i in range(half, n):
        k = i - half
        t_ns[k] = t_ns[i]
        for j in range(3):
            acc[k, j] = acc[i, j]
            gyr[k, j] = gyr[i, j]
        for j in range(4):
            trace[k, j] = trace[i, j]
    counters.filled = n - half


class History:
    """The arrays of one sensor's history; ``counters`` (1,) of ``COUNTERS`` say how many of their rows are filled."""

    def __init__(self, rate_hz: float, counters: Vec | None = None) -> None:
        n = max(int(HISTORY_S * rate_hz), 64)
        self.arrays = HistoryArrays(np.zeros(n, np.int64), np.zeros((n, 3)), np.zeros((n, 3)), np.zeros((n, 4)))
        self.counters = np.zeros(1, COUNTERS) if counters is None else counters

    @property
    def filled(self) -> int:
        """How many rows are filled."""
        return int(self.counters["filled"][0])

    def counts(self, restarts: int) -> SampleCounts:
        """What became of the samples so far."""
        _, _, _, used, doubled_or_backward, not_finite = self.counters[0].tolist()
        return SampleCounts(used, doubled_or_backward, not_finite, restarts)

    def store(self, samples: Samples, begin: int) -> tuple[int, int]:
        """Copy the samples from ``begin`` on, up to a silence or until there is no room.

        Samples not newer than the one before, and samples that are not finite or beyond ``LARGEST_VALUE``, are counted
        and passed over. Returns the first sample not yet seen to, and why: ``KEPT`` where there is no more; ``SILENCE``
        where that sample comes after one, as the first of all does: then :meth:`restart` first; ``FULL``:
        :meth:`forget_half` first.
        """
        stored, outcome = store_samples(self.counters[0], self.arrays, samples, begin)
        return int(stored), int(outcome)

    def restart(self, t_ns: int) -> bool:
        """Forget everything; the next sample is that of ``t_ns``. Returns whether there was anything before."""
        was_running = bool(self.counters["running"][0])
        self.counters["running"], self.counters["filled"] = True, 0
        self.counters["newest_ns"] = max(t_ns - 1, LONG_AGO_NS)
        return was_running

    def forget_half(self) -> None:
        """Make room: the older half goes."""
        forget_half(self.counters[0], self.arrays)


def as_samples(t_ns: IntArray, acc: FloatArray, gyr: FloatArray) -> Samples:
    """Samples as one kind of array: for any other the core would be compiled once more."""
    kinds = ((t_ns, np.int64), (acc, np.float64), (gyr, np.float64))
    return Samples(*(np.require(x, kind, ("C", "W")) for x, kind in kinds))


NEVER_NS = 2**63 - 1
TRANSITIONS = tuple(Transition)  # by number
SAMPLED = [("t_ns", np.int64), ("acc", np.float64, 3), ("gyr", np.float64, 3)]
SAMPLE = record_type(SAMPLED)
pack_sample = struct_of(SAMPLE, "t_ns", "acc", "gyr").pack_into

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

    def __init__(self, sensor: str, rate_hz: float, live: Vec) -> None:
        self.foot = sensor
        self.machine = GaitPhaseMachine(sensor)
        self._history = History(rate_hz, live["counters"])
        self._restarts = 0
        self._sample, self._core, self._state = live["sample"], live["core"], live["core"]["state"][0]
        self._bytes = live.view(np.uint8).data
        self._seen = handed(self._core)
        limits = self._core["thresholds"]
        self._limits = partial(struct_of(limits.dtype).unpack_from, limits.view(np.uint8).data)
        self._fired = NEVER_NS, features_in(self._seen), Thresholds()

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
    def gyr_bias_radps(self) -> FloatArray:
        """The gyroscope's bias as estimated now (3,)."""

    @abstractmethod
    def set_incline(self, incline: float) -> None:
        """What the ground rises per horizontal distance (NaN: nobody knows), for strides whose heel has yet to rise.

        A stride under way, or not yet closed, keeps the incline with which it began.
        """

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

    @property
    def thresholds(self) -> Thresholds:
        """The guards' thresholds now: this person's measures follow the strides."""
        return Thresholds._make(self._limits())

    @property
    def measures(self) -> dict[str, float]:
        """This person's measures now, by name: what of the thresholds follows the strides."""
        return {name: getattr(self.thresholds, name) for name, _ in MEASURES}

    def set_thresholds(self, thresholds: Thresholds) -> None:
        """Begin with these instead of the calibration's; before the first sample, for the bounds count from them."""
        fill(self._core, thresholds=thresholds)

    def _fire(self, number: int) -> PhaseChange:
        """Take the machine through what the compiled guards let pass at the newest sample."""
        t_ns = int(self._state["t_ns"])
        _, seen, limits = self._fired = t_ns, features_in(self._seen), self.thresholds
        return self.machine.fire(TRANSITIONS[number], t_ns, seen, limits)

    def seen(self) -> tuple[Features, Thresholds]:
        """What the guards saw at the newest sample: where one of them fired, before the machine went through it."""
        t_ns, fired, limits = self._fired
        if t_ns == int(self._state["t_ns"]):
            return fired, limits
        return features_in(self._seen), self.thresholds

    def _restart(self, t_ns: int) -> list[PhaseChange]:
        """Begin anew in stance with the sample of this time: the change, if there was anything before."""
        if not self._history.restart(t_ns):
            return []
        self._restarts += 1
        return [self.machine.restart(t_ns)]
