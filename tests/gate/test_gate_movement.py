"""The gate's coarse check: no burst on a foot that rests, none over more swings than it has; by hand it is possible."""

from __future__ import annotations

import math
from typing import Any

import pytest
from gate_bench import MS, Bench, assert_held, make_channel, make_limits

from fes.config import Channel
from fes.gate.movement import MOVES_RADPS, SWINGS_RADPS, SWUNG_NS, Movement
from fes.signals import ImuSample, StimCommand, Vector3
from fes.signals import OperatorAction as Action

LASTING = {"limits": {"max_on_s": 3.0}}
PLAIN = make_channel(extension_s=0.0, fall_s=0.1, **LASTING)
THROUGH_STANCE = make_channel(start_phase="loading_response", stop_phase="pre_swing", **LASTING)
TO_STANCE = make_channel(stop_phase="stance", extension_s=0.0, fall_s=0.1, **LASTING)


def resting(channel: Channel = PLAIN, ms: int = 620, **more: Any) -> Bench:
    """An armed bench whose foot has rested for so long."""
    bench = Bench(channel, **more)
    bench.rests = True
    step(bench, ms)
    return bench


def step(bench: Bench, ms: int, turns_radps: float | None = None) -> None:
    """Let time pass with a sample every 20 ms, of a foot that turns about the vertical."""
    for _ in range(ms // 20):
        bench.wait(20, sampling=False)
        living = 1e-9 * (bench.t_ns % 1_000_003)
        bench.sample(**({} if turns_radps is None else {"gyr_radps": (0.0, 0.0, turns_radps + living)}))


def held(bench: Bench, ms: int, turns_radps: float | None = None) -> StimCommand:
    """Ask for current at every sample of so long; the last answer."""
    command = bench.ask(current_ma=0.5)
    for _ in range(ms // 20):
        step(bench, 20, turns_radps)
        command = bench.ask(current_ma=0.5)
    return command


@pytest.mark.requirement("SR-22")
def test_no_burst_begins_on_a_foot_that_rests() -> None:
    assert resting(ms=600).ask(current_ma=0.5).on
    bench = resting(ms=620)
    assert_held(bench, bench.ask(current_ma=0.5), "channel 0: the foot rests")


@pytest.mark.requirement("SR-22")
def test_none_goes_on_where_the_foot_comes_to_rest() -> None:
    bench = Bench(PLAIN)
    assert held(bench, 100, 1.0).on
    assert held(bench, 600, 0.199).on
    assert_held(bench, held(bench, 20, 0.199), "the foot rests")


def test_a_foot_that_moves_slowly_does_not_rest() -> None:
    bench = resting()
    assert held(bench, 1000, 0.21).on


@pytest.mark.parametrize(("channel", "ms"), [(TO_STANCE, 600), (THROUGH_STANCE, 3000)])
def test_a_channel_for_stance_is_on_while_the_foot_rests_but_not_in_standing(channel: Channel, ms: int) -> None:
    assert resting(channel, ms).ask(current_ma=0.5).on
    assert_held(bench := resting(channel, ms + 20), bench.ask(current_ma=0.5), "the foot rests")
    if channel is THROUGH_STANCE:  # for it alone a burst may do without a swing
        assert held(resting(channel), 1600, 0.4).on


BOUNDS = {
    "current_ma": {"low": 5.0, "high": 20.0},
    "pulse_width_us": {"low": 200.0, "high": 300.0},
    "start_delay_s": {"low": 0.0, "high": 0.2},
    "extension_s": {"low": 0.0, "high": 0.4},
}
TUNING = {"mode": "suggest", "toe_clearance_m": {"low": 0.012, "high": 0.035}, "bounds": BOUNDS}


@pytest.mark.parametrize(
    "lasting",
    [{"extension_s": 0.3, "fall_s": 0.2}, {"extension_s": 0.0, "fall_s": 0.1, "tuning": TUNING}],
    ids=["as set", "as its tuning may make it"],
)
def test_what_a_burst_goes_on_for_after_contact_counts_as_movement(lasting: dict[str, Any]) -> None:
    channel = make_channel(**lasting)
    assert resting(channel, 1000).ask(current_ma=0.5).on
    assert not resting(channel, 1020).ask(current_ma=0.5).on


@pytest.mark.requirement("SR-22")
def test_a_burst_lasts_two_swings_at_most() -> None:
    bench = Bench(PLAIN)
    for _ in range(2):
        assert held(bench, 100, 0.81).on
        assert held(bench, 320, 0.4).on
    assert_held(bench, held(bench, 20, 0.81), "channel 0: on for more than 2 swings of the foot")


def test_a_halt_within_a_swing_begins_no_other() -> None:
    bench = Bench(PLAIN)
    for _ in range(5):
        assert held(bench, 100, 1.0).on
        assert held(bench, 260, 0.4).on


def test_the_swing_under_way_when_a_burst_begins_is_one_of_its_own() -> None:
    bench = Bench(PLAIN)
    step(bench, 100, 1.0)
    step(bench, 280, 0.4)
    assert bench.ask(current_ma=0.5).on
    held(bench, 40, 0.4)
    assert held(bench, 100, 1.0).on
    held(bench, 320, 0.4)
    assert_held(bench, held(bench, 20, 1.0), "more than 2 swings")


@pytest.mark.requirement("SR-22")
def test_a_burst_without_a_swing_is_over_after_a_second_and_a_half() -> None:
    bench = resting()
    step(bench, 20, 0.5)
    assert held(bench, 1500, 0.5).on
    command = held(bench, 20, 0.5)
    assert_held(bench, command, "on for 1.52 s without a swing of the foot")


def test_another_burst_counts_anew() -> None:
    bench = resting()
    step(bench, 20, 0.5)
    for _ in range(3):
        assert held(bench, 1400, 0.5).on
        bench.off()
        step(bench, 120, 0.5)


@pytest.mark.requirement("SR-22")
def test_what_was_stopped_stays_off_until_it_is_asked_for_anew() -> None:
    bench = resting(risen=False)
    assert not bench.ask(current_ma=0.5).on
    step(bench, 100, 1.0)
    assert not bench.ask(current_ma=10.0).on
    bench.off()
    step(bench, 120, 1.0)
    assert bench.ask(current_ma=0.5).on


def test_what_is_not_a_number_is_no_movement() -> None:
    bench = resting()
    bench.sample(gyr_radps=(math.nan, 0.0, 2.0))
    bench.wait(20)
    bench.rearm()
    assert "the foot rests" in bench.ask(current_ma=0.5).refused


@pytest.mark.requirement("SR-22")
def test_the_other_foots_movement_permits_nothing() -> None:
    bench = Bench(make_channel(0), make_channel(1, "right_foot"))
    bench.rests = True
    for _ in range(40):
        bench.wait(20, sampling=False)
        bench.sample()
        bench.observe(_moving(bench, "right_foot"))
    assert "the foot rests" in bench.ask(0, 0.5).refused
    assert bench.ask(1, 0.5).on


def _moving(bench: Bench, sensor: str) -> ImuSample:
    bench.t_ns += MS
    living = 1e-9 * (bench.t_ns % 1_000_003)
    return ImuSample(bench.t_ns, sensor, bench.t_ns - 3 * MS, (living, 0.0, 9.8), (0.0, 0.0, 0.5 + living))


# --- by hand --------------------------------------------------------------------------------------------------------


@pytest.mark.requirement("SR-22")
@pytest.mark.parametrize(("action", "ms"), [(Action.TEST_BURST, 600), (Action.TRIGGER, 1100)])
def test_a_burst_asked_for_by_hand_goes_out_at_rest_once_and_for_its_time(action: Action, ms: int) -> None:
    bench = resting()
    bench.act(action, 0.0)
    assert held(bench, ms).on
    assert_held(bench, held(bench, 20), "the foot rests")
    bench.off()
    step(bench, 120)
    assert not bench.ask(current_ma=0.5).on


def test_one_act_makes_one_burst() -> None:
    bench = resting()
    bench.act(Action.TRIGGER, 0.0)
    assert bench.ask(current_ma=0.5).on
    bench.off()
    step(bench, 120)
    assert not bench.ask(current_ma=0.5).on


@pytest.mark.parametrize("ms", [500, 520])
def test_it_begins_at_once_or_not_at_all(ms: int) -> None:
    bench = resting()
    bench.act(Action.TRIGGER, 0.0)
    step(bench, ms)
    assert bench.ask(current_ma=0.5).on is (ms == 500)


@pytest.mark.parametrize("action", [Action.ARM, Action.DISARM, Action.EMERGENCY_STOP])
def test_an_arming_or_a_stop_in_between_forgets_it(action: Action) -> None:
    bench = resting()
    bench.act(Action.TRIGGER, 0.0)
    bench.act(action)
    bench.rearm()
    assert "the foot rests" in bench.ask(current_ma=0.5).refused


@pytest.mark.parametrize(
    ("action", "value"), [(Action.TRIGGER, 1.0), (Action.EXERCISE, 0.0), (Action.SET_INTENSITY, 0)]
)
def test_what_a_person_asked_for_otherwise_is_no_burst_of_this_channel(action: Action, value: float) -> None:
    bench = resting()
    bench.act(action, value)
    assert "the foot rests" in bench.ask(current_ma=0.5).refused


def test_intensity_set_meanwhile_takes_nothing_back() -> None:
    bench = resting()
    bench.act(Action.TRIGGER, 0.0)
    bench.act(Action.SET_INTENSITY, 0.5)
    assert bench.ask(current_ma=0.5).on


def test_a_burst_by_hand_that_a_step_took_over_goes_by_the_foot() -> None:
    bench = resting()
    bench.act(Action.TRIGGER, 0.0)
    assert held(bench, 1300, 0.5).on
    assert held(bench, 300, 1.0).refused == ""


@pytest.mark.requirement("SR-22")
def test_in_exercise_nothing_goes_out_that_nobody_asked_for() -> None:
    bench = Bench(
        make_channel(extension_s=0.0, fall_s=0.2, limits=make_limits(max_on_s=3.0)), by_sensors=False, exercise_s=1.0
    )
    assert_held(bench, bench.ask(current_ma=0.5), "nobody asked for a burst")
    bench.off()
    bench.act(Action.EXERCISE, 0.0)
    assert held(bench, 1200).on
    assert_held(bench, held(bench, 20), "longer than a person asked for")


# --- at the bounds, to the digit ------------------------------------------------------------------------------------


def turning(t_ns: int, rate: Vector3) -> ImuSample:
    return ImuSample(t_ns, "left_foot", t_ns, (0.0, 0.0, 9.8), rate)


@pytest.mark.parametrize("axis", range(3))
def test_a_foot_that_turns_as_slowly_as_that_about_any_axis_moves_and_swings(axis: int) -> None:
    movement = Movement()
    assert (movement.moved_ns, movement.swings) == (None, 0)
    for t_ns, radps, moved_ns, swings in (
        (10, math.nextafter(MOVES_RADPS, 0), None, 0),
        (20, MOVES_RADPS, 20, 0),
        (30, math.nextafter(SWINGS_RADPS, 0), 30, 0),
        (40, SWINGS_RADPS, 40, 1),
        (40 + SWUNG_NS - 1, SWINGS_RADPS, 40 + SWUNG_NS - 1, 1),
        (40 + 2 * SWUNG_NS - 1, SWINGS_RADPS, 40 + 2 * SWUNG_NS - 1, 2),
    ):
        x, y, z = (radps if k == axis else 0.0 for k in range(3))
        movement.observe(turning(t_ns, (x, y, z)))
        assert (movement.moved_ns, movement.swings) == (moved_ns, swings)
