"""The virtual patient walks as people do, drags a foot that hangs, and clears the ground when stimulated."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from statistics import mean, median
from typing import Any

import numpy as np
import pytest
from scipy.signal import welch
from virtual_walks import affected, walk

from benchmarks.lib.real_sets import data_folder, stroke_feet
from benchmarks.loop import closed_loop_walk, second_patient, tuning_cohort
from benchmarks.loop.tuning import Kept, Result
from fes.signals import G_MPS2, NS_PER_S, ImuSample
from fes.simulation.forward import (
    DeliveredPulse,
    MuscleSettings,
    PatientSettings,
    VirtualPatient,
    draw_patient,
    harm_of,
    settings_for,
)
from fes.simulation.forward.draw import HEMIPARETIC
from fes.simulation.forward.dynamics import STANCE
from fes.simulation.forward.gait_patterns import PATTERNS, joint_curves, stride_time_s
from fes.simulation.sensor import PERFECT, ImuModel

DROP = PatientSettings(seed=3, speed_mps=0.8)


def values(samples: list[ImuSample]) -> list[tuple[object, ...]]:
    return [(s.t_ns, s.sensor, s.acc_mps2, s.gyr_radps) for s in samples]


def train(begin_s: float, end_s: float, current_ma: float = 25.0, channel: int = 0) -> list[DeliveredPulse]:
    return [
        DeliveredPulse(round(t * NS_PER_S), channel, current_ma, 300.0)
        for t in np.arange(begin_s, end_s, 0.025).tolist()
    ]


def test_any_step_size_gives_the_same_bits() -> None:
    pulses = train(5.0, 8.0)
    whole = VirtualPatient(DROP)
    expected = values(whole.advance(9 * NS_PER_S, pulses))
    for step_ns in (3_000_000, 10_000_000, 333_333_333):
        cut, got, given = VirtualPatient(DROP), [], 0
        for t_ns in [*range(step_ns, 9 * NS_PER_S, step_ns), 9 * NS_PER_S]:
            due = sum(pulse.t_ns <= t_ns for pulse in pulses)
            got += cut.advance(t_ns, pulses[given:due])
            given = due
        assert values(got) == expected
        assert cut.strides == whole.strides
        assert cut.events == whole.events


def test_pulses_that_come_late_by_less_than_the_delay_act_as_in_time() -> None:
    pulses = train(5.0, 7.0)
    in_time, late = VirtualPatient(DROP), VirtualPatient(DROP)
    expected = values(in_time.advance(8 * NS_PER_S, pulses))
    got, given = [], 0
    for t_ns in range(10_000_000, 8 * NS_PER_S + 1, 10_000_000):
        due = sum(pulse.t_ns <= t_ns - 20_000_000 for pulse in pulses)
        got += late.advance(t_ns, pulses[given:due])
        given = due
    assert values(got) == expected


def test_the_seed_and_nothing_else_decides() -> None:
    one, same, other = (VirtualPatient(PatientSettings(seed=seed)) for seed in (1, 1, 2))
    a, b, c = (values(patient.advance(7 * NS_PER_S)) for patient in (one, same, other))
    assert a == b
    assert a != c


def test_time_does_not_run_backward() -> None:
    patient = VirtualPatient(DROP)
    patient.advance(NS_PER_S)
    with pytest.raises(ValueError, match="cannot go back"):
        patient.advance(NS_PER_S - 1_000_000)


def test_standing_sensors_feel_gravity_and_nothing_else() -> None:
    patient = VirtualPatient(PatientSettings(imu=PERFECT))
    samples = patient.advance(3 * NS_PER_S)
    assert {s.sensor for s in samples} == {"left_foot", "right_foot", "left_shank", "right_shank"}
    assert len(samples) == 4 * 300
    assert max(abs(math.hypot(*s.acc_mps2) - G_MPS2) for s in samples) < 0.02
    assert max(math.hypot(*s.gyr_radps) for s in samples) < 0.01


def test_a_healthy_walk_has_healthy_numbers() -> None:
    patient, _ = walk(settings_for("healthy", speed_mps=1.3), 25.0)
    strides = affected(patient, 4)
    assert mean(s.stride_length_m for s in strides) == pytest.approx(1.3 * stride_time_s(1.3, 1.75), rel=0.04)
    assert 0.008 < median(s.toe_clearance_m for s in strides) < 0.03
    assert all(12.0 < math.degrees(s.pitch_at_contact_rad) < 28.0 for s in strides)
    assert not any(s.dragged or s.stumbled for s in strides)
    swing = mean((s.t_contact_ns - s.t_foot_off_ns) * 1e-9 for s in strides) / stride_time_s(1.3, 1.75)
    assert 0.33 < swing < 0.44
    assert 0.20 < median(s.heel_clearance_m for s in strides) < 0.32


def test_a_foot_stands_still_and_does_not_sink() -> None:
    patient, _ = walk(settings_for("healthy", speed_mps=1.0), 20.0)
    trace = patient.trace("left_foot")
    for event, after in zip(patient.events, patient.events[1:], strict=False):
        if event.foot == "left_foot" and event.kind == "foot_flat":
            begin = event.t_ns * 1e-9 + 0.08
            rows = (trace["t_s"] > begin) & (trace["t_s"] < begin + 0.15)
            assert np.ptp(trace["x_m"][rows]) < 0.003
            assert np.degrees(np.abs(trace["pitch_rad"][rows])).max() < 3.0
        assert after.t_ns >= event.t_ns
    assert trace["heel_m"].min() > -0.015


def test_a_hanging_foot_drags_and_adequate_stimulation_clears_it() -> None:
    hanging, _ = walk(DROP, 40.0)
    lifted, _ = walk(DROP, 40.0, 22.0)
    without, with_ = affected(hanging), affected(lifted)
    assert median(s.toe_clearance_m for s in without) < 0.004
    assert mean(s.dragged for s in without) > 0.3
    assert sum(s.stumbled for s in without) > 0
    assert 0.01 <= median(s.toe_clearance_m for s in with_) <= 0.03
    assert not any(s.dragged or s.stumbled for s in with_)
    assert median(s.pitch_at_contact_rad for s in with_) > median(s.pitch_at_contact_rad for s in without) + 0.2


def test_more_charge_lifts_more_and_the_stretched_calf_holds_it_back() -> None:
    clearance, pitch = [], []
    for current_ma in (10.0, 16.0, 22.0, 34.0):
        strides = affected(walk(DROP, 25.0, current_ma, after_heel_off_s=0.25)[0])  # late enough for the push-off
        clearance.append(median(s.toe_clearance_m for s in strides))
        pitch.append(median(s.pitch_at_contact_rad for s in strides))
    assert clearance == sorted(clearance)
    assert pitch == sorted(pitch)
    assert clearance[-1] > clearance[0] + 0.01
    assert 12.0 < math.degrees(pitch[-1]) < 25.0  # the knee is straight at contact: the calf pulls


def test_a_burst_in_pre_swing_costs_push_off_and_is_counted() -> None:
    without, late, early = (
        walk(DROP, 25.0, current_ma, after_heel_off_s=after_s)[0]
        for current_ma, after_s in ((0, 0), (26, 0.25), (26, 0))
    )
    off_deg = [-median(math.degrees(s.pitch_at_foot_off_rad) for s in affected(one)) for one in (without, late, early)]
    assert off_deg[0] - off_deg[1] < 3.0
    assert off_deg[0] - off_deg[2] > 5.0
    harm = [harm_of(affected(one)) for one in (without, late, early)]
    assert [one.early_bursts for one in harm] == [0, 0, harm[2].strides]
    assert harm[0].push_off_lost == 0.0
    assert harm[1].push_off_lost < 0.05 < 0.1 < harm[2].push_off_lost
    assert harm[0].co_contraction_nms < harm[1].co_contraction_nms < harm[2].co_contraction_nms
    assert median(s.toe_clearance_m for s in affected(early)) < median(s.toe_clearance_m for s in affected(late))


def test_tibialis_anterior_inverts_and_the_peronei_evert() -> None:
    def inversion_deg() -> list[float]:
        one = replace(DROP, voluntary_dorsiflexion=0.5, spasticity=0.0, evertor_channel=1)
        patient = VirtualPatient(one)
        patient.advance(4 * NS_PER_S, train(2.0, 4.0) + train(3.0, 4.0, 30.0, channel=1))
        trace = patient.trace("right_foot")
        rolls = [math.degrees(trace["roll_rad"][np.searchsorted(trace["t_s"], t)]) for t in (1.9, 2.9, 3.95)]
        return rolls

    still, inverted, everted = inversion_deg()
    assert abs(still) < 0.5
    assert inverted > still + 0.5  # even of a foot on the ground, four times as stiff as in the air
    assert everted < inverted - 1.0


def test_a_strong_burst_inverts_the_foot_in_the_air_and_evertors_level_it() -> None:
    def contacts(current_ma: float, evertor_ma: float) -> list[float]:
        settings = replace(DROP, spasticity=0.0, inversion_share=0.2, evertor_channel=1)
        patient = VirtualPatient(settings)
        on, next_ns, seen = False, 0, 0
        for t_ns in range(10_000_000, 20 * NS_PER_S, 10_000_000):
            for event in patient.events[seen:]:
                if event.foot == "right_foot" and event.kind in ("foot_off", "initial_contact"):
                    on, next_ns = event.kind == "foot_off", t_ns
            seen, pulses = len(patient.events), []
            while on and next_ns <= t_ns:
                pulses += [DeliveredPulse(next_ns, k, ma, 300.0) for k, ma in ((0, current_ma), (1, evertor_ma))]
                next_ns += 25_000_000
            patient.advance(t_ns, pulses)
        return [math.degrees(s.inversion_at_contact_rad) for s in affected(patient, 3)]

    assert median(contacts(34.0, 0.0)) > 5.0
    assert abs(median(contacts(34.0, 24.0))) < 5.0


def test_a_spasm_follows_a_burst_that_stretches_a_spastic_calf_too_fast() -> None:
    calm = replace(DROP, spasticity=0.5, spasm_radps=math.inf)
    ready = replace(calm, spasm_radps=1.5)
    spasms = []
    for settings, current_ma in ((calm, 36.0), (ready, 0.0), (ready, 20.0), (ready, 36.0)):
        strides = affected(walk(settings, 25.0, current_ma, after_heel_off_s=0.25)[0])
        spasms.append(harm_of(strides).spasms / len(strides))
    assert spasms[:3] == [0.0, 0.0, 0.0]
    assert spasms[3] > 0.8


def test_stimulation_that_ends_before_contact_lets_the_foot_slap() -> None:
    kept = affected(walk(DROP, 30.0, 24.0)[0])
    cut = affected(walk(DROP, 30.0, 24.0, before_contact_s=0.15)[0])
    assert median(s.pitch_at_contact_rad for s in cut) < median(s.pitch_at_contact_rad for s in kept) - 0.05
    loading = [median((s.t_flat_ns - s.t_contact_ns) * 1e-9 for s in strides) for strides in (kept, cut)]
    assert loading[1] < loading[0]


def test_stimulation_that_comes_late_misses_the_low_point() -> None:
    early = affected(walk(DROP, 30.0, 20.0)[0])
    late = affected(walk(DROP, 30.0, 20.0, after_heel_off_s=0.62)[0])
    assert median(s.toe_clearance_m for s in late) < median(s.toe_clearance_m for s in early) - 0.005


def test_the_habit_of_lifting_the_leg_goes_when_the_foot_clears() -> None:
    strides = affected(walk(DROP, 40.0, 24.0)[0], 0)
    first, last = strides[1].toe_clearance_m, mean(s.toe_clearance_m for s in strides[-8:])
    assert first > last + 0.01


def test_a_stumble_shortens_the_step() -> None:
    strides = affected(walk(settings_for("severe", seed=5, compensation=0.2), 60.0)[0], 2)
    caught = [s.stride_length_m for s in strides if s.stumbled]
    free = [s.stride_length_m for s in strides if not s.stumbled]
    assert len(caught) >= 3
    assert len(free) >= 3
    assert mean(caught) < mean(free) - 0.03


def test_a_calf_that_turns_spastic_is_as_one_that_always_was() -> None:
    calm, always = replace(DROP, spasticity=0.0, spasm_radps=1.5), replace(DROP, spasticity=0.9, spasm_radps=1.5)
    turned = VirtualPatient(calm)
    turned.set_spasticity(0.9)
    people = ((calm, None), (always, None), (calm, turned))
    lands_rad = [
        median(stride.pitch_at_contact_rad for stride in affected(walk(settings, 25.0, 30.0, patient=one)[0]))
        for settings, one in people
    ]
    assert lands_rad[2] == pytest.approx(lands_rad[1], abs=1e-3)
    assert lands_rad[0] > lands_rad[1] + math.radians(5.0)


def test_an_electrode_that_comes_loose_and_a_muscle_that_tires() -> None:
    patient, _ = walk(DROP, 20.0, 22.0)
    assert patient.fitness > 0.9
    patient.set_fitness(0.4)
    assert patient.fitness == 0.4
    loose, _ = walk(PatientSettings(seed=3, speed_mps=0.8, electrode_quality=0.4), 25.0, 22.0)
    assert max(s.peak_torque_nm for s in affected(loose)) < 0.5
    assert affected(loose)[0].charge_uc > 100.0  # it was delivered, and lost in the skin
    for setter in (patient.set_fitness, patient.set_electrode_quality, patient.set_spasticity):
        with pytest.raises(ValueError, match="from 0 to 1"):
            setter(1.5)


def test_pulses_of_another_channel_do_nothing() -> None:
    quiet, other = VirtualPatient(DROP), VirtualPatient(DROP)
    assert values(quiet.advance(8 * NS_PER_S)) == values(other.advance(8 * NS_PER_S, train(4.0, 8.0, channel=1)))


@pytest.mark.parametrize("pattern", [name for name in PATTERNS if name != "none"])
def test_each_hemiparetic_pattern_walks(pattern: str) -> None:
    settings = settings_for("moderate", pattern=pattern, seed=4)
    assert settings.speed_mps == PATTERNS[pattern].speed_mps
    patient, _ = walk(settings, 40.0)
    mine = affected(patient, 2)
    other = [s for s in patient.strides if s.foot == "left_foot"][2:]
    assert len(mine) >= 6
    assert mean(s.stride_length_m for s in mine) == pytest.approx(mean(s.stride_length_m for s in other), rel=0.15)
    swing = [mean((s.t_contact_ns - s.t_foot_off_ns) * 1e-9 for s in strides) for strides in (mine, other)]
    assert swing[0] > swing[1]  # Wang et al., Table 2: the afflicted leg swings longer


def test_the_hiked_and_the_swung_leg_show() -> None:
    hiked, swung, flat = (
        walk(settings_for("moderate", pattern=f"hemiparetic_{n}", seed=4), 30.0)[0] for n in (4, 3, 5)
    )
    assert median(s.toe_clearance_m for s in affected(hiked, 2)) > median(s.toe_clearance_m for s in affected(flat, 2))
    sideways = [np.ptp(patient.trace("right_foot")["y_m"]) for patient in (swung, flat)]
    assert sideways[0] > sideways[1] + 0.04


def test_speed_stop_and_walking_on() -> None:
    patient = VirtualPatient(settings_for("healthy", speed_mps=0.8))
    patient.advance(15 * NS_PER_S)
    patient.set_speed(1.2)
    patient.advance(30 * NS_PER_S)
    lengths = [stride.stride_length_m for stride in affected(patient, 2)]
    assert median(lengths[-6:]) > median(lengths[:4]) + 0.15
    patient.stop()
    patient.advance(40 * NS_PER_S)
    stood = len(patient.strides)
    assert patient.strides[-1].walking is False
    patient.advance(45 * NS_PER_S)
    assert len(patient.strides) == stood
    assert patient.walks[0][1] < 40.0
    patient.walk()
    patient.advance(60 * NS_PER_S)
    assert len(patient.strides) > stood + 8
    with pytest.raises(ValueError, match="use stop"):
        patient.set_speed(0.0)


@pytest.mark.parametrize("speed_mps", [0.4, 1.3])
def test_the_feet_come_to_stand_below_the_hip_and_walk_on_without_a_jerk(speed_mps: float) -> None:
    patient = VirtualPatient(settings_for("mild", speed_mps=speed_mps, seed=4))
    walked = [s for s in patient.advance(20 * NS_PER_S) if s.t_ns > 8 * NS_PER_S]
    patient.stop()
    stopped = patient.advance(26 * NS_PER_S)
    for foot in ("left_foot", "right_foot"):
        stood = patient.trace(foot)["x_m"][-1] - float(patient._walker.belt["x"][0])
        assert abs(stood) < 0.12
    patient.walk()
    again = patient.advance(32 * NS_PER_S)
    hardest = {s.sensor: max(math.hypot(*x.acc_mps2) for x in walked if x.sensor == s.sensor) for s in walked[:4]}
    for sample in stopped + again:
        if "foot" in sample.sensor:
            assert math.hypot(*sample.acc_mps2) < 1.5 * hardest[sample.sensor]


def stood(patient: VirtualPatient) -> float:
    """Heading in rad of the left foot when it last lay flat."""
    trace = patient.trace("left_foot")
    return float(trace["yaw_rad"][trace["mode"] == STANCE + 10][-1])


def test_turning_feet() -> None:
    patient = VirtualPatient(DROP)
    patient.advance(12 * NS_PER_S)
    before = stood(patient)
    patient.turn(math.radians(90.0))
    patient.advance(24 * NS_PER_S)
    assert math.degrees(stood(patient) - before) == pytest.approx(90.0, abs=8.0)


def test_lost_and_doubled_samples() -> None:
    patient = VirtualPatient(PatientSettings(imu=ImuModel(lost=0.1, doubled=0.05), sensors=("right_foot",)))
    samples = patient.advance(5 * NS_PER_S)
    stamps = [s.t_ns for s in samples]
    assert 420 < len(set(stamps)) < 470
    assert len(stamps) > len(set(stamps)) + 10


def test_sensors_clip_at_their_range() -> None:
    patient = VirtualPatient(PatientSettings(imu=ImuModel(acc_range_mps2=2.0 * G_MPS2, gyr_range_radps=2.0)))
    samples = patient.advance(12 * NS_PER_S)
    assert max(abs(v) for s in samples for v in s.acc_mps2) <= 2.0 * G_MPS2
    assert sum(abs(v) > 1.99 for s in samples for v in s.gyr_radps) > 20


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"side": "middle"}, "side"), ({"pattern": "limp"}, "pattern"), ({"speed_mps": 9.0}, "speed_mps"),
        ({"spasticity": float("nan")}, "spasticity"), ({"rate_hz": 300.0}, "2000 must be a multiple"),
        ({"voluntary_dorsiflexion": True}, "voluntary_dorsiflexion"), ({"sensors": ("hat",)}, "sensors"),
        ({"sensors": ()}, "sensors"), ({"muscle": MuscleSettings(threshold_uc=12.0)}, "saturation_uc"),
        ({"muscle": MuscleSettings(tau_rise_s=0.0)}, "muscle.tau_rise_s"),
    ],
)  # fmt: skip
def test_settings_that_cannot_be_are_refused_by_name(wrong: dict[str, object], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        settings_for("severe", **wrong)


def test_the_joint_curves_pass_through_the_published_values() -> None:
    curves = joint_curves(1.3, 1.75)
    phase = np.linspace(0.0, 1.0, 201)
    k = np.arange(1, 8)
    knee = curves.knee[0] + np.cos(2 * np.pi * np.outer(phase, k)) @ curves.knee[1::2]
    knee += np.sin(2 * np.pi * np.outer(phase, k)) @ curves.knee[2::2]
    assert np.degrees(knee).max() == pytest.approx(62.0, abs=3.0)
    assert phase[int(np.argmax(knee))] == pytest.approx(0.73, abs=0.03)
    assert np.degrees(knee[0]) == pytest.approx(4.0, abs=3.0)


# --- The comparison of tunings keeps who has walked, and takes nobody for another tuning's ---


def test_who_has_walked_is_kept_and_found_again(tmp_path: Path) -> None:
    file = tmp_path / "people.jsonl"
    walked = {"short": Result([True, False, True]), "tuner": replace(Result([False]), latched="why", named="slip")}
    Kept(file).add(True, 7, {"day": walked})
    again = Kept(file)
    assert {arm: again.results[True, 7, "day", arm] for arm in walked} == walked
    assert again.has(True, 7, "day", ["tuner", "short"])
    assert again.left(True, 7, ["day", "slip"], ["short"]) == (["slip"], ["short"])
    assert again.left(True, 7, ["day"], ["short", "plain"]) == (["day"], ["plain"])
    assert again.left(True, 7, ["day"], ["short", "tuner"]) == ([], [])
    for other in ((False, 7, "day", ["short"]), (True, 8, "day", ["short"]), (True, 7, "day", ["short", "plain"])):
        assert not again.has(*other)


def test_a_result_of_another_tuning_counts_as_none(tmp_path: Path) -> None:
    file = tmp_path / "people.jsonl"
    Kept(file).add(False, 7, {"day": {"short": Result([True])}})
    row = json.loads(file.read_text(encoding="utf-8"))
    file.write_text(json.dumps(row | {"tuning": "another"}) + "\n", encoding="utf-8")
    assert not Kept(file).results


# --- The second patient, which judges the tuning: its sensor feels what a foot does ---


@pytest.fixture
def second() -> Any:
    return second_patient, closed_loop_walk, tuning_cohort


def test_level_strides_are_level_to_the_sensor(second: Any) -> None:
    patients, walks, cohort = second
    for seed in (1001, 3000):
        settings, made = patients.draw_second(seed), patients.SecondPatient
        session = cohort.session_with(made(settings).geometry["right_foot"])
        done = walks.walk(settings, session, walks.calibration_of(settings, made), 40.0, 15, made=made)
        rises_m = [one.free_rise_m for one in done.measured if one.valid]
        assert len(rises_m) > 10
        assert median(abs(rise_m) for rise_m in rises_m) < 0.02, "it was 0.15 when contacts left it a velocity"


def share_below_5_hz(acc_mps2: Any, rate_hz: float) -> float:
    """Of the power of the acceleration's size (N, 3) about its mean."""
    size = np.linalg.norm(acc_mps2, axis=1)
    frequency_hz, power = welch(size - size.mean(), rate_hz, nperseg=int(4 * rate_hz))
    return float(power[frequency_hz < 5.0].sum() / power.sum())


def test_its_foot_shakes_as_real_feet_do(second: Any) -> None:
    folder = data_folder()
    if not (folder / "stroke_treadmill").is_dir():
        pytest.skip(f"the recordings are not here: {folder}")
    patients, _, _ = second
    real = median(share_below_5_hz(track.acc_mps2, track.rate_hz) for _, track, _ in stroke_feet(folder))
    shares = []
    for seed in (1001, 2000, 3000, 4000, 5000, 6000, 7000, 8000):
        settings = patients.draw_second(seed)
        heard = patients.SecondPatient(settings).advance(40_000_000_000)
        walks = [one.acc_mps2 for one in heard if one.sensor == settings.affected_foot and one.t_ns > 8_000_000_000]
        shares.append(share_below_5_hz(np.array(walks), settings.rate_hz))
    print(f"below 5 Hz: {median(shares):.2f} ({min(shares):.2f} to {max(shares):.2f}), real feet {real:.2f}")
    assert abs(median(shares) / real - 1.0) < 0.2


# --- Patients drawn for a cohort: all five slow walks, bodies and delays that differ ---


def test_fifteen_in_a_row_have_all_five_slow_walks() -> None:
    for first in (0, 7, 100):
        cohort = [draw_patient(5, number) for number in range(first, first + 15)]
        slow = [one for one in cohort if one.pattern != "none"]
        assert {one.pattern for one in slow} == set(HEMIPARETIC) == set(PATTERNS) - {"none"}
        assert all(0.21 <= one.speed_mps <= 0.35 for one in slow)
        assert all(one.speed_mps > 0.35 for one in cohort if one.pattern == "none")


def test_people_differ_and_the_same_number_is_the_same_person() -> None:
    cohort = [draw_patient(5, number) for number in range(30)]
    assert cohort == [draw_patient(5, number) for number in range(30)]
    assert cohort != [draw_patient(6, number) for number in range(30)]
    heights, delays = {one.height_m for one in cohort}, {one.muscle.delay_s for one in cohort}
    assert max(heights) - min(heights) > 0.2
    assert max(delays) - min(delays) > 0.02
    assert len({one.placements["right_foot"] for one in cohort}) == 30
    assert any(one.inversion_share > 0.1 for one in cohort)
    assert any(one.inversion_share < 0.0 for one in cohort)


def test_settings_by_name_win() -> None:
    assert draw_patient(5, 0, side="left", speed_mps=0.3).side == "left"
    with pytest.raises(ValueError, match="speed_mps"):
        draw_patient(5, 0, speed_mps=9.0)
