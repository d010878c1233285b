"""CSV files as devices and spreadsheets write them: read by the proposal, or asked about, never guessed in silence."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st
from test_recording import walk

from fes.cli.main import main
from fes.datasets import read_file
from fes.recording import (
    Recording,
    RecordingError,
    SidecarMissingError,
    Track,
    read_recording,
    sidecar_template,
    write_recording,
)
from fes.recording.csv_layout import csv_layout
from fes.recording.naming import group_columns, stated_unit
from fes.signals import G_MPS2

AXES = "XYZ"


def table(track: Track, *, acc: float = 1.0, gyr: float = 180.0 / np.pi, first: np.ndarray | None = None) -> list[str]:
    columns = [track.acc_mps2 / acc, track.gyr_radps * gyr]
    columns = columns if first is None else [first, *columns]
    return [",".join(f"{value:.10g}" for value in row) for row in np.column_stack(columns).tolist()]


def put(path: Path, lines: list[str], *, encoding: str = "utf-8", newline: str = "\r\n") -> Path:
    path.write_bytes((newline.join(lines) + newline).encode(encoding))
    return path


def dot(path: Path, track: Track) -> Path:
    """One sensor as a phone's app exports it: lines of its own on top, a counter, microseconds, no units."""
    above = ["sep=,", "DeviceTag:,17", "OutputRate:,100Hz", "© Somebody 2023", ""]
    rows = table(track, first=np.column_stack([np.arange(1, len(track.t_ns) + 1), 4e9 + track.t_ns / 1e3]))
    return put(path, [*above, "PacketCounter,SampleTimeFine,Acc_X,Acc_Y,Acc_Z,Gyr_X,Gyr_Y,Gyr_Z", *rows])


def accepted(path: Path, *changes: tuple[str, str]) -> Recording:
    text = sidecar_template(path)
    for old, new in changes:
        assert old in text, text
        text = text.replace(old, new)
    path.with_suffix(".toml").write_text(text, encoding="utf-8")
    return read_recording(path)


def same(read: Track, track: Track) -> None:
    np.testing.assert_allclose(read.acc_mps2, track.acc_mps2, rtol=1e-6, atol=1e-4)
    np.testing.assert_allclose(read.gyr_radps, track.gyr_radps, rtol=1e-6, atol=1e-4)
    assert read.rate_hz == pytest.approx(track.rate_hz, rel=1e-4)


def test_lines_above_the_header_and_the_side_in_the_files_name(tmp_path: Path) -> None:
    track = walk("right_foot")
    path = dot(tmp_path / "Right_foot_D42.csv", track)
    text = sidecar_template(path)
    assert "rate_hz = 100  # by line 3: “OutputRate:,100Hz”" in text
    assert 'time_unit = "us"  # steps of 10000: 100 Hz' in text
    assert "[sensors.right_foot]  # by the file's name" in text
    same(accepted(path).tracks["right_foot"], track)


def test_two_files_of_one_walk(tmp_path: Path) -> None:
    left, right = walk("left_foot"), walk("right_foot", start_ns=20_000_000)
    path = dot(tmp_path / "Left_D42_0312.csv", left)
    dot(tmp_path / "Right_D43_0312.csv", right)
    text = sidecar_template(path)
    proposed = text.split("delete the “# ” of these lines:\n")[1].split("\n\n")[0]
    assert list(accepted(path).tracks) == ["left_foot"], "the other file only joins when somebody says so"
    both = accepted(path, (proposed, re.sub("^# ", "", proposed, flags=re.M)))
    same(both.tracks["left_foot"], left)
    same(both.tracks["right_foot"], right)
    assert both.tracks["right_foot"].t_ns[0] - both.tracks["left_foot"].t_ns[0] == 20_000_000


@pytest.mark.parametrize(
    ("value", "message"), [('"nowhere.csv"', r"nowhere\.csv: cannot be read"), ('"../a.csv"', "beside the sidecar")]
)
def test_the_other_file_is_told_of(tmp_path: Path, value: str, message: str) -> None:
    path = dot(tmp_path / "Left.csv", walk())
    dot(tmp_path / "Right.csv", walk())
    with pytest.raises(RecordingError, match=message):
        accepted(path, ('\nacc = ["Acc_X"', f'\nfile = {value}\nacc = ["Acc_X"'))


def test_a_german_spreadsheet_with_both_feet(tmp_path: Path) -> None:
    left, right = walk("left_foot"), walk("right_foot")
    names = [f"{k}{a} {s} ({u})" for s in ("rechts", "links") for k, u in (("Acc", "g"), ("Gyr", "°/s")) for a in AXES]
    values = np.column_stack(
        [left.t_ns / 1e6] + [v for t in (right, left) for v in (t.acc_mps2 / G_MPS2, np.degrees(t.gyr_radps))]
    )
    rows = [";".join(f"{value:.9f}".replace(".", ",") for value in row) for row in values.tolist()]
    path = put(tmp_path / "Gangtest.csv", [";".join(["Zeit (ms)", *names]), *rows], encoding="utf-8-sig")
    recording = accepted(path)
    same(recording.tracks["left_foot"], left)
    same(recording.tracks["right_foot"], right)


def test_an_older_spreadsheets_letters_and_padded_lines(tmp_path: Path) -> None:
    track = walk()
    header = ",".join([f"Acc_{a} (g)" for a in AXES] + [f"Gyr_{a} (°/s)" for a in AXES])
    above = ["Abtastrate: 100 Hz,,,,,", "linker Fuß,,,,,", ",,,,,"]
    path = put(tmp_path / "a.csv", [*above, header, *table(track, acc=G_MPS2)], encoding="cp1252")
    assert 'encoding = "cp1252"' in sidecar_template(path)
    assert "[sensors.left_foot]  # by line 2: “linker Fuß,,,,,”" in sidecar_template(path)
    same(accepted(path).tracks["left_foot"], track)


def test_units_under_the_header_and_a_tab_at_every_lines_end(tmp_path: Path) -> None:
    track = walk("left_shank")
    names = ["T_Timestamp_Unix_CAL", *(f"T_Accel_LN_{a}_CAL" for a in AXES), *(f"T_Accel_WR_{a}_CAL" for a in AXES)]
    names += [f"T_Gyro_{a}_CAL" for a in AXES]
    values = np.column_stack(
        [1.7e12 + track.t_ns / 1e6, track.acc_mps2 * 0.5, track.acc_mps2, np.degrees(track.gyr_radps)]
    )
    rows = ["\t".join(f"{value:.10f}" for value in row) + "\t" for row in values.tolist()]
    units = "\t".join(["ms"] + ["m/(s^2)"] * 6 + ["deg/s"] * 3) + "\t"
    path = put(tmp_path / "left_shank.csv", ["sep=\t", "\t".join(names) + "\t", units, *rows])
    text = sidecar_template(path)
    assert "_WR_X" in text.split("[sensors")[1], "the wide range: the other ends at 2 g"
    same(accepted(path).tracks["left_shank"], track)


def test_nothing_that_a_file_does_not_tell_passes_unanswered(tmp_path: Path) -> None:
    path = put(tmp_path / "p05.csv", ["acc_x,acc_y,acc_z,gyr_x,gyr_y,gyr_z", *table(walk(), gyr=1.0)])
    with pytest.raises(RecordingError) as caught:
        accepted(path)
    assert "rate_hz = 0" in str(caught.value)
    assert "sensors.? = '?': which sensor is it?" in str(caught.value)
    assert caught.value.__cause__ is None, "one clear sentence, without what pydantic says before it"
    answered = ("rate_hz = 0", "rate_hz = 100"), ('"?"', "left_foot")
    with pytest.raises(RecordingError, match=r"gyr_unit = '[?]': is not answered yet. "):
        accepted(path, *answered, ('gyr_unit = "rad/s"', 'gyr_unit = "?"'))
    same(accepted(path, *answered).tracks["left_foot"], walk())


def test_a_counter_is_no_time(tmp_path: Path) -> None:
    rows = table(walk(), first=np.arange(400.0))
    path = put(tmp_path / "left.csv", ["t,acc_x,acc_y,acc_z,gyr_x,gyr_y,gyr_z", *rows])
    assert "rate_hz = 0  # ?" in sidecar_template(path), "1 ms and 1000 Hz, or a count: nobody knows"


def test_a_unit_that_the_numbers_deny_is_asked_for(tmp_path: Path) -> None:
    names = ",".join([f"acc_{a} [g]" for a in "xyz"] + [f"gyr_{a} [rad/s]" for a in "xyz"])
    text = sidecar_template(put(tmp_path / "left.csv", [names, *table(walk())]))
    assert 'acc_unit = "?"  # ? its name says g, but at rest it reads 9.8' in text
    assert 'gyr_unit = "?"' in text


def test_a_sensor_that_hardly_moves_does_not_tell_its_unit(tmp_path: Path) -> None:
    still = walk()
    quiet = Track(still.sensor, 100.0, still.t_ns, still.t_sensor_ns, still.acc_mps2 * 0 + [0, 0, 9.8], still.gyr_radps)
    text = sidecar_template(put(tmp_path / "left.csv", ["ax,ay,az,gx,gy,gz", *table(quiet)]))
    assert re.search(r'^gyr_unit = "\?"', text, re.M)


def test_a_header_over_few_rows_is_a_header(tmp_path: Path) -> None:
    for rows in ([], ["1,2"], ["1,x"]):
        assert "#   a\n#   b\n" in sidecar_template(put(tmp_path / "a.csv", ["a,b", *rows]))


def test_numbers_without_a_header_are_told(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="has no header: its first line holds numbers"):
        sidecar_template(put(tmp_path / "a.csv", table(walk())))


@pytest.mark.parametrize(
    ("kind", "name", "unit"),
    [
        ("acc", "AccX (g)", "g"), ("acc", "acc_x_mps2", "m/s^2"), ("acc", "Accel X [m/s²]", "m/s^2"),
        ("acc", "Accel_X (m/(s^2))", "m/s^2"), ("acc", "acc_x_mg", "mg"), ("acc", "Acc_X", ""),
        ("gyr", "Gyr_X (°/s)", "deg/s"), ("gyr", "gyro_x_dps", "deg/s"), ("gyr", "omega_z [rad/s]", "rad/s"),
        ("time", "Zeit (ms)", "ms"), ("time", "t_us", "us"), ("time", "Timestamp", ""),
    ],
)  # fmt: skip
def test_units_in_names(kind: str, name: str, unit: str) -> None:
    assert stated_unit(kind, name) == unit


@pytest.mark.parametrize(
    ("call", "sensor"),
    [
        ("links", "left_foot"),
        ("rechter Fuß", "right_foot"),
        ("L", "left_foot"),
        ("shank_right", "right_shank"),
        ("IMU3", ""),
    ],
)
def test_sides_in_names(call: str, sensor: str) -> None:
    (group,) = group_columns([f"{call}_{kind}_{axis}" for kind in ("acc", "gyr") for axis in "xyz"])
    assert group.whole
    assert group.sensor == sensor


@settings(max_examples=60, deadline=None)
@given(text=st.text(alphabet="abxyz019,;.\t \"'°\n-", max_size=300))
def test_any_text_is_laid_out_or_refused(tmp_path_factory: pytest.TempPathFactory, text: str) -> None:
    path = tmp_path_factory.mktemp("any") / "a.csv"
    path.write_text(text, encoding="utf-8")
    try:
        layout = csv_layout(path)
    except RecordingError:
        return
    assert layout.names
    sidecar_template(path)


def test_analyse_writes_the_proposal_once_and_never_over_a_file(tmp_path: Path) -> None:
    path = put(tmp_path / "p05.csv", ["acc_x,acc_y,acc_z,gyr_x,gyr_y,gyr_z", *table(walk(), gyr=1.0)])
    with pytest.raises(SidecarMissingError) as caught:
        read_recording(path)
    assert caught.value.sidecar == tmp_path / "p05.toml"
    told = CliRunner().invoke(main, ["analyse", str(path)])
    assert told.exit_code == 2
    assert "2 answers are missing: the “?” in lines" in told.output
    written = (tmp_path / "p05.toml").read_text(encoding="utf-8")
    assert written == caught.value.proposal
    again = CliRunner().invoke(main, ["analyse", str(path)])
    assert again.exit_code == 2
    assert "which sensor is it?" in again.output
    assert (tmp_path / "p05.toml").read_text(encoding="utf-8") == written


# --- Recordings of real walks pass the checks; spoiled units of real walks do not ---


DATA = Path(os.environ.get("FES_DATA", Path(__file__).parents[3] / "shared" / "data"))
needs_data = pytest.mark.skipif(not DATA.is_dir(), reason=f"no recordings under {DATA}; set FES_DATA")


def stroke_walks() -> list[Path]:
    return sorted((DATA / "stroke_treadmill").glob("*.npz"))


@needs_data
@pytest.mark.data
def test_walks_of_stroke_survivors_pass_on_feet_and_shanks(tmp_path: Path) -> None:
    walks = stroke_walks()
    assert walks
    for number, one in enumerate(walks):
        recording = read_file("stroke_treadmill", one).recording
        path = tmp_path / f"{number}.parquet"
        write_recording(recording, path)
        read = read_recording(path)
        assert set(read.tracks) == set(recording.tracks)
        for track in read.tracks.values():
            assert (track.quality.missing, track.quality.irregular) == (0, 0)


@needs_data
@pytest.mark.data
@pytest.mark.parametrize(
    ("old", "new", "fix"),
    [
        ('acc_unit = "m/s^2"', 'acc_unit = "g"', 'set acc_unit = "m/s\\^2"'),
        ('gyr_unit = "rad/s"', 'gyr_unit = "deg/s"', 'set gyr_unit = "rad/s"'),
    ],
)
def test_wrong_units_of_real_walks_are_refused(tmp_path: Path, old: str, new: str, fix: str) -> None:
    for number, one in enumerate(stroke_walks()[:4]):
        path = tmp_path / f"{number}.parquet"
        write_recording(read_file("stroke_treadmill", one).recording, path)
        sidecar = path.with_suffix(".toml")
        sidecar.write_text(sidecar.read_text(encoding="utf-8").replace(old, new), encoding="utf-8")
        with pytest.raises(RecordingError, match=fix):
            read_recording(path)


@needs_data
@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "rate_hz", "feet"), [("gaitmap_walk/imu_sample.csv", 204.8, 2), ("xio_walk/short_walk.csv", 398.3, 1)]
)
def test_files_as_their_makers_left_them_read_with_the_template(
    tmp_path: Path, name: str, rate_hz: float, feet: int
) -> None:
    path = tmp_path / "own.csv"
    shutil.copyfile(DATA / name, path)
    template = sidecar_template(path).replace("rate_hz = 0", f"rate_hz = {rate_hz}").replace('"?"', "left_foot")
    path.with_suffix(".toml").write_text(template, encoding="utf-8")
    recording = read_recording(path)
    assert list(recording.tracks) == ["left_foot", "right_foot"][:feet]
    assert recording.tracks["left_foot"].rate_hz == pytest.approx(rate_hz, rel=1e-3)
    peak = np.percentile(np.linalg.norm(recording.tracks["left_foot"].gyr_radps, axis=1), 99)
    assert 3.0 < peak < 20.0
    if feet == 1:
        assert recording.tracks["left_foot"].quality.doubled > 100, "its stamps are known to be doubled"


def test_heavy_libraries_load_only_where_used() -> None:
    code = (
        "import sys, fes.recording, fes.session_log\n"
        "heavy = {'pyarrow', 'can', 'cantools', 'scipy', 'pandas', 'numba'} & set(sys.modules)\n"
        "assert not heavy, heavy"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
