"""The second patient, which judges the tuning: its sensor feels what a foot does, and nothing that no foot can do."""

from __future__ import annotations

from statistics import median
from typing import Any

import numpy as np
import pytest
from scipy.signal import welch

from benchmarks.lib.real_sets import data_folder, stroke_feet
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


def share_below_5_hz(acc_mps2: Any, rate_hz: float) -> float:
    """Of the power of the acceleration's size (N, 3) about its mean."""
    size = np.linalg.norm(acc_mps2, axis=1)
    frequency_hz, power = welch(size - size.mean(), rate_hz, nperseg=int(4 * rate_hz))
    return float(power[frequency_hz < 5.0].sum() / power.sum())


def test_its_foot_shakes_as_real_feet_do(second: Any) -> None:
    folder = data_folder()
    if not (folder / "stroke_treadmill").is_dir():
        pytest.skip(f"the recordings are not here: {folder}")
    patients, _, _ = second
    real = median(share_below_5_hz(track.acc_mps2, track.rate_hz) for _, track, _ in stroke_feet(folder))
    shares = []
    for seed in (1001, 2000, 3000, 4000, 5000, 6000, 7000, 8000):
        settings = patients.draw_second(seed)
        heard = patients.SecondPatient(settings).advance(40_000_000_000)
        walks = [one.acc_mps2 for one in heard if one.sensor == settings.affected_foot and one.t_ns > 8_000_000_000]
        shares.append(share_below_5_hz(np.array(walks), settings.rate_hz))
    print(f"below 5 Hz: {median(shares):.2f} ({min(shares):.2f} to {max(shares):.2f}), real feet {real:.2f}")
    assert abs(median(shares) / real - 1.0) < 0.2
