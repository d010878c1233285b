"""Steps backward, walked with the calibration of a walk forward: refused, so that no burst follows them."""

from dataclasses import replace

import numpy as np
import pytest
from replays import trial

from fes.calibration.recording import calibrate_track
from fes.config import Stimulation
from fes.estimation.foot.calibration import FootCalibration
from fes.estimation.foot.tracker import FootTracker
from fes.estimation.sensor_choice import stride_settings
from fes.estimation.strides.integration import goes_backward
from fes.estimation.strides.results import StrideMaker
from fes.recording.tracks import Track
from fes.signals import StrideResult
from fes.stimulation.walking import WalkingJudge
from statemachine.phases import PhaseChange


def turned_round(track: Track) -> Track:
    """The same movement, last sample first: joints go backward nearly so."""
    return replace(
        track,
        t_ns=track.t_ns[0] + track.t_ns[-1] - track.t_ns[::-1],
        t_sensor_ns=track.t_sensor_ns[0] + track.t_sensor_ns[-1] - track.t_sensor_ns[::-1],
        acc_mps2=track.acc_mps2[::-1].copy(),
        gyr_radps=-track.gyr_radps[::-1],
    )


@pytest.mark.parametrize("name", ["both_feet_100hz", "negard_patient2"])
def test_steps_backward_are_told_and_permit_no_bursts(name: str) -> None:
    track = trial(name).tracks["right_foot"]
    calibration = calibrate_track(track)
    assert isinstance(calibration, FootCalibration)
    back = turned_round(track)
    tracker = FootTracker(calibration, StrideMaker(track.sensor, stride_settings(calibration)))
    judge, permitted, strides = WalkingJudge(Stimulation()), 0, list[StrideResult]()
    for outcome in tracker.advance(back.t_sensor_ns, back.acc_mps2, back.gyr_radps):
        if isinstance(outcome, StrideResult):
            strides.append(outcome)
            judge.on_stride(outcome)
        elif isinstance(outcome, PhaseChange):
            permitted += judge.on_phase(outcome) and outcome.transition.name == "T1"
    told = [stride for stride in strides if stride.reason.startswith("went backward")]
    assert len(strides) > 20
    assert len(told) > 0.2 * len(strides)
    assert permitted <= 0.1 * len(strides)


@pytest.mark.parametrize(("ahead_m", "turn_rad", "backward"), [(-0.4, 0.0, True), (0.4, 0.0, False), (-0.1, 0.0, False),
                                                               (-0.4, 1.7, False)])  # fmt: skip
def test_a_stride_goes_backward_where_the_heel_points(ahead_m: float, turn_rad: float, backward: bool) -> None:
    position = np.linspace((0.0, 0.0, 0.0), (0.0, ahead_m, 0.0), 50)  # the toe points along y
    quaternion = np.tile((np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)), (50, 1))
    assert goes_backward(quaternion, position, turn_rad, 1.0, 0.0, 0.0) == backward
