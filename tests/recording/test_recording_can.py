"""CAN logs with their DBC are recordings."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import can
import cantools
import numpy as np
import pytest
from test_recording import walk

from fes.recording import RecordingError, read_recording, sidecar_template

DBC = """VERSION ""
NS_ :
BS_:
BU_: IMU
"""
DBC += "\n".join(
    f"""BO_ {number} {side}{kind}: 6 IMU
"""
    + "\n".join(
        f' SG_ {axis} : {16 * place}|16@1- ({factor},0) [0|0] "" Vector__XXX' for place, axis in enumerate("xyz")
    )
    + "\n"
    for number, side, kind, factor in (
        (257, "Left", "Acc", "0.01"),
        (258, "Left", "Gyr", "0.001"),
        (2566914049, "Right", "Acc", "0.01"),
        (2566914050, "Right", "Gyr", "0.001"),
    )
)
SIDECAR = """
acc_unit = "m/s^2"
gyr_unit = "rad/s"
belt_speed_mps = 0.9
[can]
dbc = "imu.dbc"
"""
for _side in ("Left", "Right"):
    SIDECAR += f"[sensors.{_side.lower()}_foot]\n"
    SIDECAR += f'acc = ["{_side}Acc.x", "{_side}Acc.y", "{_side}Acc.z"]\n'
    SIDECAR += f'gyr = ["{_side}Gyr.x", "{_side}Gyr.y", "{_side}Gyr.z"]\n'


def log(folder: Path, suffix: str, skip: Callable[[str, int], bool] = lambda message, number: False) -> Path:
    path = folder / f"walk{suffix}"
    (folder / "imu.dbc").write_text(DBC)
    path.with_suffix(".toml").write_text(SIDECAR)
    database = cantools.database.load_string(DBC)
    with can.Logger(path) as writer:
        for number in range(400):
            for side in ("Left", "Right"):
                track = walk(f"{side.lower()}_foot")
                for offset, (kind, values) in enumerate((("Acc", track.acc_mps2), ("Gyr", track.gyr_radps))):
                    message = database.get_message_by_name(f"{side}{kind}")
                    if skip(message.name, number):
                        continue
                    data = message.encode(dict(zip("xyz", values[number].tolist(), strict=True)))
                    time_s = 1_700_000_000.0 + number * 0.01 + offset * 0.001
                    writer(can.Message(time_s, message.frame_id, is_extended_id=message.is_extended_frame, data=data))
            writer(can.Message(1_700_000_000.0 + number * 0.01 + 0.002, 0x700, is_extended_id=False, data=b"other"))
    return path


@pytest.mark.parametrize("suffix", [".asc", ".blf", ".log"])
def test_each_format_gives_the_samples(tmp_path: Path, suffix: str) -> None:
    recording = read_recording(log(tmp_path, suffix))
    assert list(recording.tracks) == ["left_foot", "right_foot"]
    assert recording.belt_speed_mps == 0.9
    for sensor, track in recording.tracks.items():
        made = walk(sensor)
        np.testing.assert_allclose(track.acc_mps2, made.acc_mps2, atol=0.0051)
        np.testing.assert_allclose(track.gyr_radps, made.gyr_radps, atol=0.00051)
        np.testing.assert_allclose(track.t_ns, made.t_ns + 1_000_000, atol=2_000)  # formats keep microseconds
        assert track.rate_hz == pytest.approx(100.0, rel=1e-3)
        assert (track.quality.missing, track.quality.irregular) == (0, 0)


def test_lost_frames_are_counted_and_halves_never_mixed(tmp_path: Path) -> None:
    path = log(tmp_path, ".blf", skip=lambda name, number: (name, number) in {("LeftAcc", 50), ("LeftGyr", 90)})
    track = read_recording(path).tracks["left_foot"]
    assert (track.quality.samples, track.quality.missing) == (398, 2)
    made = walk("left_foot")
    keep = [number for number in range(400) if number not in (50, 90)]
    expected = made.acc_mps2[keep]
    np.testing.assert_allclose(track.acc_mps2, expected, atol=0.0051)
    np.testing.assert_allclose(track.gyr_radps, made.gyr_radps[keep], atol=0.00051)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("LeftAcc.x", "LeftAcc.X", r"left_foot: imu\.dbc has no 'LeftAcc\.X'.*Did you mean .*'LeftAcc\.x'"),
        ("LeftAcc.x", "speed", r"names are Message\.Signal"),
        ("imu.dbc", "other.dbc", r"other\.dbc: cannot be read.*sought beside the sidecar"),
        ('[can]\ndbc = "imu.dbc"', "rate_hz = 100", r"is a CAN log: say \[can\]"),
        ("belt_speed_mps = 0.9", 'time_column = "t"', "a CAN log has its own times"),
        ('"m/s^2"', '"g"', 'set acc_unit = "m/s\\^2"'),
    ],
)
def test_a_sidecar_that_does_not_fit(tmp_path: Path, old: str, new: str, message: str) -> None:
    path = log(tmp_path, ".asc")
    path.with_suffix(".toml").write_text(SIDECAR.replace(old, new))
    with pytest.raises(RecordingError, match=message):
        read_recording(path)


def test_damaged_files(tmp_path: Path) -> None:
    path = log(tmp_path, ".blf")
    (tmp_path / "imu.dbc").write_text("no dbc")
    with pytest.raises(RecordingError, match=r"imu\.dbc: is no DBC"):
        read_recording(path)
    (tmp_path / "imu.dbc").write_text(DBC.replace("LeftAcc: 6", "LeftAcc: 8"))
    with pytest.raises(RecordingError, match=r"frame 1 \(identifier 0x101, 6 bytes\) does not fit message LeftAcc"):
        read_recording(path)
    path.write_bytes(b"not a blf file at all, but long enough to look at")
    with pytest.raises(RecordingError, match="cannot be read as a CAN log"):
        read_recording(path)


def test_a_log_without_the_sensor(tmp_path: Path) -> None:
    path = log(tmp_path, ".asc", skip=lambda name, number: name.startswith("Right"))
    with pytest.raises(RecordingError, match="right_foot: no frame of RightAcc, RightGyr came"):
        read_recording(path)


def test_the_proposal_takes_the_dbc_that_lies_beside_the_log(tmp_path: Path) -> None:
    path = log(tmp_path, ".asc")
    before = read_recording(path).tracks
    path.with_suffix(".toml").unlink()
    with_units = DBC
    for kind, unit in (("Acc", "m/s^2"), ("Gyr", "rad/s")):
        head, *rest = with_units.split(f"{kind}: 6 IMU")
        with_units = head + "".join(f"{kind}: 6 IMU" + part.replace('""', f'"{unit}"', 3) for part in rest)
    (tmp_path / "imu.dbc").write_text(with_units)
    proposal = sidecar_template(path)
    assert "?" not in proposal
    path.with_suffix(".toml").write_text(proposal)
    for sensor, track in read_recording(path).tracks.items():
        np.testing.assert_array_equal(track.acc_mps2, before[sensor].acc_mps2)
    (tmp_path / "other.dbc").write_text(DBC)
    assert 'dbc = "sensors.dbc"  # ? beside' in sidecar_template(path), "of two nobody knows which"
