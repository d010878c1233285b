"""Patients drawn for a cohort: all five slow walks, bodies and delays that differ, twitches as published."""

from __future__ import annotations

import pytest

from fes.simulation.forward import draw_patient
from fes.simulation.forward.draw import HEMIPARETIC
from fes.simulation.forward.gait_patterns import PATTERNS


def test_fifteen_in_a_row_have_all_five_slow_walks() -> None:
    for first in (0, 7, 100):
        cohort = [draw_patient(5, number) for number in range(first, first + 15)]
        slow = [one for one in cohort if one.pattern != "none"]
        assert {one.pattern for one in slow} == set(HEMIPARETIC) == set(PATTERNS) - {"none"}
        assert all(0.21 <= one.speed_mps <= 0.35 for one in slow)
        assert all(one.speed_mps > 0.35 for one in cohort if one.pattern == "none")


def test_people_differ_and_the_same_number_is_the_same_person() -> None:
    cohort = [draw_patient(5, number) for number in range(30)]
    assert cohort == [draw_patient(5, number) for number in range(30)]
    assert cohort != [draw_patient(6, number) for number in range(30)]
    heights, delays = {one.height_m for one in cohort}, {one.muscle.delay_s for one in cohort}
    assert max(heights) - min(heights) > 0.2
    assert max(delays) - min(delays) > 0.02
    assert len({one.placements["right_foot"] for one in cohort}) == 30
    assert any(one.inversion_share > 0.1 for one in cohort)
    assert any(one.inversion_share < 0.0 for one in cohort)


def test_settings_by_name_win() -> None:
    assert draw_patient(5, 0, side="left", speed_mps=0.3).side == "left"
    with pytest.raises(ValueError, match="speed_mps"):
        draw_patient(5, 0, speed_mps=9.0)
