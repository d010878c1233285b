"""Calibration finds out how a sensor sits and what is wrong with it; or says what to record."""

from __future__ import annotations

import importlib
import json
import math
import os
import re
from dataclasses import fields, replace
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from replays import cut
from scipy.spatial.transform import Rotation
from stepping_feet import Steps, stepping

from fes.calibration.recording import calibrate_phase_sensors, calibrate_track
from fes.estimation.foot.calibration import (
    LYING_MPS2,
    LYING_SHARE,
    MOST_AXIS_SD_RAD,
    CalibrationError,
    FootCalibration,
    calibrate_foot,
    stretch_for_calibration,
)
from fes.estimation.foot.tracker import FootTracker
from fes.estimation.strides.results import StrideMaker, StrideSettings
from fes.recording import Recording, Track, read_recording
from fes.signals import FOOT_SENSORS, G_MPS2, NS_PER_S, FloatArray, IntArray, StrideResult
from fes.simulation.forward import VirtualPatient, draw_patient, settings_for
from fes.simulation.forward.closed_loop import recording_of
from fes.simulation.sensor import ImuModel, mounting
from fes.simulation.truth import load_truth
from sim_inputs.generator.trials import TRIALS
from statemachine.guards import Thresholds
from statemachine.phases import Phase, PhaseChange

FOLDER = Path(__file__).resolve().parents[2] / "sim_inputs"
DOCS = Path(__file__).resolve().parents[2] / "docs"
WALKS = [
    ("negard_patient1", "right_foot"), ("negard_patient2", "right_foot"), ("soft_contact", "right_foot"),
    ("both_feet_100hz", "left_foot"), ("both_feet_100hz", "right_foot"), ("misaligned", "left_foot"),
    ("misaligned", "right_foot"),
]  # fmt: skip


@cache
def recording(name: str) -> Recording:
    return read_recording(FOLDER / f"{name}.parquet")


@cache
def calibrated(name: str, foot: str) -> FootCalibration:
    return calibrate_track(recording(name).tracks[foot])


def angle_deg(a: FloatArray | tuple[float, ...], b: FloatArray | tuple[float, ...]) -> float:
    u, v = np.array(a), np.array(b)
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(u, v)), u @ v)))


@pytest.mark.parametrize("stand_s", [5, 30, 120])
def test_who_stands_before_few_slow_strides_is_calibrated_as_who_walks_at_once(stand_s: int) -> None:
    walk = cut(recording("negard_patient2"), 3.0, 11.0).tracks["right_foot"]
    stands = standing_before(walk, stand_s)
    at_once, stood = (
        calibrate_foot("right_foot", each.rate_hz, each.t_sensor_ns, each.acc_mps2, each.gyr_radps)
        for each in (walk, stands)
    )
    assert stood.strides >= 3
    assert angle_deg(stood.toe_down, at_once.toe_down) < 3.0


def turned(track: Track, by: Rotation) -> Track:
    return replace(track, acc_mps2=by.apply(track.acc_mps2), gyr_radps=by.apply(track.gyr_radps))


def standing_before(track: Track, stand_s: int) -> Track:
    """The track with its first second, at rest, so many times before it."""
    n = int(track.rate_hz)
    rows = np.concatenate([np.tile(np.arange(n), stand_s), np.arange(len(track.t_ns))])
    t_ns = (np.arange(len(rows)) * NS_PER_S / track.rate_hz).astype(np.int64)
    return with_samples(track, t_ns, track.acc_mps2[rows], track.gyr_radps[rows])


def with_samples(track: Track, t_sensor_ns: IntArray, acc: FloatArray, gyr: FloatArray) -> Track:
    arrival = np.maximum.accumulate(t_sensor_ns)
    return replace(track, t_ns=arrival, t_sensor_ns=t_sensor_ns, acc_mps2=acc, gyr_radps=gyr)


def first_seconds(track: Track, begin_s: float, end_s: float) -> Track:
    part = slice(*np.searchsorted(track.t_sensor_ns, (begin_s * 1e9, end_s * 1e9)))
    return with_samples(track, track.t_sensor_ns[part], track.acc_mps2[part], track.gyr_radps[part])


# --- how the sensor sits ---------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "foot"), WALKS)
def test_the_axes_are_those_of_the_mounting(name: str, foot: str) -> None:
    """Against how the generator mounted the sensor: y of the foot is toe-down positive, z is up."""
    placement = next(trial for trial in TRIALS if trial.name == name).placements[foot]
    foot_from_sensor = mounting(*placement.angles_deg)
    found = calibrated(name, foot)
    assert angle_deg(found.up, foot_from_sensor[2]) < 2.5
    assert angle_deg(found.toe_down, foot_from_sensor[1]) < 12.0  # the foot turns about the walk's axis, toed out
    assert angle_deg(found.forward(), foot_from_sensor[0]) < 12.0
    assert np.linalg.norm(found.toe_down) == pytest.approx(1.0, abs=1e-9)
    assert np.dot(found.toe_down, found.up) == pytest.approx(0.0, abs=1e-9)
    assert found.axis_confidence > 0.9
    assert found.strides >= 20


ROTATIONS = [Rotation.random(random_state=seed) for seed in range(5)]
ROTATIONS += [Rotation.from_euler("zyx", turn, degrees=True) for turn in ((180, 0, 0), (0, 0, 180), (0, 180, 0))]


@pytest.mark.parametrize("by", ROTATIONS, ids=lambda r: str(np.round(r.as_rotvec(), 1)))
@pytest.mark.parametrize("foot", ["left_foot", "right_foot"])
def test_any_mounting_gives_the_same_foot(foot: str, by: Rotation) -> None:
    """Samples turned by any rotation: axis and its sign, up and biases turn with them, measures stay."""
    track = recording("both_feet_100hz").tracks[foot]
    plain, found = calibrated("both_feet_100hz", foot), calibrate_track(turned(track, by))
    assert angle_deg(found.toe_down, by.apply(plain.toe_down)) < 2.0
    assert angle_deg(found.up, by.apply(plain.up)) < 2.0
    np.testing.assert_allclose(found.acc_bias_mps2, by.apply(plain.acc_bias_mps2), atol=0.03)
    np.testing.assert_allclose(
        found.gyr_bias_radps, by.apply(plain.gyr_bias_radps), atol=0.004
    )  # another second, other sway
    for mine, theirs in zip(found.thresholds(), plain.thresholds(), strict=True):
        assert mine == pytest.approx(theirs, rel=0.05)
    assert found.strides == plain.strides


@pytest.mark.parametrize("foot", ["left_foot", "right_foot"])
def test_any_mounting_gives_the_same_strides(foot: str) -> None:
    track = first_seconds(recording("both_feet_100hz").tracks[foot], 0.0, 25.0)
    lengths = []
    for by in (Rotation.identity(), Rotation.random(random_state=9)):
        t = turned(track, by)
        calibration = calibrate_track(t)
        maker = StrideMaker(foot, StrideSettings(calibration.forward(), np.array(calibration.up)))
        outcomes = FootTracker(calibration, maker).advance(t.t_sensor_ns, t.acc_mps2, t.gyr_radps)
        lengths.append([o.stride_length_m for o in outcomes if isinstance(o, StrideResult)])
    assert len(lengths[0]) > 10
    np.testing.assert_allclose(lengths[0], lengths[1], atol=0.005)


@pytest.mark.parametrize("roll_deg", [20.0, 40.0, 60.0, -40.0])
def test_the_axis_of_a_foot_that_lands_on_its_edge(roll_deg: float) -> None:
    """It rolls in late swing and slaps flat after contact, faster than it pitches: the falls stay sagittal."""
    name, foot = "both_feet_100hz", "left_foot"
    track, plain = recording(name).tracks[foot], calibrated(name, foot)
    t_s, roll = 1e-9 * track.t_sensor_ns, np.zeros(len(track.t_sensor_ns))
    for stride in load_truth(FOLDER / f"{name}.parquet").strides_of(foot):
        rise, slap = (
            np.clip((t_s - begin_s) / span_s, 0.0, 1.0)
            for begin_s, span_s in ((stride.t_loading_response_s - 0.2, 0.2), (stride.t_loading_response_s, 0.1))
        )
        roll += sum(sign * u**3 * (10.0 - 15.0 * u + 6.0 * u**2) for sign, u in ((1.0, rise), (-1.0, slap)))
    roll *= np.radians(roll_deg)
    forward = plain.forward()
    back = Rotation.from_rotvec(-roll[:, None] * forward)
    gyr = back.apply(track.gyr_radps) + np.outer(np.gradient(roll, t_s), forward)
    level = gyr - np.outer(gyr @ plain.up, plain.up)
    found = calibrate_track(replace(track, acc_mps2=back.apply(track.acc_mps2), gyr_radps=gyr))
    assert angle_deg(found.toe_down, plain.toe_down) < 3.0
    assert angle_deg(found.up, plain.up) < 2.0
    assert found.push_off_radps == pytest.approx(plain.push_off_radps, rel=0.05)
    most_turned = np.linalg.eigh(level.T @ level)[1][:, -1]
    if abs(roll_deg) > 30.0:  # most of the rotation is about quite another axis
        assert abs(float(most_turned @ plain.toe_down)) < np.cos(np.radians(25.0))


def crabbing(crab_deg: float) -> Track:
    """A foot that turns about its y axis and goes another way, so far to the left of where it points."""
    track, places = stepping("right_foot", Steps())
    ahead = np.gradient(np.gradient(places[:, 0], 0.01), 0.01)
    pitch = -np.cumsum(track.gyr_radps[:, 1]) * 0.01
    angle = math.radians(crab_deg)
    acc = track.acc_mps2 + (math.cos(angle) - 1.0) * np.outer(ahead, [1.0, 0.0, 0.0]) * np.cos(pitch)[:, None]
    acc -= (math.cos(angle) - 1.0) * np.outer(ahead * np.sin(pitch), [0.0, 0.0, 1.0])
    return replace(track, acc_mps2=acc + math.sin(angle) * ahead[:, None] * [0.0, 1.0, 0.0])


@pytest.mark.parametrize(("crab_deg", "off_deg"), [(0.0, 0.0), (15.0, 2.2), (25.0, 12.0), (50.0, 37.0), (-50.0, -37.0)])
def test_falls_move_the_axis_from_the_travel_by_13_degrees_at_most(crab_deg: float, off_deg: float) -> None:
    """Up to 15° that the two are apart the falls count six sevenths; beyond 13° the axis is less sure."""
    found, straight = calibrate_track(crabbing(crab_deg)), calibrate_track(crabbing(0.0))
    assert math.degrees(math.atan2(-found.toe_down[0], found.toe_down[1])) == pytest.approx(off_deg, abs=1.0)
    assert found.axis_sd_rad == pytest.approx(straight.axis_sd_rad * max(abs(crab_deg) / 13.0, 1.0), rel=0.05)


def test_an_axis_that_is_too_uncertain_is_refused() -> None:
    assert re.search(
        r"the mediolateral axis is uncertain by ±20° \(19° are allowed\): the 12 strides", refused(crabbing(57.0))
    )


@pytest.mark.parametrize("crab_deg", [90.0, -90.0, 75.0])
def test_a_foot_that_is_carried_sideways_is_refused_as_that(crab_deg: float) -> None:
    message = refused(crabbing(crab_deg))
    assert re.search(r"it walked sideways: the foot tilts by \d+° about the line that it is carried along", message)
    assert "Walk straight ahead" in message


SHORT = [(name, foot, begin_s) for name, foot in WALKS[3:] for begin_s in (10.0, 14.0, 19.0, 23.0)]


@pytest.mark.parametrize(("name", "foot", "begin_s"), SHORT)
def test_five_seconds_of_walking_suffice(name: str, foot: str, begin_s: float) -> None:
    """Wherever they begin and end, in the middle of a stride too."""
    found, whole = calibrate_track(samples(name, foot, begin_s, begin_s + 5.0)), calibrated(name, foot)
    assert angle_deg(found.toe_down, whole.toe_down) < 3.0
    assert angle_deg(found.up, whole.up) < 2.0
    assert found.axis_confidence > 0.9
    assert 3 <= found.strides <= 4
    for measure in MEASURES[:3]:
        assert getattr(found, measure) == pytest.approx(getattr(whole, measure), rel=0.1)


@pytest.mark.parametrize("begin_s", [10.0, 14.0, 19.0, 23.0])
@pytest.mark.parametrize(("name", "foot"), WALKS[:3])
def test_eight_seconds_of_a_slow_foot_suffice(name: str, foot: str, begin_s: float) -> None:
    found, whole = calibrate_track(samples(name, foot, begin_s, begin_s + 8.0)), calibrated(name, foot)
    assert angle_deg(found.toe_down, whole.toe_down) < 3.0
    assert angle_deg(found.up, whole.up) < 2.0
    assert found.axis_confidence > 0.75


def turned_by_turns(track: Track, at_s: list[float], degrees: float) -> Track:
    """The sensor is turned about gravity at these instants, to and fro: the strides between lead different ways."""
    t_s, acc, gyr = 1e-9 * track.t_sensor_ns, track.acc_mps2.copy(), track.gyr_radps.copy()
    by = Rotation.from_rotvec(np.radians(degrees) * np.array(calibrated("both_feet_100hz", "left_foot").up))
    turned = np.searchsorted(at_s, t_s, side="right") % 2 == 1
    acc[turned], gyr[turned] = by.apply(acc[turned]), by.apply(gyr[turned])
    return replace(track, acc_mps2=acc, gyr_radps=gyr)


def test_two_strides_must_agree_better_than_many() -> None:
    name, foot = "both_feet_100hz", "left_foot"
    flat_s = [stride.t_stance_s + 0.15 for stride in load_truth(FOLDER / f"{name}.parquet").strides_of(foot)]
    two = strides_of(name, foot, 10, 2)
    found = calibrate_track(two)
    assert found.strides == 2
    assert 0.0 < found.axis_sd_rad < 0.5 * MOST_AXIS_SD_RAD
    assert angle_deg(found.toe_down, calibrated(name, foot).toe_down) < 3.0
    assert "of 2 movements lead more than 40° away" in refused(turned_by_turns(two, [flat_s[10]], 90.0))
    many = calibrate_track(turned_by_turns(strides_of(name, foot, 10, 8), flat_s[10:17], 50.0))
    assert many.strides == 8
    assert found.axis_sd_rad < many.axis_sd_rad < MOST_AXIS_SD_RAD


def test_strides_that_hold_a_gap_are_left_out() -> None:
    name, foot = "both_feet_100hz", "left_foot"
    track, plain = recording(name).tracks[foot], calibrated(name, foot)
    true, keep = load_truth(FOLDER / f"{name}.parquet").strides_of(foot), np.ones(len(track.t_sensor_ns), np.bool_)
    for number in (10, 20, 30):
        at = np.searchsorted(track.t_sensor_ns, 1e9 * (true[number].t_swing_s + 0.15))
        keep[at : at + 10] = False
    found = calibrate_track(with_samples(track, track.t_sensor_ns[keep], track.acc_mps2[keep], track.gyr_radps[keep]))
    assert found.strides == plain.strides - 3
    assert angle_deg(found.toe_down, plain.toe_down) < 0.5
    for measure in MEASURES:
        assert getattr(found, measure) == pytest.approx(getattr(plain, measure), rel=0.05)


def test_backwards_is_told_from_forwards() -> None:
    """The same swings carried the other way, sensor turned by half about the vertical: toe-down turns its sign too."""
    track = recording("both_feet_100hz").tracks["right_foot"]
    plain = calibrated("both_feet_100hz", "right_foot")
    about_up = Rotation.from_rotvec(np.pi * np.array(plain.up))
    assert angle_deg(calibrate_track(turned(track, about_up)).toe_down, -np.array(plain.toe_down)) < 2.0


# --- what is wrong with it -------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "foot"), WALKS)
def test_the_gyroscopes_bias_is_that_of_standing(name: str, foot: str) -> None:
    track = recording(name).tracks[foot]
    still = track.t_sensor_ns < 3_500_000_000
    found = calibrated(name, foot)
    assert found.standing
    np.testing.assert_allclose(found.gyr_bias_radps, track.gyr_radps[still].mean(axis=0), atol=0.002)


def test_a_bias_added_is_a_bias_found() -> None:
    track = recording("both_feet_100hz").tracks["left_foot"]
    plain = calibrated("both_feet_100hz", "left_foot")
    more = np.array([0.02, -0.015, 0.01])
    found = calibrate_track(replace(track, gyr_radps=track.gyr_radps + more))
    np.testing.assert_allclose(np.array(found.gyr_bias_radps) - plain.gyr_bias_radps, more, atol=1e-9)


NEVER_STILL = [
    ("both_feet_100hz", "left_foot", 8.0, 30.0), ("both_feet_100hz", "right_foot", 8.0, 30.0),
    ("misaligned", "left_foot", 8.0, 30.0), ("negard_patient1", "right_foot", 8.0, 40.0),
    ("soft_contact", "right_foot", 8.0, 40.0),
]  # fmt: skip
MORE_DPS = [(0.0, 0.0, 0.0), (2.0, 0.0, 0.0), (0.0, -2.0, 0.0), (0.0, 0.0, 2.0), (1.2, 1.2, -1.2)]


@pytest.mark.parametrize(("name", "foot", "begin_s", "end_s"), NEVER_STILL)
def test_without_a_still_second_the_axes_are_the_same(name: str, foot: str, begin_s: float, end_s: float) -> None:
    found, plain = calibrate_track(samples(name, foot, begin_s, end_s)), calibrated(name, foot)
    assert not found.standing
    assert plain.standing
    assert angle_deg(found.toe_down, plain.toe_down) < 3.0
    assert angle_deg(found.up, plain.up) < 2.0


@pytest.mark.parametrize("more_dps", MORE_DPS)
@pytest.mark.parametrize(("name", "foot", "begin_s", "end_s"), NEVER_STILL)
def test_without_a_still_second_the_bias_is_that_by_which_gravity_closes(
    name: str, foot: str, begin_s: float, end_s: float, more_dps: tuple[float, ...]
) -> None:
    """Across gravity, where it tilts the foot; of what turns it about gravity hardly anything shows."""
    part, plain = samples(name, foot, begin_s, end_s), calibrated(name, foot)
    found = calibrate_track(replace(part, gyr_radps=part.gyr_radps + np.radians(more_dps)))
    off_dps = np.degrees(np.array(found.gyr_bias_radps) - plain.gyr_bias_radps) - more_dps
    up = np.array(plain.up)
    assert abs(off_dps @ plain.toe_down) < 0.6
    assert np.linalg.norm(off_dps - (off_dps @ up) * up) < 0.7


@pytest.mark.parametrize("more_dps", [(2.0, 0.0, 0.0), (0.0, 2.0, 0.0), (0.0, -2.0, 0.0), (-1.4, 1.4, 0.0)])
def test_of_a_faultless_sensor_the_bias_is_found_to_three_tenths_of_a_degree_per_second(
    more_dps: tuple[float, ...],
) -> None:
    track, _ = stepping("left_foot", Steps(count=14))
    walked = first_seconds(track, 2.05, 18.0)  # from the first swing on: nobody stands still
    plain = calibrate_track(walked)
    found = calibrate_track(replace(walked, gyr_radps=walked.gyr_radps + np.radians(more_dps)))
    assert not found.standing
    assert found.strides == plain.strides >= 10
    assert np.degrees(found.gyr_bias_radps)[:2] == pytest.approx(more_dps[:2], abs=0.3)


def true_acc_bias(name: str, foot: str) -> FloatArray:
    """What the accelerometer reads beyond gravity while the walker stands, by the true orientation (3,)."""
    truth, track = load_truth(FOLDER / f"{name}.parquet").feet[foot], recording(name).tracks[foot]
    standing = truth.t_ns < 3_000_000_000
    turns = Rotation.from_quat(np.roll(truth.q_world_from_sensor[standing], -1, axis=1))
    gravity = turns.inv().apply([0.0, 0.0, G_MPS2]).mean(axis=0)
    return np.asarray(track.acc_mps2[track.t_sensor_ns < 3_000_000_000].mean(axis=0) - gravity)


@pytest.mark.parametrize(("name", "foot"), [w for w in WALKS if w[0] != "soft_contact"])
def test_the_accelerometers_bias_along_gravity(name: str, foot: str) -> None:
    found = calibrated(name, foot)
    up = np.array(found.up)
    assert float(up @ found.acc_bias_mps2) == pytest.approx(float(up @ true_acc_bias(name, foot)), abs=0.05)


def test_the_accelerometers_bias_across_gravity() -> None:
    """Rest does not show it, walking does: in the slow drop foot, where it costs most, most of it is found."""
    found = calibrated("negard_patient1", "right_foot")
    true, up = true_acc_bias("negard_patient1", "right_foot"), np.array(found.up)
    across = np.eye(3) - np.outer(up, up)
    forward = found.forward()
    assert abs(forward @ true) > 0.05
    assert abs(forward @ (found.acc_bias_mps2 - true)) < 0.4 * abs(forward @ true)
    assert np.linalg.norm(across @ (found.acc_bias_mps2 - true)) < np.linalg.norm(across @ true)


@pytest.mark.parametrize(("pattern", "rate_hz", "side", "seed"), [(4, 100.0, "right", 4), (5, 200.0, "left", 105)])
def test_a_foot_that_still_sinks_does_not_pass_for_a_foot_at_rest(
    pattern: int, rate_hz: float, side: str, seed: int
) -> None:
    """A soft sole gives way for a quarter of a second after contact: of a sensor without bias none must be found."""
    faultless = replace(ImuModel(), acc_bias_mps2=0.0, scale_error=0.0, cross_axis=0.0)
    settings = settings_for(
        "moderate", pattern=f"hemiparetic_{pattern}", seed=seed, rate_hz=rate_hz, side=side, sensors=FOOT_SENSORS,
        imu=faultless,
    )  # fmt: skip
    patient = VirtualPatient(settings)
    track = recording_of(patient, patient.advance(40 * NS_PER_S), "soft sole", "").tracks[f"{side}_foot"]
    found = calibrate_track(track)
    assert abs(np.dot(found.up, found.acc_bias_mps2)) < 0.005
    assert abs(np.dot(found.toe_down, found.acc_bias_mps2)) < 0.05


def loading_responses_s(track: Track, calibration: FootCalibration) -> list[float]:
    """How long the phase machine stayed in loading response, each time."""
    maker = StrideMaker(track.sensor, StrideSettings(calibration.forward(), np.array(calibration.up)))
    outcomes = FootTracker(calibration, maker).advance(track.t_sensor_ns, track.acc_mps2, track.gyr_radps)
    phases = [change for change in outcomes if isinstance(change, PhaseChange)]
    return [
        1e-9 * (after.t_ns - change.t_ns)
        for change, after in pairwise(phases)
        if change.destination is Phase.LOADING_RESPONSE
    ]


def test_a_foot_that_has_landed_is_not_held_up_by_what_its_reckoned_speed_has_drifted() -> None:
    foot = ("both_feet_100hz", "right_foot")
    spent = loading_responses_s(recording(foot[0]).tracks[foot[1]], calibrated(*foot))
    assert len(spent) > 40
    assert max(spent) < 0.4  # it had been half a second


DATA = Path(os.environ.get("FES_DATA") or Path(__file__).resolve().parents[3] / "shared" / "data")
BRISK = DATA / "stroke_treadmill" / "MR02_FBIC.npz"


@pytest.mark.skipif(not BRISK.is_file(), reason="the stroke-treadmill recordings are not here (FES_DATA)")
@pytest.mark.parametrize("more_mps2", [-0.02, 0.02])
def test_a_bias_a_little_off_does_not_strand_the_phases(more_mps2: float) -> None:
    """A brisk foot that hardly rests: with most biases the machine got lost in loading response, for up to 27 s."""
    track = importlib.import_module("benchmarks.lib.real_sets").load_run(BRISK)[0]["right_foot"]
    found = calibrate_track(track)
    x, y, z = (np.array(found.acc_bias_mps2) + more_mps2 * np.array(found.up)).tolist()
    spent = loading_responses_s(track, replace(found, acc_bias_mps2=(x, y, z)))
    assert len(spent) > 180
    assert max(spent) < 2.0


# --- this person's measures ----------------------------------------------------------------------------


MEASURES = ("push_off_radps", "fall_radps", "stride_s", "contact_jerk_mps3")


def test_measures_follow_the_person() -> None:
    slow, brisk = calibrated("negard_patient1", "right_foot"), calibrated("both_feet_100hz", "right_foot")
    assert slow.push_off_radps < 4.0 < brisk.push_off_radps
    assert slow.stride_s > 1.8 > 1.3 > brisk.stride_s
    for found in (slow, brisk):
        assert found.fall_radps > found.push_off_radps


@pytest.mark.parametrize(("name", "foot"), WALKS)
def test_the_stride_time_is_the_true_one(name: str, foot: str) -> None:
    contacts = [stride.t_loading_response_s for stride in load_truth(FOLDER / f"{name}.parquet").strides_of(foot)]
    assert calibrated(name, foot).stride_s == pytest.approx(np.median(np.diff(contacts)), rel=0.05)


def test_fitted_thresholds_are_the_documented_ones_all_others_stay_at_their_defaults() -> None:
    fitted = {f.name for f in fields(FootCalibration)} & set(Thresholds._fields)
    assert fitted == set(MEASURES)
    odd = replace(calibrated("negard_patient1", "right_foot"), **dict.fromkeys(fitted, 0.123))
    differing = {name for name, a, b in zip(Thresholds._fields, odd.thresholds(), Thresholds(), strict=True) if a != b}
    assert differing == fitted | {"swing_s"}, "which follows from the stride time"
    page = (DOCS / "phases.md").read_text(encoding="utf-8")
    paragraph = page[page.index("Calibration sets ") :].partition("\n\n")[0]
    for name in fitted:
        assert f"`{name}`" in paragraph
        assert f"``{name}``" in (FootCalibration.__doc__ or "")


def test_the_compiled_cores_parameters() -> None:
    found = calibrated("negard_patient1", "right_foot")
    p = found.parameters()
    assert (p.toe_down_x, p.toe_down_y, p.toe_down_z) == found.toe_down
    assert (p.acc_bias_x_mps2, p.acc_bias_y_mps2, p.acc_bias_z_mps2) == found.acc_bias_mps2
    assert (p.gyr_bias_x_radps, p.gyr_bias_y_radps, p.gyr_bias_z_radps) == found.gyr_bias_radps
    assert (p.sample_s, p.jerk_lag) == (0.002, 5)


@pytest.mark.parametrize(("name", "foot"), WALKS[:4:3])
def test_there_and_back_through_the_log(name: str, foot: str) -> None:
    found = calibrated(name, foot)
    assert FootCalibration.from_dict(json.loads(json.dumps(found.to_dict()))) == found


def test_a_minute_is_enough() -> None:
    t_ns = np.arange(0, 90_000_000_000, 10_000_000) + 123_000_000_000
    gyr = np.zeros((len(t_ns), 3))
    gyr[1000:, 1] = 2.0
    assert stretch_for_calibration(t_ns, gyr) == slice(700, 6700)  # the foot stands for ten seconds
    assert stretch_for_calibration(t_ns[:50], gyr[:50]) == slice(0, 50)


# --- what cannot be calibrated ---------------------------------------------------------------------------


def samples(name: str, foot: str, begin_s: float, end_s: float) -> Track:
    return first_seconds(recording(name).tracks[foot], begin_s, end_s)


def strides_of(name: str, foot: str, first: int, count: int) -> Track:
    """So many strides and no more, from standing on the foot to standing on it."""
    true = load_truth(FOLDER / f"{name}.parquet").strides_of(foot)
    return samples(name, foot, true[first - 1].t_stance_s - 0.05, true[first + count - 1].t_stance_s + 0.4)


def refused(track: Track) -> str:
    with pytest.raises(CalibrationError) as error:
        calibrate_foot(track.sensor, track.rate_hz, track.t_sensor_ns, track.acc_mps2, track.gyr_radps)
    assert str(error.value).startswith(f"{track.sensor}: ")
    return str(error.value)


def test_too_short() -> None:
    assert "1.0 s is too short to calibrate" in refused(samples("both_feet_100hz", "left_foot", 0.0, 1.0))


def test_nobody_walks() -> None:
    message = refused(samples("both_feet_100hz", "left_foot", 0.0, 4.0))
    assert "0 strides found, 2 are needed" in message
    assert "five strides of walking straight ahead" in message


def test_one_stride_is_not_enough() -> None:
    message = refused(strides_of("negard_patient1", "right_foot", 5, 1))
    assert re.search("[01] strides found, 2 are needed", message)


def test_acceleration_in_g() -> None:
    track = samples("both_feet_100hz", "left_foot", 0.0, 30.0)
    message = refused(replace(track, acc_mps2=track.acc_mps2 / G_MPS2))
    assert "reads 1.0" in message
    assert "instead of about 9.81" in message
    assert "Check acc_unit" in message


def test_a_gyroscope_that_is_switched_off() -> None:
    track = samples("both_feet_100hz", "left_foot", 0.0, 30.0)
    assert "0 strides found" in refused(replace(track, gyr_radps=0.0 * track.gyr_radps))


def in_stances(name: str, foot: str, share: float) -> np.ndarray:
    """Where a share of the stances is, from contact to toe-off, each so often at random: (N,) bool."""
    true, t_s = load_truth(FOLDER / f"{name}.parquet").strides_of(foot), 1e-9 * recording(name).tracks[foot].t_sensor_ns
    chosen = np.random.default_rng(1).random(len(true)) < share
    inside = np.zeros(len(t_s), np.bool_)
    for (one, after), taken in zip(pairwise(true), chosen[:-1].tolist(), strict=True):
        if taken:
            inside |= (t_s >= one.t_loading_response_s - 0.1) & (t_s < after.t_swing_s + 0.1)
    return inside


@pytest.mark.parametrize("off_mps2", [1.5 * LYING_MPS2, -1.5 * LYING_MPS2])
def test_an_accelerometer_that_lies_in_many_stances_is_refused(off_mps2: float) -> None:
    track, up = (
        recording("both_feet_100hz").tracks["left_foot"],
        np.array(calibrated("both_feet_100hz", "left_foot").up),
    )
    acc = track.acc_mps2 + off_mps2 * np.outer(in_stances("both_feet_100hz", "left_foot", 4.0 * LYING_SHARE), up)
    message = refused(replace(track, acc_mps2=acc))
    assert "of the time that the foot rests the accelerometer is more than 2 m/s² off gravity" in message
    assert "Exchange or recalibrate the sensor" in message


@pytest.mark.parametrize("held", [(0.0, 0.0, G_MPS2), (1.0, -2.0, 9.5), (-3.5, -0.6, 9.0)])
@pytest.mark.parametrize("noise_mps2", [0.0, 1e-12, 1e-3])
def test_an_accelerometer_that_has_stopped(held: tuple[float, ...], noise_mps2: float) -> None:
    """Turned by the gyroscope, what it holds leads away from the spot, like strides; of its bias it says nothing."""
    track = samples("both_feet_100hz", "left_foot", 0.0, 45.0)
    acc = np.array(held) + noise_mps2 * np.random.default_rng(3).standard_normal(track.acc_mps2.shape)
    assert "the accelerometer shows gravity and nothing else" in refused(replace(track, acc_mps2=acc))


def test_to_and_fro_has_no_direction() -> None:
    """Half of the strides carry the sensor the other way, as the film runs backward: where is the toe?"""
    there = samples("both_feet_100hz", "left_foot", 8.0, 24.0)
    back = replace(there, acc_mps2=there.acc_mps2[::-1], gyr_radps=-there.gyr_radps[::-1])
    shift = there.t_sensor_ns[-1] - there.t_sensor_ns[0] + 10_000_000
    both = with_samples(
        there,
        np.concatenate((there.t_sensor_ns, there.t_sensor_ns + shift)),
        np.concatenate((there.acc_mps2, back.acc_mps2)),
        np.concatenate((there.gyr_radps, back.gyr_radps)),
    )
    message = refused(both)
    assert re.search(r"no one way forward: \d+ of \d+ movements lead more than 40° away", message)
    assert "Walk straight ahead" in message


@pytest.mark.parametrize("name", ["both_feet_100hz", "negard_patient1", "negard_patient2"])
def test_a_walk_backward_is_refused_as_that(name: str) -> None:
    """As the film runs backward: the foot tilts as far, toe up where it tilted toe down."""
    track = recording(name).tracks["right_foot"]
    back = with_samples(track, track.t_sensor_ns, track.acc_mps2[::-1].copy(), -track.gyr_radps[::-1])
    tilts = re.search(r"it walked backward: .* tilts toe-up by (\d+)° and toe-down by (\d+)°", refused(back))
    assert tilts is not None
    assert int(tilts[1]) > 20 + int(tilts[2])


@pytest.mark.parametrize("seed", [0, 4, 8])
def test_a_sensor_shaken_by_hand_is_no_walk(seed: int) -> None:
    """Carried and turned to and fro at 1–4 Hz, with pauses."""
    random, t_s = np.random.default_rng(seed), np.arange(0.0, 30.0, 0.01)
    held = np.clip(2.0 * np.sin(2.0 * np.pi * t_s / random.uniform(3.0, 8.0)) + 0.5, 0.0, 1.0)[:, None]
    waves = random.normal(size=(2, 4, 1, 3)) * np.sin(
        2.0 * np.pi * (random.uniform(1.0, 4.0, (2, 4, 1, 1)) * t_s[:, None] + random.random((2, 4, 1, 3)))
    )
    turn, place = held * waves.sum(axis=1) * np.array([0.3, 0.04])[:, None, None]
    turned_to = Rotation.from_rotvec(turn).as_matrix()
    spin = np.einsum("nji,njk->nik", turned_to, np.gradient(turned_to, 0.01, axis=0))
    gyr = np.column_stack([spin[:, 2, 1], spin[:, 0, 2], spin[:, 1, 0]])
    force = np.gradient(np.gradient(place, 0.01, axis=0), 0.01, axis=0) + np.array([0.0, 0.0, G_MPS2])
    acc = np.einsum("nji,nj->ni", turned_to, force)
    plain = recording("both_feet_100hz").tracks["left_foot"]
    message = refused(with_samples(plain, (1e9 * t_s).astype(np.int64), acc, gyr))
    assert re.search(r"no one way forward: \d+ of \d+ movements lead more than 40° away", message)


# drop feet that slap down faster than they push off, or whose falls part the strides in their middle: each was refused
SLAPPING = ((7016, 0), (7029, 0), (7047, 0), (7083, 0), (7089, 0))


@pytest.mark.parametrize(("number", "seed"), SLAPPING)
def test_a_drop_foot_that_slaps_down_is_calibrated(number: int, seed: int) -> None:
    settings = draw_patient(seed, number, sensors=("right_foot",))
    patient, foot = VirtualPatient(settings), settings.affected_foot
    found = calibrate_track(recording_of(patient, patient.advance(25 * NS_PER_S), "", "").tracks[foot])
    assert angle_deg(found.toe_down, mounting(*settings.placements[foot].angles_deg)[1]) < 8.5
    assert found.axis_sd_rad < math.radians(15.0)


def test_a_walk_in_a_circle_is_calibrated_as_one_straight_ahead() -> None:
    """Of one metre's radius: each stride turns the foot by 46° and the way with it."""
    straight, places = stepping("right_foot", Steps())
    speed, pitch = np.gradient(places[:, 0], 0.01), np.cumsum(straight.gyr_radps[:, 1]) * -0.01
    vertical = np.column_stack([np.sin(pitch), 0.0 * pitch, np.cos(pitch)])
    acc = straight.acc_mps2 + np.outer(speed**2, [0.0, 1.0, 0.0])
    curved = replace(straight, acc_mps2=acc, gyr_radps=straight.gyr_radps + speed[:, None] * vertical)
    found, plain = calibrate_track(curved), calibrate_track(straight)
    assert found.strides == plain.strides
    assert angle_deg(found.toe_down, plain.toe_down) < 3.0
    assert found.axis_sd_rad == pytest.approx(plain.axis_sd_rad, rel=0.1)


# --- a recording's feet ----------------------------------------------------------------------------------


def test_where_the_first_minute_shows_too_little_the_whole_recording_is_taken() -> None:
    track = recording("both_feet_100hz").tracks["left_foot"]
    quiet = np.tile(np.arange(300), 21)[:6200]  # a minute of the standing, again and again
    later = with_samples(
        track,
        np.arange(6200 + len(track.t_sensor_ns)) * 10_000_000,
        np.concatenate((track.acc_mps2[quiet], track.acc_mps2)),
        np.concatenate((track.gyr_radps[quiet], track.gyr_radps)),
    )
    found = calibrate_track(later)
    assert found.strides >= 20
    assert angle_deg(found.toe_down, calibrated("both_feet_100hz", "left_foot").toe_down) < 3.0


def test_doubled_and_backward_stamps_do_not_matter() -> None:
    track = recording("both_feet_100hz").tracks["left_foot"]
    n = len(track.t_sensor_ns)
    late = np.arange(500, n, 97)
    order = np.insert(np.arange(n), late, late - np.where(late % 2, 1, 5))  # some again, some five samples late
    spoiled = with_samples(track, track.t_sensor_ns[order], track.acc_mps2[order], track.gyr_radps[order])
    assert calibrate_track(spoiled) == calibrated("both_feet_100hz", "left_foot")


def test_one_foot_that_cannot_be_calibrated_does_not_stop_the_other() -> None:
    whole = recording("both_feet_100hz")
    still = samples("both_feet_100hz", "left_foot", 0.0, 4.0)
    found = calibrate_phase_sensors(replace(whole, tracks={**whole.tracks, "left_foot": still}))
    assert list(found.calibrations) == ["right_foot"]
    assert list(found.missing) == ["left_foot"]
    assert "0 strides found" in found.missing["left_foot"]


def test_no_foot_at_all() -> None:
    whole = recording("both_feet_100hz")
    with pytest.raises(CalibrationError, match=r"both_feet_100hz\.parquet: it holds none of the sensors"):
        calibrate_phase_sensors(replace(whole, tracks={}))


@pytest.mark.parametrize("share", [0.02, 0.2, 1.0])
def test_rates_in_degrees_are_named_whatever_share_of_the_walk_they_are(share: float) -> None:
    track = cut(recording("negard_patient2"), 0.0, 24.0).tracks["right_foot"]
    late = np.arange(len(track.t_ns)) >= (1.0 - share) * len(track.t_ns)
    gyr = np.where(late[:, None], np.degrees(track.gyr_radps), track.gyr_radps)
    with pytest.raises(CalibrationError, match=r"right_foot: .* rad/s are more than any leg turns: is its unit °/s\?"):
        calibrate_track(replace(track, gyr_radps=gyr))
