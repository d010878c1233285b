"""Off-line analysis and its command, and calibration as a file."""

from __future__ import annotations

import csv
import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result
from pyarrow import parquet
from shank_walks import shank_walk

from fes.analysis.pipeline import analyse, calibrations_of
from fes.calibration.recording import SensorCalibrations, load, save
from fes.cli.main import main
from fes.config import Ground
from fes.estimation.foot.calibration import CalibrationError
from fes.recording import Recording, Track, read_recording
from statemachine.phases import Phase

TRIALS = Path(__file__).resolve().parents[2] / "sim_inputs"
TRIAL = TRIALS / "both_feet_100hz.parquet"


def run(*arguments: str | Path) -> Result:
    return CliRunner().invoke(main, [str(argument) for argument in arguments])


@pytest.fixture(scope="module")
def analysed():
    recording = read_recording(TRIAL)
    recording, found = calibrations_of(recording)
    assert found.missing == {}
    return analyse(recording, found.calibrations)


def test_both_feet_come_in_order_of_time_and_agree_with_the_truth(analysed):
    assert {stride.foot for stride in analysed.strides} == {"left_foot", "right_foot"}
    for events in (
        [change.t_ns for change in analysed.phases],
        [stride.t_start_ns for stride in analysed.strides],
    ):
        assert events == sorted(events)
    with (TRIALS / "both_feet_100hz.strides.csv").open() as file:
        truth = [row for row in csv.DictReader(file) if row["steady"] == "yes"]
    errors = []
    for row in truth:
        foot_off_ns = 1e9 * float(row["t_swing_s"])
        found = [s for s in analysed.strides if s.foot == row["foot"] and s.t_start_ns < foot_off_ns < s.t_end_ns]
        assert len(found) == 1
        errors.append(found[0].stride_length_m - float(row["stride_length_m"]))
    assert abs(sum(errors) / len(errors)) < 0.017


def without_geometry(recording: Recording) -> Recording:
    return replace(recording, geometry={})


@pytest.fixture(scope="module")
def estimated(analysed):
    return analyse(without_geometry(analysed.recording), analysed.calibrations)


def test_toe_and_heel_clearance_agree_with_the_truth_whether_given_or_estimated(analysed, estimated):
    with (TRIALS / "both_feet_100hz.strides.csv").open() as file:
        truth = [row for row in csv.DictReader(file) if row["steady"] == "yes"]
    for result, most_m in ((analysed, (0.003, 0.004)), (estimated, (0.004, 0.015))):
        for quantity, bound_m in zip(("toe_clearance_m", "heel_clearance_m"), most_m, strict=True):
            errors = []
            for row in truth:
                foot_off_ns = 1e9 * float(row["t_swing_s"])
                found = next(
                    s for s in result.strides if s.foot == row["foot"] and s.t_start_ns < foot_off_ns < s.t_end_ns
                )
                errors.append(getattr(found, quantity) - float(row[quantity]))
            assert abs(sum(errors) / len(errors)) < bound_m, quantity
    lengths = [[stride.stride_length_m for stride in result.strides] for result in (analysed, estimated)]
    assert lengths[0] == pytest.approx(lengths[1], abs=0.005)


def test_it_says_whether_toe_and_heel_were_given_or_estimated(analysed, estimated):
    for foot, true in analysed.recording.geometry.items():
        given, found = analysed.points[foot], estimated.points[foot]
        assert given.to_json()["source"] == "given"
        assert given.geometry == true
        told = found.to_json()
        assert (told["source"], told["observed"], told["reason"]) == ("estimated", True, "")
        assert abs(found.geometry.toe_forward_m - true.toe_forward_m) < 2.0 * told["toe_forward_sd_m"]
        assert abs(found.geometry.heel_forward_m - true.heel_forward_m) < 2.0 * told["heel_forward_sd_m"]
        assert given.levels
        assert found.levels
        assert "estimated" in found.describe()
        assert "[geometry]" in given.describe()
    record = estimated.walk_record()
    assert {note.source for note in record.notes} == {"left_foot", "right_foot"}
    assert all(note.severity == "info" and "estimated" in note.text for note in record.notes)
    assert record.header["toe_and_heel"]["left_foot"]["source"] == "estimated"


def test_ground_that_proves_level_gives_the_same_clearance(analysed):
    for geometry in (analysed.recording.geometry, {}):
        recording = replace(analysed.recording, geometry=geometry)
        free = analyse(recording, analysed.calibrations, ground=Ground(free=True))
        known = analyse(recording, analysed.calibrations)
        pairs = [(a.toe_clearance_m, b.toe_clearance_m) for a, b in zip(free.strides, known.strides, strict=True)]
        off = [a - b for a, b in pairs if a == a and b == b]
        assert len(off) > 20
        assert abs(np.mean(off)) < 0.003


def test_the_ground_is_as_the_sidecar_says_unless_told(analysed):
    told = Ground(incline_percent=10.0)
    recording = replace(analysed.recording, ground=told)
    assert analyse(recording, analysed.calibrations).ground is told
    assert analyse(recording, analysed.calibrations, ground=Ground()).ground.level


def test_few_strides_leave_the_prior_and_a_warning(analysed):
    tracks = {}
    for name, track in analysed.recording.tracks.items():
        until = track.t_ns < track.t_ns[0] + 8_000_000_000
        tracks[name] = Track(
            name, track.rate_hz, track.t_ns[until], track.t_sensor_ns[until], track.acc_mps2[until],
            track.gyr_radps[until],
        )  # fmt: skip
    short = analyse(replace(analysed.recording, tracks=tracks, geometry={}), analysed.calibrations)
    assert short.points
    for foot, known in short.points.items():
        told = known.to_json()
        assert told["strides"] < 3
        assert told["observed"] is False
        assert "3 are needed" in told["reason"]
        assert told["toe_forward_sd_m"] > 0.02
        note = next(note for note in short.walk_record().notes if note.source == foot)
        assert note.severity == "warning"
        assert "assumed, not measured" in note.text


def test_rows_hold_every_stride_and_phase_change(analysed):
    strides, phases = analysed.stride_table().rows(), analysed.phase_table().rows()
    assert len(strides) == len(analysed.strides)
    assert strides[0]["stride_length_m"] == analysed.strides[0].stride_length_m
    assert [row["t_live_s"] for row in phases] == [1e-9 * change.t_ns for change in analysed.phases]
    events = analysed.event_table().rows()
    assert abs(len(events) - len(strides)) <= 4
    assert all(row["t_foot_off_s"] < row["t_mid_swing_s"] < row["t_initial_contact_s"] for row in events)
    assert {row["to"] for row in phases} == {phase.name.lower() for phase in Phase}


def test_calibration_survives_the_file(tmp_path, analysed):
    path = tmp_path / "a.json"
    save(SensorCalibrations(analysed.calibrations), path)
    assert load(path).calibrations == analysed.calibrations


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "is no calibration"),
        ("[]", "is no calibration"),
        ('{"format": 1}', "is no calibration"),
        ('{"format": 99, "feet": {}}', "is of format 99"),
        ('{"format": 1, "feet": {"left_foot": {"sensor": "left_foot"}}}', "is no calibration"),
        ('{"format": 1, "feet": {"left_foot": 3}}', "is no calibration"),
    ],
)
def test_a_bad_calibration_file_says_what_to_do(tmp_path, text, said):
    path = tmp_path / "bad.json"
    path.write_text(text)
    with pytest.raises(CalibrationError, match=r"bad\.json") as caught:
        load(path)
    assert said in str(caught.value)
    assert "fes calibrate" in str(caught.value) or "Calibrate anew" in str(caught.value)


def test_command_writes_tables_and_report_and_takes_a_calibration(tmp_path):
    calibration = tmp_path / "feet.json"
    made = run("calibrate", TRIAL, "--out", calibration)
    assert made.exit_code == 0, made.output
    assert "left_foot: from" in made.output
    done = run("analyse", TRIAL, "--calibration", calibration, "--out", tmp_path / "out")
    assert done.exit_code == 0, done.output
    folder = tmp_path / "out" / "both_feet_100hz-001"
    with (folder / "strides.csv").open() as file:
        strides = list(csv.DictReader(file))
    assert len(strides) > 80
    assert all(row["toe_clearance_m"] for row in strides if row["valid"] == "true")
    report = (folder / "report.html").read_text()
    assert "<html" in report[:500]
    assert "toe and heel as the sidecar&#39;s [geometry] gives them" in report
    assert "toe and heel as the sidecar's [geometry] gives them" in " ".join(done.output.split())


@pytest.mark.parametrize("kind", ["parquet", "json"])
def test_tables_in_other_formats_hold_the_same(tmp_path, analysed, kind):
    done = run("analyse", TRIAL, "--out", tmp_path, "--format", kind, "--no-report", "--json")
    assert done.exit_code == 0, done.output
    shown = json.loads(done.stdout)
    assert len(shown["strides"]) == len(analysed.strides)
    assert shown["toe_and_heel"]["left_foot"]["source"] == "given"
    path = tmp_path / "both_feet_100hz-001" / f"strides.{kind}"
    rows = json.loads(path.read_text()) if kind == "json" else parquet.read_table(path).to_pylist()
    assert [row["stride_length_m"] for row in rows] == [s.stride_length_m for s in analysed.strides]
    assert not (path.parent / "report.html").exists()


def test_one_bad_recording_does_not_stop_the_others(tmp_path):
    bad = tmp_path / "bad.csv"
    bad.write_text("")
    done = run("analyse", bad, TRIAL, "--out", tmp_path / "out", "--no-report")
    assert done.exit_code == 1
    assert "1 of 2 recordings could not be used" in done.output
    assert (tmp_path / "out" / "both_feet_100hz-001" / "strides.csv").is_file()
    alone = run("analyse", bad, "--out", tmp_path / "out")
    assert alone.exit_code == 2
    assert "bad" in alone.output


def test_a_calibration_of_other_sensors_is_refused(tmp_path, analysed):
    path = tmp_path / "left.json"
    save(SensorCalibrations({"left_foot": analysed.calibrations["left_foot"]}), path)
    refused = run("analyse", TRIALS / "negard_patient2.parquet", "--calibration", path, "--out", tmp_path)
    assert refused.exit_code == 2
    assert "calibrates none of the sensors" in refused.output


@pytest.mark.parametrize("rise_m", [0.0, 0.15])
def test_a_shank_alone_tells_the_foots_strides(tmp_path, rise_m):
    walk = shank_walk(strides=16, rise_m=rise_m, standing_s=3.0, rate_hz=200.0)
    track = Track("left_shank", 200.0, walk.t_ns, walk.t_ns, walk.acc, walk.gyr)
    recording, found = calibrations_of(
        Recording("shank", None, {"left_shank": track}), incline=0.0 if rise_m == 0.0 else math.nan
    )
    result = analyse(recording, found.calibrations, ground=Ground(free=rise_m != 0.0))
    valid = [stride for stride in result.strides if stride.valid]
    assert len(valid) >= 12
    lengths = sorted(stride.stride_length_m for stride in valid)
    assert lengths[len(lengths) // 2] == pytest.approx(walk.stride_length_m, rel=0.08)
    assert result.event_table().rows() == result.path_table().rows() == []
    assert "a path needs a sensor" in result.no_path["left_shank"]
    assert len(result.walk_record().samples) == 1


def test_unlabelled_feet_are_told_apart(analysed):
    names = {"left_foot": "foot_b", "right_foot": "foot_a"}
    tracks = {names[name]: replace(track, sensor=names[name]) for name, track in analysed.recording.tracks.items()}
    recording, found = calibrations_of(replace(analysed.recording, tracks=tracks, geometry={}))
    assert found.sides == {"foot_a": "right_foot", "foot_b": "left_foot"}
    assert set(recording.tracks) == set(found.calibrations) == {"left_foot", "right_foot"}
