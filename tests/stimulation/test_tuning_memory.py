"""What was right is known again by the speed walked, and by nothing that is far from it."""

from __future__ import annotations

from dataclasses import replace

import pytest
from tuning_plant import channel, charge_of, stride, tuning

from fes.stimulation.envelope import BurstParameters
from fes.stimulation.tuning.memory import NEAR_MPS, SpeedMemory
from fes.stimulation.tuning.report import TuningReport
from fes.stimulation.tuning.tuner import Tuner


def walked(*kept: tuple[float, float]) -> SpeedMemory:
    """Ten strides at each speed (m/s) with its drive, once it is known to be another one."""
    memory = SpeedMemory()
    for speed_mps, drive in kept:
        at(memory, speed_mps)
        for _ in range(10):
            memory.changed(speed_mps)
            memory.keep(settings(drive))
    return memory


def settings(drive: float) -> BurstParameters:
    """Every number of theirs follows the drive."""
    return BurstParameters(20.0 * drive, 0.1 * drive, 0.05 * drive, (100.0 * drive, 200.0 * drive))


def at(memory: SpeedMemory, speed_mps: float) -> float | None:
    """The drive of what is remembered there."""
    for _ in range(3):
        memory.changed(speed_mps)
    found = memory.remembered()
    if found is None:
        return None
    drive = found.current_ma / 20.0
    assert (found.start_delay_s, found.extension_s) == (pytest.approx(0.1 * drive), pytest.approx(0.05 * drive))
    assert found.widths_us == pytest.approx((100.0 * drive, 200.0 * drive))
    return drive


def test_another_speed_is_one_that_is_walked_for_some_strides() -> None:
    memory = SpeedMemory()
    assert [memory.changed(0.8) for _ in range(4)] == [False] * 4
    assert not memory.changed(1.2)
    assert not memory.changed(0.8)
    assert [memory.changed(1.2) for _ in range(4)].count(True) == 1
    assert [memory.changed(1.25) for _ in range(4)] == [False] * 4  # no other speed yet
    slow = SpeedMemory()
    assert [slow.changed(0.25) for _ in range(4)] == [False] * 4
    assert [slow.changed(0.33) for _ in range(4)] == [
        False
    ] * 4  # a third more, but strides of who walks slowly differ so


def test_what_was_right_at_a_speed_is_known_there_again() -> None:
    memory = walked((0.5, 0.9), (1.0, 1.4))
    assert at(memory, 0.5) == pytest.approx(0.9)
    assert at(memory, 1.0) == pytest.approx(1.4)


def test_between_two_speeds_it_is_interpolated_and_beyond_them_only_near() -> None:
    memory = walked((0.6, 0.8), (1.0, 1.2))
    assert at(memory, 0.8) == pytest.approx(1.0)
    assert at(memory, 0.7) == pytest.approx(0.9)
    for far in (False, True):
        off_mps = NEAR_MPS + (0.02 if far else -0.01)
        assert at(walked((0.6, 0.8), (1.0, 1.2)), 1.0 + off_mps) == (None if far else pytest.approx(1.2))
        assert at(walked((1.0, 1.2), (0.6, 0.8)), 0.6 - off_mps) == (None if far else pytest.approx(0.8))


def test_the_newest_counts_more_and_what_a_fault_made_wrong_is_forgotten() -> None:
    memory = walked((0.8, 1.0), (0.8, 1.5))
    known = at(memory, 0.8)
    assert known is not None
    assert 1.4 < known < 1.5
    memory.forget()
    assert memory.remembered() is None
    assert at(SpeedMemory(), 0.8) is None


# --- the tuner's: by speed, and never onto stairs ------------------------------------------------------------


class Walk:
    """A foot that needs more current the faster it goes."""

    def __init__(self) -> None:
        self.tuner, self.number, self.reports = Tuner(channel(tuning(max_change_ma=5.0))), 0, list[TuningReport]()

    def walk(self, strides: int, speed_mps: float, rise_m: float = 0.0) -> Walk:
        for _ in range(strides):
            now = self.tuner.parameters
            clearance_m = 0.021 + 0.003 * (now.current_ma - 25.0 * speed_mps / 0.6)
            one = stride(self.number, clearance_m, speed_mps=speed_mps, height_gained_m=0.0, free_rise_m=rise_m)
            report = self.tuner.observe(self.number, one, charge_of(now), 1.0)
            self.reports += [report] if report else []
            self.number += 1
        return self

    @property
    def current_ma(self) -> float:
        return self.tuner.parameters.current_ma


def test_back_at_a_speed_it_goes_on_with_what_was_right_there() -> None:
    walk = Walk().walk(25, 0.6)
    slow_ma = walk.current_ma
    walk.walk(25, 0.8)
    assert walk.current_ma > slow_ma + 5.0
    walk.reports.clear()
    walk.walk(5, 0.6)
    assert abs(walk.current_ma - slow_ma) <= 3.0
    assert any("at 0.6 m/s this was right before" in report.text for report in walk.reports)


def test_what_was_right_at_a_speed_lowers_nothing_while_the_toe_is_too_low() -> None:
    walk = Walk().walk(25, 0.6).walk(25, 0.8)
    strong_ma = walk.current_ma
    for number in range(walk.number, walk.number + 5):  # slower again, and an electrode slips meanwhile
        before_ma = walk.current_ma
        walk.tuner.observe(number, stride(number, 0.004, speed_mps=0.6), charge_of(walk.tuner.parameters), 1.0)
        assert walk.current_ma >= before_ma
    assert walk.current_ma > strong_ma


@pytest.mark.parametrize("method", ["run_to_run", "learning"])
def test_at_another_speed_the_burst_is_even_and_begins_as_the_session_says(method: str) -> None:
    """What was learnt of its shape holds at the old speed; nowhere is it stronger than where it was strongest."""
    tuner = Tuner(channel(tuning(method=method, timing=True)))
    for number in range(6):
        tuner.observe(number, stride(number, 0.02), charge_of(tuner.parameters), 1.0)
    shaped = (*(290.0,) * 6, *(200.0,) * (len(tuner.start.widths_us) - 6))
    tuner.parameters = replace(tuner.parameters, start_delay_s=0.12, widths_us=shaped)
    before, strides = tuner.parameters, tuner.model.strides
    report = tuner.observe(6, stride(6, 0.02, speed_mps=1.0), charge_of(before), 1.0)
    assert report is not None
    assert (report.kind, "even until this speed is known" in report.text) == ("change", True)
    now = tuner.parameters
    assert (now.current_ma, now.start_delay_s) == (before.current_ma, tuner.start.start_delay_s)
    assert set(now.widths_us) == {290.0, 200.0 + tuner.tuning.max_change_us}  # no further than one stride may go
    assert tuner.model.strides == strides
    tuner.freeze(6)
    tuner.observe(7, stride(7, 0.02, speed_mps=1.6), charge_of(now), 1.0)
    assert tuner.parameters == now


@pytest.mark.parametrize(("charge_share", "intensity"), [(0.0, 1.0), (1.0, 0.0), (0.5, 0.5)])
def test_a_burst_becomes_even_only_where_one_was_given_and_below_the_usual_intensity_only_up_to_the_sessions(
    charge_share: float, intensity: float
) -> None:
    tuner = Tuner(channel(tuning(method="learning")))
    for number in range(6):
        tuner.observe(number, stride(number, 0.02), charge_of(tuner.parameters), 1.0)
    own_us, count = tuner.start.widths_us[0], len(tuner.start.widths_us)
    shaped = (own_us + 90.0, own_us, *(own_us - 90.0,) * (count - 2))
    tuner.parameters = replace(tuner.parameters, widths_us=shaped)
    charge_uc = charge_share * charge_of(tuner.parameters)
    tuner.observe(6, stride(6, 0.02, speed_mps=1.0), charge_uc, intensity)
    raised_us = tuner.tuning.max_change_us if charge_share * intensity > 0.0 else 0.0
    assert tuner.parameters.widths_us == (shaped[0], own_us, *(own_us - 90.0 + raised_us,) * (count - 2))


def test_what_is_walked_at_another_speed_is_not_kept_for_the_old_one() -> None:
    memory = walked((0.6, 0.8))
    memory.changed(1.0)
    memory.keep(settings(1.4))
    assert at(memory, 0.6) == pytest.approx(0.8)


def test_on_stairs_what_was_learnt_is_put_away_after_two_strides_and_comes_back() -> None:
    walk = Walk().walk(25, 0.6)
    learnt, own = walk.tuner.parameters, walk.tuner.start
    assert abs(learnt.current_ma - own.current_ma) > 2.0
    walk.walk(1, 0.6, rise_m=0.17)
    assert walk.tuner.parameters == learnt  # one may be a kerb
    walk.walk(4, 0.6, rise_m=0.17)
    assert walk.tuner.parameters == own
    assert any("the session's own settings there" in report.text for report in walk.reports)
    model = walk.tuner.model.strides
    walk.walk(3, 0.6)
    assert walk.tuner.parameters == learnt
    assert walk.tuner.model.strides <= model + 3  # the stairs taught nothing


def test_frozen_on_stairs_nothing_moves() -> None:
    walk = Walk().walk(25, 0.6)
    learnt = walk.tuner.parameters
    walk.tuner.freeze(0)
    walk.walk(5, 0.6, rise_m=0.17)
    assert walk.tuner.parameters == learnt
