"""IC, FO and the foot-strike angle on recordings of real walks, by the project's own benchmark and its bars."""

from __future__ import annotations

import importlib
import os
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from fes.calibration.recording import calibrate_track

ROOT = Path(__file__).resolve().parents[2]
DATA = Path(os.environ.get("FES_DATA") or ROOT.parent / "shared" / "data")
pytestmark = [
    pytest.mark.data,
    pytest.mark.skipif(
        not ((DATA / "gaitmap_walk").is_dir() and (DATA / "stroke_treadmill").is_dir()),
        reason=f"no gaitmap_walk and stroke_treadmill in {DATA}; set FES_DATA to the folder that holds them",
    ),
]


@pytest.fixture(scope="module")
def benchmark() -> ModuleType:
    return importlib.import_module("benchmarks.accuracy.events")


@pytest.mark.parametrize("method", ["off-line", "causal, instants"])
def test_every_event_of_the_walk_with_markers_meets_its_bar(benchmark: ModuleType, method: str) -> None:
    scores = benchmark.score("gaitmap_walk", benchmark.gaitmap_cases(DATA), method)
    assert [s.true for s in scores] == [57, 57]
    for s in scores:
        assert benchmark.holds(s), s
        assert s.extra == 0, s
        # the second step of the turn, which the reference does not count
        assert s.confirmed == 1, s


def test_the_phase_machine_decides_in_time_on_the_walk_with_markers(benchmark: ModuleType) -> None:
    contact, off = benchmark.score("gaitmap_walk", benchmark.gaitmap_cases(DATA), "causal, phase machine")
    assert off.found == 57
    assert contact.found >= 56  # the turn's second step has no push-off
    assert abs(off.median_ms) <= 10.0
    assert contact.median_ms <= 25.0
    assert max(contact.p95_ms, off.p95_ms) <= 50.0


def test_causal_decisions_and_offline_events_agree_on_stroke_survivors(benchmark: ModuleType) -> None:
    missed = extra = events = 0
    for run, track, _ in benchmark.stroke_tracks(DATA):
        for s in benchmark.score(run, [benchmark._as_truth(run, track)], "causal, instants"):
            missed += s.true - s.found
            extra += s.extra
            events += s.true
            assert s.median_ms <= 20.0, s
            assert s.p95_ms <= 80.0, s
    assert events > 6000
    assert missed + extra <= 0.002 * events


def test_offline_strides_of_stroke_survivors_are_as_steady_as_a_treadmill_makes_them(benchmark: ModuleType) -> None:
    for run, track, _ in benchmark.stroke_tracks(DATA):
        events = benchmark.offline(track, calibrate_track(track))
        stride_s = np.diff(events.ic_ns) * 1e-9
        swing_s = (events.ic_ns - events.fo_ns) * 1e-9
        typical = np.median(stride_s)
        # a stride missed would last two, a false one half; every patient has the odd short or long one
        assert np.count_nonzero(stride_s < 0.65 * typical) == 0, run
        assert np.count_nonzero(stride_s > 1.6 * typical) <= 2, run
        assert 0.2 < np.median(swing_s) / typical < 0.45, run
        # from stride to stride: over a run some patients' swing slowly gets longer
        assert np.median(np.abs(np.diff(swing_s))) < 0.04, run


def test_foot_strike_angle_agrees_with_vicon(benchmark: ModuleType) -> None:
    angles = benchmark.strike_angles(benchmark.stroke_tracks(DATA))
    correlation, offset, sd = benchmark.strike_score(angles)
    assert len(angles) == 13
    assert correlation >= 0.98
    assert sd <= 1.6
    assert abs(offset) < 4.0
