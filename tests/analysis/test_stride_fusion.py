"""Stride lengths from two solutions of the same recording."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fes.analysis.ground_path import fuse, lengths_along
from fes.analysis.pipeline import analyse, calibrations_of
from fes.analysis.swings import find_swings, turning_points
from fes.calibration.recording import calibrate_track
from fes.estimation.foot.tracker import FootTracker
from fes.estimation.strides.integration import SOLVED
from fes.estimation.strides.results import Rows, StrideMaker, StrideSettings
from fes.estimation.zupt import foot_trajectory
from fes.estimation.zupt.foot_trajectory import FootSamples, foot_samples
from fes.recording import Recording, Track, read_recording
from fes.report.findings import findings, session_json
from fes.report.summary import summarise
from fes.signals import G_MPS2, FloatArray
from fes.simulation import bundled_file
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


# --- Swings from the raw signals: as many as a known movement has ---


STRIDE_S = 1.2


def walk(strides: int, rate_hz: float, turn: Rotation, slap_rad: float = 0.2) -> tuple[np.ndarray, ...]:
    """A foot that stands for 0.6 of each cycle, then turns by −50° and back past flat, slaps down, and travels."""
    t = np.arange(0.0, strides * STRIDE_S + 2.0, 1.0 / rate_hz)
    phase = np.clip((t - 1.0) / STRIDE_S, 0.0, strides - 1e-9) % 1.0
    knots = [0.0, 0.5, 0.64, 0.88, 0.95, 1.0]
    pitch = np.interp(phase, knots, [0.0, 0.0, -0.9, slap_rad, 0.0, 0.0])
    speed = np.where((phase > 0.6) & (phase < 0.92), np.sin((phase - 0.6) / 0.32 * np.pi) * 3.0, 0.0)
    smooth = np.hanning(round(0.06 * rate_hz) | 1)
    pitch, speed = (np.convolve(np.pad(v, 50, "edge"), smooth / smooth.sum(), "same")[50:-50] for v in (pitch, speed))
    ahead = np.gradient(speed, t)
    acc = np.column_stack(
        [np.cos(pitch) * ahead + np.sin(pitch) * G_MPS2, 0 * t, np.cos(pitch) * G_MPS2 - np.sin(pitch) * ahead]
    )
    gyr = np.column_stack([0 * t, -np.gradient(pitch, t), 0 * t])  # x ahead, y left, z up: toe-up is −y
    return np.rint(t * 1e9).astype(np.int64), turn.apply(acc), turn.apply(gyr)


@pytest.mark.parametrize("rate_hz", [50.0, 100.0, 1000.0])
@pytest.mark.parametrize("turn", [(0.0, 0.0, 0.0), (180.0, 0.0, 0.0), (20.0, -40.0, 130.0)])
def test_every_swing_is_counted_once(rate_hz, turn):
    t_ns, acc, gyr = walk(12, rate_hz, Rotation.from_euler("xyz", turn, degrees=True))
    swings = find_swings(t_ns, acc, gyr)
    true_ns = 1e9 * (1.0 + STRIDE_S * (np.arange(12) + 0.76))
    assert len(swings.sure) == len(swings.possible) == 12
    assert np.abs(swings.sure - true_ns).max() < 0.08e9, "in mid-swing, not at the slap or at push-off"
    spans = [(int(t - 6e8), int(t + 6e8)) for t in true_ns[:6]]
    assert swings.outside(spans).tolist() == swings.sure[6:].tolist()
    assert swings.outside([(0, spans[5][1])]).tolist() == swings.sure[1:].tolist(), "one swing a stride"


def test_one_that_the_end_cuts_may_be_one():
    t_ns, acc, gyr = walk(12, 100.0, Rotation.identity())
    seen = t_ns < 1e9 * (1.0 + STRIDE_S * 11.84)  # the foot still turns toe-up
    swings = find_swings(t_ns[seen], acc[seen], gyr[seen])
    assert (len(swings.sure), len(swings.possible)) == (11, 12)


def test_standing_has_none():
    rng = np.random.default_rng(2)
    t_ns = np.arange(3000) * 10_000_000
    acc = rng.normal([0.0, 0.0, G_MPS2], 0.05, (3000, 3))
    assert not len(find_swings(t_ns, acc, rng.normal(0.0, 0.01, (3000, 3))).possible)
    assert not len(find_swings(t_ns[:0], acc[:0], acc[:0]).sure)
    assert not len(find_swings(t_ns, acc, np.full((3000, 3), np.nan)).sure), "nothing was measured"


def test_turning_points_come_by_turns():
    assert turning_points(np.array([0.0, 1.0, 0.9, 2.0, -1.0, -0.9, 3.0, 0.0]), 0.5) == [0, 3, 4, 6]


def test_strides_that_are_missing_are_told():
    recording = read_recording(bundled_file("negard_patient1.parquet"))
    foot = next(iter(recording.tracks))
    whole = analyse(Recording("walk", None, {foot: recording.tracks[foot]})).walk_record()
    told = summarise(whole).feet[foot]
    assert (told.unexplained, told.swings >= 10) == (0, True)
    cut = replace(whole, strides=[stride for stride in whole.strides if stride.number not in (4, 5, 6)])
    summary = summarise(cut)
    assert summary.feet[foot].unexplained == 3
    texts = [finding.text for finding in findings(summary)]
    assert any(f"{told.swings} swings" in text and "3 unexplained between" in text for text in texts)
    assert any("of" in text and "swings passed all four phases" in text for text in texts)
    assert session_json(summary)["feet"][foot]["unexplained"] == 3
