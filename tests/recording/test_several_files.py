"""A sensor whose accelerometer and gyroscope are files of their own, as phones write them: made walks, published heads.

The heads are Sensor Logger's and phyphox's (fes/recording/several_files.py has the sources). The two files have stamps
and rates of their own.
"""

from __future__ import annotations

import re
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import pytest
from test_recording import walk

import fes
from fes.recording import RecordingError, Track, read_recording, sidecar_template
from fes.recording import several_files as module
from fes.recording.units import repaired

FINE = walk(seconds=20.0, rate_hz=1000.0)
EPOCH_NS = 1_790_000_000_000_000_000
HEAD = "time,seconds_elapsed,z,y,x\n"
ABOUT = "version,device name,platform,appVersion,sampleRateMs,standardisation\n3,Phone,{},1.64,10|10,{}\n"
Rows = tuple[np.ndarray, np.ndarray]


def at(values: np.ndarray, begin_s: float, rate_hz: float) -> Rows:
    """Times and values as a file of such a rate would have them."""
    t_s = np.arange(begin_s, 19.9, 1.0 / rate_hz)
    return t_s, np.column_stack([np.interp(t_s, FINE.t_ns * 1e-9, axis) for axis in values.T])


ACC, GYR = at(FINE.acc_mps2, 0.013, 100.0), at(FINE.gyr_radps, 0.004, 97.0)
GRAVITY = (ACC[0], np.tile([0.0, 0.0, 9.80665], (ACC[0].size, 1)))


def logged(rows: Rows, sign: float = 1.0, elapsed: bool = True) -> str:
    lines = (
        f"{EPOCH_NS + round(t_s * 1e9)},{t_s:.9f},{','.join(f'{sign * v:.9f}' for v in xyz[::-1])}"
        for t_s, xyz in zip(*rows, strict=True)
    )
    return HEAD + "\n".join(lines) + "\n"


def phyphox(rows: Rows, kind: str, unit: str) -> str:
    head = ",".join(['"Time (s)"', *(f'"{kind} {axis} ({unit})"' for axis in "xyz")])
    lines = (f"{t_s:.9E}," + ",".join(f"{v:.9E}" for v in xyz) for t_s, xyz in zip(*rows, strict=True))
    return head + "\n" + "\n".join(lines) + "\n"


LINEAR = (ACC[0], ACC[1] - GRAVITY[1])
GYROSCOPE = {"Gyroscope.csv": logged(GYR)}
ANDROID = {"TotalAcceleration.csv": logged(ACC), "Accelerometer.csv": logged(LINEAR), **GYROSCOPE}
IPHONE = {"Accelerometer.csv": logged(LINEAR, -1.0), "Gravity.csv": logged(GRAVITY, -1.0), **GYROSCOPE}
RAW_G = {
    "Accelerometer.csv": logged(LINEAR, -1.0),
    "AccelerometerUncalibrated.csv": logged((ACC[0], ACC[1] / 9.80665), -1.0),
}
META = "Metadata.csv"
PHONES: dict[str, Mapping[str, str]] = {
    "android": {**ANDROID, META: ABOUT.format("android", "false")},
    "iphone": {**IPHONE, META: ABOUT.format("ios", "false")},
    "iphone, standardised": {
        "Accelerometer.csv": logged(LINEAR), "Gravity.csv": logged(GRAVITY), **GYROSCOPE,
        META: ABOUT.format("iOS", "true"),
    },
    "iphone, raw in g": {**RAW_G, **GYROSCOPE, META: ABOUT.format("ios", "false")},
    "phyphox": {
        "Accelerometer.csv": phyphox(ACC, "Acceleration", "m/s^2"), "Gyroscope.csv": phyphox(GYR, "Gyroscope", "rad/s"),
        "Linear Accelerometer.csv": phyphox(LINEAR, "Linear Acceleration", "m/s^2"),
        "meta/device.csv": '"property","value"\n"deviceModel","x"\n',
        "meta/time.csv": '"event","experiment time"\n"START",0\n',
    },
    "two of one name": {
        "MW_C8_Accelerometer.csv": "epoch (ms),x-axis (g),y-axis (g),z-axis (g)\n" + "\n".join(
            f"{1000 * t:.3f},{','.join(f'{v / 9.80665:.7f}' for v in xyz)}" for t, xyz in zip(*ACC, strict=True)),
        "MW_C8_Gyroscope.csv": "epoch (ms),x-axis (deg/s),y-axis (deg/s),z-axis (deg/s)\n" + "\n".join(
            f"{1000 * t:.3f},{','.join(f'{np.degrees(v):.6f}' for v in xyz)}" for t, xyz in zip(*GYR, strict=True)),
    },
}  # fmt: skip


def folder_of(path: Path, files: Mapping[str, str]) -> Path:
    for name, text in files.items():
        (path / name).parent.mkdir(parents=True, exist_ok=True)
        (path / name).write_text(text, encoding="utf-8")
    return path


def zip_of(path: Path, files: Mapping[str, str | bytes], inside: str = "") -> Path:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, text in files.items():
            archive.writestr(f"{inside}{name}", text)
    return path


def read(path: Path, sidecar: Path | None = None, **changes: str) -> Track:
    """As a user does: the proposal, its one question answered."""
    template = sidecar_template(path)
    assert template.count("?") - template.count("? which") <= 1, template
    template = template.replace('[sensors."?"]', "[sensors.left_foot]")
    for before, after in changes.items():
        template = template.replace(before, after)
    (sidecar or path.with_suffix(".toml")).write_text(template, encoding="utf-8")
    return read_recording(path).tracks["left_foot"]


def judge(track: Track, rows: Rows = ACC) -> None:
    """What was read is what was recorded, on one clock."""
    t_s = (track.t_sensor_ns - track.t_sensor_ns[0]) * 1e-9 + rows[0][
        np.searchsorted(rows[0], max(ACC[0][0], GYR[0][0]) - 1e-9)
    ]
    inner = slice(10, -10)
    for values, true, allowed in ((track.acc_mps2, FINE.acc_mps2, 0.2), (track.gyr_radps, FINE.gyr_radps, 0.1)):
        expected = np.column_stack([np.interp(t_s, FINE.t_ns * 1e-9, axis) for axis in true.T])
        assert np.sqrt(np.mean((values - expected)[inner] ** 2)) < allowed
    assert abs(track.rate_hz - 100.0) < 0.1
    assert track.quality.missing == 0


@pytest.mark.parametrize("name", PHONES)
@pytest.mark.parametrize("packed", [False, True])
def test_a_phone_is_read_from_its_proposal(tmp_path: Path, name: str, packed: bool) -> None:
    path = zip_of(tmp_path / "left.zip", PHONES[name]) if packed else folder_of(tmp_path / "left", PHONES[name])
    track = read(path)
    judge(track)


@pytest.mark.parametrize("inside", ["2026-09-21_14-13-20/", "a/b/", "walk\\"])
def test_a_zip_with_a_folder_in_it(tmp_path: Path, inside: str) -> None:
    path = zip_of(tmp_path / "w.zip", {**PHONES["iphone"], "._Gyroscope.csv": "x"}, inside)
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("__MACOSX/._Accelerometer.csv", b"\0\0")
    judge(read(path))


def test_a_folder_with_points_in_its_name_and_one_inside(tmp_path: Path) -> None:
    path = folder_of(tmp_path / "21.09.2026" / "export", PHONES["android"]).parent
    judge(read(path, tmp_path / "21.09.2026.toml"))
    assert read_recording(path).path == path


@pytest.mark.parametrize("name", ["MW_C8_Accelerometer.csv", "MW_C8_Gyroscope.csv"])
def test_one_of_two_files_finds_the_other(tmp_path: Path, name: str) -> None:
    folder_of(tmp_path, PHONES["two of one name"])
    folder_of(tmp_path, {"MW_E0_Accelerometer.csv": "x", "MW_E0_Gyroscope.csv": "x"})
    judge(read(tmp_path / name))


def test_a_second_phone_is_a_second_sensor(tmp_path: Path) -> None:
    left, right = (zip_of(tmp_path / f"{side}.zip", PHONES["android"], f"{side}/") for side in ("left", "right"))
    template = sidecar_template(left)
    right_text = template[template.index("[sensors.") :].replace("left_foot]", f'right_foot]\nfile = "{right.name}"')
    left.with_suffix(".toml").write_text(template + right_text, encoding="utf-8")
    tracks = read_recording(left).tracks
    judge(tracks["left_foot"])
    np.testing.assert_array_equal(tracks["right_foot"].acc_mps2, tracks["left_foot"].acc_mps2)


def test_without_the_metadata_the_sign_is_asked(tmp_path: Path) -> None:
    path = folder_of(tmp_path / "left", IPHONE)
    assert 'acc_sign = "?"' in sidecar_template(path)
    path.with_suffix(".toml").write_text(sidecar_template(path), encoding="utf-8")
    with pytest.raises(RecordingError, match="acc_sign"):
        read_recording(path)
    text = sidecar_template(path).replace('acc_sign = "?"', "acc_sign = -1")
    path.with_suffix(".toml").write_text(text, encoding="utf-8")
    judge(read_recording(path).tracks["left_foot"])


def lines_without(text: str, rows: slice) -> str:
    head, *lines = text.splitlines(keepends=True)
    del lines[rows]
    return head + "".join(lines)


@pytest.mark.parametrize(
    ("name", "lost", "missing"),
    [
        ("Gyroscope.csv", slice(500, 550), (50, 56)),
        ("TotalAcceleration.csv", slice(500, 550), (50, 50)),
        ("Gyroscope.csv", slice(700, 701), (1, 3)),
        ("Gyroscope.csv", slice(1000, None), (930, 960)),
        ("Gyroscope.csv", slice(0, 500), (510, 530)),
    ],
)
def test_a_gap_stays_one_and_is_counted(tmp_path: Path, name: str, lost: slice, missing: tuple[int, int]) -> None:
    files = {**ANDROID, name: lines_without(ANDROID[name], lost)}
    track = read(folder_of(tmp_path / "left", files))
    assert missing[0] <= track.quality.missing <= missing[1]
    if lost == slice(500, 550):
        assert np.diff(track.t_sensor_ns).max() * 1e-9 == pytest.approx(0.525, abs=0.02)


def shifted(text: str, row: int, by_ns: int, last: int | None = None) -> str:
    lines = text.splitlines()
    for line in range(row + 1, len(lines) if last == -1 else row + 2):
        stamp, rest = lines[line].split(",", 1)
        lines[line] = f"{int(stamp) + by_ns},{rest}"
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize("by_s", [-3600.0, 5.0, 1e6])
def test_a_single_wild_stamp_in_one_file_is_put_right(tmp_path: Path, by_s: float) -> None:
    files = {**ANDROID, "Gyroscope.csv": shifted(ANDROID["Gyroscope.csv"], 300, round(by_s * 1e9))}
    track = read(folder_of(tmp_path / "left", files))
    assert track.quality.repaired == 1
    judge(track)


BOMB = {"Accelerometer.csv": "0\n" * 200_000, "Gyroscope.csv": "0\n" * 200_000}
TWO = {f"{phone}/{name}": text for phone in ("a", "b") for name, text in ANDROID.items()}


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda p: zip_of(p, {"../Accelerometer.csv": "x", **GYROSCOPE}), r"'\.\./Accelerometer.csv'.*Export"),
        (lambda p: zip_of(p, {**ANDROID, "C:\\x.csv": "x"}), "leads out of its folder"),
        (lambda p: zip_of(p, BOMB), r"would unpack to .* GB, more than .*unpack it yourself and name the folder"),
        (lambda p: p.write_text("time,x,y,z\n") and p, r"cannot be read as a zip: .*Copy or export it again"),
        (lambda p: zip_of(p, ANDROID).write_bytes(p.read_bytes()[:-200]) and p, "cannot be read as a zip"),
        (lambda p: damaged(zip_of(p, ANDROID)), "cannot be read as a zip"),
        (lambda p: zip_of(p, TWO), r"the files of 2 sensors: a/TotalAcceleration.csv .* b/.*name one, .*file = …"),
        (lambda p: zip_of(p, {"notes.txt": "x"}), "does not hold one accelerometer file and one gyroscope file"),
        (lambda p: zip_of(p, {"[Content_Types].xml": "x"}), "is a spreadsheet. Save its table as CSV"),
        (lambda p: zip_of(p, {"Accelerometer.csv": logged(LINEAR), **GYROSCOPE}), "gravity was sub.*switch on Gravity"),
        (lambda p: zip_of(p, {**ANDROID, "Gyroscope.csv": ""}), r"left.zip/Gyroscope.csv: is empty"),
    ],
)  # fmt: skip
def test_a_hostile_zip_is_told_with_what_to_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, make: Callable[[Path], Path], said: str
) -> None:
    if "GB" in said:
        monkeypatch.setattr(module, "MOST_BYTES", 400_000)
    path = make(tmp_path / "left.zip")
    with pytest.raises(RecordingError, match=said) as caught:
        read_recording(path)
    assert "/tmp/tmp" not in str(caught.value)
    assert [each.name for each in tmp_path.iterdir()] == ["left.zip"]


def damaged(path: Path) -> Path:
    data = bytearray(path.read_bytes())
    data[200:260] = bytes(60)
    path.write_bytes(data)
    return path


@pytest.mark.parametrize(
    ("files", "changes", "said"),
    [
        (ANDROID, {"Gyroscope.csv": "none.csv"}, r"none.csv: cannot be read"),
        (ANDROID, {'acc_file = "': 'acc_file = "../'}, "acc_file = '../TotalAcceleration.csv' must be the name alone"),
        (ANDROID, {"gyr_file": "# "}, "gyr_file is missing"),
        (ANDROID, {'time_column = "time"': "rate_hz = 100"}, "which only times bring together: say time_column"),
        ({**ANDROID, "Gyroscope.csv": shifted(GYROSCOPE["Gyroscope.csv"], 0, 10**12, -1)}, {}, "do not overlap"),
        ({**ANDROID, "Gyroscope.csv": shifted(GYROSCOPE["Gyroscope.csv"], 900, -(10**10), -1)}, {}, "jumps back 9.99"),
        ({**ANDROID, "Gyroscope.csv": GYROSCOPE["Gyroscope.csv"].replace(",0.1", ",1e12")}, {}, "is no measurement"),
    ],
)  # fmt: skip
def test_files_that_do_not_fit_each_other(
    tmp_path: Path, files: Mapping[str, str], changes: dict[str, str], said: str
) -> None:
    with pytest.raises(RecordingError, match=said):
        read(folder_of(tmp_path / "left", files), **changes)


def test_a_lag_between_the_files_and_a_repair_are_findings(tmp_path: Path) -> None:
    track = fes.read(fes.bundled_file("both_feet_100hz.parquet")).tracks["left_foot"]
    t_s = (track.t_sensor_ns - track.t_sensor_ns[0]) * 1e-9
    later = shifted(logged((t_s + 0.06, track.gyr_radps)), 100, 10**10)
    files = {"TotalAcceleration.csv": logged((t_s, track.acc_mps2)), "Gyroscope.csv": later}
    path = folder_of(tmp_path / "left", files)
    read(path)
    found = {each.code: each for each in fes.analyse(path).findings}
    assert "1 single time stamp far from the others" in found["stamps"].text
    assert found["lag"].level == "alert"
    early_ms = re.search(r"the accelerometer is (\d+) ± \d+ ms early", found["lag"].text)
    assert early_ms is not None
    assert abs(int(early_ms[1]) - 60) <= 20


USUAL = np.arange(100, dtype=np.int64) * 10_000_000


@pytest.mark.parametrize(
    ("row", "stamp_s", "count"),
    [
        (50, -100.0, 1),
        (50, 1e6, 1),
        (50, 0.4, 1),  # 0.1 s back
        (0, 1e6, 1),
        (0, -1e9, 1),
        (99, 1e6, 1),
        (50, 0.49, 0),  # as the one before: a live session leaves it out
        (50, 0.51, 0),
        (50, 0.503, 0),
        (50, 0.475, 0),
    ],
)
def test_a_single_stamp_is_put_between_its_neighbours(row: int, stamp_s: float, count: int) -> None:
    stamps = USUAL.copy()
    stamps[row] = round(stamp_s * 1e9)
    found, repairs = repaired(stamps)
    assert repairs == count
    np.testing.assert_array_equal(found, USUAL if count else stamps)


@pytest.mark.parametrize(
    "stamps",
    [
        np.concatenate((USUAL, USUAL)),  # a clock that began anew
        np.concatenate((USUAL, USUAL + 10**11)),  # a pause
        np.delete(USUAL, slice(40, 60)),
        USUAL[[*range(40), 41, 40, *range(42, 100)]],  # two packets in the wrong order
        USUAL[[*range(40), 46, *range(40, 46), *range(47, 100)]],
        np.repeat(USUAL[::4], 4),  # packets
        np.repeat(USUAL, [2 if k == 30 else 1 for k in range(100)]),
        USUAL[:3],
        np.zeros(50, np.int64),
    ],
)
def test_what_is_no_single_wrong_stamp_stays(stamps: np.ndarray) -> None:
    found, count = repaired(stamps)
    assert found is stamps
    assert count == 0
