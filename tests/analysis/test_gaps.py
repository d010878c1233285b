"""A gap ends what is followed: paths, tables and means do not reach across it, and its length costs nothing."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fes.analysis.parameters.gait import GaitParameters, gait_parameters
from fes.analysis.pipeline import analyse, calibrations_of
from fes.analysis.results import Analysis
from fes.analysis.swings import find_swings
from fes.recording import Recording, Track, read_recording
from fes.report.page import render_report
from fes.signals import NS_PER_S, IntArray

WALK = Path(__file__).parents[2] / "sim_inputs" / "both_feet_100hz.parquet"


def kept(track: Track, rows: np.ndarray, t_ns: IntArray) -> Track:
    return replace(
        track, t_ns=t_ns[rows], t_sensor_ns=t_ns[rows], acc_mps2=track.acc_mps2[rows], gyr_radps=track.gyr_radps[rows]
    )


def paused(recording: Recording, seconds: float, at_s: float = 30.0) -> Recording:
    """The recording with a pause in which nothing was recorded."""
    tracks = {}
    for name, track in recording.tracks.items():
        late = track.t_ns - track.t_ns[0] >= round(at_s * NS_PER_S)
        tracks[name] = kept(track, np.ones(late.size, bool), track.t_ns + late * round(seconds * NS_PER_S))
    return replace(recording, tracks=tracks)


@pytest.fixture(scope="module")
def walk() -> Recording:
    return read_recording(WALK)


@pytest.fixture(scope="module")
def whole(walk: Recording) -> tuple[Analysis, GaitParameters]:
    result = analyse(walk, calibrations_of(walk)[1].calibrations)
    return result, gait_parameters(result)


@pytest.mark.parametrize("pause_s", [10.0, 600.0, 90_000.0])
def test_a_pause_costs_the_stride_in_which_it_falls_and_nothing_else(
    walk: Recording, whole: tuple[Analysis, GaitParameters], pause_s: float
) -> None:
    before, usual = whole
    result = analyse(paused(walk, pause_s), before.calibrations)
    gait = gait_parameters(result)
    for foot, path in result.paths.items():
        assert len(path.seen_ns) == 2
        assert path.distance_m == pytest.approx(before.paths[foot].distance_m, abs=3.0), "two strides are cut"
        for key in ("step_time_s", "stride_time_s", "stride_length_m", "foot_strike_angle_rad", "swing_s"):
            if key in usual.feet[foot]:
                assert gait.feet[foot][key].mean == pytest.approx(usual.feet[foot][key].mean, rel=0.02), (foot, key)
        times = [row["t_s"] for row in result.path_table().rows() if row["foot"] == foot]
        assert len(times) <= len(before.paths[foot].at_rate()[0]) + 2
        assert np.diff(times).max() == pytest.approx(pause_s, abs=2.0)
        assert np.isnan(path.places_at(path.seen_ns[:1, 1] + NS_PER_S)).all()
    assert len(result.event_table().rows()) == pytest.approx(len(before.event_table().rows()), abs=2)
    assert gait.walk.cadence_per_min == pytest.approx(usual.walk.cadence_per_min, rel=0.01)
    swings = [find_swings(t.t_ns, t.acc_mps2, t.gyr_radps).sure.size for t in result.recording.tracks.values()]
    assert swings == pytest.approx(
        [find_swings(t.t_ns, t.acc_mps2, t.gyr_radps).sure.size for t in walk.tracks.values()], abs=2
    )


def test_a_day_s_pause_makes_no_larger_report(walk: Recording, whole: tuple[Analysis, GaitParameters]) -> None:
    sizes = []
    for result in (whole[0], analyse(paused(walk, 90_000.0), whole[0].calibrations)):
        sizes.append(len(render_report(result.walk_record(), paths=result.paths)))
    assert sizes[1] < 1.1 * sizes[0]


def test_means_hold_no_step_across_an_unseen_one(walk: Recording, whole: tuple[Analysis, GaitParameters]) -> None:
    """511 and 603 of some 5,700 samples are lost, in bursts of up to 0.6 s."""
    tracks = {}
    for seed, (name, track) in enumerate(walk.tracks.items()):
        random, there = np.random.default_rng(seed), np.ones(track.t_ns.size, bool)
        while np.count_nonzero(~there) < (511, 603)[seed]:
            begin = int(random.integers(0, there.size - 60))
            there[begin : begin + int(random.integers(5, 60))] = False
        tracks[name] = kept(track, there, track.t_ns)
    result = analyse(replace(walk, tracks=tracks), whole[0].calibrations)
    gait = gait_parameters(result)
    for foot, strides in gait.strides.items():
        steps = strides["step_time_s"]
        usual = whole[1].strides[foot]["step_time_s"]
        assert np.isfinite(steps).sum() >= 5
        assert np.nanmax(steps) <= np.nanmax(usual) + 0.05, "none is longer than without losses"
        assert len(strides) <= len(whole[1].strides[foot]) - 5, "strides with a loss are left out"
