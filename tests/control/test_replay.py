"""Whole replays of the bundled trials, without a stimulator: when it stimulates, and that it is always the same."""

from __future__ import annotations

import csv
import json
import tomllib
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from replays import (
    MS,
    SETTINGS,
    TRIALS,
    Burst,
    Replays,
    both_feet,
    bursts,
    cut,
    edit,
    one_sample_changed,
    replay,
    rewritten,
    same_outputs,
    trial,
)

from fes.calibration.recording import calibrate_phase_sensors, calibrate_track
from fes.cli.replay.command import prepared, repeat
from fes.cohort.sweep.grid import Point, session_with
from fes.config import ConfigError, Ground, load_session, validate_session
from fes.control.replay import identity, refuse_long_silence, session_for
from fes.estimation.foot.calibration import CalibrationError
from fes.recording import RecordingError, write_recording
from fes.report.summary import summarise
from fes.session_log import SessionLogError, SessionRecord, read_session
from fes.session_log.framing import RecordType
from fes.signals import NS_PER_S, ImuSample

FEET = {0: "right_foot", 1: "left_foot"}
WALKING = ("negard_patient1", "negard_patient2", "both_feet_100hz", "both_feet_200hz", "misaligned", "example_csv")
EARLY_S, LATE_S = 0.05, 0.1  # a burst may lie this far outside true pre-swing … end of loading response


@dataclass(frozen=True)
class TrueStride:
    t_pre_swing_s: float
    t_stance_s: float
    walking: bool


def truth(name: str, foot: str) -> list[TrueStride]:
    with (TRIALS / f"{name}.strides.csv").open(encoding="utf-8") as file:
        return [
            TrueStride(float(row["t_pre_swing_s"]), float(row["t_stance_s"]), row["walking"] == "yes")
            for row in csv.DictReader(file)
            if row["foot"] == foot
        ]


def inside(burst: Burst, strides: list[TrueStride], late_s: float = LATE_S) -> bool:
    """Whether a burst lies within one walking stride's swing, with what comes before and after it."""
    on_s, off_s = burst.t_on_ns / NS_PER_S, burst.t_off_ns / NS_PER_S
    return any(
        stride.walking and stride.t_pre_swing_s - EARLY_S <= on_s and off_s <= stride.t_stance_s + late_s
        for stride in strides
    )


def channels_of(record: SessionRecord) -> list[int]:
    return sorted({command.channel for command in record.commands})


@pytest.mark.requirement("SR-02")
@pytest.mark.parametrize("name", WALKING)
def test_walking_is_stimulated_in_swing_and_never_else(replays: Replays, name: str) -> None:
    record = replays.of(name)
    for channel in channels_of(record):
        strides = truth(name, FEET[channel])
        mine = bursts(record.commands, channel)
        assert len(strides) - 3 <= len(mine) <= len(strides) - 1  # one stride shows that this is walking
        wrong = [burst for burst in mine if not inside(burst, strides)]
        assert not wrong
        times = [burst.t_on_ns for burst in mine]
        assert min(np.diff(times)) > 0.7 * NS_PER_S, "one burst a stride"
    assert record.complete
    assert not [note for note in record.notes if note.severity == "fault"]


def test_soft_contact_is_the_hard_case(replays: Replays) -> None:
    """Feet put down so softly that no contact is felt: stimulation may then last into stance, by 0.3 s."""
    strides = truth("soft_contact", "right_foot")
    mine = bursts(replays.of("soft_contact").commands)
    outside = [burst for burst in mine if not inside(burst, strides, late_s=0.4)]
    assert outside == []
    assert len(mine) >= len(strides) - 3


def test_not_one_burst_that_a_clinician_would_call_wrong(replays: Replays) -> None:
    """Standing, weight shifts, turning, heels lifted, sitting, and ten strides between: stimulated in these only."""
    record = replays.of("not_walking")
    with (TRIALS / "not_walking.activities.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    moving = [
        (float(row["start_s"]), float(row["end_s"]))
        for row in rows
        if row["walking"] == "yes" or row["activity"].startswith("treadmill")
    ]
    assert channels_of(record) == [0, 1]
    for channel in (0, 1):
        mine = bursts(record.commands, channel)
        assert 6 <= len(mine) <= 10
        assert all(inside(burst, truth("not_walking", FEET[channel])) for burst in mine)
        first_s, last_s = mine[0].t_on_ns / NS_PER_S, mine[-1].t_off_ns / NS_PER_S
        assert moving[0][0] < first_s < last_s < moving[-1][1]


@pytest.mark.requirement("SR-02")
@pytest.mark.parametrize("name", [*WALKING, "soft_contact", "not_walking"])
def test_on_only_in_the_phases_asked_for(replays: Replays, name: str) -> None:
    """By the phases as they were found, to the sample: nothing is on in a stance that has been seen."""
    record = replays.of(name)
    for channel in channels_of(record):
        changes = [change for change in record.phases if change.foot == FEET[channel]]
        times = np.array([change.t_ns for change in changes])
        # both feet are sampled at the same instants: what counts is a channel's last command at each
        last = {command.t_ns: command for command in record.commands if command.channel == channel}
        for t_ns, command in last.items():
            newest = changes[max(int(np.searchsorted(times, t_ns, side="right")) - 1, 0)]
            assert not (command.on and newest.destination.name == "STANCE")


@pytest.mark.requirement("SR-20")
def test_a_replay_repeated_is_the_same(replays: Replays, tmp_path: Path) -> None:
    again = replay(TRIALS / "example_csv.csv", tmp_path)
    assert same_outputs(again, replays.of("example_csv"))
    assert len(again.commands) > 500


def test_cutting_off_the_end_changes_nothing_before(replays: Replays, tmp_path: Path) -> None:
    """What is decided depends on what has come, not on what will come (calibration apart, from the first minute)."""
    path = tmp_path / "cut.parquet"
    write_recording(cut(trial("both_feet_100hz"), 0.0, 61.0), path)
    settings = tmp_path / "both.toml"
    settings.write_text(both_feet(SETTINGS.read_text()))
    shorter, whole = replay(path, tmp_path, settings), replays.of("both_feet_100hz")
    n = sum(command.t_ns < 60 * NS_PER_S for command in whole.commands)
    assert shorter.commands[:n] == whole.commands[:n]


# --- the session log, replayed ------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("log")
    replay(TRIALS / "example_csv.csv", out)
    return out / "example_csv-001" / "session.feslog"


@pytest.mark.requirement("SR-20")
def test_a_log_gives_the_same_bytes(log: Path) -> None:
    record = read_session(log)
    again = repeat(log)
    assert again.difference == ""
    assert again.commands == len(record.commands) > 500
    assert again.strides == len(record.strides) > 3


def test_a_log_changed_by_nothing_is_the_same(log: Path, tmp_path: Path) -> None:
    same = rewritten(log, tmp_path / "same.feslog", lambda kind, payload: payload)
    assert same.read_bytes() == log.read_bytes()


@pytest.mark.parametrize("moved_mps2", [0.5, 50.0])
def test_one_changed_sample_shows(log: Path, tmp_path: Path, moved_mps2: float) -> None:
    at_ns = next(change.t_ns for change in read_session(log).phases if change.destination.name == "SWING")

    def move(sample: ImuSample) -> ImuSample:
        x, y, z = sample.acc_mps2
        return sample._replace(acc_mps2=(x + moved_mps2, y, z))

    changed = rewritten(log, tmp_path / "changed.feslog", one_sample_changed(move, at_ns))
    assert "recorded" in repeat(changed).difference


def test_a_changed_command_shows(log: Path, tmp_path: Path) -> None:
    on = next(frame for frame, command in _frames_and_commands(log) if command.on)

    def louder(kind: int, payload: bytes) -> bytes:
        return (
            payload.replace(on.data, bytes([*on.data[:-1], on.data[-1] ^ 1])) if kind == RecordType.FRAME else payload
        )

    changed = rewritten(log, tmp_path / "changed.feslog", louder)
    assert on.data.hex() in repeat(changed).difference


def _frames_and_commands(log: Path) -> list[tuple[Any, Any]]:
    record = read_session(log)
    frames = [frame for frame in record.frames if frame.identifier == 0x120] or record.frames[1:]
    return list(zip(frames[-len(record.commands) :], record.commands, strict=True))


@pytest.mark.parametrize("share", [0.2, 0.5, 0.93, 0.999])
def test_a_torn_log_is_compared_up_to_its_tear(log: Path, tmp_path: Path, share: float) -> None:
    whole = log.read_bytes()
    torn = tmp_path / "torn.feslog"
    torn.write_bytes(whole[: int(share * len(whole))])
    again = repeat(torn)
    assert again.difference == ""
    assert not read_session(torn).complete
    if share > 0.4:
        assert 0 < again.commands <= repeat(log).commands


def test_a_torn_and_tampered_log_shows_too(log: Path, tmp_path: Path) -> None:
    at_ns = next(change.t_ns for change in read_session(log).phases if change.destination.name == "PRE_SWING")
    gone = one_sample_changed(lambda sample: sample._replace(gyr_radps=(9.0, 9.0, 9.0)), at_ns - 200 * MS)
    changed = rewritten(log, tmp_path / "changed.feslog", gone)
    changed.write_bytes(changed.read_bytes()[:-5000])
    assert repeat(changed).difference


def test_a_log_of_another_version_says_so(log: Path, tmp_path: Path) -> None:
    def older(kind: int, payload: bytes) -> bytes:
        return payload.replace(b"gyr_bias_radps", b"gyr_bias_degps") if kind == RecordType.HEADER else payload

    with pytest.raises(SessionLogError, match=r"cannot be replayed by fes .*replay its recording"):
        repeat(rewritten(log, tmp_path / "older.feslog", older))


def test_a_log_whose_session_sets_a_threshold_that_is_gone_says_which(log: Path, tmp_path: Path) -> None:
    """Its numbers are still there: only a replay needs the rule."""

    def older(kind: int, payload: bytes) -> bytes:
        set_there = {"struck_share": 0.03}
        if kind != RecordType.HEADER:
            return payload
        header = json.loads(payload)
        return json.dumps({**header, "session": {**header["session"], "thresholds": set_there}}).encode()

    old = rewritten(log, tmp_path / "older.feslog", older)
    with pytest.raises(ConfigError, match=r"older\.feslog: .*struck_share is no threshold"):
        repeat(old)
    assert summarise(read_session(old)).feet


# --- preparing ----------------------------------------------------------------------------------------------


def test_the_same_inputs_have_the_same_identity() -> None:
    session = load_session(SETTINGS)
    one = identity("ab", session)
    assert one == identity("ab", session) != identity("cd", session)
    assert one != identity("ab", session.model_copy(update={"name": "another"}))
    numbers = [identity(str(n), session) for n in range(500)]
    assert all(1 <= value <= 65535 for each in numbers for value in (each.session_id, each.boot_id))
    assert len({each.session_id for each in numbers}) > 490


def test_a_recording_completes_the_settings() -> None:
    recording = trial("example_csv")
    session = session_for(recording, load_session(SETTINGS))
    assert session.subject == "simulated"
    assert session.treadmill is not None
    assert session.treadmill.belt_speed_mps == recording.belt_speed_mps
    assert set(session.geometry) == set(recording.geometry)
    assert session_for(recording, None).channels == ()


def test_the_ground_is_the_recordings_unless_the_session_says_it() -> None:
    said = load_session(SETTINGS)
    uphill = replace(trial("example_csv"), ground=Ground(incline_percent=10.0))
    on_purpose = validate_session(said.model_dump(exclude_unset=True) | {"ground": {}}, SETTINGS)
    assert session_for(uphill, said).ground == session_for(uphill, None).ground == uphill.ground
    assert session_for(uphill, session_with(said, Point(), SETTINGS)).ground == uphill.ground
    assert session_for(uphill, on_purpose).ground == Ground()
    assert session_for(uphill, session_with(on_purpose, Point(), SETTINGS)).ground == Ground()
    assert session_for(trial("example_csv"), said).ground == Ground()


def test_a_replay_calibrates_on_the_ground_that_was_walked_on(tmp_path: Path) -> None:
    path = tmp_path / "walk.csv"
    write_recording(trial("example_csv"), path)
    level = prepared(path, SETTINGS, None).found.calibrations
    sidecar = path.with_suffix(".toml")
    sidecar.write_text(f"ground = {{ incline_percent = 10.0 }}\n{sidecar.read_text()}")
    uphill = prepared(path, SETTINGS, None)
    track = uphill.recording.tracks["right_foot"]
    assert level["right_foot"] == calibrate_track(track)
    assert uphill.found.calibrations["right_foot"] == calibrate_track(track, incline=0.1) != calibrate_track(track)
    assert replay(path, tmp_path).header["session"]["ground"]["incline_percent"] == 10.0


def test_channels_without_a_sensor_are_left_out_with_their_antagonists() -> None:
    data = tomllib.loads(both_feet(SETTINGS.read_text()))
    for channel, other in zip(data["channels"], (1, 0), strict=True):
        channel["never_with"] = [other]
    session = session_for(trial("example_csv"), validate_session(data, SETTINGS))
    assert [channel.number for channel in session.channels] == [0]
    assert session.channels[0].never_with == ()


def test_no_walking_cannot_be_calibrated() -> None:
    with pytest.raises(CalibrationError, match=r"example_csv\.csv: right_foot: .*strides"):
        calibrate_phase_sensors(cut(trial("example_csv"), 0.0, 4.0))
    nothing = replace(trial("example_csv"), tracks={})
    with pytest.raises(CalibrationError, match="none of the sensors"):
        calibrate_phase_sensors(nothing)


def test_a_silence_of_an_hour_is_refused_with_its_place() -> None:
    def set_clock(track: Any) -> Any:
        later = track.t_ns + 3600 * NS_PER_S * (track.t_ns > 10 * NS_PER_S)
        return replace(track, t_ns=later, t_sensor_ns=later)

    recording = trial("example_csv")
    refuse_long_silence(recording)
    with pytest.raises(RecordingError, match=r"nothing from 10\.0\d+ s to 3610\.0\d+ s.*cut the recording"):
        refuse_long_silence(edit(recording, set_clock))


def test_results_never_overwrite_one_another(tmp_path: Path) -> None:
    for _ in range(3):
        replay(TRIALS / "example_csv.csv", tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == [f"example_csv-00{n}" for n in (1, 2, 3)]
