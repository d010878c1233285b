"""The controller alone: cadence of requests, what starts and ends a burst, and that nothing else does.

Phases come from a script instead of a walking person, so that every time is known.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from functools import cache
from itertools import pairwise
from statistics import median
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from replays import MS, SETTINGS, TRIALS, trial
from test_live_operator import CALIBRATION
from test_live_operator import settings as live_settings

from benchmarks.loop.closed_loop_walk import Walk, calibration_of, walk
from fes.calibration.recording import calibrate_phase_sensors
from fes.config import Channel, FootGeometry, Session, load_session
from fes.config.session import FootSwitch
from fes.control.controller import Controller, Decision
from fes.estimation.foot.calibration import FootCalibration
from fes.estimation.foot.tracker import FootTracker
from fes.estimation.sensor_choice import stride_settings, tracker_of
from fes.gate import gate_of
from fes.signals import (
    Event,
    FootSwitchEvent,
    ImuSample,
    OperatorAct,
    OperatorAction,
    StimCommand,
    StimRequest,
    StrideResult,
    Tick,
)
from fes.simulation.forward import settings_for
from fes.stimulation.walking import SwitchFallback
from statemachine.phases import Phase, PhaseChange, Transition

FOOT = "right_foot"
STEP_NS = 2 * MS
PERIOD_NS = 20 * MS
CYCLE = (
    (200, Transition.T1, Phase.STANCE, Phase.PRE_SWING),
    (500, Transition.T2, Phase.PRE_SWING, Phase.SWING),
    (900, Transition.T3, Phase.SWING, Phase.LOADING_RESPONSE),
    (1000, Transition.T4, Phase.LOADING_RESPONSE, Phase.STANCE),
)


@cache
def calibrations() -> dict[str, FootCalibration]:
    return calibrate_phase_sensors(trial("example_csv")).calibrations


class ScriptedFoot:
    """Stands in for the tracker: phase changes at known times."""

    def __init__(self, changes: Iterable[PhaseChange]) -> None:
        self.foot = FOOT
        self.phase = Phase.STANCE
        self._changes = {change.t_ns: change for change in changes}
        self.incline = 0.0

    def set_incline(self, incline: float) -> None:
        self.incline = incline

    def step(self, t_ns: int, acc_mps2: Any, gyr_radps: Any) -> list[PhaseChange | StrideResult]:
        change = self._changes.get(t_ns)
        if change is None:
            return []
        self.phase = change.destination
        return [change]


def changes(*rows: tuple[int, Transition, Phase, Phase]) -> list[PhaseChange]:
    return [PhaseChange(ms * MS, FOOT, transition, source, to) for ms, transition, source, to in rows]


def make(script: Iterable[PhaseChange] = (), strides_before_start: int = 0) -> Controller:
    session = load_session(SETTINGS)
    session = session.model_copy(
        update={"stimulation": session.stimulation.model_copy(update={"strides_before_start": strides_before_start})}
    )
    controller = Controller(session, calibrations())
    controller.trackers[FOOT] = cast(FootTracker, ScriptedFoot(script))
    return controller


def sample(t_ns: int, sensor: str = FOOT) -> ImuSample:
    return ImuSample(t_ns, sensor, t_ns, (0.0, 0.0, 9.81), (0.0, 0.0, 0.0))


def act(t_ms: int, action: OperatorAction, value: float = 0.0) -> OperatorAct:
    return OperatorAct(t_ms * MS, action, value)


def intensity(t_ms: int, value: float) -> OperatorAct:
    return act(t_ms, OperatorAction.SET_INTENSITY, value)


def run(controller: Controller, until_ms: int, acts: Iterable[OperatorAct] = ()) -> dict[int, StimRequest]:
    """Samples every 2 ms from 0, acts in between; the requests of channel 0 by their time in ms."""
    events: list[Event] = [sample(t_ns) for t_ns in range(0, until_ms * MS, STEP_NS)]
    events = sorted([*events, *acts], key=lambda event: event.t_ns)
    asked: dict[int, StimRequest] = {}
    for event in events:
        for request in controller.step(event).requests:
            assert request.channel == 0
            asked[event.t_ns // MS] = request
    return asked


def on_times(asked: dict[int, StimRequest]) -> list[int]:
    return [ms for ms, request in asked.items() if request.on]


def test_standing_is_one_off_request_every_period() -> None:
    asked = run(make(), 1000, [intensity(0, 1.0)])
    assert list(asked) == list(range(0, 1000, 20))
    assert not on_times(asked)


def test_a_stride_switches_at_once_and_keeps_to_the_grid_in_between() -> None:
    asked = run(make(changes(*CYCLE)), 1200, [intensity(0, 1.0)])
    off_grid = [ms for ms in asked if ms % 20]
    first, last = on_times(asked)[0], on_times(asked)[-1]
    assert first == 200
    assert all(asked[ms].on for ms in asked if first <= ms <= last)
    assert [ms for ms in asked if ms % 20 == 0] == list(range(0, 1200, 20))
    ended = next(ms for ms in asked if ms > last)
    assert ended == 1000  # stance ends the burst at the very sample
    assert set(off_grid) <= {first, ended}
    assert max(request.current_ma for request in asked.values()) == 30.0
    rise = [(ms, asked[ms].current_ma) for ms in on_times(asked) if ms <= 350]
    assert all(current <= max(0.2 * (ms - 200), 0.5) + 1e-9 for ms, current in rise)


def test_stance_between_two_periods_is_off_at_that_sample() -> None:
    rows = (*CYCLE[:1], (510, Transition.T5, Phase.PRE_SWING, Phase.STANCE))
    asked = run(make(changes(*rows)), 700, [intensity(0, 1.0)])
    assert asked[500].on
    assert not asked[510].on
    assert not [ms for ms in on_times(asked) if ms >= 510]


def test_lost_data_end_the_burst_at_once() -> None:
    rows = (*CYCLE[:2], (610, Transition.NONE, Phase.SWING, Phase.STANCE))
    asked = run(make(changes(*rows)), 700, [intensity(0, 1.0)])
    assert asked[600].on
    assert not asked[610].on


@pytest.mark.parametrize("action", [OperatorAction.DISARM, OperatorAction.EMERGENCY_STOP, OperatorAction.ARM])
def test_an_operator_ends_a_burst_at_once_and_it_does_not_come_back(action: OperatorAction) -> None:
    asked = run(make(changes(*CYCLE)), 1200, [intensity(0, 1.0), act(611, action)])
    assert asked[600].on
    assert not asked[611].on
    assert not [ms for ms in on_times(asked) if ms >= 611]


def test_arming_in_mid_swing_waits_for_the_next_stride() -> None:
    second = tuple((ms + 1200, transition, source, to) for ms, transition, source, to in CYCLE)
    acts = [act(600, OperatorAction.ARM), intensity(600, 1.0)]
    asked = run(make(changes(*CYCLE, *second)), 2400, acts)
    assert on_times(asked)[0] == 1400


@pytest.mark.parametrize(
    ("value", "peak_ma"), [(0.5, 15.0), (1.0, 30.0), (7.0, 30.0), (-1.0, None), (math.nan, None), (0.0, None)]
)
def test_intensity_scales_the_current(value: float, peak_ma: float | None) -> None:
    asked = run(make(changes(*CYCLE)), 1200, [intensity(0, value)])
    currents = [request.current_ma for request in asked.values() if request.on]
    assert (max(currents) if currents else None) == peak_ma


def test_a_lower_intensity_acts_now_a_higher_one_with_the_next_burst() -> None:
    acts = [intensity(0, 1.0), intensity(600, 0.5), intensity(700, 1.0)]
    asked = run(make(changes(*CYCLE)), 1200, acts)
    assert asked[580].current_ma == 30.0
    assert {asked[ms].current_ma for ms in range(620, 900, 20)} == {15.0}
    asked = run(make(changes(*CYCLE)), 1200, [intensity(0, 1.0), intensity(611, 0.0)])
    assert not asked[611].on


def test_nothing_starts_before_the_foot_is_known_to_walk() -> None:
    asked = run(make(changes(*CYCLE), strides_before_start=1), 1200, [intensity(0, 1.0)])
    assert not on_times(asked)


@pytest.mark.parametrize("sensor", ["left_foot", "right_shank", "nonsense"])
def test_samples_of_unknown_sensors_only_let_time_pass(sensor: str) -> None:
    with_them, without = make(changes(*CYCLE)), make(changes(*CYCLE))
    for controller in (with_them, without):
        controller.step(intensity(0, 1.0))
    for t_ns in range(0, 1200 * MS, STEP_NS):
        expected = without.step(sample(t_ns))
        assert with_them.step(sample(t_ns)) == expected
        assert with_them.step(sample(t_ns, sensor)) == Decision()


def test_silence_between_samples_keeps_the_grid() -> None:
    controller = make()
    times = [0, 5, 31, 33, 39, 40, 59, 130, 139, 140]
    asked = [ms for ms in times if controller.step(Tick(ms * MS)).requests]
    assert asked == [0, 31, 40, 130, 140]


def test_silence_in_a_burst_is_put_before_the_gate_at_every_tick() -> None:
    controller = make(changes(*CYCLE))
    run(controller, 602, [intensity(0, 1.0)])
    ticks = [ms for ms in range(610, 660, 10) if controller.step(Tick(ms * MS)).requests]
    assert ticks == [610, 620, 630, 640, 650]


def test_the_plan_keeps_to_the_host_clock() -> None:
    """A sensor whose clock is an hour off stimulates at the same moments."""
    hour_ns = 3600 * 1_000_000_000
    rows = [
        PhaseChange(change.t_ns + hour_ns, FOOT, change.transition, change.source, change.destination)
        for change in changes(*CYCLE)
    ]
    reference = run(make(changes(*CYCLE)), 1200, [intensity(0, 1.0)])
    controller = make(rows)
    controller.step(intensity(0, 1.0))
    shifted = {}
    for t_ns in range(0, 1200 * MS, STEP_NS):
        decision = controller.step(ImuSample(t_ns, FOOT, t_ns + hour_ns, (0.0, 0.0, 9.81), (0.0, 0.0, 0.0)))
        for request in decision.requests:
            shifted[t_ns // MS] = request
    assert shifted == {ms: request for ms, request in reference.items() if ms in shifted}
    assert on_times(shifted) == on_times(reference)


@settings(max_examples=60, deadline=None)
@given(
    gaps_ms=st.lists(st.integers(0, 45), min_size=1, max_size=120),
    acts=st.lists(st.sampled_from(list(OperatorAction)), max_size=6),
    value=st.floats(0.0, 1.0),
)
def test_requests_come_in_time_whatever_the_events(
    gaps_ms: list[int], acts: list[OperatorAction], value: float
) -> None:
    """At the first event of every period there is a request; the same events give the same decisions."""
    times = np.cumsum(gaps_ms) * 2
    script = [
        PhaseChange(int(times[i]) * MS, FOOT, *CYCLE[k % 4][1:])
        for k, i in enumerate(range(0, len(times), 7))
        if i == 0 or times[i] != times[i - 7]
    ]
    events: list[Event] = [intensity(0, value), *(sample(int(ms) * MS) for ms in times)]
    for place, action in enumerate(acts):
        at = 1 + place * len(times) // 6
        events.insert(at, OperatorAct(events[at - 1].t_ns, action, value))
    one, other = make(script), make(script)
    asked: list[int] = []
    for event in events:
        decision = one.step(event)
        assert other.step(event) == decision
        if decision.requests:
            asked.append(event.t_ns)
        assert event.t_ns // PERIOD_NS == asked[-1] // PERIOD_NS


@pytest.mark.parametrize(
    "action", [OperatorAction.SET_BELT_SPEED, OperatorAction.SET_INCLINE, OperatorAction.FREE_GROUND]
)
def test_what_is_walked_on_neither_starts_nor_ends_a_burst(action: OperatorAction) -> None:
    reference = run(make(changes(*CYCLE)), 1200, [intensity(0, 1.0)])
    said = [intensity(0, 1.0), act(100, action, 0.1), act(700, action, 0.1)]
    assert run(make(changes(*CYCLE)), 1200, said) == reference


def test_geometry_sets_the_sensor_height() -> None:
    geometry = FootGeometry(toe_forward_m=0.1, toe_up_m=-0.06, heel_forward_m=-0.1, heel_up_m=-0.08)
    calibration = calibrations()[FOOT]
    assert stride_settings(calibration).geometry is None
    assert stride_settings(calibration, geometry).sensor_height_m == pytest.approx(0.07)
    for session in (Session(name="x"), Session(name="x", geometry={FOOT: geometry})):
        tracker = tracker_of(session, calibration)
        assert isinstance(tracker, FootTracker)
        assert tracker._maker.settings.geometry == dict(session.geometry).get(FOOT)


# --- The example session with a channel on the gastrocnemius, on a virtual patient ---


PATIENT = settings_for("severe", seed=3, sensors=("right_foot",), calf_channel=1)
SESSION = load_session(TRIALS / "session_push_off.toml")
CALF, TIBIALIS = SESSION.channels
SETTLED = 6  # strides that are not compared
LATE_NS = 60_000_000  # a phase is known some samples after the foot's true event
APART_NS = 1_000_000_000 // 50  # less than the time between two pulses of a channel


@pytest.fixture(scope="module")
def calibration() -> FootCalibration:
    return calibration_of(PATIENT)


@pytest.fixture(scope="module")
def both(calibration: FootCalibration) -> Walk:
    return walked(calibration, CALF, TIBIALIS)


@pytest.fixture(scope="module")
def alone(calibration: FootCalibration) -> Walk:
    return walked(calibration, TIBIALIS)


def walked(calibration: FootCalibration, *channels: Channel) -> Walk:
    return walk(PATIENT, SESSION.model_copy(update={"channels": channels}), calibration, 40.0, 25)


def changed(channel: Channel, **settings: Any) -> Channel:
    return Channel.model_validate({**channel.model_dump(), **settings})


def lasting(extension_s: float) -> Channel:
    """The calf's channel without the limit that ends its burst early."""
    return changed(CALF, extension_s=extension_s, limits={**CALF.limits.model_dump(), "max_on_s": 1.0})


def times_ns(done: Walk, channel: Channel) -> list[int]:
    return [pulse.t_ns for pulse in done.pulses if pulse.channel == channel.number]


def test_the_calf_is_stimulated_between_heel_rise_and_foot_off_alone(both: Walk) -> None:
    assert not both.latched
    strides = both.strides[2:-1]
    calf_ns = [t for t in times_ns(both, CALF) if strides[0].t_heel_off_ns < t < strides[-1].t_contact_ns]
    in_pre_swing = [sum(one.t_heel_off_ns < t < one.t_foot_off_ns for t in calf_ns) for one in strides]
    assert all(3 <= count <= 5 for count in in_pre_swing)  # 0.1 s at 40 Hz
    assert sum(in_pre_swing) == len(calf_ns)


def test_antagonists_never_have_pulses_at_the_same_time(both: Walk) -> None:
    bursts: list[tuple[int, int, int]] = []  # begin, end, channel
    for channel in (CALF, TIBIALIS):
        for t in times_ns(both, channel):
            if bursts and bursts[-1][2] == channel.number and t - bursts[-1][1] < 3 * APART_NS:
                bursts[-1] = (bursts[-1][0], t, channel.number)
            else:
                bursts.append((t, t, channel.number))
    bursts.sort()
    assert {channel for _, _, channel in bursts} == {CALF.number, TIBIALIS.number}
    assert all(end < begin for (_, end, _), (begin, _, _) in pairwise(bursts))
    off_ns = [one.t_foot_off_ns for one in both.strides]
    tibialis = [begin for begin, _, channel in bursts if channel == TIBIALIS.number]
    assert all(min(abs(begin - t) for t in off_ns) < LATE_NS for begin in tibialis[1:-1])


def test_it_pushes_off_more_and_the_toe_passes_no_lower(both: Walk, alone: Walk) -> None:
    more, usual = both.strides[SETTLED:], alone.strides[SETTLED:]
    assert median(s.push_off_j for s in more) > 1.05 * median(s.push_off_j for s in usual)
    assert median(s.toe_clearance_m for s in more) > median(s.toe_clearance_m for s in usual) - 0.002
    assert sum(s.dragged or s.stumbled for s in more) == 0


def test_a_burst_up_to_foot_off_does_harm_that_is_counted(
    calibration: FootCalibration, both: Walk, alone: Walk
) -> None:
    longer = walked(calibration, lasting(0.0), TIBIALIS)
    assert not longer.latched
    assert longer.harm.drags > both.harm.drags + len(longer.strides) / 4
    assert longer.harm.co_contraction_nms > both.harm.co_contraction_nms + 0.5
    assert both.harm.drags <= alone.harm.drags


def test_a_burst_through_swing_harms_at_once_and_most_strides(calibration: FootCalibration) -> None:
    """Nothing is wrong with the sensor, and the phases come in order: what tells such a setting is the harm counted."""
    through = walked(calibration, lasting(0.3), TIBIALIS)
    first_ns, *_, last_ns = times_ns(through, CALF)
    during = [one for one in through.strides if first_ns < one.t_contact_ns < last_ns + 10**9]
    harmed = [one.dragged or one.stumbled for one in during]
    assert harmed[0]
    assert sum(harmed) > 0.5 * len(harmed)


def test_exclusion_holds_whatever_the_phases_say(calibration: FootCalibration) -> None:
    done = walked(calibration, CALF, changed(TIBIALIS, start_phase="pre_swing"))
    calf_ns, tibialis_ns = times_ns(done, CALF), times_ns(done, TIBIALIS)
    assert calf_ns
    for one in done.strides[2:]:
        own = [t for t in calf_ns if one.t_heel_off_ns < t < one.t_contact_ns]
        assert own
        assert not any(min(own) <= t <= max(own) for t in tibialis_ns)


def test_no_other_session_stimulates_the_calf() -> None:
    assert [c.muscle for c in load_session(TRIALS / "session.toml").channels] == ["tibialis anterior"]


# --- A foot switch times bursts when the sensor tells no steps, and only then; the gate judges as ever ---


STRIDE_MS, SWING_MS = 1200, 450


def by_switch(
    use: str, *, switch_until_ms: int = 8000, silent_at_ms: int | None = None, samples_until_ms: int = 8000
) -> list[StimCommand]:
    """A sensor that tells no step, for it turns about the vertical alone, on a foot whose switch walks."""
    switch = FootSwitch.model_validate({"foot": FOOT, "source": "can_bit", "use": use})
    session = live_settings().model_copy(update={"foot_switches": (switch,)})
    controller, gate = Controller(session, {FOOT: CALIBRATION}), gate_of(session, {FOOT: CALIBRATION.up})
    commands: list[StimCommand] = []
    for ms in range(0, 8000, 10):
        events = []
        if ms <= samples_until_ms:
            living, turns_radps = 1e-4 * (ms // 10 % 9), 0.9 if ms % STRIDE_MS < SWING_MS else 0.0
            events.append(ImuSample(ms * MS, FOOT, ms * MS, (living, 0.0, 9.81), (living, 0.0, turns_radps)))
        if ms == 500:
            events += [
                OperatorAct(ms * MS, OperatorAction.ARM),
                OperatorAct(ms * MS, OperatorAction.SET_INTENSITY, 1.0),
            ]
        if ms > 500 and ms <= switch_until_ms and ms % STRIDE_MS in (0, SWING_MS // 10 * 10):
            events.append(FootSwitchEvent(ms * MS, FOOT, ms % STRIDE_MS != 0))
        if ms == silent_at_ms:
            events.append(FootSwitchEvent(ms * MS, FOOT, None))
        for event in events:
            gate.observe(event)
            commands += [gate.judge(event.t_ns, request) for request in controller.step(event).requests]
    return commands


def test_it_takes_over_after_two_cycles_and_bursts_with_the_switch() -> None:
    on = [command for command in by_switch("fallback") if command.on]
    began = [
        two.t_ns // MS for one, two in zip([None, *on], on, strict=False) if not one or two.t_ns - one.t_ns > 100 * MS
    ]
    assert [pytest.approx(ms, abs=40) for ms in (3600, 4800, 6000, 7200)] == began
    assert max(command.current_ma for command in on) == pytest.approx(30.0, abs=0.5)


def test_a_switch_that_only_compares_times_nothing() -> None:
    assert not [command for command in by_switch("compare") if command.on]


def test_a_switch_that_falls_silent_in_mid_burst_ends_it_as_soon_as_that_is_known() -> None:
    on = [command for command in by_switch("fallback", switch_until_ms=3600, silent_at_ms=4100) if command.on]
    assert on[0].t_ns // MS >= 3600
    assert 4080 <= on[-1].t_ns // MS <= 4100  # the sample of that moment comes before it


def test_after_a_silence_it_is_believed_after_two_cycles_again() -> None:
    fallback = SwitchFallback(FOOT)

    def released(at_ms: int) -> list[PhaseChange]:
        fallback.changes_at(FootSwitchEvent((at_ms - STRIDE_MS // 2) * MS, FOOT, True))
        return fallback.changes_at(FootSwitchEvent(at_ms * MS, FOOT, False))

    assert [bool(released(cycle * STRIDE_MS)) for cycle in range(1, 5)] == [False, False, True, True]
    (lost,) = fallback.changes_at(FootSwitchEvent(5000 * MS, FOOT, None))
    assert lost.transition is Transition.NONE
    assert fallback.changes_at(FootSwitchEvent(5100 * MS, FOOT, None)) == []  # the sensor's bursts are not its to end
    assert [bool(released(6000 + cycle * STRIDE_MS)) for cycle in range(1, 5)] == [False, False, True, True]


def test_an_open_contact_that_stays_open_is_left_to_the_longest_on_time() -> None:
    """A broken wire looks just like it."""
    on = [command.t_ns // MS for command in by_switch("fallback", switch_until_ms=3600) if command.on]
    assert on[0] >= 3600
    assert on[-1] <= 3600 + 3000 + 60


def test_without_data_from_the_sensor_there_is_no_current_whatever_the_switch_says() -> None:
    on = [command.t_ns // MS for command in by_switch("fallback", samples_until_ms=4900) if command.on]
    assert on
    assert on[-1] <= 4900 + 40


def test_the_sensors_first_swing_takes_over_again() -> None:
    fallback = SwitchFallback(FOOT)
    for cycle in range(4):
        at_ns = cycle * STRIDE_MS * MS
        fallback.changes_at(FootSwitchEvent(at_ns, FOOT, False))
        fallback.changes_at(FootSwitchEvent(at_ns + SWING_MS * MS, FOOT, True))
    assert fallback.active
    lifted = PhaseChange(5000 * MS, FOOT, Transition.T1, Phase.STANCE, Phase.PRE_SWING)
    swing = PhaseChange(5100 * MS, FOOT, Transition.T2, Phase.PRE_SWING, Phase.SWING)
    assert not fallback.follows_sensor(lifted)
    assert fallback.follows_sensor(swing)
    assert not fallback.active
    assert fallback.changes_at(FootSwitchEvent(5200 * MS, FOOT, True)) == []


def test_a_switch_that_chatters_or_stands_is_not_believed() -> None:
    fallback = SwitchFallback(FOOT)
    for number in range(50):
        fallback.changes_at(FootSwitchEvent(number * 40 * MS, FOOT, bool(number % 2)))
    assert not fallback.active
    slow = SwitchFallback(FOOT)
    for number in range(6):
        slow.changes_at(FootSwitchEvent(number * 3500 * MS, FOOT, False))
    assert not slow.active
