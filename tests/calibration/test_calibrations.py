"""Calibrations of whole recordings: feet, shanks, feet without a label; and what must not be used is refused."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from replays import SETTINGS, keep, trial
from scipy.spatial.transform import Rotation
from shank_walks import shank_walk

from fes.calibration.recording import (
    SensorCalibrations,
    calibrate_all,
    calibrate_phase_sensors,
    calibrate_sensors,
    labelled,
    load,
    refuse_others,
    save,
    stored_calibrations,
)
from fes.calibration.side_detection import USUAL_DIFFERENCE, tell_sides
from fes.cli.main import main
from fes.config import load_session
from fes.control.replay import session_for
from fes.estimation.foot.calibration import CalibrationError
from fes.estimation.sensor_choice import Calibration
from fes.estimation.shank.calibration import ShankCalibration
from fes.recording import Recording, Track, write_recording
from fes.session_log import read_session

TWO_FEET = "left_hemiparesis"


def shank_track(sensor: str = "right_shank") -> Track:
    walk = shank_walk(strides=14, standing_s=2.0, noise=0.03)
    return Track(sensor, walk.rate_hz, walk.t_ns, walk.t_ns, walk.acc, walk.gyr)


def shank_recording(sensor: str = "right_shank") -> Recording:
    return Recording("shank", None, {sensor: shank_track(sensor)})


def turned(track: Track, degrees: float) -> Track:
    """The sensor was strapped on otherwise."""
    by = Rotation.from_rotvec(np.radians(degrees) * np.array([1.0, 0.0, 0.0]))
    return replace(track, acc_mps2=by.apply(track.acc_mps2), gyr_radps=by.apply(track.gyr_radps))


def same(one: dict[str, Calibration], other: dict[str, Calibration]) -> bool:
    """NaN is equal to itself in JSON."""
    return json.dumps({k: v.to_dict() for k, v in one.items()}) == json.dumps(
        {k: v.to_dict() for k, v in other.items()}
    )


def test_what_is_written_is_read(tmp_path: Path) -> None:
    recording = shank_recording()
    both = replace(recording, tracks={**trial("example_csv").tracks, **recording.tracks})
    found = calibrate_all(both)
    assert list(found.calibrations) == ["right_foot", "right_shank"]
    save(found, tmp_path / "c.json")
    assert same(load(tmp_path / "c.json").calibrations, found.calibrations)


def test_a_shank_drives_only_where_there_is_no_foot() -> None:
    alone = shank_recording()
    both = replace(alone, tracks={**trial("example_csv").tracks, **alone.tracks})
    assert list(calibrate_phase_sensors(both).calibrations) == ["right_foot"]
    assert list(calibrate_phase_sensors(alone).calibrations) == ["right_shank"]
    channels = session_for(alone, load_session(SETTINGS)).channels
    assert [channel.foot for channel in channels] == ["right_foot"]
    assert session_for(shank_recording("left_shank"), load_session(SETTINGS)).channels == ()


def test_with_both_the_foot_drives_and_the_shank_is_recorded(tmp_path: Path) -> None:
    recording = trial("example_csv")
    foot = recording.tracks["right_foot"]
    shank = shank_track()
    shank = replace(shank, t_ns=shank.t_ns + foot.t_ns[0], t_sensor_ns=shank.t_ns + foot.t_ns[0])
    both = replace(recording, tracks={"right_foot": foot, "right_shank": shank})
    write_recording(both, tmp_path / "walk.csv")
    arguments = ["replay", str(tmp_path / "walk.csv"), "--session", str(SETTINGS), "--out", str(tmp_path / "out")]
    result = CliRunner().invoke(main, [*arguments, "--no-report"])
    assert result.exit_code == 0, result.output
    record = read_session(next(tmp_path.glob("out/*/session.feslog")))
    assert {change.foot for change in record.phases} == {"right_foot"}
    assert len(record.samples["right_shank"].t_ns) == len(shank.t_ns)


@pytest.mark.requirement("SR-21")
def test_another_rate_is_refused(tmp_path: Path) -> None:
    save(calibrate_sensors(shank_recording(), ["right_shank"]), tmp_path / "c.json")
    half = keep(shank_track(), slice(None, None, 2))
    recording = Recording("half", None, {"right_shank": replace(half, rate_hz=50.0)})
    with pytest.raises(
        CalibrationError, match=r"c\.json: right_shank was calibrated at 100 Hz and runs at 50 Hz\. Calib"
    ):
        stored_calibrations(tmp_path / "c.json", recording)


@pytest.mark.requirement("SR-21")
@pytest.mark.parametrize("name", ["right_shank", "right_foot"])
def test_a_sensor_that_was_moved_is_refused(tmp_path: Path, name: str) -> None:
    recording = shank_recording() if name == "right_shank" else trial("example_csv")
    save(calibrate_sensors(recording, [name]), tmp_path / "c.json")
    track = recording.tracks[name]
    little = replace(recording, tracks={name: turned(track, 8.0)})
    assert list(stored_calibrations(tmp_path / "c.json", little)[1].calibrations) == [name]
    much = replace(recording, tracks={name: turned(track, 60.0)})
    with pytest.raises(CalibrationError, match=f"{name} sits otherwise than when it was calibrated"):
        stored_calibrations(tmp_path / "c.json", much)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d.update(format=9), "is of format 9"),
        (lambda d: d.pop("feet"), "no calibration"),
        (lambda d: d["shanks"]["right_shank"].update(rate_hz=-1.0), "rate_hz of right_shank"),
        (lambda d: d["shanks"]["right_shank"].update(up=[0.0, 0.0, 2.0]), "up of right_shank is no unit vector"),
        (lambda d: d["shanks"]["right_shank"].update(left=[1.0]), "mediolateral axis of right_shank"),
        (lambda d: d["shanks"]["right_shank"].update(acc_bias_mps2=[0.0, 0.0, float("nan")]), "bias of right_shank"),
        (lambda d: d["shanks"].clear(), "no sensor"),
        (lambda d: d.update(sides={"foot_a": "nose"}), "'foot_a' cannot be 'nose'"),
    ],
)
def test_a_spoilt_file_is_refused(tmp_path: Path, change: Any, message: str) -> None:
    path = tmp_path / "c.json"
    save(calibrate_sensors(shank_recording(), ["right_shank"]), path)
    data = json.loads(path.read_text())
    change(data)
    path.write_text(json.dumps(data))
    with pytest.raises(CalibrationError, match=message):
        load(path)


@pytest.mark.requirement("SR-21")
def test_left_is_told_from_right_only_when_the_signs_agree() -> None:
    clear = 0.5 * USUAL_DIFFERENCE
    assert tell_sides(clear, -clear).left == 0
    assert tell_sides(-clear, clear).left == 1
    assert tell_sides(clear, -clear).sure
    assert tell_sides(clear, -clear).score == pytest.approx(1.0)
    faint = 0.1 * USUAL_DIFFERENCE
    assert not tell_sides(faint, -faint).sure
    split = clear * np.array([1.0, 1.0, -0.2, -0.2])
    assert not tell_sides(split, -split).sure


def unlabelled(recording: Recording, names: dict[str, str]) -> Recording:
    return replace(
        recording,
        tracks={names[name]: replace(track, sensor=names[name]) for name, track in recording.tracks.items()},
    )


@pytest.mark.requirement("SR-21")
def test_feet_without_a_label_are_never_driven_and_a_label_is_asked_for() -> None:
    recording = unlabelled(trial("example_csv"), {"right_foot": "foot_a"})
    with pytest.raises(CalibrationError, match=r"rename \[sensors\.foot_a\] to \[sensors\.left_foot\]"):
        calibrate_phase_sensors(recording)
    with pytest.raises(CalibrationError, match="takes two feet"):
        calibrate_all(recording)


def test_the_found_sides_name_the_tracks() -> None:
    recording = unlabelled(trial("example_csv"), {"right_foot": "foot_b"})
    assert list(labelled(recording, {"foot_b": "right_foot"}).tracks) == ["right_foot"]
    double = replace(recording, tracks={**recording.tracks, **trial("example_csv").tracks})
    with pytest.raises(CalibrationError, match="second right_foot"):
        labelled(double, {"foot_b": "right_foot"})


def test_unlabelled_feet_survive_the_file(tmp_path: Path) -> None:
    from fes.recording import read_recording

    recording = unlabelled(trial("example_csv"), {"right_foot": "foot_b"})
    write_recording(recording, tmp_path / "walk.csv")
    assert list(read_recording(tmp_path / "walk.csv").tracks) == ["foot_b"]
    result = CliRunner().invoke(main, ["replay", str(tmp_path / "walk.csv"), "--out", str(tmp_path / "out")])
    assert result.exit_code == 2
    assert "which foot is which" in result.output


def test_the_command_writes_what_replay_takes(tmp_path: Path) -> None:
    recording = shank_recording()
    write_recording(recording, tmp_path / "walk.csv")
    target = tmp_path / "mine.json"
    result = CliRunner().invoke(main, ["calibrate", str(tmp_path / "walk.csv"), "--out", str(target), "--json"])
    assert result.exit_code == 0, result.output
    told = json.loads(result.output)
    assert told["phase_sensors"] == {"right_foot": "right_shank"}
    assert SensorCalibrations(load(target).calibrations).calibrations.keys() == told["sensors"].keys()
    table = CliRunner().invoke(main, ["calibrate", str(tmp_path / "walk.csv"), "--out", str(target)])
    assert "right_foot" in table.output
    assert "arm" in table.output
    arguments = ["replay", str(tmp_path / "walk.csv"), "--calibration", str(target), "--session", str(SETTINGS)]
    result = CliRunner().invoke(main, [*arguments, "--out", str(tmp_path / "out"), "--no-report"])
    assert result.exit_code == 0, result.output
    record = read_session(next(tmp_path.glob("out/*/session.feslog")))
    assert {change.foot for change in record.phases} == {"right_shank"}
    assert any(command.on for command in record.commands)
    again = CliRunner().invoke(main, ["replay", str(next(tmp_path.glob("out/*/session.feslog")))])
    assert again.exit_code == 0, again.output


def test_shank_calibrations_come_back_whole() -> None:
    found = calibrate_sensors(shank_recording(), ["right_shank"], incline=math.nan).calibrations["right_shank"]
    assert isinstance(found, ShankCalibration)
    assert not found.level
    back = ShankCalibration.from_dict(json.loads(json.dumps(found.to_dict())))
    assert back.levels == found.levels
    assert back.parameters() == found.parameters()


@pytest.mark.requirement("SR-28")
def test_a_calibration_is_bound_to_the_sensors_that_told_their_numbers(tmp_path: Path) -> None:
    found = calibrate_sensors(shank_recording(), ["right_shank"])
    bound = replace(found, serials={"right_shank": "0A", "left_shank": "0B"})
    save(bound, tmp_path / "c.json")
    stored = load(tmp_path / "c.json")
    assert stored.serials == bound.serials
    refuse_others(stored, {"right_shank": "0A", "left_shank": "0B"}, "c.json")
    refuse_others(stored, {"left_foot": "0C"}, "c.json")  # of a place that it binds nothing to
    refuse_others(found, {"right_shank": "0C"}, "c.json")  # made where none told its number
    with pytest.raises(
        CalibrationError, match=r"right_shank was calibrated with sensor 0A, on it is 0B; .* left_shank's"
    ):
        refuse_others(stored, {"right_shank": "0B", "left_shank": "0A"}, "c.json")
    with pytest.raises(CalibrationError, match="on it is 0C; that one it does not know"):
        refuse_others(stored, {"right_shank": "0C"}, "c.json")
