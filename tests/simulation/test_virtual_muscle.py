"""The stimulated muscle against its own published time constants, and the passive ankle at rest."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from statistics import median

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from virtual_walks import STEP_NS, affected, walk

from fes.calibration.recording import calibrate_track
from fes.estimation.foot.tracker import FootTracker
from fes.estimation.numerics.jit import jit
from fes.estimation.numerics.records import Record
from fes.estimation.strides.results import StrideMaker, StrideSettings
from fes.recording import Track, read_recording, write_recording
from fes.signals import NS_PER_S, StrideResult
from fes.simulation.forward import (
    DeliveredPulse,
    MuscleSettings,
    PatientSettings,
    VirtualPatient,
    VirtualStride,
    harm_of,
    settings_for,
)
from fes.simulation.forward.closed_loop import recording_of, truth_of
from fes.simulation.forward.dynamics import (
    DAMPING_RATIO,
    LEG,
    MUSCLE,
    activation_at_40hz,
    damping,
    muscle,
    passive,
    recruitment,
)
from fes.simulation.forward.leg import body_of, muscle_of
from fes.simulation.sensor import PERFECT
from fes.simulation.truth import load_truth, write_truth
from statemachine.guards import Thresholds
from statemachine.phases import Phase, PhaseChange, Transition

DT = 0.0005


MUSCLES = [  # the ends of the ranges that patients are drawn from, and the usual one
    MuscleSettings(fatigue_s=math.inf),
    MuscleSettings(fatigue_s=math.inf, tau_calcium_s=0.022, tau_rise_s=0.055, tau_fall_s=0.05),
    MuscleSettings(fatigue_s=math.inf, tau_calcium_s=0.030, tau_rise_s=0.070, tau_fall_s=0.07),
]


def run(
    own: MuscleSettings, seconds: float, frequency_hz: float, share: float = 1.0, until_s: float = 1e9
) -> np.ndarray:
    """Activation, fitness and torque (N, 3) of a muscle pulled by a regular train, on the 0.5 ms grid."""
    one = np.zeros(1, MUSCLE)
    one[0] = muscle_of(own)
    one["recruited"] = share
    every = round(1.0 / frequency_hz / DT)
    out = np.empty((round(seconds / DT), 3))
    for k in range(len(out)):
        if k % every == 0 and k * DT < until_s:
            one["released"] += 1.0
        muscle(one[0], -0.3, 0.0, DT)
        out[k] = one["active"][0], one["fit"][0], one["torque"][0]
    return out


@settings(deadline=None)  # the first call compiles
@given(st.floats(0.0, 60.0), st.floats(0.0, 60.0))
def test_recruitment_never_falls_with_charge(a: float, b: float) -> None:
    low, high = sorted((a, b))
    assert 0.0 <= recruitment(low, 3.5, 11.0) <= recruitment(high, 3.5, 11.0) <= 1.0


def test_recruitment_has_a_threshold_and_saturates() -> None:
    assert recruitment(1.0, 3.5, 11.0) == 0.0
    assert recruitment(3.5, 3.5, 11.0) < 0.06
    assert recruitment(7.25, 3.5, 11.0) == pytest.approx(0.5, abs=0.03)
    assert recruitment(11.0, 3.5, 11.0) > 0.94
    assert recruitment(16.0, 3.5, 11.0) > 0.99


def test_a_short_pulse_needs_less_charge_and_more_current() -> None:
    own = MuscleSettings(chronaxie_us=300.0)
    assert own.equivalent_uc(6.0, 300.0) == pytest.approx(6.0)
    currents = [1e3 / own.equivalent_uc(1e-3 * width_us, width_us) for width_us in (75.0, 150.0, 300.0, 1e6)]
    rheobase = currents[-1]
    assert [one / rheobase for one in currents[:3]] == pytest.approx([5.0, 3.0, 2.0], rel=1e-3)  # chronaxie: twice
    charges = [current * width for current, width in zip(currents, (75.0, 150.0, 300.0, 1e6), strict=True)]
    assert charges == sorted(charges)


@pytest.mark.parametrize("own", MUSCLES)
def test_a_twitch_is_a_sixth_of_the_force_at_40_hz_and_grows_by_summation(own: MuscleSettings) -> None:
    fused = run(own, 1.0, 40.0)[round(0.8 / DT) :, 0].mean()
    twitch = run(own, 1.0, 1.0)[:, 0]
    assert 0.10 <= twitch.max() / fused <= 0.20
    assert 0.045 <= twitch.argmax() * DT <= 0.085  # contraction time
    two = run(own, 1.0, 40.0, until_s=0.03)[:, 0]
    assert two.max() > 2.0 * twitch.max()  # of two pulses 25 ms apart


@pytest.mark.parametrize("own", MUSCLES)
def test_half_the_frequency_gives_somewhat_more_than_half_the_force(own: MuscleSettings) -> None:
    force = {hz: run(own, 1.5, hz)[round(1.0 / DT) :, 0].mean() for hz in (10.0, 20.0, 40.0)}
    assert force[40.0] == pytest.approx(1.0, abs=0.01)
    assert 0.5 < force[20.0] < 0.75
    assert 0.15 < force[10.0] < 0.35


@jit
def walked(one: Record, seconds: float) -> None:
    """Bursts of 0.55 s at 40 Hz, one every 1.25 s."""
    for k in range(round(seconds / DT)):
        if k % 2500 < 1100 and k % 2500 % 50 == 0:
            one.released += 1.0
        muscle(one, -0.3, 0.0, DT)


def test_twenty_minutes_of_walking_tire_the_muscle() -> None:
    one = np.zeros(1, MUSCLE)
    one[0] = muscle_of(MuscleSettings())
    one["recruited"] = 0.8
    fit = []
    for _ in range(20):
        walked(one[0], 60.0)
        fit.append(float(one["fit"][0]))
    assert fit == sorted(fit, reverse=True)
    assert fit[1] > 0.85
    assert 0.5 < fit[-1] < 0.8


def test_the_step_response_has_the_time_constants_asked_for() -> None:
    own = MuscleSettings(tau_calcium_s=0.005, tau_rise_s=0.08, tau_fall_s=0.12, fatigue_s=math.inf)
    track = run(own, 1.6, 100.0, until_s=0.8)[:, 0]
    top = track[round(0.75 / DT)]
    assert np.argmax(track > 0.632 * top) * DT == pytest.approx(0.08, abs=0.02)
    falling = track[round(0.8 / DT) :]
    assert np.argmax(falling < 0.368 * top) * DT == pytest.approx(0.12 + 0.015, abs=0.025)


def test_force_grows_with_frequency_and_fuses() -> None:
    own = MuscleSettings(fatigue_s=math.inf)
    level, ripple = [], []
    for frequency in (10.0, 20.0, 40.0):
        steady = run(own, 1.5, frequency)[round(1.0 / DT) :, 0]
        level.append(steady.mean())
        ripple.append(np.ptp(steady) / steady.mean())
    assert level == sorted(level)
    assert level[2] == pytest.approx(1.0, abs=0.05)
    assert ripple[0] > 3 * ripple[2]


def test_fatigue_and_recovery() -> None:
    own = MuscleSettings(fatigue_s=10.0, recovery_s=20.0, fatigue_floor=0.3)
    fit = run(own, 60.0, 40.0, until_s=30.0)[:, 1]
    tired = fit[round(30.0 / DT) - 1]
    assert tired == pytest.approx(0.3 + 0.7 * math.exp(-3.0), abs=0.06)
    assert fit[-1] == pytest.approx(1.0 - (1.0 - tired) * math.exp(-1.5), abs=0.03)
    slower = run(own, 10.0, 20.0)[-1, 1]
    assert slower > run(own, 10.0, 40.0)[-1, 1]


def test_the_delay_is_the_electromechanical_one() -> None:
    for delay_s in (0.02, 0.06):
        patient = VirtualPatient(PatientSettings(muscle=MuscleSettings(delay_s=delay_s)))
        pulses = [DeliveredPulse(NS_PER_S + k * 25_000_000, 0, 40.0, 300.0) for k in range(8)]
        patient.advance(2 * NS_PER_S, pulses)
        trace = patient.trace("right_foot")
        first = trace["t_s"][np.argmax(trace["activation"] > 0.001)]
        assert first == pytest.approx(1.0 + delay_s, abs=0.008)


@settings(max_examples=20, deadline=None)
@given(st.floats(5.0, 60.0), st.floats(0.05, 1.0))
def test_torque_stays_within_what_the_muscle_has(frequency: float, share: float) -> None:
    own = MuscleSettings(max_torque_nm=14.0)
    most = share / activation_at_40hz(own.tau_calcium_s, own.tau_rise_s, own.tau_fall_s)  # fused, far above 40 Hz
    torque = run(own, 0.4, frequency, share)[:, 2]
    assert torque.min() >= 0.0
    assert torque.max() <= 14.0 * most


def test_a_free_foot_comes_to_rest_where_gravity_and_tissue_balance() -> None:
    from fes.simulation.forward.dynamics import BELT, SWING, plan, step

    legs, belt = np.zeros(1, LEG), np.zeros(1, BELT)
    legs[0] = body_of(PatientSettings(spasticity=0.0), affected=True)
    legs["mode"], legs["lift_m"], legs["swing_t"], legs["swing_s"] = SWING, 2.0, 1e6, 1.0  # held high in the air
    legs["z"], legs["pitch"], legs["hold"] = 2.0 - legs["thigh_m"] - legs["shank_m"], 0.3, 0.0
    energy = []
    for k in range(8000):
        plan(legs[0], belt[0], k * DT)
        step(legs[0], belt[0], k * DT, DT)
        energy.append(0.5 * float(legs["inertia"][0]) * float(legs["vpitch"][0]) ** 2)
    leg = legs[0]
    lever = leg["com_x"] * math.cos(leg["pitch"]) + 0.5 * leg["sole_m"] * math.sin(leg["pitch"])
    pull = (
        passive(leg["pitch"] - leg["shank"], leg["bend"], leg["stiff"], leg["short_rad"])
        - leg["foot_kg"] * 9.80665 * lever
    )
    assert abs(pull) < 0.02
    assert energy[-1] < 1e-8 < max(energy)
    assert math.degrees(leg["pitch"]) == pytest.approx(-20.0, abs=8.0)


@settings(deadline=None)
@given(st.floats(-1.2, 0.8), st.floats(0.0, 1.2))
def test_tight_tissue_keeps_the_damping_ratio(angle: float, knee: float) -> None:
    step, inertia = 1e-5, 0.0126
    slope = (passive(angle - step, knee, 1.0, 0.0) - passive(angle + step, knee, 1.0, 0.0)) / (2.0 * step)
    critical = 2.0 * math.sqrt(inertia * slope)
    assert damping(angle, knee, 1.0, 0.0, 0.5, inertia) == pytest.approx(max(0.5, DAMPING_RATIO * critical), rel=1e-3)


def test_the_end_of_the_range_does_not_throw_the_foot_back() -> None:
    inertia, pitch, rate, stored, fastest = 0.0126, math.radians(-62.0), 0.0, 0.0, 0.0
    for _ in range(400):
        pull = passive(pitch, 0.8, 1.0, 0.0)
        stored += max(pull, 0.0) * rate * DT
        rate += (pull - damping(pitch, 0.8, 1.0, 0.0, 0.5, inertia) * rate) / inertia * DT
        pitch += rate * DT
        fastest = max(fastest, rate)
    assert fastest < 0.6 * math.sqrt(2.0 * stored / inertia)  # of a spring that loses nothing


# --- The stimulated calf: more push-off from pulses at heel rise ---


CALF = 1
PATIENT = settings_for("moderate", seed=5, calf_channel=CALF)  # does not drag by itself


def strides(settings: PatientSettings, begin: str, burst_s: float, current_ma: float = 35.0) -> list[VirtualStride]:
    """A walk of 25 s with 40 Hz on the calf for ``burst_s`` from each event ``begin`` of the affected foot on."""
    patient = VirtualPatient(settings)
    seen = 0
    for t_ns in range(STEP_NS, 25 * NS_PER_S + 1, STEP_NS):
        begun = [e.t_ns for e in patient.events[seen:] if e.foot == settings.affected_foot and e.kind == begin]
        seen = len(patient.events)
        pulses = [
            DeliveredPulse(begin_ns + k * 25_000_000, CALF, current_ma, 300.0)
            for begin_ns in begun
            for k in range(round(burst_s / 0.025))
        ]
        patient.advance(t_ns, pulses)
    return affected(patient)


def test_no_electrode_on_the_calf_means_that_its_pulses_do_nothing() -> None:
    bare = replace(PATIENT, calf_channel=None)
    assert strides(bare, "heel_off", 0.1) == strides(PATIENT, "heel_off", 0.0)


def test_pulses_at_heel_rise_raise_the_push_off_with_their_strength() -> None:
    walks = [strides(PATIENT, "heel_off", 0.1, current_ma) for current_ma in (0.0, 20.0, 35.0)]
    pushed_j = [median(one.push_off_j for one in walk) for walk in walks]
    assert pushed_j == sorted(pushed_j)
    assert pushed_j[2] > pushed_j[0] + 0.3
    off_rad = [median(one.pitch_at_foot_off_rad for one in walk) for walk in walks]
    assert off_rad[2] < off_rad[0] - math.radians(1.0)
    assert harm_of(walks[2]).drags == 0


def test_a_burst_through_swing_pulls_the_toe_down() -> None:
    without, through = (strides(PATIENT, "foot_off", burst_s) for burst_s in (0.0, 0.3))
    assert median(one.toe_clearance_m for one in through) < median(one.toe_clearance_m for one in without) - 0.01
    assert harm_of(without).drags == 0
    assert harm_of(through).drags > len(through) / 2


def test_both_muscles_at_once_are_counted_as_co_contraction() -> None:
    def impulse_nms(*channels: int) -> float:
        patient = VirtualPatient(replace(PATIENT, spasticity=0.0))
        patient.advance(7 * NS_PER_S)
        while (patient.events[-1].foot, patient.events[-1].kind) != ("right_foot", "foot_off"):
            patient.advance(patient.now_ns + STEP_NS)
        begin_ns = patient.now_ns
        patient.advance(
            begin_ns + 2 * NS_PER_S,
            [DeliveredPulse(begin_ns + k * 25_000_000, c, 30.0, 300.0) for k in range(10) for c in channels],
        )
        return max(one.co_contraction_nms for one in patient.strides if one.t_contact_ns > begin_ns)

    assert impulse_nms(0, CALF) > impulse_nms(0) + 0.3


def test_the_calf_tires_and_recovers() -> None:
    tired = replace(PATIENT, calf=MuscleSettings(max_torque_nm=25.0, fatigue_s=5.0))
    fresh_j, tired_j = (
        median(one.push_off_j for one in strides(settings, "heel_off", 0.1)[-5:]) for settings in (PATIENT, tired)
    )
    assert tired_j < fresh_j - 0.05


def test_two_muscles_cannot_share_a_channel() -> None:
    with pytest.raises(ValueError, match=r"calf_channel = 0 is the dorsiflexors' channel already"):
        PatientSettings(calf_channel=0)
    with pytest.raises(ValueError, match=r"calf_channel = 1 is the evertors' channel already"):
        PatientSettings(evertor_channel=1, calf_channel=1)
    with pytest.raises(ValueError, match="calf_channel = 8: must be a whole number from 0 to 7"):
        PatientSettings(calf_channel=8)
    with pytest.raises(ValueError, match=r"calf\.saturation_uc"):
        PatientSettings(calf=MuscleSettings(threshold_uc=12.0))


# --- What the product's own estimators make of a virtual patient's signals: as good as on real ones ---


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
