"""Exchanged feet are named in a session's first strides, and refuse to arm; feet on their own sides say nothing."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import pytest

from fes.analysis.pipeline import calibrations_of
from fes.estimation.foot.calibration import FootCalibration
from fes.estimation.foot.tracker import FootTracker
from fes.estimation.sensor_choice import Calibration, stride_settings
from fes.estimation.strides.results import StrideMaker
from fes.live.sides import EXCHANGED, SideCheck
from fes.recording import Recording, Track, read_recording
from fes.recording.tracks import samples_of
from fes.signals import FOOT_SENSORS, ImuSample, StrideResult, SystemFault

TRIAL = Path(__file__).resolve().parents[2] / "sim_inputs"


def recording_of_two_feet() -> tuple[Recording, Mapping[str, Calibration]]:
    recording, found = calibrations_of(read_recording(TRIAL / "both_feet_100hz.parquet"))
    return recording, found.calibrations


def exchanged(tracks: Mapping[str, Track]) -> dict[str, Track]:
    left, right = (tracks[foot] for foot in FOOT_SENSORS)
    return {"left_foot": replace(right, sensor="left_foot"), "right_foot": replace(left, sensor="right_foot")}


def followed(recording: Recording, calibrations: Mapping[str, Calibration]) -> tuple[SideCheck, int]:
    """The check after a walk, and how many strides it had seen when it was done."""
    check, seen = SideCheck(calibrations), 0
    trackers = {}
    for foot, calibration in calibrations.items():
        assert isinstance(calibration, FootCalibration)
        trackers[foot] = FootTracker(calibration, StrideMaker(foot, stride_settings(calibration)))
    for event in samples_of(recording, set(calibrations)):
        check.add_event(event)
        assert isinstance(event, ImuSample)
        for outcome in trackers[event.sensor].step(event.t_sensor_ns, event.acc_mps2, event.gyr_radps):
            if isinstance(outcome, StrideResult) and not check.done:
                seen += 1
                check.add_stride(outcome)
    return check, seen


@pytest.mark.requirement("SR-21")
def test_exchanged_feet_are_told_in_the_first_strides_and_feet_on_their_own_sides_are_not() -> None:
    recording, calibrations = recording_of_two_feet()
    check, _ = followed(recording, calibrations)
    assert check.exchanged == ""
    assert check.read_events(7) == []
    check, seen = followed(replace(recording, tracks=exchanged(recording.tracks)), calibrations)
    assert check.exchanged == EXCHANGED
    assert seen <= 24
    assert check.read_events(7) == [SystemFault(7, EXCHANGED)]
    assert check.read_events(8) == [], "once; but it goes on speaking against arming"
    assert check.exchanged == EXCHANGED


def test_one_foot_alone_is_never_told() -> None:
    recording, calibrations = recording_of_two_feet()
    check, _ = followed(
        replace(recording, tracks={"left_foot": recording.tracks["left_foot"]}),
        {"left_foot": calibrations["left_foot"]},
    )
    assert check.done
    assert check.exchanged == ""
    assert check.fileno() is None
