"""From phases to bursts: the trapezoid, its ends, its rounding, and what it leaves to the gate to refuse (nothing)."""

from __future__ import annotations

import math
from typing import Any

import pytest
from hypothesis import event, given, settings
from hypothesis import strategies as st

from fes.config import Channel
from fes.gate import SafetyGate
from fes.signals import ImuSample, OperatorAct, OperatorAction, StimCommand, StimRequest
from fes.stimulation.envelope import BurstParameters, Envelope, round_down
from fes.stimulation.plan import StimulationPlan
from statemachine.phases import Phase, PhaseChange, Transition

MS = 1_000_000
STANCE, PRE_SWING, SWING, LOADING = Phase.STANCE, Phase.PRE_SWING, Phase.SWING, Phase.LOADING_RESPONSE
TRANSITIONS = {
    (STANCE, PRE_SWING): Transition.T1,
    (PRE_SWING, SWING): Transition.T2,
    (SWING, LOADING): Transition.T3,
    (LOADING, STANCE): Transition.T4,
    (PRE_SWING, STANCE): Transition.T5,
    (SWING, STANCE): Transition.T6,
}


def make_channel(number: int = 0, foot: str = "left_foot", **changes: Any) -> Channel:
    limits = {
        "max_current_ma": 40.0,
        "max_pulse_width_us": 400.0,
        "max_frequency_hz": 50.0,
        "max_charge_per_phase_uc": 12.0,
        "max_charge_per_minute_mc": 50.0,
        "max_current_density_ma_per_cm2": 1.0,
        "max_rise_ma_per_s": 200.0,
        "max_on_s": 2.0,
        "min_off_s": 0.1,
    } | changes.pop("limits", {})
    own = {
        "name": f"channel {number}",
        "number": number,
        "foot": foot,
        "electrode_area_cm2": 25.0,
        "current_ma": 20.0,
        "pulse_width_us": 300.0,
        "frequency_hz": 40.0,
        "rise_s": 0.1,
        "fall_s": 0.1,
        "extension_s": 0.06,
        "limits": limits,
    }
    return Channel.model_validate(own | changes)


class Walk:
    """One foot stepping through its phases, with requests whenever the plan or the 20 ms period wants them."""

    def __init__(self, *channels: Channel, intensity: float = 1.0, foot: str = "left_foot", **steps: float) -> None:
        self.plan = StimulationPlan(channels or (make_channel(),), **steps)
        self.phase = STANCE
        self.foot = foot
        self.t_ms = 0
        self.intensity = intensity
        self.requests()

    def enter(self, phase: Phase, *, permitted: bool = True, foot: str | None = None) -> None:
        change = PhaseChange(self.t_ms * MS, foot or self.foot, TRANSITIONS[self.phase, phase], self.phase, phase)
        self.plan.on_phase(change, permitted=permitted)
        self.phase = phase

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


def test_trapezoid_of_one_stride() -> None:
    walk = Walk()
    walk.enter(PRE_SWING)
    assert walk.current(0) == 0.5, "it begins with one step of the device"
    assert walk.current(25) == 5.0
    assert walk.current(50) == 10.0
    assert walk.current(100) == 20.0
    walk.enter(SWING)
    assert walk.current(500) == 20.0
    walk.enter(LOADING)
    assert walk.current(560) == 20.0, "held past first contact"
    assert walk.current(610) == 10.0
    assert walk.current(635) == 5.0
    assert walk.current(660) == 0.0
    walk.t_ms = 700
    walk.enter(STANCE)
    assert walk.current(1000) == 0.0


def test_width_and_frequency_stay_the_same_through_the_burst() -> None:
    walk = Walk()
    walk.enter(PRE_SWING)
    for t_ms in (10, 60, 150):
        walk.current(t_ms)
        assert walk.requests()[0] == StimRequest(0, True, walk.current(), 300.0, 40.0)


def test_values_are_rounded_down_to_the_devices_steps() -> None:
    channel = make_channel(current_ma=19.9, pulse_width_us=299.9, frequency_hz=39.9)
    walk = Walk(channel)
    walk.enter(PRE_SWING)
    walk.current(100)
    assert walk.requests() == (StimRequest(0, True, 19.5, 299.0, 39.0),)
    walk = Walk(channel, current_step_ma=2.0, pulse_width_step_us=10.0)
    walk.enter(PRE_SWING)
    walk.current(100)
    assert walk.requests() == (StimRequest(0, True, 18.0, 290.0, 39.0),)


def test_below_one_step_is_off() -> None:
    for weak in (make_channel(frequency_hz=0.9), make_channel(pulse_width_us=0.9), make_channel(current_ma=0.4)):
        walk = Walk(weak)
        walk.enter(PRE_SWING)
        assert walk.current(100) == 0.0


def test_the_rise_begins_at_the_first_request_whenever_the_phase_came() -> None:
    plan = StimulationPlan((make_channel(),))
    plan.on_phase(PhaseChange(0, "left_foot", Transition.T1, STANCE, PRE_SWING), permitted=True)
    assert plan.requests(50 * MS, 1.0)[0].current_ma == 0.5
    assert plan.requests(60 * MS, 1.0)[0].current_ma == 2.0


def test_start_delay() -> None:
    walk = Walk(make_channel(start_delay_s=0.05))
    walk.enter(PRE_SWING)
    assert walk.current(49) == 0.0
    assert walk.current(100) == 10.0


def test_stop_before_the_delay_is_over_drops_the_burst() -> None:
    walk = Walk(make_channel(start_delay_s=0.2))
    walk.enter(PRE_SWING)
    walk.current(100)
    walk.enter(SWING)
    walk.current(150)
    walk.enter(LOADING)
    assert walk.current(400) == 0.0


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
    walk.plan.on_phase(PhaseChange(0, "left_foot", Transition.NONE, SWING, STANCE), permitted=True)
    assert walk.current(100) == 0.0
    walk.phase = LOADING
    walk.enter(STANCE)
    assert walk.current(200) == 20.0
    walk.plan.on_phase(PhaseChange(200 * MS, "left_foot", Transition.NONE, STANCE, STANCE), permitted=True)
    assert walk.current() == 0.0


def test_stop_while_still_rising_falls_from_the_level_reached() -> None:
    walk = Walk(make_channel(extension_s=0.0))
    walk.enter(PRE_SWING)
    walk.current(30)
    walk.enter(SWING)
    walk.current(50)
    walk.enter(LOADING)
    assert walk.current(50) == 10.0
    assert walk.current(100) == 5.0
    assert walk.current(125) == 2.5
    assert walk.current(150) == 0.0


def test_burst_still_rising_goes_on_rising_through_the_extension() -> None:
    walk = Walk(make_channel(extension_s=0.02))
    walk.enter(PRE_SWING)
    walk.current(30)
    walk.enter(SWING)
    walk.current(50)
    walk.enter(LOADING)
    assert walk.current(70) == 14.0
    assert walk.current(120) == 7.0


def test_no_fall_time_is_a_cut() -> None:
    walk = Walk(make_channel(extension_s=0.0, fall_s=0.0))
    walk.enter(PRE_SWING)
    walk.current(100)
    walk.enter(SWING)
    walk.enter(LOADING)
    assert walk.current(101) == 0.0


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


def test_calf_from_stance_to_swing() -> None:
    """Push-off: starts with a delay in stance, is held through pre-swing, and stops in swing."""
    walk = Walk(make_channel(start_phase="stance", start_delay_s=0.2, stop_phase="swing", extension_s=0.0))
    walk.phase = LOADING
    walk.enter(STANCE)
    assert walk.current(199) == 0.0
    assert walk.current(300) == 20.0
    walk.enter(PRE_SWING)
    assert walk.current(400) == 20.0
    walk.enter(SWING)
    assert walk.current(450) == 10.0
    walk.enter(LOADING)
    assert walk.current() == 0.0


def test_start_phase_entered_again_begins_a_new_burst_after_the_least_off_time() -> None:
    walk = Walk(make_channel(start_phase="stance", stop_phase="swing"))
    walk.phase = LOADING
    walk.enter(STANCE)
    walk.current(100)
    walk.enter(PRE_SWING)
    assert walk.current(200) == 20.0
    walk.enter(STANCE)
    assert walk.current() == 0.0
    assert walk.current(299) == 0.0
    assert walk.current(350) == 10.0


def test_intensity_scales_the_current() -> None:
    walk = Walk(intensity=0.5)
    walk.enter(PRE_SWING)
    assert walk.current(100) == 10.0


def test_lower_intensity_acts_at_once_and_a_higher_one_with_the_next_burst() -> None:
    walk = Walk()
    walk.enter(PRE_SWING)
    assert walk.current(100) == 20.0
    walk.intensity = 0.5
    assert walk.current(101) == 10.0
    walk.intensity = 0.8
    assert walk.current(120) == 10.0
    walk.enter(STANCE)
    walk.current(300)
    walk.enter(PRE_SWING)
    assert walk.current(400) == 16.0


def test_intensity_set_during_the_start_delay_is_the_bursts() -> None:
    walk = Walk(make_channel(start_delay_s=0.05), intensity=0.5)
    walk.enter(PRE_SWING)
    walk.current(40)
    walk.intensity = 0.8
    assert walk.current(200) == 16.0


def test_intensity_zero_ends_the_burst_for_good() -> None:
    walk = Walk()
    walk.enter(PRE_SWING)
    walk.current(100)
    assert walk.plan.due(101 * MS, 0.0)
    walk.intensity = 0.0
    assert walk.current(101) == 0.0
    walk.intensity = 1.0
    assert not walk.plan.due(300 * MS, 1.0)
    assert walk.current(300) == 0.0


def test_burst_dimmed_below_a_step_does_not_come_back() -> None:
    walk = Walk()
    walk.enter(PRE_SWING)
    assert walk.current(10) == 2.0
    walk.intensity = 0.02
    assert walk.current(11) == 0.0
    assert walk.current(100) == 0.0


@pytest.mark.parametrize(("given_value", "current"), [(math.nan, 0.0), (-1.0, 0.0), (7.0, 20.0), (math.inf, 20.0)])
def test_intensity_is_clipped(given_value: float, current: float) -> None:
    walk = Walk(intensity=given_value)
    walk.enter(PRE_SWING)
    assert walk.current(100) == current


def test_burst_ends_in_a_ramp_before_the_longest_on_time() -> None:
    """A heel held up for good."""
    walk = Walk()
    walk.enter(PRE_SWING)
    assert walk.current(1900) == 20.0
    assert walk.current(1950) == 10.0
    assert walk.current(2000) == 0.0
    assert walk.current(5000) == 0.0


def test_on_time_too_short_for_the_ramps_is_kept_all_the_same() -> None:
    walk = Walk(make_channel(fall_s=0.5, limits={"max_on_s": 0.15}))
    walk.enter(PRE_SWING)
    assert walk.current(100) == 20.0
    assert walk.current(149) > 10.0
    assert walk.current(150) == 0.0


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


@pytest.mark.parametrize(("least_off_s", "current_ma"), [(0.7, 20.0), (0.700000001, 0.0)])
def test_a_burst_that_would_come_half_a_second_late_does_not_come(least_off_s: float, current_ma: float) -> None:
    """Off at 200 ms, awaited from 400 ms on: with the longer rest the foot has long done something else by then."""
    walk = Walk(make_channel(limits={"min_off_s": least_off_s}))
    walk.enter(PRE_SWING)
    assert walk.current(200) > 0.0
    walk.enter(STANCE)
    assert walk.current(200) == 0.0
    assert walk.current(400) == 0.0
    walk.enter(PRE_SWING)
    assert walk.current(880) == 0.0
    assert walk.current(1100) == current_ma
    assert walk.current(1500) == current_ma


def test_round_down_never_exceeds() -> None:
    assert round_down(20.0, 0.5) == 20.0
    assert round_down(20.49, 0.5) == 20.0
    assert round_down(0.0, 0.5) == 0.0
    below_nine_tenths = math.nextafter(0.9, 0.0)
    assert round_down(below_nine_tenths, 0.1) <= below_nine_tenths


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
