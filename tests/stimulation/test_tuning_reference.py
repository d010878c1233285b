"""Which samples of a swing ask for what: the toe's height in mid-swing, pitch or roll where contact comes."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from tuning_plant import BAND, stride, tuning

from fes.config import FootGeometry, Tuning
from fes.signals import MID_SWING_BEGIN, MID_SWING_END, FloatArray, StrideResult
from fes.stimulation.tuning.demand import demands_of
from fes.stimulation.tuning.reference import Missing, missing_drive, toe_heights_m
from fes.stimulation.tuning.response import ResponseModel
from fes.stimulation.tuning.targets import Reading, read_stride, swing_times

FOOT = FootGeometry(toe_forward_m=0.15, toe_up_m=-0.05, heel_forward_m=-0.08, heel_up_m=-0.05)
PITCH = {"low": 0.0, "high": 20.0}
OFF_S, SWING_S = 0.4, 0.5  # since entry into pre-swing, which is 0.2 s after the stride's begin
AT_S = np.linspace(0.0, 1.4, 101) - 0.2
SHARE = (AT_S - OFF_S) / SWING_S  # of the swing


def asked(one: StrideResult, tuned: Tuning, gain: float = 0.6) -> Missing:
    """What its samples are short of, when the strides before it were like it."""
    model, times = ResponseModel(), swing_times(one)
    reading = read_stride(one, tuned)
    assert isinstance(reading, Reading)
    assert times is not None
    drives = dict.fromkeys(reading.levels, 0.6)
    for _ in range(8):
        model.add(reading, drives)
    return missing_drive(one, times, demands_of(model, reading, drives), model, FOOT, gain)


def within(missing: Missing, begin: float, end: float) -> list[float]:
    """Of the samples in this share of the swing."""
    shares = (np.array(missing.times_s) - OFF_S) / SWING_S
    return [drive for share, drive in zip(shares, missing.drives, strict=True) if begin <= share <= end]


def with_pitch(pitch_deg: FloatArray, toe_m: float = 0.022) -> StrideResult:
    return stride(0, toe_m, pitch_rad=np.radians(pitch_deg))


def test_until_mid_swing_is_over_the_toe_asks_and_then_the_pitch() -> None:
    low = asked(with_pitch(np.full(101, 10.0), toe_m=0.002), tuning(pitch_at_contact_deg=PITCH))
    assert low.times_s == sorted(low.times_s)
    middle, late = within(low, MID_SWING_BEGIN, MID_SWING_END - 0.03), within(low, MID_SWING_END + 0.03, 1.0)
    assert middle
    assert late
    assert min(middle) > 0.0
    assert max(late) <= 0.0
    down = asked(with_pitch(np.full(101, -8.0), toe_m=0.025), tuning(pitch_at_contact_deg=PITCH))
    assert max(within(down, MID_SWING_BEGIN, MID_SWING_END - 0.03)) <= 0.0
    assert min(within(down, MID_SWING_END + 0.03, 1.0)) > 0.0
    shares = (np.array(down.times_s) - OFF_S) / SWING_S
    assert min(shares) >= MID_SWING_BEGIN
    assert max(shares) <= 1.0  # before mid-swing and after contact nothing asks


def test_a_sample_asks_by_what_it_lies_beside_the_one_measured() -> None:
    falling = -8.0 - 20.0 * np.clip(1.0 - SHARE, 0.0, 1.0)  # at contact −8°, before it lower
    late = within(asked(with_pitch(falling), tuning(pitch_at_contact_deg=PITCH)), MID_SWING_END + 0.01, 1.0)
    assert late == sorted(late, reverse=True)
    assert late[0] > late[-1] + 0.02
    pushes = np.where(SHARE < 0.5, 10.0, 10.0 + 8.0 * np.sin(np.pi * np.clip(SHARE - 0.5, 0.0, 1.0) / 0.5))
    one = with_pitch(pushes, toe_m=BAND["low"] - 0.004)
    middle = within(asked(one, tuning(pitch_at_contact_deg=PITCH)), MID_SWING_BEGIN, MID_SWING_END - 0.02)
    assert middle[0] > middle[-1]  # where the toe is higher it asks for less
    heights = toe_heights_m(one, FOOT)
    assert heights[np.argmax(pushes)] - heights[0] == pytest.approx(
        0.15 * (math.sin(math.radians(pushes.max())) - math.sin(math.radians(10.0))), abs=0.002
    )


def test_a_toe_that_stands_below_what_was_measured_moves_no_later_demand() -> None:
    """Foot off was seen before the toe had left the ground: where it still stands is no height to measure from."""
    toe_m = BAND["low"] - 0.004
    level = with_pitch(np.full(101, 0.0), toe_m)
    for stands_m in (0.0, 0.008):
        path = np.zeros((101, 3))
        path[:, 2] = np.where(SHARE < 0.4, toe_m - stands_m, toe_m)  # the sole is level: the toe goes as the sensor
        missing = asked(replace(level, trajectory_m=path), tuning())
        later = within(missing, 0.45, MID_SWING_END - 0.02)
        assert later == pytest.approx([0.35] * len(later))
        assert len(later) > 8


def test_of_a_level_below_the_band_all_is_asked_for_and_within_it_a_share() -> None:
    low = [asked(with_pitch(np.full(101, -8.0)), tuning(pitch_at_contact_deg=PITCH), gain) for gain in (0.3, 0.6)]
    high = [asked(with_pitch(np.full(101, 18.0)), tuning(pitch_at_contact_deg=PITCH), gain) for gain in (0.3, 0.6)]
    late = [within(each, MID_SWING_END + 0.01, 1.0)[-1] for each in (*low, *high)]
    assert late[0] == late[1] > 0.0
    assert late[3] == pytest.approx(2.0 * late[2])
    assert late[3] < 0.0


def test_an_evertor_asks_from_where_the_foot_turns_to_what_it_lands_with() -> None:
    tuned = tuning(toe_clearance_m=None, eversion_at_contact_deg={"low": -5.0, "high": 5.0})
    missing = asked(stride(0, 0.02, roll_rad=np.full(101, math.radians(9.0))), tuned)
    shares = (np.array(missing.times_s) - OFF_S) / SWING_S
    assert 0.6 <= min(shares) < 0.65
    assert min(missing.drives) > 0.0  # inverted too far: more of the evertors
