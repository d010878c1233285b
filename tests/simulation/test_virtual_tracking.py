"""What the product's own estimators make of a virtual patient's signals: as good as on real ones, against the truth."""

from __future__ import annotations

from pathlib import Path
from statistics import median

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from virtual_walks import walk

from fes.calibration.recording import calibrate_track
from fes.estimation.foot.tracker import FootTracker
from fes.estimation.strides.results import StrideMaker, StrideSettings
from fes.recording import Track, read_recording, write_recording
from fes.signals import NS_PER_S, StrideResult
from fes.simulation.forward import PatientSettings, VirtualPatient, VirtualStride, settings_for
from fes.simulation.forward.closed_loop import recording_of, truth_of
from fes.simulation.sensor import PERFECT
from fes.simulation.truth import load_truth, write_truth
from statemachine.guards import Thresholds
from statemachine.phases import Phase, PhaseChange, Transition

CASES = {
    "healthy": (settings_for("healthy", speed_mps=1.2), 0.0),
    "healthy 200 Hz": (settings_for("healthy", speed_mps=0.9, rate_hz=200.0), 0.0),
    "drop foot": (settings_for("severe", speed_mps=0.6, seed=2), 0.0),
    "stimulated": (settings_for("severe", speed_mps=0.8, seed=3), 26.0),
    "slow": (settings_for("moderate", speed_mps=0.35, seed=4), 0.0),
    "hemiparetic 2": (settings_for("moderate", pattern="hemiparetic_2", seed=5), 0.0),
}
ORDER = [Transition.T1, Transition.T2, Transition.T3, Transition.T4]


def outcomes(track: Track) -> tuple[list[PhaseChange], list[StrideResult]]:
    calibration = calibrate_track(track)
    maker = StrideMaker(track.sensor, StrideSettings(forward=calibration.forward(), up=np.array(calibration.up)))
    found = FootTracker(calibration, maker).advance(track.t_sensor_ns, track.acc_mps2, track.gyr_radps)
    return (
        [one for one in found if isinstance(one, PhaseChange)],
        [one for one in found if isinstance(one, StrideResult)],
    )


@pytest.mark.parametrize("case", CASES)
def test_phases_and_strides_are_found_on_both_feet(case: str) -> None:
    settings, current_ma = CASES[case]
    patient, samples = walk(settings, 50.0, current_ma)
    recording = recording_of(patient, samples, "walk", "")
    for foot in ("left_foot", "right_foot"):
        # while the belt speeds up, its own acceleration is no step; the last stride may be cut off
        truth = [stride for stride in patient.strides if stride.foot == foot][2:-1]
        changes, strides = outcomes(recording.tracks[foot])
        in_order, off_ms, contact_ms, ratio = 0, [], [], []
        for stride in truth:
            here = _around(stride, changes)
            if [change.transition for change in here] == ORDER:
                in_order += 1
                off_ms.append(1e-6 * (here[1].t_ns - stride.t_foot_off_ns))
                contact_ms.append(1e-6 * (here[2].t_ns - stride.t_contact_ns))
            ratio += [
                found.stride_length_m / stride.stride_length_m
                for found in strides
                if found.valid and found.t_start_ns < stride.t_foot_off_ns and found.t_end_ns > stride.t_contact_ns
            ]
        assert in_order >= 0.99 * len(truth) > 8
        assert abs(median(off_ms)) < 40.0
        assert abs(median(contact_ms)) < 50.0
        assert median(ratio) == pytest.approx(1.0, abs=0.03)


def _around(stride: VirtualStride, changes: list[PhaseChange]) -> list[PhaseChange]:
    begin, end = stride.t_heel_off_ns - NS_PER_S // 4, stride.t_flat_ns + NS_PER_S // 3
    return [change for change in changes if begin < change.t_ns < end]


def test_the_truth_survives_writing_and_agrees_with_itself(tmp_path: Path) -> None:
    patient = VirtualPatient(PatientSettings(seed=6, speed_mps=0.9))
    samples = patient.advance(20 * NS_PER_S)
    truth = truth_of(patient, "walk")
    write_truth(truth, tmp_path)
    write_recording(recording_of(patient, samples, "walk", "told"), tmp_path / "walk.parquet")
    again = load_truth(tmp_path / "walk.parquet")
    assert read_recording(tmp_path / "walk.parquet").belt_speed_mps == 0.9
    assert [stride.number for stride in again.strides_of("left_foot")] == [
        stride.number for stride in truth.strides_of("left_foot")
    ]
    for foot, poses in again.feet.items():
        assert np.allclose(np.linalg.norm(poses.q_world_from_sensor, axis=1), 1.0, atol=1e-4)
        for stride in again.strides_of(foot)[1:-1]:
            rows = (poses.t_ns * 1e-9 > stride.t_swing_s + 0.02) & (
                poses.t_ns * 1e-9 < stride.t_loading_response_s - 0.02
            )
            assert (poses.phase[rows] == Phase.SWING).all()
            assert 0.5 < stride.stride_length_m < 1.6
    assert [activity.activity for activity in again.activities] == ["standing", "walking"]


def test_acceleration_integrates_to_the_path() -> None:
    patient = VirtualPatient(PatientSettings(imu=PERFECT, rate_hz=1000.0, sensors=("left_foot",), seed=8))
    samples = patient.advance(9 * NS_PER_S)
    truth = truth_of(patient, "walk").feet["left_foot"]
    rate = np.array([sample.gyr_radps for sample in samples])
    q = Rotation.from_quat(truth.q_world_from_sensor[0], scalar_first=True)
    begin = round(truth.t_ns[0] / 1_000_000)
    for row in rate[begin : begin + 7000]:
        q = q * Rotation.from_rotvec(row * 0.001)
    end = Rotation.from_quat(truth.q_world_from_sensor[700], scalar_first=True)
    assert np.degrees((q.inv() * end).magnitude()) < 1.5


def test_a_toe_that_catches_is_not_taken_for_the_usual_push_off() -> None:
    """Calibrated on a walk that stumbles at most strides, a lifted foot's push-off is seen all the same."""
    levels = {}
    for own in (0.0, 1.0):
        patient = VirtualPatient(
            PatientSettings(
                seed=2, speed_mps=1.35, compensation=0.2, voluntary_dorsiflexion=own, sensors=("right_foot",)
            )
        )
        walked = recording_of(patient, patient.advance(30 * NS_PER_S), "walk", "")
        levels[own] = calibrate_track(walked.tracks["right_foot"]).push_off_radps
        stumbled = sum(stride.stumbled for stride in patient.strides if stride.foot == "right_foot")
        assert (stumbled > 10) == (own == 0.0)
    assert Thresholds().push_off_share * levels[0.0] < 0.6 * levels[1.0]
