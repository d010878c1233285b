"""The tuning's own rule: what it does in each state, and how it gets from one to the other."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from tuning_plant import BOUNDS, Plant, Tuned, channel, charge_of, stride, tuning

from fes.signals import OperatorAct, OperatorAction
from fes.stimulation.envelope import BurstParameters
from fes.stimulation.tuning.report import Seen
from fes.stimulation.tuning.rule import TRANSITIONS, Event, OwnRule, State
from fes.stimulation.tuning.settings import OWN
from fes.stimulation.tuning.targets import Reading, read_stride

PITCH = {"low": 4.0, "high": 25.0}
MID_M = 0.0235  # of the band: 12 to 35 mm
WIDE = BOUNDS | {"pulse_width_us": {"low": 60.0, "high": 300.0}}
TEN = {"max_change_us": 30.0}


def own(tuned: Tuned) -> OwnRule:
    assert isinstance(tuned.tuner.rule, OwnRule)
    return tuned.tuner.rule


def levelled(level: float) -> float:
    """A toe clearance at this place of the band."""
    return 0.012 + level * 0.023


def walked(levels: list[float], **settings: Any) -> Tuned:
    tuned = Tuned(channel(tuning(**settings)))
    for number, level in enumerate(levels):
        tuned.walk(stride(number, levelled(level)))
    return tuned


def test_every_state_can_be_left_and_every_event_matters_somewhere() -> None:
    assert set(TRANSITIONS) == set(State)
    assert {event for row in TRANSITIONS.values() for event in row} == set(Event)
    for state, row in TRANSITIONS.items():
        assert any(to is not state for to in row.values()), state
        assert Event.FAULT in row or state is State.SPARE, "a fault counts in every state"


def test_what_is_missing_is_given_at_once_as_far_as_one_stride_may() -> None:
    tuned = walked([-0.5, -0.5])
    assert tuned.parameters.current_ma == 32.0
    (change,) = [report for report in tuned.said if report.kind == "change"]
    assert change.text == (
        "toe clearance 1 mm (target 12–35), 22 mm is aimed at, more is needed: current 30.0 → 32.0 mA"
    )


def test_in_the_band_nothing_changes() -> None:
    tuned = walked([0.4, 0.5, 0.45, 0.4, 0.5, 0.62, 0.45])
    assert tuned.parameters == tuned.tuner.start
    assert not [report for report in tuned.said if report.kind == "change"]


def test_what_is_short_is_given_with_the_next_stride_and_what_is_nearly_right_is_left() -> None:
    assert walked([0.5, 0.5, 0.5, OWN.toe_aim - 0.9 * OWN.near]).parameters.current_ma == 30.0
    little, much = (walked([0.5, 0.5, 0.5, level]).parameters.current_ma for level in (0.3, 0.0))
    assert 30.0 < little <= much == 32.0


@pytest.mark.parametrize(("level", "strides"), [(0.7, OWN.surely), (1.0, 2)])
def test_less_when_each_of_five_says_so_or_the_foot_is_far_too_high(level: float, strides: int) -> None:
    before, after = (walked([0.5] * 6 + [level] * count).parameters.current_ma for count in (strides - 1, strides))
    assert before == 30.0
    assert 0.0 < before - after <= OWN.eased * 40.0


def test_a_foot_that_answers_steeply_is_not_thrown_over_its_band() -> None:
    one = channel(tuning(method="learning", bounds=WIDE, **TEN), pulse_width_us=65.0)
    tuned, levels = Tuned(one), []
    for number in range(60):
        level = 13.0 * (max(tuned.parameters.widths_us) / 400.0 - 0.2)  # bands: 0.1 of the drive is more than the band
        levels.append(level)
        tuned.walk(stride(number, levelled(level)))
    assert all(0.0 <= level <= 1.0 for level in levels[15:]), levels


@pytest.mark.parametrize("method", ["run_to_run", "learning"])
def test_the_tail_follows_the_pitch_and_never_exceeds_the_front(method: str) -> None:
    one = channel(tuning(method=method, pitch_at_contact_deg=PITCH, bounds=WIDE, **TEN))
    tuned = Tuned(one)
    for number in range(12):
        tuned.walk(stride(number, levelled(0.5), pitch_deg=20.0))
    widths = tuned.parameters.widths_us
    assert widths[-1] < widths[0] == 300.0, "a pitch that is too much takes from the tail alone"
    for number in range(12, 30):
        tuned.walk(stride(number, levelled(0.7), pitch_deg=-2.0))  # a toe that high does not let the front follow
        assert max(tuned.parameters.widths_us) == tuned.parameters.widths_us[0]


def test_the_tail_begins_where_the_front_has_carried_the_toe_over() -> None:
    tuned = Tuned(channel(tuning(method="learning", pitch_at_contact_deg=PITCH, bounds=WIDE, **TEN)))
    for number in range(12):
        tuned.walk(stride(number, levelled(0.5), pitch_deg=20.0))
    widths = tuned.parameters.widths_us
    until_s = 0.4 + OWN.carried * 0.5 - OWN.answer_s  # pre-swing of 0.4 s, swing of 0.5 s
    assert sum(width == widths[0] for width in widths) == round(until_s / 0.05)


def test_a_foot_of_any_strength_reaches_the_band_and_stays_there() -> None:
    for range_m in (0.04, 0.06, 0.15):  # the last answers with 4 bands to a third of the bound
        plant = Plant(range_m=range_m)
        tuned = Tuned(channel(current_ma=12.0))
        levels = []
        for number in range(60):
            clear_m = plant.clearance_m(tuned.parameters)
            levels.append((clear_m - 0.012) / 0.023)
            tuned.walk(stride(number, clear_m))
        inside = [0.0 <= level <= 1.0 for level in levels[20:]]
        assert np.mean(inside) > 0.9, (range_m, levels)


def test_evertors_are_held_in_the_middle_of_their_band() -> None:
    band = {"low": -5.0, "high": 5.0}
    tuned = Tuned(channel(tuning(toe_clearance_m=None, eversion_at_contact_deg=band)))
    for number in range(6):
        tuned.walk(stride(number, 0.02, roll_rad=np.full(101, math.radians(8.0))))  # turned inward
    assert tuned.parameters.current_ma > 30.0
    before = tuned.parameters.current_ma
    for number in range(6, 16):
        tuned.walk(stride(number, 0.02, roll_rad=np.full(101, math.radians(-8.0))))
    assert tuned.parameters.current_ma < before
    assert "eversion at contact" in tuned.said[-1].text


def test_on_stairs_that_nobody_told_of_all_stays_as_it_is() -> None:
    tuned = walked([-0.5] * 5)
    learnt = tuned.parameters
    for number in range(5, 12):
        tuned.walk(stride(number, levelled(-0.5), height_gained_m=0.17))
    assert tuned.parameters == learnt
    assert "a stair or a slope" in tuned.said[-1].text


def test_what_was_right_on_other_ground_comes_back_with_it() -> None:
    tuned = walked([-0.5] * 4)
    flat_ma, at = tuned.parameters.current_ma, 4
    for incline, level in ((0.1, 0.9), (0.0, 0.5)):  # uphill the toe lies high, so less will do
        now = stride(at, levelled(level))
        tuned.tuners.on_act(OperatorAct(now.t_start_ns, OperatorAction.SET_INCLINE, incline))
        for number in range(at, at + 10):
            rise_m = incline * 0.8
            tuned.walk(stride(number, levelled(level), height_gained_m=rise_m, free_rise_m=rise_m))
        at += 10
        if incline:
            assert tuned.parameters.current_ma < flat_ma - 3.0
    assert tuned.parameters.current_ma == pytest.approx(flat_ma, abs=2.0), "what was walked with last on even ground"
    assert own(tuned).state is State.FOLLOW


def test_start_and_end_follow_the_phases_within_their_steps() -> None:
    tuned = Tuned(channel(tuning(timing=True, max_change_s=0.02)))
    for number in range(30):
        before = tuned.parameters
        tuned.walk(stride(number, MID_M))
        assert abs(tuned.parameters.start_delay_s - before.start_delay_s) <= 0.02 + 1e-9
    wanted_s = 0.4 + OWN.up_at * 0.5 - OWN.answer_s - tuned.tuner.channel.rise_s
    assert tuned.parameters.start_delay_s == pytest.approx(wanted_s, abs=0.005)
    assert tuned.parameters.extension_s == 0.0, "the loading response is over sooner than the force"
    assert any("timing follows the speed (0.6 m/s)" in report.text for report in tuned.said)


def test_a_jerked_foot_is_given_less() -> None:
    tuned = walked([0.5] * 3)
    for number in range(3, 5):
        tuned.walk(stride(number, -0.03))
    assert tuned.parameters.current_ma == 28.0
    assert "cannot be true, stimulation may jerk the foot; less" in tuned.said[-1].text


def test_a_foot_that_does_not_answer_stops_it_and_what_was_raised_is_taken_back() -> None:
    tuned = Tuned(channel())
    for number in range(4):
        tuned.walk(stride(number, 0.0), charge_uc=0.0)
    for number in range(4, 30):
        tuned.walk(stride(number, 0.0))
        if tuned.tuner.frozen:
            break
    assert "does not answer to all that the bounds allow" in tuned.tuner.frozen
    stopped = tuned.said[-1]
    assert stopped.kind == "roll_back"
    assert "tuning has stopped and goes back: current 40.0 → 38.0 mA" in stopped.text
    for number in range(40, 50):
        tuned.walk(stride(number, 0.0))
    assert tuned.parameters.current_ma == 30.0


def test_a_foot_that_answers_too_little_is_told_of_and_not_given_up() -> None:
    tuned = Tuned(channel())
    for number in range(4):
        tuned.walk(stride(number, 0.0), charge_uc=0.0)
    for number in range(4, 40):
        tuned.walk(stride(number, levelled(-0.2)))
    assert not tuned.tuner.frozen
    assert tuned.parameters.current_ma == 40.0
    hints = [report.text for report in tuned.said if "is not reached at the upper bound" in report.text]
    assert len(hints) == 1


def test_strides_that_teach_nothing_are_told_of() -> None:
    tuned = walked([0.5] * 3)
    for number in range(3, 13):
        tuned.walk(stride(number, levelled(-0.5), turn_rad=0.6))
    assert tuned.parameters == tuned.tuner.start
    assert "10 strides in a row have taught nothing" in tuned.said[-1].text


def test_after_a_named_fault_nothing_is_lowered_for_five_strides() -> None:
    one = channel()
    rule, given = OwnRule(one), BurstParameters.for_channel(one)
    high = levelled(1.5)
    assert one.tuning is not None

    def proposed_ma(number: int, noticed: str = "") -> float:
        seen = stride(number, high)
        reading = read_stride(seen, one.tuning or tuning())
        assert isinstance(reading, Reading)
        proposal = rule.stride(Seen(seen, reading, given, charge_of(given), 1.0, "", noticed))
        assert proposal is not None
        assert proposal.wanted is not None
        return proposal.wanted.current_ma

    assert proposed_ma(3) < 30.0
    for number in range(4, 4 + OWN.spared):
        assert proposed_ma(number, "the electrodes" if number == 4 else "") == 30.0
        assert rule.state is State.SPARE
    assert proposed_ma(20) < 30.0
    assert rule.state is State.FOLLOW
