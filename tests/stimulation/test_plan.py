"""From phases to bursts: the trapezoid, its ends, its rounding, and what it leaves to the gate to refuse (nothing)."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import gate_bench
import pytest
from hypothesis import event, given, settings
from hypothesis import strategies as st

from fes.config import Channel
from fes.gate import SafetyGate
from fes.signals import ImuSample, OperatorAct, OperatorAction, StimCommand, StimRequest
from fes.stimulation.envelope import BurstParameters, Envelope, round_down
from fes.stimulation.plan import StimulationPlan
from statemachine.phases import Phase, PhaseChange, Transition
from statemachine.table import TABLE

MS = 1_000_000
STANCE, PRE_SWING, SWING, LOADING = Phase.STANCE, Phase.PRE_SWING, Phase.SWING, Phase.LOADING_RESPONSE
TRANSITIONS = {(row.source, row.destination): row.transition for row in TABLE}
ENDS = {row.transition: (row.source, row.destination) for row in TABLE} | {Transition.NONE: (SWING, STANCE)}


def make_channel(number: int = 0, foot: str = "left_foot", **changes: Any) -> Channel:
    limits = {"max_current_ma": 40.0, "max_charge_per_phase_uc": 12.0, "max_rise_ma_per_s": 200.0}
    own = {"rise_s": 0.1, "fall_s": 0.1, "extension_s": 0.06, **changes, "limits": limits | changes.get("limits", {})}
    return gate_bench.make_channel(number, foot, **own)


class Walk:
    """One foot stepping through its phases, with requests whenever the plan or the 20 ms period wants them."""

    def __init__(self, *channels: Channel, **more: Any) -> None:
        self.plan = StimulationPlan(channels or (make_channel(),), **more)
        self.phase = STANCE
        self.t_ms = 0
        self.intensity = 1.0
        self.requests()

    def enter(self, phase: Phase, *, permitted: bool = True, foot: str = "left_foot") -> None:
        change = PhaseChange(self.t_ms * MS, foot, TRANSITIONS[self.phase, phase], self.phase, phase)
        self.plan.on_phase(change, permitted=permitted)
        self.phase = phase

    def lose(self) -> None:
        """The phase is lost; the foot begins anew in stance."""
        self.plan.on_phase(
            PhaseChange(self.t_ms * MS, "left_foot", Transition.NONE, self.phase, STANCE), permitted=True
        )
        self.phase = STANCE

    def requests(self) -> tuple[StimRequest, ...]:
        return self.plan.requests(self.t_ms * MS, self.intensity)

    def current(self, at_ms: int | None = None, number: int = 0) -> float:
        """The current requested at a time; 0 for off. Until then commands go out every 20 ms, and when one is due."""
        target = self.t_ms if at_ms is None else at_ms
        while self.t_ms < target:
            if self.t_ms % 20 == 0 or self.plan.due(self.t_ms * MS, self.intensity):
                self.requests()
            self.t_ms += 1
        request = next(one for one in self.requests() if one.channel == number)
        assert request.on == (request.current_ma > 0)
        return request.current_ma


def test_off_is_its_own_request_before_anything_has_happened() -> None:
    plan = StimulationPlan((make_channel(), make_channel(3)))
    assert plan.requests(0, 1.0) == (StimRequest(0, False), StimRequest(3, False))
    assert not plan.due(10 * MS, 1.0)


class ByHand(NamedTuple):
    """A burst asked for at that time, to hold for 300 ms; ``adopt``: for a step to take over."""

    at_ms: int
    adopt: bool = False


# a phase is entered; a whole number only lets time pass until then (ms), with a current (mA) it is what is asked for
# then; a lone fraction is the operator's intensity from there on
Script = list[Phase | int | float | ByHand | tuple[int, float]]
BURSTS: dict[str, tuple[dict[str, Any], Script]] = {
    "the trapezoid of one stride": ({}, [
        PRE_SWING, (0, 0.5), (25, 5.0), (50, 10.0), (100, 20.0), SWING, (500, 20.0),
        LOADING, (560, 20.0), (610, 10.0), (635, 5.0), (660, 0.0), 700, STANCE, (1000, 0.0),
    ]),
    "a start delay": ({"start_delay_s": 0.05}, [PRE_SWING, (49, 0.0), (100, 10.0)]),
    "a stop before the delay is over drops it": (
        {"start_delay_s": 0.2}, [PRE_SWING, 100, SWING, 150, LOADING, (400, 0.0)]
    ),
    "a stop while it still rises: it falls from the level reached": (
        {"extension_s": 0.0}, [PRE_SWING, 30, SWING, 50, LOADING, (50, 10.0), (100, 5.0), (125, 2.5), (150, 0.0)]
    ),
    "it goes on rising through the extension": (
        {"extension_s": 0.02}, [PRE_SWING, 30, SWING, 50, LOADING, (70, 14.0), (120, 7.0)]
    ),
    "no fall time is a cut": ({"extension_s": 0.0, "fall_s": 0.0}, [PRE_SWING, 100, SWING, LOADING, (101, 0.0)]),
    "a calf's, from stance to swing": (
        {"start_phase": "stance", "start_delay_s": 0.2, "stop_phase": "swing", "extension_s": 0.0},
        [STANCE, (199, 0.0), (300, 20.0), PRE_SWING, (400, 20.0), SWING, (450, 10.0), LOADING, (450, 0.0)],
    ),
    "a start phase entered again begins another after the least off time": (
        {"start_phase": "stance", "stop_phase": "swing"},
        [STANCE, 100, PRE_SWING, (200, 20.0), STANCE, (200, 0.0), (299, 0.0), (350, 10.0)],
    ),
    "a heel held up for good: it ends in a ramp before the longest on time": (
        {}, [PRE_SWING, (1900, 20.0), (1950, 10.0), (2000, 0.0), (5000, 0.0)]
    ),
    "an on time too short for the ramps is kept all the same": (
        {"fall_s": 0.5, "limits": {"max_on_s": 0.15}}, [PRE_SWING, (100, 20.0), (149, 18.0), (150, 0.0)]
    ),
    "what would come half a second late comes": (
        {"limits": {"min_off_s": 0.7}},
        [PRE_SWING, (200, 20.0), STANCE, (200, 0.0), 400, PRE_SWING, (880, 0.0), (1100, 20.0), (1500, 20.0)],
    ),
    "what would come later does not: the foot has long done something else": (
        {"limits": {"min_off_s": 0.700000001}},
        [PRE_SWING, (200, 20.0), STANCE, (200, 0.0), 400, PRE_SWING, (880, 0.0), (1100, 0.0), (1500, 0.0)],
    ),
    **{f"less than a step of {what} is off": ({what: less}, [PRE_SWING, (100, 0.0)])
       for what, less in (("frequency_hz", 0.9), ("pulse_width_us", 0.9), ("current_ma", 0.4))},
    "by hand it holds and falls, after 60 ms of extension": (
        {}, [ByHand(20), (20, 0.5), (70, 10.0), (300, 20.0), (380, 20.0), (430, 10.0), (480, 0.0)]
    ),
    "by hand it does not begin anew while it lasts": ({}, [ByHand(20), 200, ByHand(200), (480, 0.0)]),
    "by hand and adopted it becomes the step's, and its hold is forgotten": ({}, [
        ByHand(20, True), 200, PRE_SWING, (200, 20.0), (700, 20.0), 720, SWING, 740, LOADING,
        (790, 20.0), (850, 10.0), (900, 0.0),
    ]),
    "by hand and not adopted it ends, and after the least off time the step's own begins": (
        {}, [ByHand(20), 200, PRE_SWING, (200, 0.0), (299, 0.0), 320, (500, 20.0)]
    ),
    "by hand and falling already it is not adopted": (
        {}, [ByHand(20, True), 400, PRE_SWING, (400, 0.0), 500, (700, 20.0)]
    ),
    "a step before it begins its own, which has no hold": (
        {}, [ByHand(300, True), 20, PRE_SWING, 40, (240, 20.0), (900, 20.0)]
    ),
    "intensity scales the current": ({}, [0.5, PRE_SWING, (100, 10.0)]),
    "a lower intensity acts at once, a higher one with the next burst": (
        {}, [PRE_SWING, (100, 20.0), 0.5, (101, 10.0), 0.8, (120, 10.0), STANCE, 300, PRE_SWING, (400, 16.0)]
    ),
    "it has the intensity of the time at which it is due": (
        {"start_delay_s": 0.1}, [0.5, 20, PRE_SWING, 120, 1.0, (400, 10.0)]
    ),
    "an intensity set during the start delay is the burst's": (
        {"start_delay_s": 0.05}, [0.5, PRE_SWING, 40, 0.8, (200, 16.0)]
    ),
    "intensity 0 ends it for good": ({}, [PRE_SWING, (100, 20.0), 0.0, (101, 0.0), 1.0, (300, 0.0)]),
    "dimmed below a step it does not come back": ({}, [PRE_SWING, (10, 2.0), 0.02, (11, 0.0), (100, 0.0)]),
    **{f"an intensity of {given} is clipped": ({}, [given, PRE_SWING, (100, ma)])
       for given, ma in ((math.nan, 0.0), (-1.0, 0.0), (7.0, 20.0), (math.inf, 20.0))},
}  # fmt: skip


@pytest.mark.parametrize("what", BURSTS)
def test_a_bursts_current(what: str) -> None:
    changes, script = BURSTS[what]
    walk = Walk(make_channel(**changes))
    walk.phase = LOADING if script[0] is STANCE else STANCE
    for step in script:
        if isinstance(step, Phase):
            walk.enter(step)
        elif isinstance(step, ByHand):
            walk.plan.start(0, step.at_ms * MS, 300 * MS, adopt=step.adopt)
        elif isinstance(step, float):
            walk.intensity = step
        elif isinstance(step, int):
            walk.current(step)
        else:
            assert walk.current(step[0]) == step[1], step


def test_width_and_frequency_stay_the_same_through_the_burst() -> None:
    walk = Walk()
    walk.enter(PRE_SWING)
    for t_ms in (10, 60, 150):
        walk.current(t_ms)
        assert walk.requests()[0] == StimRequest(0, True, walk.current(), 300.0, 40.0)


@pytest.mark.parametrize(
    ("steps", "pulse"),
    [({}, (19.5, 299.0, 39.0)), ({"current_step_ma": 2.0, "pulse_width_step_us": 10.0}, (18.0, 290.0, 39.0))],
)
def test_values_are_rounded_down_to_the_devices_steps(
    steps: dict[str, float], pulse: tuple[float, float, float]
) -> None:
    walk = Walk(make_channel(current_ma=19.9, pulse_width_us=299.9, frequency_hz=39.9), **steps)
    walk.enter(PRE_SWING)
    walk.current(100)
    assert walk.requests() == (StimRequest(0, True, *pulse),)


def rising(*channels: Channel, at_ns: int = 0, **steps: float) -> StimulationPlan:
    """A plan whose left foot's heel rises."""
    plan = StimulationPlan(channels or (make_channel(),), **steps)
    plan.requests(0, 1.0)
    plan.on_phase(PhaseChange(at_ns, "left_foot", Transition.T1, STANCE, PRE_SWING), permitted=True)
    return plan


def test_the_rise_begins_at_the_first_request_whenever_the_phase_came() -> None:
    plan = rising()
    assert [plan.requests(t_ms * MS, 1.0)[0].current_ma for t_ms in (50, 60)] == [0.5, 2.0]


@pytest.mark.requirement("SR-02")
@pytest.mark.parametrize("end", [PRE_SWING, SWING, LOADING])
def test_into_stance_cuts_off_at_once(end: Phase) -> None:
    """T5, T6 and T4."""
    walk = Walk()
    walk.enter(PRE_SWING)
    for phase in (SWING, LOADING)[: end - 1]:
        walk.current(walk.t_ms + 90)
        walk.enter(phase)
    assert walk.current(walk.t_ms + 50) > 0.0
    walk.enter(STANCE)
    assert walk.plan.due(walk.t_ms * MS, 1.0)
    assert walk.current() == 0.0
    assert walk.current(walk.t_ms + 500) == 0.0


@pytest.mark.requirement("SR-02")
def test_lost_phase_cuts_off_and_starts_nothing() -> None:
    walk = Walk(make_channel(start_phase="stance", stop_phase="swing"))
    walk.lose()
    assert walk.current(100) == 0.0
    walk.phase = LOADING
    walk.enter(STANCE)
    assert walk.current(200) == 20.0
    walk.lose()
    assert walk.current() == 0.0


@pytest.mark.requirement("SR-02")
def test_not_permitted_at_the_start_means_not_in_this_cycle() -> None:
    walk = Walk()
    walk.enter(PRE_SWING, permitted=False)
    walk.current(20)
    walk.enter(SWING)
    walk.enter(LOADING)
    assert walk.current(200) == 0.0
    walk.enter(STANCE)
    walk.enter(PRE_SWING)
    assert walk.current(300) == 20.0


def test_permission_counts_at_the_start_only() -> None:
    walk = Walk()
    walk.enter(PRE_SWING)
    walk.current(100)
    walk.enter(SWING, permitted=False)
    assert walk.current(200) == 20.0


@pytest.mark.requirement("SR-02")
def test_skipped_start_phase_means_no_burst() -> None:
    walk = Walk(make_channel(start_phase="swing", stop_phase="stance"))
    walk.enter(PRE_SWING)
    walk.current(100)
    walk.phase = PRE_SWING
    walk.plan.on_phase(PhaseChange(100 * MS, "left_foot", Transition.T3, SWING, LOADING), permitted=True)
    assert walk.current(200) == 0.0


def test_each_foot_has_its_own_channels() -> None:
    walk = Walk(make_channel(0), make_channel(1, "right_foot"))
    walk.enter(PRE_SWING)
    assert walk.current(100) == 20.0
    assert walk.current(number=1) == 0.0
    walk.phase = STANCE
    walk.enter(PRE_SWING, foot="right_foot")
    assert walk.current(200, number=1) == 20.0
    assert walk.current() == 20.0


def test_a_channel_is_due_though_the_one_before_it_rests() -> None:
    walk = Walk(make_channel(0), make_channel(1, "right_foot"))
    walk.enter(PRE_SWING, foot="right_foot")
    assert [walk.plan.due(t_ms * MS, 1.0) for t_ms in (0, 2, 3)] == [True, True, True]


def test_cancel_ends_bursts_of_one_foot_or_both() -> None:
    walk = Walk(make_channel(0), make_channel(1, "right_foot"), make_channel(2, start_delay_s=0.5))
    walk.enter(PRE_SWING)
    walk.phase = STANCE
    walk.enter(PRE_SWING, foot="right_foot")
    walk.current(100)
    walk.plan.cancel("left_foot")
    assert [request.on for request in walk.requests()] == [False, True, False]
    walk.plan.cancel()
    assert [request.on for request in walk.requests()] == [False, False, False]
    assert walk.current(700, number=2) == 0.0
    walk.phase = STANCE
    walk.enter(PRE_SWING)
    assert walk.current(800) == 20.0


def test_due_speaks_up_exactly_when_a_channel_goes_on_or_off() -> None:
    walk = Walk()
    walk.enter(PRE_SWING)
    assert [walk.plan.due(t_ms * MS, 1.0) for t_ms in (0, 2, 3, 50)] == [True] * 4
    walk.current(3)
    assert not any(walk.plan.due(t_ms * MS, 1.0) for t_ms in (4, 50, 200))
    walk.current(200)
    walk.enter(SWING)
    walk.enter(LOADING)
    assert [walk.plan.due(t_ms * MS, 1.0) for t_ms in (200, 260, 357, 358, 400)] == [False, False, False, True, True]


def test_due_changes_nothing() -> None:
    asked, unasked = Walk(), Walk()
    for walk in (asked, unasked):
        walk.enter(PRE_SWING)
    for t_ms in range(0, 90, 7):
        asked.plan.due(t_ms * MS, 0.3)
    assert asked.current(90) == unasked.current(90) > 0.0


def test_late_news_of_a_start_does_not_jump() -> None:
    """The phase change is dated before the last command: the rise counts from the first command of the burst."""
    walk = Walk()
    walk.current(100)
    walk.plan.on_phase(PhaseChange(40 * MS, "left_foot", Transition.T1, STANCE, PRE_SWING), permitted=True)
    assert walk.current(100) == 0.5
    assert walk.current(110) == 2.0


@pytest.mark.requirement("SR-08")
def test_antagonist_waits_until_its_partner_is_off() -> None:
    calf = make_channel(0, start_phase="swing", stop_phase="stance", never_with=[1])
    walk = Walk(calf, make_channel(1))
    walk.enter(PRE_SWING)
    walk.current(100)
    walk.enter(SWING)
    assert walk.current(200) == 0.0
    assert walk.current(number=1) == 20.0
    walk.enter(LOADING)
    assert walk.current(340) == 0.0
    assert walk.current(357) == 0.0
    assert walk.current(358, number=1) == 0.0
    assert walk.current(408) == 10.0


def test_rounding_down_where_the_quotient_rounds_up() -> None:
    assert 17 * 0.1 > 1.7
    assert round_down(1.7, 0.1) == 16 * 0.1
    assert round_down(3.4999999999999996, 0.7) == 4 * 0.7
    assert round_down(20.49, 0.5) == round_down(20.0, 0.5) == 20.0


# --- properties ---------------------------------------------------------------------------------------------

seconds = st.floats(0.0, 1.0).map(lambda value: round(value, 3))


@st.composite
def envelopes(draw: st.DrawFn) -> Envelope:
    stop = draw(st.none() | st.integers(-100 * MS, 4000 * MS))
    whole = st.integers(0, 1000 * MS)
    current_ma, intensity = draw(st.floats(0.1, 130.0)), draw(st.floats(0.0, 1.0))
    rise_ns, fall_ns, most_ns = draw(whole) + 1, draw(whole), draw(st.integers(1, 3000 * MS))
    parameters = BurstParameters(current_ma, 0.0, 0.0, (300.0,))
    return Envelope(0, parameters, 40.0, rise_ns, draw(whole), fall_ns, most_ns, intensity, stop)


@given(envelope=envelopes(), times=st.lists(st.integers(-100 * MS, 5000 * MS), min_size=2, max_size=30))
@settings(max_examples=200, deadline=None)
def test_envelope_is_within_bounds_rises_then_falls_and_ends(envelope: Envelope, times: list[int]) -> None:
    levels = [envelope.level_ma(t_ns) for t_ns in sorted(times)]
    peak = levels.index(max(levels))
    assert all(0.0 <= level <= envelope.parameters.current_ma * envelope.intensity for level in levels)
    assert levels[: peak + 1] == sorted(levels[: peak + 1])
    assert levels[peak:] == sorted(levels[peak:], reverse=True)
    for t_ns, level in zip(sorted(times), levels, strict=True):
        assert level == 0.0 or not envelope.over(t_ns)
        assert level == 0.0 or t_ns < envelope.max_on_ns


@given(value=st.floats(0.0, 1e4), step=st.sampled_from([0.1, 0.25, 0.5, 1.0, 2.0]))
def test_rounding_is_down_by_less_than_a_step(value: float, step: float) -> None:
    rounded = round_down(value, step)
    assert rounded <= value < rounded + step * (1 + 1e-9)
    assert rounded / step == pytest.approx(round(rounded / step))


NEXT = {STANCE: [PRE_SWING], PRE_SWING: [SWING, STANCE], SWING: [LOADING, STANCE], LOADING: [STANCE]}
names = ["stance", "pre_swing", "swing", "loading_response"]


@st.composite
def channel_sets(draw: st.DrawFn) -> tuple[Channel, ...]:
    channels = []
    for number in range(draw(st.integers(1, 3))):
        start, stop = draw(st.permutations(names))[:2]
        rise_s = draw(st.floats(0.1, 0.5))
        channels.append(
            make_channel(
                number,
                draw(st.sampled_from(["left_foot", "right_foot"])),
                current_ma=draw(st.floats(1.0, 20.0)),
                start_phase=start,
                stop_phase=stop,
                start_delay_s=draw(seconds),
                rise_s=rise_s,
                extension_s=draw(st.floats(0.0, 0.3)),
                fall_s=draw(st.floats(0.0, 0.5)),
                never_with=draw(st.sampled_from([[], [(number + 1) % 3]])),
                limits={"max_on_s": draw(st.sampled_from([0.3, 1.0, 3.0]))},
            )
        )
    return tuple(channels)


@st.composite
def phase_steps(draw: st.DrawFn) -> list[tuple[int, int, bool, float]]:
    """How long each phase lasts (ms), which of its exits is taken, whether a start is permitted, the intensity."""
    dwell_ms = st.integers(1, 60) | st.integers(1, 900)
    intensities = st.sampled_from([1.0, 1.0, 0.7, 0.1, 0.0])
    step = st.tuples(dwell_ms, st.sampled_from([0, 0, 0, 1]), st.sampled_from([True, True, True, False]), intensities)
    return draw(st.lists(step, max_size=12))


@pytest.mark.parametrize("step_ma", [0.5, 1.0, 2.0])
@given(channels=channel_sets(), left=phase_steps(), right=phase_steps())
@settings(max_examples=100, deadline=None)
def test_gate_never_refuses_what_the_plan_asks(
    step_ma: float,
    channels: tuple[Channel, ...],
    left: list[tuple[int, int, bool, float]],
    right: list[tuple[int, int, bool, float]],
) -> None:
    """Any phases at any pace, changing intensity, both feet; samples every 4 ms, commands every 20 ms or when due."""
    plan = StimulationPlan(channels, current_step_ma=step_ma)
    gate = SafetyGate(channels, max_data_age_ms=40, validity_ms=60, current_step_ma=step_ma)
    changes = sorted(changes_of("left_foot", left) + changes_of("right_foot", right), key=lambda pair: pair[0].t_ns)
    phases = {"left_foot": LOADING, "right_foot": LOADING}
    end_ms = (changes[-1][0].t_ns // MS if changes else 0) + 1000
    intensity, on = 1.0, 0
    for t_ms in range(0, end_ms, 4):
        t_ns = t_ms * MS
        for foot in phases:
            living = 1e-9 * (t_ns % 1_000_003)
            turns_radps = 1.0 if t_ms % 200 == 0 else 0.0  # by jerks, or the gate would say that the foot rests
            gate.observe(ImuSample(t_ns, foot, t_ns, (0.0, living, 9.8), (0.0, 0.0, turns_radps + living)))
        while changes and changes[0][0].t_ns <= t_ns:
            change, (_, _, permitted, intensity) = changes.pop(0)
            plan.on_phase(change, permitted=permitted)
            phases[change.foot] = change.destination
        if t_ms == 0:
            gate.observe(OperatorAct(t_ns, OperatorAction.ARM))
        if t_ms % 20 and not plan.due(t_ns, intensity):
            continue
        for channel, request in zip(channels, plan.requests(t_ns, intensity), strict=True):
            command = gate.judge(t_ns, request)
            assert command == answer_to(request, t_ns), command.refused
            assert request.current_ma <= channel.current_ma * intensity
            assert not request.on or within_run(phases[channel.foot], channel)
            on += request.on
    event("stimulated" if on else "silent")


def test_gate_lets_a_device_of_coarse_steps_begin_right_after_a_command() -> None:
    """The command may be another channel's; 200 mA/s where 400 are allowed, in steps of 1 mA."""
    channels = (make_channel(limits={"max_rise_ma_per_s": 400.0}),)
    plan = StimulationPlan(channels, current_step_ma=1.0)
    gate = SafetyGate(channels, max_data_age_ms=40, validity_ms=60, current_step_ma=1.0)
    gate.observe(ImuSample(0, "left_foot", 0, (0.0, 0.0, 9.8), (0.0, 0.0, 1.0)))
    gate.observe(OperatorAct(0, OperatorAction.ARM))
    gate.judge(0, plan.requests(0, 1.0)[0])
    plan.on_phase(PhaseChange(0, "left_foot", Transition.T1, STANCE, PRE_SWING), permitted=True)
    asked = [plan.requests(t_ms * MS, 1.0)[0] for t_ms in (4, 5)]
    assert [request.current_ma for request in asked] == [1.0, 1.0]
    commands = [gate.judge(t_ms * MS, request) for t_ms, request in zip((4, 5), asked, strict=True)]
    assert [command.current_ma for command in commands] == [1.0, 1.0]
    assert gate.latched == ""


def changes_of(
    foot: str, steps: list[tuple[int, int, bool, float]]
) -> list[tuple[PhaseChange, tuple[int, int, bool, float]]]:
    phase, t_ms, changes = LOADING, 0, []
    for step in steps:
        t_ms += step[0]
        destination = NEXT[phase][step[1] % len(NEXT[phase])]
        transition = TRANSITIONS[phase, destination]
        changes.append((PhaseChange(t_ms * MS, foot, transition, phase, destination), step))
        phase = destination
    return changes


def answer_to(request: StimRequest, t_ns: int) -> StimCommand:
    width_us, rate_hz = request.pulse_width_us, request.frequency_hz
    return StimCommand(t_ns, request.channel, request.on, request.current_ma, width_us, rate_hz, 60)


def within_run(phase: Phase, channel: Channel) -> bool:
    walked = names.index(channel.start_phase)
    while walked != phase:
        if names[walked] == channel.stop_phase:
            return False
        walked = (walked + 1) % 4
    return True


def test_same_calls_same_answers() -> None:
    def run() -> list[StimRequest]:
        walk = Walk(make_channel(0), make_channel(1, start_phase="swing", stop_phase="stance"))
        said: list[StimRequest] = []
        for phase in (PRE_SWING, SWING, LOADING, STANCE) * 3:
            walk.enter(phase)
            for _ in range(20):
                walk.t_ms += 13
                said.extend(walk.requests())
        return said

    assert run() == run()
    assert any(request.on for request in run())


def test_another_sensors_phases_change_nothing() -> None:
    walk = Walk()
    walk.enter(PRE_SWING, foot="left_shank")
    assert walk.current(100) == 0.0
