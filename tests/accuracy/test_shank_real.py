"""Shanks of stroke survivors tell the phases, and two feet tell left from right: the bars of the benchmark."""

from __future__ import annotations

import importlib
import os
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from fes.calibration.recording import calibrate_all, calibrate_shank_track, calibrate_track, refuse_misfit
from fes.estimation.shank.tracker import ShankTracker
from fes.recording import Recording

ROOT = Path(__file__).resolve().parents[2]
DATA = Path(os.environ.get("FES_DATA") or ROOT.parent / "shared" / "data")
RUNS = sorted((DATA / "stroke_treadmill").glob("*.npz"))
ONE_OF_EACH = [path for path in RUNS if path.stem in ("MR02_FBIC", "MR05_2FB", "MR08_FBIC", "MR11_2FB")]
pytestmark = [
    pytest.mark.data,
    pytest.mark.skipif(
        not RUNS, reason=f"no recordings in {DATA}; set FES_DATA to the folder that holds stroke_treadmill"
    ),
]


@pytest.fixture(scope="module")
def benchmark() -> ModuleType:
    return importlib.import_module("benchmarks.accuracy.shank_phases")


@pytest.fixture(scope="module")
def results(benchmark: ModuleType) -> list[Any]:
    return [result for path in RUNS for result in benchmark.evaluate(path)]


def test_the_four_phases_come_in_order(benchmark: ModuleType, results: list[Any]) -> None:
    """99.5 % of strides, no side below 97 %, at most 0.2 false swings in a hundred."""
    assert len(results) == 26
    assert benchmark.holds(results, [])


def test_foot_off_and_contact_are_the_foot_sensors(results: list[Any]) -> None:
    """Within two samples of the foot sensor's in the median of sides; heel-off within eight, foot-flat within ten.

    On some sides the foot has slowed and jolts 70 ms before its shank has come to a stop.
    """
    later = np.array([result.later_ms for result in results])
    heel_off, foot_off, contact, flat = np.median(later, axis=0)
    assert abs(foot_off) <= 20.0
    assert 0.0 <= contact <= 20.0
    assert np.abs(later[:, 1:3]).max() <= 70.0
    assert abs(heel_off) <= 80.0
    assert abs(flat) <= 100.0


def test_causal_strides_are_as_long_as_the_belt_says(results: list[Any]) -> None:
    ratios = np.array([r.speed_ratio for r in results if not np.isnan(r.speed_ratio)])
    assert 0.98 <= ratios.mean() <= 1.02
    assert np.abs(ratios - 1.0).max() <= 0.06
    assert sum(r.invalid for r in results) <= 0.01 * sum(r.solved for r in results)


def test_left_is_told_from_right_on_other_subjects(benchmark: ModuleType) -> None:
    told = benchmark.tell_all(DATA)
    assert len({t.subject for t in told}) >= 4
    assert all(t.right and t.held_out_right for t in told)


@pytest.mark.parametrize("path", ONE_OF_EACH, ids=lambda path: path.stem)
def test_unlabelled_feet_are_named_and_swapped_ones_noticed(benchmark: ModuleType, path: Path) -> None:
    tracks, _ = benchmark.load_run(path)
    bare = {
        "foot_a": replace(tracks["right_foot"], sensor="foot_a"),
        "foot_b": replace(tracks["left_foot"], sensor="foot_b"),
    }
    found = calibrate_all(Recording(path.stem, None, bare))
    assert found.sides == {"foot_a": "right_foot", "foot_b": "left_foot"}
    assert found.calibrations["right_foot"].up == calibrate_track(tracks["right_foot"]).up
    assert not calibrate_all(Recording(path.stem, None, tracks)).swapped
    swapped = {
        "left_foot": replace(tracks["right_foot"], sensor="left_foot"),
        "right_foot": replace(tracks["left_foot"], sensor="right_foot"),
    }
    assert calibrate_all(Recording(path.stem, None, swapped)).swapped


@pytest.mark.parametrize("path", ONE_OF_EACH, ids=lambda path: path.stem)
def test_the_same_sensor_fits_its_calibration_to_the_end(benchmark: ModuleType, path: Path) -> None:
    shanks, rate_hz, _ = benchmark.load_shanks(path)
    tracks, _ = benchmark.load_run(path)
    for sensor, values in shanks.items():
        track = benchmark.track_of(sensor, rate_hz, *values)
        refuse_misfit(calibrate_shank_track(track), track, Path("c.json"))
    for track in tracks.values():
        refuse_misfit(calibrate_track(track), track, Path("c.json"))


def test_blocks_and_samples_give_the_same_bits(benchmark: ModuleType) -> None:
    shanks, rate_hz, _ = benchmark.load_shanks(RUNS[0])
    track = benchmark.track_of("left_shank", rate_hz, *shanks["left_shank"])
    calibration = calibrate_shank_track(track)
    n = 3000
    whole = ShankTracker(calibration).advance(track.t_ns[:n], track.acc_mps2[:n], track.gyr_radps[:n])
    tracker = ShankTracker(calibration)
    single = []
    for k in range(n):
        single += tracker.advance(track.t_ns[k : k + 1], track.acc_mps2[k : k + 1], track.gyr_radps[k : k + 1])
    assert [repr(outcome) for outcome in single] == [repr(outcome) for outcome in whole]
    assert len(whole) > 50
