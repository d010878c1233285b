"""One foot from samples to phase changes and strides: the compiled core, the phase machine and the stride solver."""

from __future__ import annotations

from typing import Any

import numpy as np

from fes.estimation.foot import features as kernel
from fes.estimation.foot.block_results import CHANGE, TrackedBlock
from fes.estimation.foot.calibration import FootCalibration
from fes.estimation.foot.features import FootParameters
from fes.estimation.foot.orientation import OrientationSettings
from fes.estimation.numerics.jit import jit_ieee
from fes.estimation.numerics.records import core_type, fill
from fes.estimation.strides import segmentation as stride_course
from fes.estimation.strides.results import TRAJECTORY_POINTS, StrideMaker
from fes.estimation.strides.segmentation import CHANGES, ROWS, STRIDE_STATE, STRIDES, Out, new_out
from fes.estimation.tracking.history import (
    BOOK,
    FULL,
    HISTORY_S,
    KEPT,
    LARGEST_VALUE,
    RESTART_GAP_S,
    SILENCE,
    History,
    SampleCounts,
    forget_half,
    take_in,
    take_one,
)
from fes.estimation.tracking.tracker import (
    ONE,
    PACK_ONE,
    TRANSITIONS,
    UNPACK_ONE,
    Outcome,
    Tracker,
    of_one_kind,
    until_due,
)
from fes.signals import FloatArray, IntArray, Vector3
from statemachine.guards import Features, Thresholds
from statemachine.phases import Phase, Transition
from statemachine.table import TABLE

__all__ = ["HISTORY_S", "LARGEST_VALUE", "RESTART_GAP_S", "FootTracker", "Outcome", "SampleCounts"]

CORE = core_type(kernel.STATE, parameters=FootParameters, thresholds=Thresholds, settings=OrientationSettings)
# all that a live step needs, beside the history: handed over as four arrays it would take twice as long as its work
LIVE = np.dtype([("one", ONE), ("core", CORE), ("course", STRIDE_STATE), ("book", BOOK)], align=True)
# what may have happened at a sample, beside the transitions 1 … 6
NOTHING, DUE, AFTER_SILENCE, NO_ROOM = 0, 7, 8, 9
NOTHING_TAKEN = -1
_NONE_FILLED = np.zeros(3, np.int64).data
_T1 = Transition.T1.value
_DESTINATIONS = (0, *(row.destination.value for row in TABLE))  # by the transition's number


@jit_ieee
def _advance(
    core: Any, t_ns: Any, acc: Any, gyr: Any, quaternions: Any, begin: int, end: int, due_ns: int
) -> tuple[int, int]:
    c = core[0]
    end = until_due(t_ns, begin, end, due_ns)
    return kernel.advance(
        c.state, c.parameters, c.thresholds, c.settings, t_ns, acc, gyr, begin, end, quaternions
    )  # fmt: skip


@jit_ieee
def _features(core: Any) -> Features:
    return kernel.features(core[0].state)


@jit_ieee
def _enter(core: Any, phase: int, acc: Any, row: int) -> None:
    p = core[0].parameters
    fx, fy, fz = acc[row, 0] - p.acc_bias_x_mps2, acc[row, 1] - p.acc_bias_y_mps2, acc[row, 2] - p.acc_bias_z_mps2
    kernel.enter(core[0].state, phase, fx, fy, fz)


@jit_ieee
def _change(core: Any, course: Any, number: int, acc: Any, row: int) -> None:
    """Go through a transition at this row, the newest; T1 after its strides."""
    _enter(core, _DESTINATIONS[number], acc, row)
    stride_course.on_phase(course, core[0].state.phase, core[0].state.t_ns)


@jit_ieee
def _step(live: Any, t_ns: Any, acc: Any, gyr: Any, quaternions: Any) -> int:
    """Take one sample in and advance over it; the number of what happened, which is then to be gone through."""
    x, book = live[0].one, live[0].book
    became = take_one(
        book, t_ns, acc, gyr, x.t_ns, x.acc[0], x.acc[1], x.acc[2], x.gyr[0], x.gyr[1], x.gyr[2]
    )  # fmt: skip
    if became == SILENCE:
        return AFTER_SILENCE
    if became == FULL:
        return NO_ROOM
    if became != KEPT:
        return NOTHING
    c, row = live[0].core, book.filled - 1
    _, number = kernel.advance(
        c.state, c.parameters, c.thresholds, c.settings, t_ns, acc, gyr, row, row + 1, quaternions
    )  # fmt: skip
    x.row = row
    if number == NOTHING:
        return DUE if x.t_ns >= live[0].course.state.due_ns else NOTHING
    seen, f = x.seen, kernel.features(c.state)
    seen.a_rest, seen.g_rest = f.a_rest, f.g_rest
    seen.toe_down_radps, seen.toe_down_change_radps2 = f.toe_down_radps, f.toe_down_change_radps2
    seen.toe_down_peak_radps, seen.toe_up_peak_radps = f.toe_down_peak_radps, f.toe_up_peak_radps
    seen.vertical_jerk_mps3, seen.in_phase_s, seen.resting_s = f.vertical_jerk_mps3, f.in_phase_s, f.resting_s
    return number


@jit_ieee
def _walk(
    taken: int, at: int, number: int,
    core: Any, course: Any, book: Any, kept_t_ns: Any, kept_acc: Any, kept_gyr: Any, quaternions: Any, biases: Any,
    t_ns: Any, acc: Any, gyr: Any,
    changes: Any, strides: Any, shapes: Any, way_ns: Any, way: Any, turns: Any, filled: Any,
) -> tuple[int, int, int]:  # fmt: skip
    """Take the samples from ``taken`` on into the history, and go through it with all phase changes and strides.

    ``at`` rows of the history are gone through already, and ``number`` is what happened at the last of them and is
    first seen to: a transition, ``DUE``, or ``NOTHING``. ``biases`` (2, 3) is working memory. After the phase changes
    come the arguments of :class:`Out`: one by one they are taken over in half the time.

    Returns the first sample not yet seen to, how many rows are gone through, and why: ``KEPT`` where there is no more,
    ``SILENCE`` before a sample that comes after one, ``FULL`` where there is no more room for what happens.
    """
    out = Out(strides, shapes, way_ns, way, turns, filled)
    c, s, p, room = core[0], core[0].state, core[0].parameters, way_ns.shape[0] - kept_t_ns.shape[0]
    biases[0, 0], biases[0, 1], biases[0, 2] = p.acc_bias_x_mps2, p.acc_bias_y_mps2, p.acc_bias_z_mps2
    end, became = book[0].filled, NOTHING_TAKEN
    while True:
        if number in (_T1, DUE):
            biases[1, 0] = p.gyr_bias_x_radps + s.bias_radps[0]
            biases[1, 1] = p.gyr_bias_y_radps + s.bias_radps[1]
            biases[1, 2] = p.gyr_bias_z_radps + s.bias_radps[2]
            if course[0].state.due_ns != stride_course.NEVER_NS:
                first, last = stride_course.close(course, at, kept_t_ns, kept_gyr, biases, out)
                if first < last:
                    q = quaternions[first]
                    stride_course.solve_rows(course, first, last, at, kept_t_ns, kept_acc, kept_gyr, q, biases, out)
            if number == _T1:
                stride_course.begin(course, at, kept_t_ns, kept_gyr, biases)
        if number != NOTHING and number != DUE:
            change = changes[filled[CHANGES]]
            change.t_ns, change.transition, change.source = kept_t_ns[at - 1], number, s.phase
            _change(core, course, number, kept_acc, at - 1)
            filled[CHANGES] += 1
        number = NOTHING
        if filled[CHANGES] >= len(changes) or filled[STRIDES] >= len(strides) or filled[ROWS] > room:
            return taken, at, FULL
        if at == end:
            if became in (KEPT, SILENCE):
                return taken, at, became
            if became == FULL:
                forget_half(book, kept_t_ns, kept_acc, kept_gyr, quaternions)
                at = book[0].filled
            taken, became = take_in(book, kept_t_ns, kept_acc, kept_gyr, t_ns, acc, gyr, taken)
            end = book[0].filled
        if at < end:
            due_ns = course[0].state.due_ns
            at, number = kernel.advance(
                s, p, c.thresholds, c.settings, kept_t_ns, kept_acc, kept_gyr,
                at, until_due(kept_t_ns, at, end, due_ns), quaternions,
            )  # fmt: skip
            if number == NOTHING and kept_t_ns[at - 1] >= due_ns:
                number = DUE


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
        h, live = self._history, np.zeros(1, LIVE)
        self._all, h.book, self._one = live["core"], live["book"], live["one"]
        self._one_bytes = live.view(np.uint8).data
        fill(self._all, parameters=calibration.parameters(), thresholds=self._thresholds, settings=self._settings)
        strides.keep_in(live["course"])
        self._state = self._all["state"][0]
        self._maker = strides
        self._asks = type(strides) is not StrideMaker  # one that wants to be asked at every stride
        self._rows = self._all, strides.core, h.book, h.t_ns, h.acc_mps2, h.gyr_radps, h.trace, np.empty((2, 3))
        self._live = live, h.t_ns, h.acc_mps2, h.gyr_radps, h.trace
        self._out = new_out(1, len(h.t_ns), TRAJECTORY_POINTS)
        self._filled = self._out.filled.data  # the same memory, read and written in a third of the time
        no_more = np.empty(0, np.int64), np.empty((0, 3)), np.empty((0, 3))
        self._end = *self._rows, *no_more, np.empty(1, CHANGE), *self._out

    @property
    def newest_t_ns(self) -> int:
        """Time stamp of the newest sample used; 0 before the first."""
        return int(self._state["t_ns"])

    @property
    def gyr_bias_radps(self) -> FloatArray:
        """The gyroscope's bias as estimated now (3,): calibrated plus what the filter has found since."""
        return np.asarray(self._gyr_bias + self._state["bias_radps"])

    def step(self, t_ns: int, acc_mps2: Vector3, gyr_radps: Vector3) -> list[Outcome]:
        """Take one sample in; see :meth:`Tracker.step`."""
        if self._asks:
            return super().step(t_ns, acc_mps2, gyr_radps)
        PACK_ONE(self._one_bytes, 0, t_ns, *acc_mps2, *gyr_radps)
        number = _step(*self._live)
        return [] if number == NOTHING else self._happened(number)

    def _happened(self, number: int) -> list[Outcome]:
        """What the newest sample led to."""
        outcomes: list[Outcome] = []
        while number >= AFTER_SILENCE:
            if number == NO_ROOM:
                self._history.forget_half()
            else:
                self._restart(int(self._one["t_ns"][0]), self._one["acc"][0], outcomes)
            number = _step(*self._live)
        if number == NOTHING:
            return outcomes
        happened = UNPACK_ONE(self._one_bytes)
        row, change = happened[1], None
        if number != DUE:
            seen = Features._make(happened[2:])
            change = self.machine.fire(TRANSITIONS[number], happened[0], seen, self._thresholds)
        if number in (_T1, DUE):
            self._filled[:] = _NONE_FILLED
            _walk(0, row + 1, number, *self._end)
            if self._filled[STRIDES]:
                outcomes.append(self._maker.stride_in(self._out))
        else:
            _change(self._all, self._maker.core, number, self._history.acc_mps2, row)
        if change is not None:
            outcomes.append(change)
        return outcomes

    def advance(self, t_ns: IntArray, acc_mps2: FloatArray, gyr_radps: FloatArray) -> list[Outcome]:
        """Take samples in; see :meth:`Tracker.advance`."""
        if self._asks:
            return super().advance(t_ns, acc_mps2, gyr_radps)
        walked = self.walk(t_ns, acc_mps2, gyr_radps)
        watch = self._maker.settings.watch
        if watch is not None:
            for path in walked.paths().each():
                watch(path)
        return walked.outcomes()

    def walk(self, t_ns: IntArray, acc_mps2: FloatArray, gyr_radps: FloatArray) -> TrackedBlock:
        """Take samples in, as :meth:`advance`, and give back what happened as arrays."""
        walked = TrackedBlock(self.foot, self._maker.settings, len(t_ns), len(self._history.t_ns))
        samples = of_one_kind(t_ns, acc_mps2, gyr_radps)
        taken, at, became = 0, self._history.filled, NOTHING_TAKEN
        while became != KEPT:
            taken, at, became = _walk(taken, at, NOTHING, *self._rows, *samples, walked.room, *walked.out)
            walked.keep()
            if became == SILENCE:
                walked.lead(self.machine)
                self._restart(int(samples[0][taken]), samples[1][taken], walked)
                at = 0
        walked.lead(self.machine)
        return walked

    def _start(self, t_ns: int, force: FloatArray) -> None:
        fx, fy, fz = force
        kernel.start(self._state, t_ns, fx, fy, fz, self._settings)

    def _core(self, history: History, begin: int, end: int, due_ns: int) -> tuple[int, int]:
        return _advance(self._all, history.t_ns, history.acc_mps2, history.gyr_radps, history.trace, begin, end, due_ns)

    def _features(self) -> Features:
        return _features(self._all)

    def _enter(self, phase: Phase, history: History, row: int) -> None:
        _enter(self._all, phase.value, history.acc_mps2, row)
