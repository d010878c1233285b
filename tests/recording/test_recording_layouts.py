"""Files as devices write them: names and heads from the vendors' documentation or from published files, made walks.

The sources stand in docs/recordings.md. Each is read from its proposal alone, or with one answer.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from test_recording import walk
from test_recording_template import accept

from fes.recording import RecordingError, Track, read_recording, sidecar_template
from fes.signals import G_MPS2

TRACK = walk(seconds=20.0)
DEGREES = np.degrees(TRACK.gyr_radps)
N = np.arange(TRACK.t_ns.size)
ACC, GYR = ([f"{kind}_{axis}" for axis in "XYZ"] for kind in ("Acc", "Gyr"))


def text_of(head: str, columns: list[np.ndarray], separator: str, end: str = "") -> str:
    data = np.column_stack(columns)
    return head + "".join(separator.join(f"{value:.15g}" for value in row) + end + "\n" for row in data.tolist())


MT_HEAD = (
    "// Start Time: Unknown\n// Update Rate: 100.0Hz\n// Filter Profile: human (46.1)\n"
    "// Option Flags: AHS Disabled ICC Disabled\n// Firmware Version: 4.0.2\n"
)
DOT_HEAD = (
    "sep=,\nDeviceTag:,Xsens DOT\nFirmwareVersion:,2.0.0\nAppVersion:,v2021.0\nSyncStatus:,Synced\n"
    "OutputRate:,60Hz\nFilterProfile:,General\nMeasurement Mode:,Extended (Quaternion)\n"
)
XIO = [f"{kind} {axis} ({unit})" for kind, unit in (("Gyroscope", "deg/s"), ("Accelerometer", "g")) for axis in "XYZ"]
SHIMMER = [f"Shimmer_B663_{name}_CAL" for name in (
    "Timestamp_Unix", *(f"{kind}_{a}" for kind in ("Accel_LN", "Accel_WR", "Gyro") for a in "XYZ"),
)]  # fmt: skip
GERMAN = ["Zeit [s]", *(f"Beschl. {a} [m/s²]" for a in "XYZ"), *(f"Drehrate {a} [°/s]" for a in "XYZ")]
LAYOUTS = {
    "mt_manager-000_00B42D4D": (
        text_of(
            MT_HEAD + "\t".join(["PacketCounter", "SampleTimeFine", *ACC, *GYR]) + "\n",
            [64_000 + N, 100 * N, TRACK.acc_mps2, TRACK.gyr_radps], "\t",
        ), ".txt",
    ),
    "dot_1": (
        text_of(
            DOT_HEAD + ",".join(["PacketCounter", "SampleTimeFine", *ACC, *GYR, "Status"]) + "\n",
            [N, 2_000_000 + 10_000 * N, TRACK.acc_mps2, DEGREES, 0 * N], ",",
        ).replace("60Hz", "100Hz"), ".csv",
    ),
    "Inertial": (
        text_of(",".join(["Timestamp (us)", *XIO]) + "\n", [10_000 * N, DEGREES, TRACK.acc_mps2 / G_MPS2], ","), ".csv",
    ),
    "Session1_Shimmer_B663_Calibrated_SD": (
        text_of(
            "\"sep=\t\"\n" + "\t".join(SHIMMER) + "\t\n" + "\t".join(["ms", *6 * ["m/(s^2)"], *3 * ["deg/s"]]) + "\t\n",
            [1.6e12 + 10.0 * N, TRACK.acc_mps2, TRACK.acc_mps2, DEGREES], "\t", "\t",
        ), ".csv",
    ),
    "german": (
        ";".join(GERMAN) + "\n" + text_of("", [N / 100, TRACK.acc_mps2, DEGREES], ";").replace(".", ","), ".csv",
    ),
}  # fmt: skip


def questions_of(path: Path) -> list[str]:
    return [line for line in sidecar_template(path).split("\n") if "?" in line and not line.startswith("# ")]


@pytest.mark.parametrize("name", LAYOUTS)
def test_each_layout_asks_for_the_side_alone(tmp_path: Path, name: str) -> None:
    content, suffix = LAYOUTS[name]
    (tmp_path / f"{name}{suffix}").write_text(content, encoding="utf-8")
    assert len(questions_of(tmp_path / f"{name}{suffix}")) == 1
    track = accept(tmp_path / f"{name}{suffix}").tracks["left_foot"]
    np.testing.assert_allclose(track.acc_mps2, TRACK.acc_mps2, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(track.gyr_radps, TRACK.gyr_radps, rtol=1e-6, atol=1e-6)
    assert track.rate_hz == pytest.approx(100.0, rel=1e-3)


@pytest.mark.parametrize("side", ["lf", "L_Foot", "links"])
def test_short_sides_in_the_file_s_name_leave_no_question(tmp_path: Path, side: str) -> None:
    path = tmp_path / f"walk_{side}.txt"
    path.write_text(LAYOUTS["mt_manager-000_00B42D4D"][0])
    assert not questions_of(path)
    assert list(accept(path).tracks) == ["left_foot"]


def chunk(tag: int, content: bytes) -> bytes:
    return b"\x04" + struct.pack("<IH", len(content) + 2, tag) + content


def xdf_stream(number: int, name: str, labels: list[str], rows: np.ndarray, t_s: np.ndarray) -> bytes:
    channels = "".join(f"<channel><label>{label}</label></channel>" for label in labels)
    head = (
        f"<?xml version='1.0'?><info><name>{name}</name><type>IMU</type><channel_count>{rows.shape[1]}</channel_count>"
    )
    head += f"<nominal_srate>100</nominal_srate><channel_format>double64</channel_format><desc><channels>{channels}"
    head += "</channels></desc></info>"
    samples = b"".join(
        b"\x08" + struct.pack("<d", t) + row.astype("<f8").tobytes() for t, row in zip(t_s, rows, strict=True)
    )
    identity = struct.pack("<I", number)
    made = chunk(2, identity + head.encode()) + chunk(3, identity + b"\x04" + struct.pack("<I", len(rows)) + samples)
    return made + chunk(6, identity + b"<?xml version='1.0'?><info></info>")


def test_both_feet_of_an_xdf_file_are_read_as_they_are(tmp_path: Path) -> None:
    pytest.importorskip("pyxdf", reason="pip install 'fes-gait[xdf]'")
    labels = [f"{kind}_{axis}" for kind in ("acc", "gyr") for axis in "xyz"]
    content, feet = b"XDF:" + chunk(1, b"<?xml version='1.0'?><info><version>1.0</version></info>"), {}
    for number, foot in enumerate(("left_foot", "right_foot"), start=1):
        track: Track = walk(foot, seconds=20.0 + number)
        t_s = 1000.0 + 0.123 * number + np.arange(track.t_ns.size) / 100
        feet[foot] = track
        content += xdf_stream(number, foot, labels, np.hstack([track.acc_mps2, track.gyr_radps]), t_s)
    path = tmp_path / "walk.xdf"
    path.write_bytes(content)
    assert not questions_of(path)
    read = accept(path)
    for foot, track in feet.items():
        np.testing.assert_allclose(read.tracks[foot].acc_mps2, track.acc_mps2, rtol=1e-9)
        assert read.tracks[foot].quality.missing == 0
    assert (read.tracks["right_foot"].t_ns[0] - read.tracks["left_foot"].t_ns[0]) * 1e-9 == pytest.approx(
        0.123, abs=1e-3
    )
    sidecar = path.with_suffix(".toml")
    sidecar.write_text(sidecar.read_text().replace('gyr = ["left_foot.gyr_x"', 'gyr = ["right_foot.gyr_x"', 1))
    with pytest.raises(RecordingError, match=r"given to|must be of one stream"):
        read_recording(path)
    (tmp_path / "cut.xdf").write_bytes(content[:900])
    with pytest.raises(RecordingError, match=r"cannot be read as XDF|holds no stream"):
        read_recording(tmp_path / "cut.xdf")


def test_apdm_s_sensors_are_known_by_their_labels(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py", reason="pip install 'fes-gait[apdm]'")
    path = tmp_path / "20240312-101500-Walk.h5"
    with h5py.File(path, "w") as file:
        for number, label in (("1031", "Left Foot"), ("1044", "Right Foot"), ("1050", "Lumbar")):
            sensor = file.create_group(f"Sensors/{number}")
            sensor["Accelerometer"], sensor["Gyroscope"] = TRACK.acc_mps2, TRACK.gyr_radps
            sensor["Magnetometer"], sensor["Time"] = 0 * TRACK.acc_mps2, 1_700_000_000_000_000 + 10_000 * N
            sensor.create_group("Configuration").attrs["Label 0"] = np.bytes_(label)
    text = sidecar_template(path)
    assert "[sensors.left_foot]" in text
    assert "[sensors.right_foot]" in text
    assert not questions_of(path), "what is worn elsewhere than on a leg is left out"
    read = accept(path)
    np.testing.assert_array_equal(read.tracks["right_foot"].acc_mps2, TRACK.acc_mps2)


def test_apdm_s_older_files_name_their_sensors_at_the_root(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py", reason="pip install 'fes-gait[apdm]'")
    path = tmp_path / "20150312-101500.h5"
    numbers = [b"SI-000123", b"SI-000124", b"SI-000125"]
    with h5py.File(path, "w") as file:
        file.attrs["FileFormatVersion"] = 4
        file.attrs["CaseIdList"] = np.array(numbers)
        file.attrs["MonitorLabelList"] = np.array([b"Right Foot      ", b"Lumbar", b"Left Foot"])
        for scale, number in enumerate(numbers, start=1):
            calibrated = file.create_group(f"{number.decode()}/Calibrated")
            calibrated["Accelerometers"], calibrated["Gyroscopes"] = TRACK.acc_mps2, TRACK.gyr_radps * scale / 3
            file[number.decode()]["Time"] = 1_400_000_000_000_000 + 10_000 * N
    assert not questions_of(path)
    read = accept(path)
    np.testing.assert_allclose(read.tracks["left_foot"].gyr_radps, TRACK.gyr_radps)
    np.testing.assert_allclose(read.tracks["right_foot"].gyr_radps, TRACK.gyr_radps / 3)
    np.testing.assert_array_equal(read.tracks["left_foot"].acc_mps2, TRACK.acc_mps2)


def mvnx(path: Path, free: np.ndarray, q: np.ndarray, rate_hz: int = 100) -> Path:
    """A file as MVN writes it, every tracker alike; frames in which the body poses for the model come first."""
    labels = ("Pelvis", "RightLowerLeg", "RightFoot", "LeftLowerLeg", "LeftFoot")
    sensors = "".join(f'<sensor label="{label}"/>' for label in labels)
    frames = []
    for k, (a, w) in enumerate(zip(free.tolist(), q.tolist(), strict=True)):
        texts = {"sensorFreeAcceleration": a * len(labels), "sensorOrientation": w * len(labels)}
        inside = "".join(f"<{name}>{' '.join(f'{v:.9f}' for v in own)}</{name}>" for name, own in texts.items())
        frames.append(f'<frame time="{10 * k}" index="{k}" tc="00:00:00:00" ms="0" type="normal">{inside}</frame>')
    pose = '<frame time="0" index="" tc="" ms="0" type="tpose"><orientation>1 0 0 0</orientation></frame>'
    path.write_text(
        '<?xml version="1.0" encoding="UTF-8"?>\n<mvnx version="4" xmlns="http://www.xsens.com/mvn/mvnx">'
        f'<subject label="S1" frameRate="{rate_hz}" segmentCount="23"><sensors>{sensors}</sensors>'
        f'<frames segmentCount="23">{pose}{"".join(frames)}</frames></subject></mvnx>'
    )
    return path


def test_mvn_s_trackers_are_turned_back_into_what_they_sensed(tmp_path: Path) -> None:
    q, free = np.empty((N.size, 4)), np.empty((N.size, 3))
    now = np.array([1.0, 0.0, 0.0, 0.0])
    for k, (acc, gyr) in enumerate(zip(TRACK.acc_mps2, TRACK.gyr_radps, strict=True)):
        w, v = now[0], now[1:]
        q[k] = now
        free[k] = acc + 2.0 * np.cross(v, np.cross(v, acc) + w * acc) - [0.0, 0.0, G_MPS2]
        half = 0.01 * (gyr + TRACK.gyr_radps[min(k + 1, N.size - 1)]) / 4.0
        c, s = 1.0, half
        now = np.array([w * c - v @ s, *(w * s + c * v + np.cross(v, s))])
        now /= np.linalg.norm(now)
    path = mvnx(tmp_path / "walk.mvnx", free, q)
    assert not questions_of(path)
    read = accept(path)
    assert set(read.tracks) >= {"left_foot", "right_foot"}
    track = read.tracks["left_foot"]
    np.testing.assert_allclose(track.acc_mps2, TRACK.acc_mps2, atol=1e-6)
    assert np.sqrt(np.mean((track.gyr_radps - TRACK.gyr_radps) ** 2)) < 0.03 * np.sqrt(np.mean(TRACK.gyr_radps**2))
    assert track.rate_hz == pytest.approx(100.0)


def test_mvn_without_the_trackers_own_data_says_what_to_export(tmp_path: Path) -> None:
    path = mvnx(tmp_path / "walk.mvnx", np.zeros((200, 3)), np.tile([1.0, 0.0, 0.0, 0.0], (200, 1)))
    path.write_text(path.read_text().replace("sensorFreeAcceleration", "sensorMagneticField"))
    with pytest.raises(RecordingError, match="has no sensorFreeAcceleration: export it with all data of the sensors"):
        sidecar_template(path)
