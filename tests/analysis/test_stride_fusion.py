"""Stride lengths from two solutions of the same recording."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from fes.analysis.pipeline import analyse, calibrations_of
from fes.analysis.stride_fusion import fuse, lengths_along
from fes.calibration.recording import calibrate_track
from fes.estimation.foot.tracker import FootTracker
from fes.estimation.strides.integration import SOLVED
from fes.estimation.strides.results import Rows, StrideMaker, StrideSettings
from fes.estimation.zupt import foot_trajectory
from fes.estimation.zupt.foot_trajectory import FootSamples, foot_samples
from fes.recording import Track, read_recording
from fes.signals import FloatArray
from fes.simulation.truth import load_truth

TRIAL = Path(__file__).resolve().parents[2] / "sim_inputs" / "both_feet_200hz.parquet"
FOOT = "left_foot"


@pytest.fixture(scope="module")
def track() -> Track:
    return read_recording(TRIAL).tracks[FOOT]


@pytest.fixture(scope="module")
def rows(track: Track) -> Rows:
    """The foot's strides by themselves."""
    calibration = calibrate_track(track)
    settings = StrideSettings(forward=calibration.forward(), up=np.array(calibration.up))
    tracker = FootTracker(calibration, StrideMaker(FOOT, settings))
    return tracker.track(track.t_sensor_ns, track.acc_mps2, track.gyr_radps).rows


def samples_of(track: Track) -> FootSamples:
    return foot_samples(track.t_sensor_ns, track.acc_mps2, track.gyr_radps)


def fused(rows: Rows, track: Track) -> tuple[Rows, FloatArray]:
    both = rows.copy()
    return both, fuse(both, samples_of(track))


def lengths_of(rows: Rows, samples: FootSamples) -> FloatArray:
    return lengths_along(samples, rows["t_start_ns"], rows["t_end_ns"])


def test_the_mean_of_both(track: Track, rows: Rows) -> None:
    (both, longer), path_m = fused(rows, track), lengths_of(rows, samples_of(track))
    own_m, length_m = rows["stride_length_m"], both["stride_length_m"]
    new = length_m != own_m
    assert np.count_nonzero(new) > 0.8 * len(rows)
    np.testing.assert_allclose(length_m[new], 0.5 * (own_m + path_m)[new], atol=1e-12)
    duration_s = 1e-9 * (rows["t_end_ns"] - rows["t_start_ns"])
    np.testing.assert_allclose((both["speed_mps"] * duration_s)[new], length_m[new])
    np.testing.assert_allclose(longer[new], (length_m / own_m)[new])
    for name in set(rows.dtype.names) - {"stride_length_m", "speed_mps"}:
        np.testing.assert_array_equal(both[name], rows[name])


def test_against_the_truth(track: Track, rows: Rows) -> None:
    both, _ = fused(rows, track)
    errors = [
        next(s["stride_length_m"] for s in both if s["t_start_ns"] < 1e9 * true.t_swing_s < s["t_end_ns"])
        - true.stride_length_m
        for true in load_truth(TRIAL).strides_of(FOOT)
        if true.steady and true.walking
    ]
    assert len(errors) > 35
    assert abs(np.mean(errors)) < 0.017
    assert np.std(errors) < 0.017


def test_where_they_are_far_apart_the_strides_own_stays(track: Track, rows: Rows) -> None:
    wrong = rows.copy()
    wrong["stride_length_m"] *= 1.3
    both, longer = fused(wrong, track)
    np.testing.assert_array_equal(both["stride_length_m"], wrong["stride_length_m"])
    assert (longer == 1.0).all()


def test_what_is_not_valid_stays(track: Track, rows: Rows) -> None:
    bad = rows[5:7].copy()
    bad["outcome"] = SOLVED + 1
    bad["stride_length_m"][0] = math.nan
    both, longer = fused(bad, track)
    np.testing.assert_array_equal(both["stride_length_m"], bad["stride_length_m"])
    assert (longer == 1.0).all()


def test_samples_that_are_of_no_use_do_not_count(track: Track, rows: Rows) -> None:
    clean = lengths_of(rows, samples_of(track))
    at = [100, 5000, 5000, 7000]
    t_ns = np.insert(track.t_sensor_ns, at, track.t_sensor_ns[at])  # doubled stamps
    acc, gyr = (np.insert(v, at, np.nan, axis=0) for v in (track.acc_mps2, track.gyr_radps))
    np.testing.assert_allclose(lengths_of(rows, foot_samples(t_ns, acc, gyr)), clean, atol=1e-9)


def test_stretches_do_not_show(track: Track, rows: Rows, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = lengths_of(rows, samples_of(track))
    monkeypatch.setattr(foot_trajectory, "STRETCH_S", 25.0)
    monkeypatch.setattr(foot_trajectory, "SEARCH_S", 4.0)
    cut = lengths_of(rows, samples_of(track))
    assert np.isfinite(whole).sum() > 40
    assert np.nanmedian(np.abs(cut - whole)) < 0.005
    assert np.nanmax(np.abs(cut - whole)) < 0.03


def test_nothing_to_go_by(track: Track, rows: Rows) -> None:
    assert len(fuse(rows[:0].copy(), samples_of(track))) == 0
    outside = lengths_along(samples_of(track), np.array([-5]), np.array([10**9]))
    assert np.isnan(outside).all()


def test_a_strides_way_is_as_long_as_its_fused_length() -> None:
    recording, found = calibrations_of(read_recording(TRIAL))
    result = analyse(recording, found.calibrations)
    longer = np.concatenate([block.longer for block in result.blocks.values() if block.longer is not None])
    assert np.abs(longer - 1.0).max() > 1e-4
    for stride in result.strides:
        if stride.valid:
            assert stride.trajectory_m[-1, 0] == pytest.approx(stride.stride_length_m, rel=1e-9)
