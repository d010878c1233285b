"""The second patient, which judges the tuning: its sensor feels what a foot does, and nothing that no foot can do."""

from __future__ import annotations

from statistics import median
from typing import Any

import pytest

from benchmarks.loop import closed_loop_walk, second_patient, tuning_cohort


@pytest.fixture
def second() -> Any:
    return second_patient, closed_loop_walk, tuning_cohort


def test_level_strides_are_level_to_the_sensor(second: Any) -> None:
    patients, walks, cohort = second
    for seed in (1001, 3000):
        settings, made = patients.draw_second(seed), patients.SecondPatient
        session = cohort.session_with(made(settings).geometry["right_foot"])
        done = walks.walk(settings, session, walks.calibration_of(settings, made), 40.0, 15, made=made)
        rises_m = [one.free_rise_m for one in done.measured if one.valid]
        assert len(rises_m) > 10
        assert median(abs(rise_m) for rise_m in rises_m) < 0.02, "it was 0.15 when contacts left it a velocity"
