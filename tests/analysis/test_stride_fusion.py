"""Stride lengths from two solutions of the same recording."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fes.analysis.pipeline import analyse, calibrations_of
from fes.analysis.stride_fusion import fused, path_lengths
from fes.calibration.foot_track import calibrate_track
from fes.estimation.foot.tracker import FootTracker
from fes.estimation.strides.results import StrideMaker, StrideSettings
from fes.estimation.zupt import foot_trajectory
from fes.recording import Track, read_recording
from fes.signals import StrideResult
from fes.simulation.truth import load_truth

TRIAL = Path(__file__).resolve().parents[2] / "sim_inputs" / "both_feet_200hz.parquet"
FOOT = "left_foot"


@pytest.fixture(scope="module")
def track() -> Track:
    return read_recording(TRIAL).tracks[FOOT]


@pytest.fixture(scope="module")
def strides(track: Track) -> list[StrideResult]:
    calibration = calibrate_track(track)
    settings = StrideSettings(forward=calibration.forward(), up=np.array(calibration.up))
    tracker = FootTracker(calibration, StrideMaker(FOOT, settings))
    outcomes = tracker.advance(track.t_sensor_ns, track.acc_mps2, track.gyr_radps)
    return [each for each in outcomes if isinstance(each, StrideResult)]


def fuse(strides: list[StrideResult], track: Track) -> list[StrideResult]:
    return fused(strides, track.t_sensor_ns, track.acc_mps2, track.gyr_radps)


def lengths_of(strides: list[StrideResult], track: Track) -> np.ndarray:
    begin, end = (np.array([getattr(s, name) for s in strides]) for name in ("t_start_ns", "t_end_ns"))
    return path_lengths(begin, end, track.t_sensor_ns, track.acc_mps2, track.gyr_radps)


def test_the_mean_of_both(track: Track, strides: list[StrideResult]) -> None:
    both, path = fuse(strides, track), lengths_of(strides, track)
    pairs = [(old, new, m) for old, new, m in zip(strides, both, path, strict=True) if new is not old]
    assert len(pairs) > 0.8 * len(strides)
    for old, new, path_m in pairs:
        assert new.stride_length_m == pytest.approx(0.5 * (old.stride_length_m + path_m), abs=1e-12)
        assert new.speed_mps * (new.t_end_ns - new.t_start_ns) == pytest.approx(1e9 * new.stride_length_m)
        assert new.trajectory_m[-1, 0] == pytest.approx(new.stride_length_m, abs=1e-9)
        np.testing.assert_array_equal(new.trajectory_m[:, 2], old.trajectory_m[:, 2])
        assert replace(new, stride_length_m=old.stride_length_m, speed_mps=old.speed_mps) == old


def test_against_the_truth(track: Track, strides: list[StrideResult]) -> None:
    both = fuse(strides, track)
    errors = [
        next(s for s in both if s.t_start_ns < 1e9 * true.t_swing_s < s.t_end_ns).stride_length_m - true.stride_length_m
        for true in load_truth(TRIAL).strides_of(FOOT)
        if true.steady and true.walking
    ]
    assert len(errors) > 35
    assert abs(np.mean(errors)) < 0.017
    assert np.std(errors) < 0.017


def test_where_they_are_far_apart_the_strides_own_stays(track: Track, strides: list[StrideResult]) -> None:
    wrong = [replace(s, stride_length_m=1.3 * s.stride_length_m) for s in strides]
    assert all(new is old for new, old in zip(fuse(wrong, track), wrong, strict=True))


def test_what_is_not_valid_stays(track: Track, strides: list[StrideResult]) -> None:
    gone = replace(strides[5], valid=False, reason="of no use", stride_length_m=math.nan)
    unsure = replace(strides[6], valid=False, reason="of no use")
    assert fuse([gone, unsure], track) == [gone, unsure]


def test_samples_that_are_of_no_use_do_not_count(track: Track, strides: list[StrideResult]) -> None:
    clean = lengths_of(strides, track)
    at = [100, 5000, 5000, 7000]
    t_ns = np.insert(track.t_sensor_ns, at, track.t_sensor_ns[at])  # doubled stamps
    acc, gyr = (np.insert(v, at, np.nan, axis=0) for v in (track.acc_mps2, track.gyr_radps))
    begin, end = (np.array([getattr(s, name) for s in strides]) for name in ("t_start_ns", "t_end_ns"))
    np.testing.assert_allclose(path_lengths(begin, end, t_ns, acc, gyr), clean, atol=1e-9)


def test_stretches_do_not_show(track: Track, strides: list[StrideResult], monkeypatch: pytest.MonkeyPatch) -> None:
    whole = lengths_of(strides, track)
    monkeypatch.setattr(foot_trajectory, "STRETCH_S", 25.0)
    monkeypatch.setattr(foot_trajectory, "SEARCH_S", 4.0)
    cut = lengths_of(strides, track)
    assert np.isfinite(whole).sum() > 40
    assert np.nanmedian(np.abs(cut - whole)) < 0.005
    assert np.nanmax(np.abs(cut - whole)) < 0.03


def test_nothing_to_go_by(track: Track, strides: list[StrideResult]) -> None:
    assert fused([], track.t_sensor_ns, track.acc_mps2, track.gyr_radps) == []
    few = slice(0, 2)
    assert fused(strides[:1], track.t_sensor_ns[few], track.acc_mps2[few], track.gyr_radps[few]) == strides[:1]
    outside = path_lengths(np.array([-5]), np.array([10**9]), track.t_sensor_ns, track.acc_mps2, track.gyr_radps)
    assert np.isnan(outside).all()


def test_a_strides_way_is_as_long_as_its_fused_length() -> None:
    recording, found = calibrations_of(read_recording(TRIAL))
    result = analyse(recording, found.calibrations)
    longer = np.concatenate([block.longer for block in result.blocks.values() if block.longer is not None])
    assert np.abs(longer - 1.0).max() > 1e-4
    for stride in result.strides:
        if stride.valid:
            assert stride.trajectory_m[-1, 0] == pytest.approx(stride.stride_length_m, rel=1e-9)
