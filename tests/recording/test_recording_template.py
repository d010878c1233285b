"""The sidecar proposed to whoever brings their own sensor: for usual files it must work as it is, or nearly."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet
from test_recording import both_feet, walk

from fes.recording import (
    Recording,
    RecordingError,
    SidecarMissingError,
    read_recording,
    sidecar_template,
    write_recording,
)
from fes.signals import G_MPS2


def put(path: Path, names: list[str], columns: list[np.ndarray], *, delimiter: str = ",", above: str = "") -> Path:
    rows = (delimiter.join(f"{value:.12g}" for value in row) for row in np.column_stack(columns).tolist())
    path.write_text(above + delimiter.join(names) + "\n" + "\n".join(rows) + "\n", encoding="utf-8")
    return path


def accept(path: Path, **answers: str) -> Recording:
    """Do as the message says: save the template it shows, with the answers for its “?”; return the recording."""
    with pytest.raises(RecordingError, match=rf"{path.stem}\.toml: is missing") as caught:
        read_recording(path)
    template = str(caught.value).split("\n\n", 1)[1]
    assert template == sidecar_template(path)
    for asked, answer in answers.items():
        template = re.sub(rf"^{asked} = .*$", f"{asked} = {answer}", template, flags=re.M)
    template = template.replace('[sensors."?"]', f"[sensors.{answers.get('sensor', 'left_foot')}]")
    path.with_suffix(".toml").write_text(template, encoding="utf-8")
    return read_recording(path)


def test_the_message_says_what_to_do_and_names_the_columns(tmp_path: Path) -> None:
    path = put(tmp_path / "own.csv", ["a", "b"], [np.arange(200.0), np.arange(200.0)])
    with pytest.raises(RecordingError) as caught:
        read_recording(path)
    message = str(caught.value)
    assert message.startswith(f"{tmp_path / 'own.toml'}: is missing. This sidecar says what own.csv holds.")
    assert "Save the following under that name" in message
    assert "#   a\n#   b\n" in message
    content = tomllib.loads(message.split("\n\n", 1)[1])
    assert content["sensors"]["?"]["acc"] == ["? acc x", "? acc y", "? acc z"]
    path.with_suffix(".toml").write_text(message.split("\n\n", 1)[1], encoding="utf-8")
    with pytest.raises(RecordingError) as caught:
        read_recording(path)
    for open_question in (
        "rate_hz = 0: must",
        "acc_unit = '?': is not answered",
        "gyr_unit = '?': is not answered",
        "sensors.? =",
    ):
        assert re.search(rf"own\.toml:\d+: {re.escape(open_question)}", str(caught.value)), open_question


def test_an_empty_sidecar_is_filled_like_a_missing_one(tmp_path: Path) -> None:
    path = put(tmp_path / "own.csv", ["a", "b"], [np.arange(200.0), np.arange(200.0)])
    path.with_suffix(".toml").touch()  # fes replay own.csv > own.toml
    with pytest.raises(RecordingError, match=r"own\.toml: is empty\.") as caught:
        read_recording(path)
    assert str(caught.value).split("\n\n", 1)[1] == sidecar_template(path)


def test_one_sensor_in_g_and_degrees_with_milliseconds(tmp_path: Path) -> None:
    track = walk()
    names = ["Time (ms)", *(f"Accelerometer {a} (g)" for a in "XYZ"), *(f"Gyroscope {a} (deg/s)" for a in "XYZ")]
    columns = [track.t_ns * 1e-6, track.acc_mps2 / G_MPS2, np.degrees(track.gyr_radps)]
    recording = accept(put(tmp_path / "own.csv", names, columns))
    read = recording.tracks["left_foot"]
    np.testing.assert_allclose(read.acc_mps2, track.acc_mps2, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(read.gyr_radps, track.gyr_radps, rtol=1e-6, atol=1e-6)
    assert read.rate_hz == pytest.approx(100.0)
    text = sidecar_template(tmp_path / "own.csv")
    assert re.findall(r"^(?!#).*\?.*$", text, re.M) == [
        '[sensors."?"]  # ? which sensor: left_foot, right_foot, left_shank, right_shank'
    ], "only the sensor's place is not known"


@pytest.mark.parametrize(
    "style",
    [
        "{side}Foot_Acc{axis}|{side}Foot_Gyr{axis}",
        "{side}_foot_acc_{axis}|{side}_foot_gyr_{axis}",
        "acc_{axis}_{s}f|gyr_{axis}_{s}f",
        "{s} a{axis}|{s} g{axis}",
        "{side}.imu.accel.{axis}|{side}.imu.omega.{axis}",
    ],
)
def test_two_feet_under_usual_names(tmp_path: Path, style: str) -> None:
    recording = both_feet()
    acc, gyr = style.split("|")
    names, columns = ["timestamp"], [recording.tracks["left_foot"].t_ns * 1e-9]
    for sensor, track in recording.tracks.items():
        side = sensor.split("_")[0]
        for form, values in ((acc, track.acc_mps2), (gyr, track.gyr_radps)):
            names += [form.format(side=side, s=side[0], axis=axis) for axis in "xyz"]
            columns.append(values)
    read = accept(put(tmp_path / "own.csv", names, columns))
    assert list(read.tracks) == ["left_foot", "right_foot"]
    for sensor, track in recording.tracks.items():
        np.testing.assert_allclose(read.tracks[sensor].gyr_radps, track.gyr_radps, rtol=1e-6, atol=1e-9)


def test_semicolons_decimal_commas_units_line_and_raw_counts(tmp_path: Path) -> None:
    track = walk()
    names = ["Zeit", *(f"a{axis}" for axis in "xyz"), *(f"g{axis}" for axis in "xyz")]
    counts = np.rint(track.acc_mps2 / G_MPS2 * 2048)
    path = put(tmp_path / "own.csv", names, [track.t_ns * 1e-9, counts, np.degrees(track.gyr_radps)], delimiter=";")
    text = path.read_text().replace(".", ",").replace("\n", "\ns;;;;°/s;°/s;°/s\n", 1)
    path.write_text(text, encoding="utf-8")
    template = sidecar_template(path)
    assert 'delimiter = ";"' in template
    assert 'decimal = ","' in template
    assert "skip_lines_after_header = 1" in template
    would_be = re.search(r"at rest it reads .*: ([\d.]+) would make that gravity", template)
    assert would_be
    read = accept(path, acc_unit=would_be[1]).tracks["left_foot"]
    np.testing.assert_allclose(read.acc_mps2, track.acc_mps2, rtol=0.01, atol=0.05)


def test_a_header_of_two_lines_is_seen(tmp_path: Path) -> None:
    track = walk()
    above = "sensor,left,left,left,left,left,left\n"
    names = ["axis", *(f"{kind}_{axis}" for kind in ("acc", "gyr") for axis in "xyz")]
    path = put(tmp_path / "own.csv", names, [np.arange(400.0), track.acc_mps2, track.gyr_radps], above=above)
    template = sidecar_template(path)
    assert "header_lines = 2" in template
    path.with_suffix(".toml").write_text(template.replace("rate_hz = 0", "rate_hz = 100"), encoding="utf-8")
    assert read_recording(path).tracks["left_foot"].quality.samples == 400


def test_parquet_has_one_too(tmp_path: Path) -> None:
    recording = Recording("x", None, {name: walk(name) for name in ("left_foot", "right_foot", "left_shank")})
    path = tmp_path / "own.parquet"
    write_recording(recording, path)
    path.with_suffix(".toml").unlink()
    assert list(accept(path).tracks) == ["left_foot", "right_foot", "left_shank"]


@pytest.mark.parametrize(
    ("name", "content", "message"), [("a.csv", b"", "is empty"), ("a.parquet", b"PAR1", "is cut short")]
)
def test_a_broken_file_is_told_first(tmp_path: Path, name: str, content: bytes, message: str) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(RecordingError, match=message):
        read_recording(tmp_path / name)


@pytest.mark.parametrize("rows", [0, 400])
def test_a_sensor_without_values_has_a_template_too(tmp_path: Path, rows: int) -> None:
    """Its numbers tell no unit, and no row of a file may hold any."""
    path = tmp_path / "own.parquet"
    write_recording(Recording("x", None, {name: walk(name) for name in ("left_foot", "right_foot")}), path)
    path.with_suffix(".toml").unlink()
    table = parquet.read_table(path).slice(0, rows)
    for number, name in enumerate(table.column_names):
        if name.startswith("left_foot"):
            table = table.set_column(number, name, pa.nulls(rows, table.schema.field(name).type))
    parquet.write_table(table, path)
    with pytest.raises(SidecarMissingError) as told:
        read_recording(path)
    assert 'acc_unit = "?"' in told.value.proposal


def test_a_can_log_is_told_of_its_dbc(tmp_path: Path) -> None:
    (tmp_path / "a.asc").write_text("")
    with pytest.raises(RecordingError, match=r'dbc = "sensors\.dbc"') as caught:
        read_recording(tmp_path / "a.asc")
    assert tomllib.loads(str(caught.value).split("\n\n", 1)[1])["can"] == {"dbc": "sensors.dbc"}


def test_text_and_parquet_are_known_by_their_content(tmp_path: Path) -> None:
    """Under .txt, an ending that nobody knows, and none; both feet of one walk are found together."""
    track = walk()
    names = ["Time (ms)", *(f"Acc_{axis}" for axis in "XYZ"), *(f"Gyr_{axis}" for axis in "XYZ")]
    for name in ("left.txt", "left", "left.dat"):
        path = put(tmp_path / name, names, [track.t_ns * 1e-6, track.acc_mps2, track.gyr_radps], delimiter="\t")
        np.testing.assert_allclose(accept(path).tracks["left_foot"].acc_mps2, track.acc_mps2, rtol=1e-6, atol=1e-9)
        path.with_suffix(".toml").unlink()
    (tmp_path / "right.txt").write_text((tmp_path / "left.txt").read_text())
    assert '# file = "right.txt"' in sidecar_template(tmp_path / "left.txt")
    write_recording(both_feet(), tmp_path / "both.parquet")
    (tmp_path / "both.parquet").rename(tmp_path / "both")
    assert list(read_recording(tmp_path / "both").tracks) == ["left_foot", "right_foot"]


@pytest.mark.parametrize("content", [b"We walked on Tuesday.\nIt rained.\n", b"", b"\0\1\2" * 500, b"\xff\xfea\0"])
def test_what_holds_no_rows_of_numbers_is_no_recording(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "notes.txt").write_bytes(content)
    with pytest.raises(
        RecordingError, match=r"none of the formats read here \(\.csv, \.parquet, .* under any other name"
    ):
        read_recording(tmp_path / "notes.txt")
