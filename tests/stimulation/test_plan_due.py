"""When a channel goes on or off: ``StimulationPlan.due`` against what a copy of the plan would then ask for."""

from __future__ import annotations

import copy
from dataclasses import replace

import pytest
from hypothesis import Phase as Stage
from hypothesis import event, given, settings
from hypothesis import strategies as st
from test_plan import LOADING, MS, NEXT, PRE_SWING, STANCE, SWING, TRANSITIONS, make_channel, rising

from fes.stimulation.envelope import BINS, BurstParameters
from fes.stimulation.plan import StimulationPlan
from statemachine.phases import PhaseChange, Transition

ACTS = ("enter", "enter", "enter", "enter", "turn back", "lost", "by hand", "cancel", "tune", "nothing")
WIDTHS = st.sampled_from([(300.0,) * BINS, (300.0, 300.0, 0.5, *(200.0,) * (BINS - 3)), (0.4,) * BINS])
INTENSITIES = st.sampled_from([1.0, 1.0, 1.0, 0.6, 0.02, 0.0, float("nan")])
STAGES = (Stage.explicit, Stage.reuse, Stage.generate, Stage.shrink)  # to explain a failure takes a minute
STEPS = st.lists(st.tuples(st.sampled_from(ACTS), st.integers(1, 250), WIDTHS, INTENSITIES), max_size=14)


@given(steps=STEPS, early_s=st.sampled_from([0.06, 0.0, -0.08]), every_ms=st.sampled_from([3, 7, 11]))
@settings(max_examples=40, deadline=None, phases=STAGES)
def test_due_says_what_asking_would_show(
    steps: list[tuple[str, int, tuple[float, ...], float]], early_s: float, every_ms: int
) -> None:
    channel = make_channel()
    own = replace(BurstParameters.for_channel(channel), extension_s=early_s)
    plan, phase, t_ms, on, changes = StimulationPlan((channel,)), STANCE, 0, False, 0
    plan.set_parameters(0, own)
    for act, dwell_ms, widths_us, intensity in steps:
        t_ns = t_ms * MS
        if act in ("enter", "turn back", "lost"):
            to = STANCE if act == "lost" else NEXT[phase][-1 if act == "turn back" else 0]
            why = Transition.NONE if act == "lost" else TRANSITIONS[phase, to]
            plan.on_phase(PhaseChange(t_ns, "left_foot", why, phase, to), permitted=True)
            phase = to
        elif act == "by hand":
            plan.start(0, t_ns, 100 * MS, adopt=dwell_ms % 2 == 0)
        elif act == "cancel":
            plan.cancel()
        elif act == "tune":
            plan.set_parameters(0, replace(own, widths_us=widths_us))
        for now_ms in range(t_ms, t_ms + dwell_ms, every_ms):
            due = plan.due(now_ms * MS, intensity)
            other = copy.deepcopy(plan, {id(channel): channel})
            assert due == (other.requests(now_ms * MS, intensity)[0].on != on)
            if due or now_ms % 20 == 0:
                changes += due
                on = plan.requests(now_ms * MS, intensity)[0].on
        t_ms += dwell_ms
    event(f"{min(changes, 6)} changes")


@pytest.mark.parametrize("intensity", [1.0, 0.02])
def test_a_burst_under_way_is_dimmed_at_once_and_ends_on_time(intensity: float) -> None:
    """Half a device's step of current is none: the burst goes off at the very moment the intensity falls."""
    plan = rising(at_ns=MS)
    plan.requests(150 * MS, 1.0)
    plan.requests(160 * MS, 1.0)
    assert plan.due(170 * MS, intensity) == (intensity < 1.0)
    plan.on_phase(PhaseChange(180 * MS, "left_foot", Transition.T2, PRE_SWING, SWING), permitted=True)
    plan.on_phase(PhaseChange(200 * MS, "left_foot", Transition.T3, SWING, LOADING), permitted=True)
    assert plan.due(200 * MS, intensity) == (intensity < 1.0)
    assert plan.due(400 * MS, 1.0)


def test_what_starts_now_is_due_now() -> None:
    plan = rising(at_ns=5 * MS)
    assert [plan.due(5 * MS + ns, 1.0) for ns in (-1, 0, 5 * MS)] == [False, True, True]


@pytest.mark.parametrize(
    ("frequency_hz", "width_us", "on"),
    [(40.0, 300.0, True), (1.0, 300.0, True), (0.9, 300.0, False), (40.0, 1.0, True), (40.0, 0.9, False)],
)
def test_one_step_of_the_device_is_enough(frequency_hz: float, width_us: float, on: bool) -> None:
    plan = rising(make_channel(frequency_hz=frequency_hz, pulse_width_us=width_us))
    assert plan.due(0, 1.0) == on
    assert [plan.requests(t_ns, 1.0)[0].on for t_ns in (0, 2_499_999, 2_500_000)] == [on, on, on]


def test_a_burst_that_goes_on_does_not_hide_another_channel_that_starts() -> None:
    plan = rising(make_channel(0), make_channel(1, "right_foot"))
    plan.requests(100 * MS, 1.0)
    plan.on_phase(PhaseChange(120 * MS, "right_foot", Transition.T1, STANCE, PRE_SWING), permitted=True)
    assert [plan.due(t_ms * MS, 1.0) for t_ms in (119, 120, 130)] == [False, True, True]
    assert [one.on for one in plan.requests(130 * MS, 1.0)] == [True, True]


@pytest.mark.parametrize(
    ("first_us", "asked", "due"),
    [
        pytest.param((300.0, 300.0, 0.5), {0: True, 60: True}, {60: 0, 99: 0, 101: 1, 149: 1, 151: 0}, id="a gap"),
        pytest.param((0.4, 0.4), {0: False}, {50: 0, 99: 0, 101: 1}, id="too narrow at first"),
    ],
)
def test_pulses_narrower_than_a_step_are_none(
    first_us: tuple[float, ...], asked: dict[int, bool], due: dict[int, int]
) -> None:
    channel = make_channel()
    plan = StimulationPlan((channel,))
    widths_us = (*first_us, *(200.0,) * (BINS - len(first_us)))
    plan.set_parameters(0, replace(BurstParameters.for_channel(channel), widths_us=widths_us))
    plan.requests(0, 1.0)
    plan.on_phase(PhaseChange(0, "left_foot", Transition.T1, STANCE, PRE_SWING), permitted=True)
    assert {t_ms: plan.requests(t_ms * MS, 1.0)[0].on for t_ms in asked} == asked
    assert {t_ms: plan.due(t_ms * MS, 1.0) for t_ms in due} == due


def test_a_channel_of_one_step_is_on_from_its_first_request() -> None:
    plan = rising(make_channel(current_ma=2.0), current_step_ma=2.0)
    assert plan.due(0, 1.0)
    assert [plan.requests(t_ms * MS, 1.0)[0].current_ma for t_ms in (0, 50, 100)] == [2.0, 2.0, 2.0]
