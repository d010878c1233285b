"""One foot from samples to phase changes and strides: the compiled core, the phase machine and the stride solver.

There is one compiled step for a live sample and one compiled block for a recording; both go through the same functions.
Python is called where the phase machine or a stride's result is wanted.
"""

import math
from collections.abc import Iterable
from typing import Any

import numpy as np

from fes.estimation.clearance.clearance import FootPaths
from fes.estimation.foot import features
from fes.estimation.foot.calibration import FootCalibration
from fes.estimation.foot.orientation import OrientationSettings
from fes.estimation.numerics.jit import jit_ieee, literal_unroll
from fes.estimation.numerics.records import Mat, Record, Vec, fill, handed, record_of, record_type
from fes.estimation.numerics.rotation import cross
from fes.estimation.strides import integration, segmentation
from fes.estimation.strides.boundaries import REST_RADPS, UNSEEN_NS
from fes.estimation.strides.integration import stride_shapes
from fes.estimation.strides.results import (
    HIDDEN,
    NAMES,
    TRAJECTORY_POINTS,
    UNKNOWN,
    Rows,
    StrideMaker,
    StrideSettings,
    reason_of,
    result_of,
    toe_out_rad,
)
from fes.estimation.strides.segmentation import CHANGES, ROWS, STRIDE_STATE, STRIDES, Out, new_out
from fes.estimation.tracking.phase_features import enter_phase
from fes.estimation.tracking.phase_features import features as features_of
from fes.estimation.tracking.tracker import (
    FULL,
    KEPT,
    SILENCE,
    HistoryArrays,
    Outcome,
    Samples,
    Tracker,
    as_samples,
    forget_half,
    live_type,
    pack_sample,
    store_sample,
    store_samples,
    until_due,
)
from fes.signals import FloatArray, IntArray, StrideResult, Vector3
from statemachine.guards import Features, Thresholds
from statemachine.machine import GaitPhaseMachine, GuardDisagreement
from statemachine.phases import Phase, PhaseChange, Transition
from statemachine.table import TABLE

CHANGE = record_type(  # and what the guard saw
    [
        ("t_ns", np.int64),
        ("transition", np.int64),  # 0: a restart
        ("features", np.float64, len(Features._fields)),
        ("thresholds", record_of(Thresholds)),
    ]
)
USUAL_STRIDES = 25  # in a history of twenty seconds
_PHASES = {row.transition: (row.source, row.destination) for row in TABLE}
SOURCES, DESTINATIONS = np.array([_PHASES.get(which, (Phase.STANCE,) * 2) for which in Transition], np.int64).T


class TrackedBlock:
    """Phase changes and strides in order, the strides' trajectories beside them.

    ``transitions`` and ``out`` are what the compiled core fills from ``samples`` samples, after a history of
    ``capacity`` (twenty seconds), from ``phase`` on; where it stops for want of room, :meth:`store` makes more.
    """

    def __init__(self, foot: str, phase: Phase, settings: StrideSettings, samples: int, capacity: int) -> None:
        strides = USUAL_STRIDES * samples // capacity + 2
        self.transitions: Rows = np.empty(6 * strides, CHANGE)
        self.longer: FloatArray | None = None  # than by itself (K,) is each stride, where more is known of its length
        self.out = new_out(strides, samples + 2 * capacity, TRAJECTORY_POINTS, shaped=False)
        self._foot, self._phase, self._settings = foot, phase, settings
        self._stored, self._capacity = 0, capacity

    def add_restart(self, changes: Iterable[PhaseChange]) -> None:
        """Add the changes of a restart, which the compiled core knows nothing of."""
        for change in changes:
            row = self.transitions[self._stored]
            row["t_ns"], row["transition"] = change.t_ns, change.transition
            self.out.filled[CHANGES] = self._stored + 1
            self.store()

    def store(self) -> None:
        """Take over what the core has found, and make room for more."""
        strides, rows, self._stored = self.out.filled.tolist()
        out = self.out
        if self._stored >= len(self.transitions):
            self.transitions = _twice(self.transitions)
        if strides == len(out.strides):
            self.out = out._replace(strides=_twice(out.strides))
        if rows > len(out.t_ns) - self._capacity:
            longer = {name: _twice(getattr(out, name)) for name in ("t_ns", "position", "quaternion")}
            self.out = self.out._replace(**longer)

    @property
    def changes(self) -> list[PhaseChange]:
        """The phase changes, made anew at every call by a machine that goes through them.

        Raises:
            GuardDisagreement: see :meth:`GaitPhaseMachine.fire`.
        """
        if not self._stored:
            return []
        machine = GaitPhaseMachine(self._foot, self._phase)
        return [
            machine.fire(Transition(number), t_ns, Features._make(seen.tolist()), Thresholds._make(limits))
            if number
            else machine.restart(t_ns)
            for t_ns, number, seen, limits in self.transitions[: self._stored].tolist()
        ]

    def change_columns(self) -> tuple[IntArray, IntArray, IntArray, IntArray]:
        """Of the C phase changes the times, the transitions, from where and to where they led: (C,) of numbers each.

        Raises:
            GuardDisagreement: one of them leaves another phase than the one before has led to.
        """
        found = self.transitions[: self._stored]
        number = found["transition"].copy()
        to = DESTINATIONS[number]
        source = np.concatenate(([int(self._phase)], to))[: len(to)]
        if ((number != Transition.NONE) & (source != SOURCES[number])).any():
            raise GuardDisagreement(f"{self._foot}: a transition leaves a phase in which the foot was not")
        return found["t_ns"].copy(), number, source, to

    @property
    def rows(self) -> Rows:
        """The strides (K,), of ``fes.estimation.strides.schema.STRIDE``."""
        rows: Rows = self.out.strides[: self.out.filled[STRIDES]]
        return rows

    @property
    def shapes(self) -> FloatArray:
        """Their shapes (K, ``TRAJECTORY_POINTS``, 5), made anew at every call; of those not solved nothing to go by."""
        rows, out = self.rows, self.out
        shapes = np.zeros((len(rows), TRAJECTORY_POINTS, 5))
        firsts, counts = rows["first"].copy(), rows["rows"].copy()
        (fx, fy, fz), (ux, uy, uz) = self._settings.forward.tolist(), self._settings.up.tolist()
        toe_out = toe_out_rad(self._foot)
        stride_shapes(firsts, counts, out.t_ns, out.quaternion, out.position, fx, fy, fz, ux, uy, uz, toe_out, shapes)
        if self.longer is not None:
            shapes[:, :, 0] *= self.longer[:, None]
        return shapes

    def paths(self) -> FootPaths:
        """The trajectories of the valid strides."""
        rows, out = self.rows[self.rows["outcome"] == integration.SOLVED], self.out
        unseen = rows["t_loading_response_ns"] == UNSEEN_NS
        contact = np.where(unseen, rows["t_stance_ns"], rows["t_loading_response_ns"])
        end = int((rows["first"] + rows["rows"]).max(initial=0))
        forward, up = self._settings.forward, self._settings.up
        return FootPaths(
            rows["number"].copy(),
            np.column_stack((rows["first"], rows["first"] + rows["rows"])),
            np.column_stack((rows["t_swing_ns"], contact)),
            out.t_ns[:end],
            out.position[:end],
            out.quaternion[:end],
            np.column_stack((forward, cross(up.tolist(), forward.tolist()), up)),
        )

    def columns(self) -> dict[str, np.ndarray[Any, Any]]:
        """The strides' numbers as columns (K,), see ``fes.estimation.strides.schema.result_columns``."""
        rows, foot = self.rows, self._foot
        valid = rows["outcome"] == integration.SOLVED
        columns: dict[str, Any] = {name: rows[name].copy() for name in NAMES if name not in HIDDEN}
        for name in UNKNOWN:
            columns[name][~valid] = math.nan
        reasons = np.full(len(rows), "", object)
        for k in np.flatnonzero(~valid | (rows["residual_rate_radps"] > REST_RADPS)).tolist():
            reasons[k] = reason_of(dict(zip(NAMES, rows[k].tolist(), strict=True)))
        return columns | {"foot": np.full(len(rows), foot, object), "valid": valid, "reason": reasons}

    def strides(self) -> list[StrideResult]:
        """The strides' results."""
        rows = zip(self.rows.tolist(), self.shapes, strict=True)
        return [result_of(self._foot, row, shape) for row, shape in rows]

    def outcomes(self) -> list[Outcome]:
        """Strides and phase changes in the order in which they came."""
        outcomes: list[Outcome] = []
        changes, done = self.changes, 0
        for stride, before in zip(self.strides(), self.rows["changes"].tolist(), strict=True):
            outcomes += changes[done:before]
            outcomes.append(stride)
            done = before
        return outcomes + changes[done:]


def _twice(array: Rows) -> Rows:
    """The same with as much room again."""
    return np.concatenate((array, np.empty_like(array)))


LIVE = live_type(features.CORE, stride=STRIDE_STATE, biases=np.dtype((np.float64, (2, 3))))
# what may have happened at a sample, beside the transitions 1 … 6
NOTHING, DUE, AFTER_SILENCE, NO_ROOM = 0, 7, 8, 9
NOTHING_STORED = -1
_NONE_FILLED = np.zeros(3, np.int64).data
_T1 = Transition.T1.value
_DESTINATIONS = (0, *(row.destination.value for row in TABLE))  # by the transition's number


@jit_ieee
def _go_through(live: Vec, strides: Vec, number: int) -> None:
    """Go through a transition at the newest sample; T1 after its strides."""
    core = live[0].core
    enter_phase(core, _DESTINATIONS[number])
    segmentation.on_phase(strides, core.state.phase, core.state.t_ns)


@jit_ieee
def _note(change: Record, core: Record, number: int) -> None:
    """Note a transition at the newest sample, before it is gone through, with what its guard saw."""
    change.t_ns, change.transition, change.thresholds = core.state.t_ns, number, core.thresholds
    k = 0
    for value in literal_unroll(features_of(core.state)):
        change.features[k] = value
        k += 1  # noqa: SIM113 - the compiler knows no enumerate here


@jit_ieee
def _step(live: Vec, t_ns: Vec, acc: Mat, gyr: Mat, quaternions: Mat) -> int:
    """Store one sample and advance over it; the number of what happened, which is then to be gone through."""
    sample, counters, core = live[0].sample, live[0].counters, live[0].core
    became = store_sample(counters, t_ns, acc, gyr, sample)
    if became == SILENCE:
        return AFTER_SILENCE
    if became == FULL:
        return NO_ROOM
    if became != KEPT:
        return NOTHING
    row = counters.filled - 1
    _, number = features.advance(core, t_ns, acc, gyr, row, row + 1, quaternions)
    if number == NOTHING:
        return DUE if sample.t_ns >= live[0].stride.state.due_ns else NOTHING
    return number


@jit_ieee
def _block(
    live: Vec, strides: Vec, history: HistoryArrays, samples: Samples, changes: Vec, out: Out,
    begin: int, at: int, number: int,
) -> tuple[int, int, int]:  # fmt: skip
    """Store the samples from ``begin`` on, and go through the history with all phase changes and strides.

    ``live`` (1,) of ``LIVE``, ``strides`` (1,) its part ``stride``; ``changes`` (C,) of ``CHANGE`` and ``out`` receive
    what happens. ``at`` rows of the history are gone through already, and ``number`` is what happened at the last of
    them and is first seen to: a transition, ``DUE``, or ``NOTHING``.

    Returns the first sample not yet seen to, how many rows are gone through, and why: ``KEPT`` where there is no more,
    ``SILENCE`` before a sample that comes after one, ``FULL`` where there is no more room for what happens.
    """
    t_ns, acc, gyr, quaternions = history
    core, counters = live[0].core, live[0].counters
    state, parameters, biases, filled = core.state, core.parameters, live[0].biases, out.filled
    room = out.t_ns.shape[0] - t_ns.shape[0]
    biases[0, 0], biases[0, 1] = parameters.acc_bias_x_mps2, parameters.acc_bias_y_mps2
    biases[0, 2] = parameters.acc_bias_z_mps2
    end, became = counters.filled, NOTHING_STORED
    while True:
        if number in (_T1, DUE):
            biases[1, 0] = parameters.gyr_bias_x_radps + state.bias_radps[0]
            biases[1, 1] = parameters.gyr_bias_y_radps + state.bias_radps[1]
            biases[1, 2] = parameters.gyr_bias_z_radps + state.bias_radps[2]
            if strides[0].state.due_ns != segmentation.NEVER_NS:
                first, last = segmentation.close(strides, at, t_ns, gyr, biases, core.thresholds.stride_s, out)
                if first < last:
                    segmentation.solve_rows(strides, first, last, at, t_ns, acc, gyr, quaternions[first], biases, out)
                    if state.gravity_ns < strides[0].state.stance_ns:
                        segmentation.chain(strides, out)
            if number == _T1:
                segmentation.begin(strides, at, t_ns, gyr, biases, core.thresholds.stride_s)
        if number != NOTHING and number != DUE:
            _note(changes[filled[CHANGES]], core, number)
            _go_through(live, strides, number)
            filled[CHANGES] += 1
        number = NOTHING
        if filled[CHANGES] >= len(changes) or filled[STRIDES] >= len(out.strides) or filled[ROWS] > room:
            return begin, at, FULL
        if at == end:
            if became in (KEPT, SILENCE):
                return begin, at, became
            if became == FULL:
                forget_half(counters, history)
                at = counters.filled
            begin, became = store_samples(counters, history, samples, begin)
            end = counters.filled
        if at < end:
            due_ns = strides[0].state.due_ns
            at, number = features.advance(core, t_ns, acc, gyr, at, until_due(t_ns, at, end, due_ns), quaternions)
            if number == NOTHING and t_ns[at - 1] >= due_ns:
                number = DUE


class FootTracker(Tracker):
    """Phases and strides of one foot; deterministic, no clock, no I/O. The history's trace is the orientation."""

    def __init__(self, calibration: FootCalibration, strides: StrideMaker, *, swing_at_reversal: bool = False) -> None:
        live, thresholds = np.zeros(1, LIVE), calibration.thresholds(swing_at_reversal=swing_at_reversal)
        super().__init__(calibration.sensor, calibration.rate_hz, live)
        parameters, settings = calibration.parameters(), OrientationSettings()
        fill(self._core, parameters=parameters, thresholds=thresholds, settings=settings)
        self._acc_bias = np.array(calibration.acc_bias_mps2)
        self._gyr_bias = np.array(calibration.gyr_bias_radps)
        strides.keep_in(live["stride"])
        self._maker = strides
        self._live = live
        arrays = self._history.arrays
        self._for_step = handed(live), *map(handed, arrays)
        self._one_stride = out = new_out(1, len(arrays.t_ns), TRAJECTORY_POINTS)
        self._filled = out.filled.data  # the same memory, read and written in a third of the time
        no_more = as_samples(np.empty(0, np.int64), np.empty((0, 3)), np.empty((0, 3)))
        one = handed(np.empty(1, CHANGE)), out._replace(strides=handed(out.strides))
        self._for_one = self._for_step[0], handed(strides.core), arrays, no_more, *one

    @property
    def gyr_bias_radps(self) -> FloatArray:
        """The gyroscope's bias as estimated now (3,): calibrated plus what the filter has found since."""
        return np.asarray(self._gyr_bias + self._state["bias_radps"])

    def set_incline(self, incline: float) -> None:
        """As :meth:`Tracker.set_incline`."""
        self._maker.set_incline(incline)

    def history(self) -> HistoryArrays:
        """A copy of the last twenty seconds at most, free of bias as known now; the trace is the orientation."""
        n = self._history.filled
        t_ns, acc, gyr, quaternions = (array[:n] for array in self._history.arrays)
        return HistoryArrays(t_ns.copy(), acc - self._acc_bias, gyr - self.gyr_bias_radps, quaternions.copy())

    def step(self, t_ns: int, acc_mps2: Vector3, gyr_radps: Vector3) -> list[Outcome]:
        """Take one sample in; see :meth:`Tracker.step`."""
        pack_sample(self._bytes, 0, t_ns, *acc_mps2, *gyr_radps)
        number = _step(*self._for_step)
        return [] if number == NOTHING else self._outcomes_of(number)

    def _outcomes_of(self, number: int) -> list[Outcome]:
        """What the newest sample led to."""
        outcomes: list[Outcome] = []
        while number >= AFTER_SILENCE:
            if number == NO_ROOM:
                self._history.forget_half()
            else:
                outcomes += self._begin(int(self._sample["t_ns"][0]), self._sample["acc"][0])
            number = _step(*self._for_step)
        if number == NOTHING:
            return outcomes
        change = None if number == DUE else self._fire(number)
        if number in (_T1, DUE):
            self._filled[:] = _NONE_FILLED
            _block(*self._for_one, 0, self._history.filled, number)
            if self._filled[STRIDES]:
                outcomes.append(self._maker.stride_in(self._one_stride))
        else:
            _go_through(*self._for_one[:2], number)
        if change is not None:
            outcomes.append(change)
        return outcomes

    def advance(self, t_ns: IntArray, acc_mps2: FloatArray, gyr_radps: FloatArray) -> list[Outcome]:
        """Take samples in; see :meth:`Tracker.advance`."""
        return self.track(t_ns, acc_mps2, gyr_radps).outcomes()

    def track(self, t_ns: IntArray, acc_mps2: FloatArray, gyr_radps: FloatArray) -> TrackedBlock:
        """Take samples in, as :meth:`advance`, and give back what happened as arrays."""
        room = len(t_ns), len(self._history.arrays.t_ns)
        tracked = TrackedBlock(self.foot, self.phase, self._maker.settings, *room)
        samples = as_samples(t_ns, acc_mps2, gyr_radps)
        begin, at, became = 0, self._history.filled, NOTHING_STORED
        while became != KEPT:
            begin, at, became = self._track(samples, tracked.transitions, tracked.out, begin, at, NOTHING)
            tracked.store()
            if became == SILENCE:
                self.machine.go_on_in(Phase(self._state["phase"]))
                tracked.add_restart(self._begin(int(samples.t_ns[begin]), samples.acc[begin]))
                at = 0
        self.machine.go_on_in(Phase(self._state["phase"]))
        return tracked

    def _track(
        self, samples: Samples, changes: Vec, out: Out, begin: int, at: int, number: int
    ) -> tuple[int, int, int]:
        begin, at, became = _block(
            self._live, self._maker.core, self._history.arrays, samples, changes, out, begin, at, number
        )  # fmt: skip
        return int(begin), int(at), int(became)

    def _begin(self, t_ns: int, acc: FloatArray) -> list[PhaseChange]:
        """Begin anew in stance at this sample; what was under way is dropped."""
        changes = self._restart(t_ns)
        segmentation.restart(self._maker.core, t_ns)
        fx, fy, fz = (acc - self._acc_bias).tolist()
        features.start(self._core[0], t_ns, fx, fy, fz)
        return changes
