"""Shanks of stroke survivors tell phases and speed, and two feet tell left from right: the bars of the benchmark."""

from __future__ import annotations

import importlib
import os
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.lib.real_sets import load_run
from fes.calibration.recording import calibrate_all, calibrate_shank_track, calibrate_track, refuse_misfit
from fes.datasets.common import even_track
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
    ratios = np.array([r.causal for r in results if not np.isnan(r.causal)])
    assert 0.98 <= ratios.mean() <= 1.02
    assert np.abs(ratios - 1.0).max() <= 0.06
    assert sum(r.invalid for r in results) <= 0.01 * sum(r.solved for r in results)


def test_speed_over_belt_meets_the_bar(results: list[Any]) -> None:
    """Mean 0.98–1.02, every side within 8 %; resetting to zero is far from it."""
    known = [r for r in results if not np.isnan(r.learnt)]
    assert len(known) == 24
    learnt, zupt = np.array([r.learnt for r in known]), np.array([r.zupt for r in known])
    assert 0.98 <= learnt.mean() <= 1.02
    assert np.abs(learnt - 1.0).max() <= 0.08
    assert learnt.std(ddof=1) < 0.04
    assert zupt.mean() < 0.9


def test_hardly_a_stride_is_lost_and_no_arm_is_wild(results: list[Any]) -> None:
    for r in results:
        assert r.solved > 80
        assert r.invalid <= 0.02 * r.solved
        assert 0.2 <= r.arm_m[2] <= 0.4
        assert np.linalg.norm(r.arm_m[:2]) < 0.08
        assert 1.0 < r.condition < 30.0


@pytest.mark.parametrize("path", ONE_OF_EACH, ids=lambda path: path.stem)
@pytest.mark.parametrize("variant", ["turned", "20 s", "50 Hz"])
def test_mounting_length_and_rate_do_not_matter(path: Path, variant: str, benchmark: ModuleType) -> None:
    """A sensor mounted any other way gives the same; 20 s of walking or half the rate stay within the bar."""
    shanks, belt_mps = load_run(path, "shank")
    for sensor, track in shanks.items():
        acc, gyr, rate_hz = track.acc_mps2, track.gyr_radps, track.rate_hz
        tolerance, known_from = 0.03, track
        if variant == "turned":
            mounting = Rotation.from_euler("xyz", (140.0, -50.0, 80.0), degrees=True)
            changed = known_from = even_track(sensor, rate_hz, mounting.apply(acc), mounting.apply(gyr))
            tolerance = 1e-3
        elif variant == "20 s":
            changed, known_from = track, track.part(slice(0, round(20.0 * rate_hz)))
        else:
            changed = known_from = even_track(sensor, 0.5 * rate_hz, acc[::2], gyr[::2])
        ratios = []
        for of, seen in ((track, track), (changed, known_from)):
            calibration = calibrate_shank_track(seen)
            strides = benchmark.with_arm(of, calibration, np.array(calibration.arm.arm_m))
            ratios.append(benchmark.speed_mps(strides, of) / belt_mps)
        assert ratios[1] == pytest.approx(ratios[0], abs=tolerance)
        assert abs(ratios[1] - 1.0) <= 0.08


def test_left_is_told_from_right_on_other_subjects(benchmark: ModuleType) -> None:
    told = benchmark.tell_all(DATA)
    assert len({t.subject for t in told}) >= 4
    assert all(t.right and t.held_out_right for t in told)


@pytest.mark.parametrize("path", ONE_OF_EACH, ids=lambda path: path.stem)
def test_unlabelled_feet_are_named_and_swapped_ones_noticed(path: Path) -> None:
    tracks, _ = load_run(path)
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
def test_the_same_sensor_fits_its_calibration_to_the_end(path: Path) -> None:
    (tracks, _), (shanks, _) = load_run(path), load_run(path, "shank")
    for track in shanks.values():
        refuse_misfit(calibrate_shank_track(track), track, Path("c.json"))
    for track in tracks.values():
        refuse_misfit(calibrate_track(track), track, Path("c.json"))


def test_blocks_and_samples_give_the_same_bits() -> None:
    track = load_run(RUNS[0], "shank")[0]["left_shank"]
    calibration = calibrate_shank_track(track)
    n = 3000
    whole = ShankTracker(calibration).advance(track.t_ns[:n], track.acc_mps2[:n], track.gyr_radps[:n])
    tracker = ShankTracker(calibration)
    single = []
    for k in range(n):
        single += tracker.advance(track.t_ns[k : k + 1], track.acc_mps2[k : k + 1], track.gyr_radps[k : k + 1])
    assert [repr(outcome) for outcome in single] == [repr(outcome) for outcome in whole]
    assert len(whole) > 50
