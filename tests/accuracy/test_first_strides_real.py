"""Real starts, turns and pauses: few steps stay without a burst. Two-minute walks of stroke survivors, with turns."""

from __future__ import annotations

import os
from collections.abc import Iterable
from itertools import islice
from pathlib import Path

import pytest

from benchmarks.lib.walkers import Foot, calibrate, feet_of
from fes.calibration.recording import calibrate_phase_sensors
from fes.config import Stimulation
from fes.estimation.foot.calibration import CalibrationError, FootCalibration
from fes.estimation.foot.tracker import FootTracker
from fes.estimation.sensor_choice import stride_settings
from fes.estimation.strides.results import StrideMaker
from fes.estimation.tracking.tracker import Outcome
from fes.recording import Track, read_recording
from fes.signals import StrideResult
from fes.simulation.truth import load_truth
from fes.stimulation.walking import WalkingJudge
from statemachine.phases import Transition

ROOT = Path(__file__).resolve().parents[2]
DATA = Path(os.environ.get("FES_DATA") or ROOT.parent / "shared" / "data")
pytestmark = [
    pytest.mark.data,
    pytest.mark.skipif(
        not (DATA / "unseen_walkers" / "stroke_walks").is_dir(),
        reason=f"no unseen_walkers/stroke_walks in {DATA}; set FES_DATA to the folder that holds them",
    ),
]
FEET = 16  # eight people's, with turns in all of them


def outcomes_of(track: Track, calibration: FootCalibration) -> list[Outcome]:
    """Phase changes and strides in the order in which they come live."""
    tracker = FootTracker(calibration, StrideMaker(track.sensor, stride_settings(calibration)))
    return list(tracker.advance(track.t_sensor_ns, track.acc_mps2, track.gyr_radps))


def heel_rises(outcomes: Iterable[Outcome], settings: Stimulation) -> list[tuple[int, bool, bool]]:
    """Of each T1: when (ns), whether a burst was permitted, whether a swing followed."""
    judge, found = WalkingJudge(settings), list[tuple[int, bool, bool]]()
    for outcome in outcomes:
        if isinstance(outcome, StrideResult):
            judge.on_stride(outcome)
            continue
        permitted = judge.on_phase(outcome)
        if outcome.transition is Transition.T1:
            found.append((outcome.t_ns, permitted, False))
        elif outcome.transition is Transition.T2 and found:
            found[-1] = (*found[-1][:2], True)
    return found


def refused(feet: Iterable[Foot], settings: tuple[Stimulation, ...]) -> tuple[int, list[int]]:
    """Steps, and how many of them each of the settings refused."""
    steps, found = 0, [0] * len(settings)
    for foot in feet:
        try:
            calibration = calibrate(foot.track)
        except CalibrationError:
            continue
        assert isinstance(calibration, FootCalibration)
        outcomes = outcomes_of(foot.track, calibration)
        swung = [[permitted for _, permitted, swings in heel_rises(outcomes, each) if swings] for each in settings]
        steps += len(swung[0])
        found = [count + own.count(False) for count, own in zip(found, swung, strict=True)]
    return steps, found


def bursts_of_nobody(settings: Stimulation) -> int:
    """In the bundled trial of not walking, permitted heel rises outside its walk."""
    recording = read_recording(ROOT / "sim_inputs" / "not_walking.parquet")
    walks = [each for each in load_truth(ROOT / "sim_inputs" / "not_walking.parquet").activities if each.walking]
    count = 0
    for sensor, calibration in calibrate_phase_sensors(recording).calibrations.items():
        if isinstance(calibration, FootCalibration):
            rises = heel_rises(outcomes_of(recording.tracks[sensor], calibration), settings)
            permitted_s = [1e-9 * t_ns for t_ns, permitted, _ in rises if permitted]
            count += sum(not any(walk.start_s <= t_s <= walk.end_s for walk in walks) for t_s in permitted_s)
    return count


def test_who_walks_and_turns_and_pauses_goes_on_being_stimulated() -> None:
    feet = islice(feet_of(DATA, ["stroke_walks"]), FEET)
    steps, (own, by_two) = refused(feet, (Stimulation(), Stimulation(strides_before_start=2)))
    assert steps > 1000
    assert own <= 0.08 * steps
    assert own < by_two


def test_of_nobody_walking_there_is_no_burst() -> None:
    assert bursts_of_nobody(Stimulation()) == 0
