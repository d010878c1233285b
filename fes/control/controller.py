"""The controller: one event in, one decision out. Pure: no clock, no I/O, no threads.

Everything it knows came as an event, so the same events give the same decisions, live and in replay.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from operator import attrgetter

from fes.config import STEEPEST_PERCENT, Session
from fes.estimation.sensor_choice import Calibration, phase_sensors, tracker_of
from fes.estimation.tracking.tracker import Outcome, Tracker
from fes.signals import (
    GROUND_ACTS,
    NS_PER_S,
    Event,
    ImuSample,
    OperatorAct,
    OperatorAction,
    StimRequest,
    StimStatus,
    StrideResult,
    Tick,
)
from fes.stimulation.onset import OnsetPredictor
from fes.stimulation.order import NOTED
from fes.stimulation.plan import BY_HAND_NS, StimulationPlan
from fes.stimulation.tuning.report import TuningReport
from fes.stimulation.tuning.session import TUNING_ACTS, Tuners
from fes.stimulation.walking import SwitchFallback, WalkingJudge
from fes.walk_record import Note
from statemachine.phases import Phase, PhaseChange

CURRENT_STEP_MA = 0.5  # of most stimulators
STEEPEST = 0.01 * STEEPEST_PERCENT


@dataclass(frozen=True, slots=True)
class Decision:
    """What came of one event: ``requests`` to put before the gate now; the rest is to be recorded."""

    requests: tuple[StimRequest, ...] = ()
    outcomes: tuple[Outcome, ...] = ()
    reports: tuple[TuningReport, ...] = ()
    notes: tuple[Note, ...] = ()


NOTHING = Decision()
_IS_ON = attrgetter("on")


class Controller:
    """From events to requests: tracker per foot, walking judge per foot, one plan, a tuner per channel that has one.

    Calibrations are by sensor name. A shank drives its side's foot where that has no sensor of its own; samples of
    sensors that drive nothing change nothing. ``incline``: what the ground rises per horizontal distance as last said,
    NaN where nobody knows. Requests are rounded down to the stimulator's ``current_step_ma``.
    """

    def __init__(
        self, session: Session, calibrations: Mapping[str, Calibration], *, current_step_ma: float = CURRENT_STEP_MA
    ) -> None:
        sensor_of = phase_sensors(calibrations)
        self.trackers: dict[str, Tracker] = {  # by the foot whose phases they follow
            foot: tracker_of(session, calibrations[sensor]) for foot, sensor in sensor_of.items()
        }
        self._foot_of = {sensor: foot for foot, sensor in sensor_of.items()}
        self._judges = {foot: WalkingJudge(session.stimulation) for foot in sensor_of}
        self._fallbacks = {
            str(switch.foot): SwitchFallback(switch.foot)
            for switch in session.foot_switches
            if switch.use == "fallback"
        }
        self.onsets = {
            foot: OnsetPredictor()
            for foot in sensor_of
            if any(channel.foot == foot and channel.onset == "predicted" for channel in session.channels)
        }
        self._late = frozenset(foot for foot, sensor in sensor_of.items() if sensor in session.by_radio)
        self._foreseen_late = sorted(self._late & self.onsets.keys())
        self._plan = StimulationPlan(session.channels, current_step_ma=current_step_ma, late=self._late)
        self.tuning = Tuners(session)
        self._reports: list[TuningReport] = []
        self._notes: list[Note] = []
        self._period_ns = round(NS_PER_S / session.stimulation.command_rate_hz)
        self._next_command_ns: int | None = None
        self._on = False
        exercise = session.exercise
        self._exercise_ns = round((exercise.rise_s + exercise.on_s) * NS_PER_S) if exercise else 0  # until it falls
        self.intensity = 0.0
        self.incline = session.ground.incline

    def phase(self, foot: str) -> Phase:
        """The gait phase of a foot now."""
        return self.trackers[foot].phase

    def judge(self, foot: str) -> WalkingJudge:
        """Who says whether this foot walks."""
        return self._judges[foot]

    def in_disorder(self) -> list[str]:
        """Of each foot whose cycle is not seen now, that and why."""
        return [self._order(foot) for foot, judge in self._judges.items() if not judge.order.in_order]

    def _order(self, foot: str) -> str:
        return f"{foot.replace('_', ' ')} {self._judges[foot].order.describe()}"

    def notices(self) -> list[str]:
        """What a person should know of the feet: those in disorder, those whose onset cannot be predicted as asked."""
        onsets = [(foot.replace("_", " "), onset) for foot, onset in self.onsets.items() if not onset.in_use]
        late = [
            f"{foot.replace('_', ' ')}: by radio, a burst begins as foreseen, or late" for foot in sorted(self._late)
        ]
        return self.in_disorder() + [f"{name}: {onset.describe()}" for name, onset in onsets] + late

    def walking(self, foot: str) -> bool:
        """Whether this foot is judged to be walking, so that a step may start a burst."""
        fallback = self._fallbacks.get(foot)
        return self._judges[foot].walking or (fallback is not None and fallback.active)

    def step(self, event: Event) -> Decision:
        """Take in one event; times must not decrease."""
        outcomes: tuple[Outcome, ...] = ()
        if isinstance(event, ImuSample):
            foot = self._foot_of.get(event.sensor)
            if foot is not None:
                results = self.trackers[foot].step(event.t_sensor_ns, event.acc_mps2, event.gyr_radps)
                if results:
                    self._follow(foot, event, results)
                    outcomes = tuple(results)
                self._judges[foot].on_time(event.t_sensor_ns)
                if foot in self.onsets:
                    self._foresee(foot, event)
        elif isinstance(event, OperatorAct):
            self._on_act(event)
        elif isinstance(event, StimStatus):
            self.tuning.on_status(event)
        for fallback in self._fallbacks.values():  # what foot switches show, where the sensors show no steps
            for change in fallback.changes_at(event):
                self._plan.on_phase(change, permitted=True)
        for foot in self._foreseen_late:  # time passes between two samples, too
            if self.onsets[foot].reached(event.t_ns):
                self._begin_early(foot, event.t_ns)
        # in a silence the gate must see how old the data have become, sooner than at the next command
        requests = self._due(event.t_ns, self._on and isinstance(event, Tick))
        if self._reports or self._notes:
            reports, notes, self._reports, self._notes = tuple(self._reports), tuple(self._notes), [], []
            return Decision(requests, outcomes, reports, notes)
        return Decision(requests, outcomes) if requests or outcomes else NOTHING

    def _follow(self, foot: str, sample: ImuSample, outcomes: list[Outcome]) -> None:
        """What one foot did at this sample, for its judge, its tuning and the plan."""
        judge = self._judges[foot]
        for outcome in outcomes:
            if isinstance(outcome, StrideResult):
                judge.on_stride(outcome)
                reports = self.tuning.on_stride(sample.t_ns, foot, outcome, self.intensity)
                if reports or self.tuning.tuners:
                    self._tune(reports)
            else:
                was_in_order, permitted = judge.order.in_order, judge.on_phase(outcome)
                if judge.order.in_order is not was_in_order:
                    severity = "warning" if was_in_order else "info"
                    self._notes.append(Note(sample.t_ns, severity, NOTED, self._order(foot)))
                if foot in self.onsets:
                    self.onsets[foot].on_phase(outcome, permitted)
                fallback = self._fallbacks.get(foot)
                if fallback is not None and not fallback.follows_sensor(outcome):
                    continue
                # stimulation keeps to the host's clock, whatever the sensor's does; a radio's stamps are of that
                t_ns = min(sample.t_sensor_ns, sample.t_ns) if foot in self._late else sample.t_ns
                change = PhaseChange(t_ns, foot, outcome.transition, outcome.source, outcome.destination)
                self._plan.on_phase(change, permitted=permitted)

    def _foresee(self, foot: str, sample: ImuSample) -> None:
        """Begin this foot's bursts early where its heel is about to rise, and that is known well of who walks."""
        onset, now_ns = self.onsets[foot], sample.t_ns if foot in self._late else None
        if onset.watching and onset.starts(sample.t_sensor_ns, *towards_heel_rise(self.trackers[foot]), now_ns):
            self._begin_early(foot, sample.t_ns)
        for severity, source, text in onset.said:
            self._notes.append(Note(sample.t_ns, severity, source, f"{foot.replace('_', ' ')}: {text}"))
        onset.said.clear()

    def _begin_early(self, foot: str, t_ns: int) -> None:
        onset, fallback = self.onsets[foot], self._fallbacks.get(foot)
        by_sensor = self._judges[foot].walking and not (fallback and fallback.active)
        onset.used = onset.in_use and by_sensor and self._plan.begin_early(foot, t_ns, self.intensity)

    def _tune(self, reports: tuple[TuningReport, ...]) -> None:
        """What the tuning reports; its parameters count from each channel's next burst."""
        self._reports += reports
        for number, parameters in self.tuning.parameters().items():
            self._plan.set_parameters(number, parameters)

    def _on_act(self, act: OperatorAct) -> None:
        self._tune(self.tuning.on_act(act))
        if act.action in TUNING_ACTS:
            return
        if act.action is OperatorAction.SET_INTENSITY:
            self.intensity = min(act.value, 1.0) if act.value > 0.0 else 0.0  # not-a-number is 0
        elif act.action in BY_HAND_NS:
            self._plan.start(act.value, act.t_ns, BY_HAND_NS[act.action], adopt=act.action is OperatorAction.TRIGGER)
        elif act.action is OperatorAction.EXERCISE:
            if self._exercise_ns:
                self._plan.start(act.value, act.t_ns, self._exercise_ns, adopt=False)
        elif act.action in GROUND_ACTS:
            free = act.action is OperatorAction.FREE_GROUND
            self.incline = math.nan if free else min(max(act.value, -STEEPEST), STEEPEST)
            for tracker in self.trackers.values():
                tracker.set_incline(self.incline)
        elif act.action is not OperatorAction.SET_BELT_SPEED:
            # armed or stopped in mid-burst: whatever comes next is a new burst
            self._plan.cancel()
            if act.action is OperatorAction.ARM:
                for judge in self._judges.values():
                    judge.order.begin_anew()

    def _due(self, t_ns: int, at_once: bool) -> tuple[StimRequest, ...]:
        """One request per channel each command period, and at once when a channel goes on or off."""
        next_ns = self._next_command_ns
        if next_ns is None:
            next_ns = self._next_command_ns = t_ns
        if t_ns >= next_ns:
            self._next_command_ns = next_ns + self._period_ns * ((t_ns - next_ns) // self._period_ns + 1)
        elif not at_once and not self._plan.due(t_ns, self.intensity):
            return ()
        requests = self._plan.requests(t_ns, self.intensity)
        self._on = any(map(_IS_ON, requests))
        return requests


def towards_heel_rise(tracker: Tracker) -> tuple[float, float]:
    """How far, and how fast, the foot has turned toe-down at the newest sample: shares of T1's limits."""
    seen, limits = tracker.seen()
    rate_radps = limits.heel_rise_share * max(limits.push_off_radps, 0.5 * limits.fall_radps)
    return seen.turned_rad / limits.turn_rad, seen.toe_down_radps / rate_radps
