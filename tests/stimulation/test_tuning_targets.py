"""What a stride measured against its bands, and which strides teach nothing."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from tuning_plant import channel, stride, tuning

from fes.stimulation.contact import pitch_at_contact_rad
from fes.stimulation.envelope import BurstParameters, difference
from fes.stimulation.ground import GroundWatch
from fes.stimulation.tuning.targets import Reading, read_stride
from fes.stimulation.tuning.usable import StrideFilter

NAN = float("nan")
PITCH = {"low": 0.0, "high": 10.0}
SENSOR = {"low": 0.1, "high": 0.2}


def reading_of(*args: float, **settings: Any) -> Reading:
    reading = read_stride(stride(1, *args), tuning(**settings))
    assert isinstance(reading, Reading)
    return reading


def test_the_ends_of_the_band_are_0_and_1() -> None:
    assert reading_of(0.012).level == pytest.approx(0.0)
    assert reading_of(0.035).level == pytest.approx(1.0)


def test_the_least_satisfied_measure_leads() -> None:
    both = reading_of(0.030, -4.0, pitch_at_contact_deg=PITCH)
    assert both.level == pytest.approx(-0.4)
    assert both.measures[0].text() == "foot pitch at contact -4 ° (target 0–10)"
    assert reading_of(0.001, 9.0, pitch_at_contact_deg=PITCH).measures[0].name == "toe clearance"


def test_without_the_toe_the_sensor_stands_in() -> None:
    reading = read_stride(stride(1, NAN, clearance_m=0.15), tuning(sensor_clearance_m=SENSOR))
    assert isinstance(reading, Reading)
    assert reading.level == pytest.approx(0.5)
    assert reading.measures[0].name == "sensor lift"


def test_without_anything_to_measure_the_reason_names_the_remedy() -> None:
    why = read_stride(stride(1, NAN), tuning())
    assert isinstance(why, str)
    assert "[geometry]" in why
    why = read_stride(
        stride(1, 0.02, t_loading_response_ns=None), tuning(toe_clearance_m=None, pitch_at_contact_deg=PITCH)
    )
    assert why == "initial contact was not seen"


def test_pitch_is_read_at_contact() -> None:
    ramp = np.linspace(0.0, 1.0, 101)
    one = stride(0, 0.02, pitch_rad=ramp)
    contact_ns = one.t_loading_response_ns
    assert contact_ns is not None
    assert pitch_at_contact_rad(one) == pytest.approx(contact_ns / one.t_end_ns)
    assert math.isnan(pitch_at_contact_rad(stride(0, 0.02, t_loading_response_ns=one.t_end_ns + 1)))


def test_an_evertor_is_judged_by_the_roll_at_contact() -> None:
    band = {"low": -5.0, "high": 10.0}
    asked = tuning(toe_clearance_m=None, eversion_at_contact_deg=band)
    reading = read_stride(stride(1, 0.02, roll_rad=np.full(101, math.radians(8.0))), asked)  # inversion is positive
    assert isinstance(reading, Reading)
    assert reading.measures[0].text() == "eversion at contact -8 ° (target -5–10)"
    assert reading.level == pytest.approx(-0.2)
    why = read_stride(stride(1, 0.02), asked)  # an older log knows no roll
    assert why == "the foot's roll at initial contact was not seen"


# --- strides that teach nothing ------------------------------------------------------------------------------


@pytest.fixture
def seen() -> StrideFilter:
    filtered = StrideFilter(tuning(), 0.15)
    for number in range(4):
        filtered.why_skip(stride(number, 0.02), 270.0, 1.0)
    return filtered


def test_an_ordinary_stride_teaches(seen: StrideFilter) -> None:
    assert seen.why_skip(stride(4, 0.02), 270.0, 1.0) == ""


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"valid": False, "reason": "samples missing for 80 ms"}, "samples missing for 80 ms"),
        ({"turn_rad": 0.6}, "turned by 34°"),
        ({"height_gained_m": 0.17}, "+17 cm up"),
        ({"stride_length_m": 0.1}, "10 cm is no walking"),
        ({"speed_mps": 1.2}, "speed changed from 0.6 to 1.2"),
    ],
)
def test_a_stride_is_skipped_with_its_reason(seen: StrideFilter, changes: dict[str, Any], reason: str) -> None:
    assert reason in seen.why_skip(stride(4, 0.02, **changes), 270.0, 1.0)


@pytest.mark.requirement("SR-23")
def test_stairs_are_left_out_though_the_solution_is_held_level() -> None:
    filtered = StrideFilter(tuning(), 0.15)
    flat = [stride(n, 0.02, height_gained_m=0.0, free_rise_m=0.02 + 0.01 * (-1) ** n) for n in range(12)]
    climb = [stride(n, 0.02, height_gained_m=0.001, free_rise_m=0.31) for n in range(12, 24)]
    whys = [filtered.why_skip(each, 270.0, 1.0) for each in flat + climb]
    assert not any("stair" in why for why in whys[:12])
    assert all("a stair or a slope" in why for why in whys[12:])  # however many there are


def test_an_incline_that_the_session_knows_teaches() -> None:
    filtered = StrideFilter(tuning(), 0.15)
    for n in range(6):
        assert "slope" not in filtered.why_skip(stride(n, 0.02, height_gained_m=0.12, free_rise_m=0.13), 270.0, 1.0)
    assert "slope" in filtered.why_skip(stride(6, 0.02, height_gained_m=0.12, free_rise_m=0.01), 270.0, 1.0)


@pytest.mark.parametrize("free", [False, True])
def test_what_was_usual_is_forgotten_with_the_ground_and_the_change_teaches_nothing(free: bool) -> None:
    filtered = StrideFilter(tuning(), 0.15)
    uphill = [stride(n, 0.02, height_gained_m=0.0, free_rise_m=0.04) for n in range(6)]
    assert not any("slope" in filtered.why_skip(each, 270.0, 1.0) for each in uphill)
    across = stride(6, 0.02, height_gained_m=0.0, free_rise_m=0.12)
    filtered.ground_changed(across.t_start_ns, free=free)
    assert filtered.why_skip(across, 270.0, 1.0) == "a person changed the ground meanwhile"
    after = stride(7, 0.02, height_gained_m=0.12, free_rise_m=0.09)  # 7 cm from what was usual before
    assert ("slope" in filtered.why_skip(after, 270.0, 1.0)) == free, "free: only the height gained is left to judge by"


def test_a_sensor_whose_heights_scatter_is_known_by_its_own_strides() -> None:
    watch = GroundWatch()
    rises = [0.04, -0.02, 0.045, 0.0, 0.03, 0.07, -0.03, 0.08, 0.06]
    told = [watch.unusual(stride(n, 0.02, height_gained_m=0.0, free_rise_m=rise)) for n, rise in enumerate(rises)]
    assert not any(told)
    assert watch.unusual(stride(9, 0.02, height_gained_m=0.0, free_rise_m=0.17))


def test_what_was_not_stimulated_teaches_nothing(seen: StrideFilter) -> None:
    assert "no stimulation" in seen.why_skip(stride(4, 0.02), 0.0, 1.0)
    assert "only 40%" in seen.why_skip(stride(5, 0.02), 108.0, 1.0)


def test_half_the_drive_is_expected_to_bring_half_the_charge(seen: StrideFilter) -> None:
    assert seen.why_skip(stride(4, 0.02), 135.0, 0.5) == ""


def test_the_first_stride_after_standing_teaches_nothing(seen: StrideFilter) -> None:
    assert "after standing" in seen.why_skip(stride(7, 0.02), 270.0, 1.0)
    assert seen.why_skip(stride(8, 0.02), 270.0, 1.0) == ""


def test_a_stride_in_which_a_person_acted_teaches_nothing(seen: StrideFilter) -> None:
    one = stride(4, 0.02)
    seen.operator_changed(one.t_start_ns + 5)
    assert "a person" in seen.why_skip(one, 270.0, 1.0)
    assert seen.why_skip(stride(5, 0.02), 270.0, 1.0) == ""


def test_a_new_speed_is_the_usual_one_with_the_second_stride(seen: StrideFilter) -> None:
    whys = [seen.why_skip(stride(n, 0.02, speed_mps=1.2), 270.0, 1.0) for n in range(4, 10)]
    assert whys[0].startswith("the speed changed from 0.6 to 1.2")
    assert not any(whys[1:])


def test_two_strides_that_differ_from_each_other_are_no_new_speed(seen: StrideFilter) -> None:
    speeds_mps = (1.2, 0.3, 1.2, 0.6, 0.6)
    whys = [bool(seen.why_skip(stride(4 + n, 0.02, speed_mps=v), 270.0, 1.0)) for n, v in enumerate(speeds_mps)]
    assert whys == [True, True, True, False, False]


def test_two_strides_of_a_turn_are_no_new_speed(seen: StrideFilter) -> None:
    for number in (4, 5):
        assert "turned" in seen.why_skip(stride(number, 0.02, speed_mps=0.3, turn_rad=1.5), 270.0, 1.0)
    assert seen.why_skip(stride(6, 0.02), 270.0, 1.0) == ""


def test_strides_of_who_walks_slowly_differ_by_more_of_their_speed() -> None:
    filtered = StrideFilter(tuning(), 0.15)
    speeds_mps = (0.25, 0.25, 0.25, 0.25, 0.34, 0.17, 0.36)
    whys = [filtered.why_skip(stride(n, 0.02, speed_mps=v), 270.0, 1.0) for n, v in enumerate(speeds_mps)]
    assert [bool(why) for why in whys[1:]] == [False] * 5 + [True]


def test_nothing_different_is_said_as_nothing() -> None:
    own = BurstParameters.for_channel(channel())
    assert difference(own, own) == ""
