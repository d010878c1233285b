"""Every fault a recording can have is refused (or counted) with the file, the place and the fix."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_recording import both_feet, walk
from test_recording_template import accept, put

from fes.analysis.pipeline import analyse, calibrations_of
from fes.recording import Recording, RecordingError, Track, read_recording, sidecar_template, write_recording
from fes.recording.sidecar import load_sidecar
from fes.recording.table import unwrapped
from fes.signals import G_MPS2

NAMES = [f"{kind}_{axis}" for kind in ("acc", "gyr") for axis in "xyz"]
SIDECAR = """
acc_unit = "m/s^2"
gyr_unit = "rad/s"
time_column = "t"

[sensors.left_foot]
acc = ["acc_x", "acc_y", "acc_z"]
gyr = ["gyr_x", "gyr_y", "gyr_z"]
"""


class Csv:
    """A good CSV of one foot as rows of text, to be spoiled."""

    def __init__(self, folder: Path) -> None:
        track = walk(seconds=4.0)
        self.path = folder / "walk.csv"
        self.sidecar = SIDECAR
        self.header = ",".join(["t", *NAMES])
        data = np.column_stack([track.t_ns * 1e-9, track.acc_mps2, track.gyr_radps])
        self.rows = [[f"{value:.7g}" for value in row] for row in data.tolist()]

    def scale(self, columns: slice, factor: float) -> None:
        for row in self.rows:
            row[columns] = [f"{float(value) * factor:.7g}" for value in row[columns]]

    def text(self) -> str:
        return "\n".join([self.header, *(",".join(row) for row in self.rows)]) + "\n"

    def read(self, text: str | bytes | None = None) -> Recording:
        text = self.text() if text is None else text
        self.path.write_bytes(text.encode() if isinstance(text, str) else text)
        self.path.with_suffix(".toml").write_text(self.sidecar, encoding="utf-8")
        return read_recording(self.path)

    def fails(self, *parts: str, text: str | bytes | None = None) -> str:
        with pytest.raises(RecordingError) as caught:
            self.read(text)
        message = str(caught.value)
        assert "walk." in message, "names the file"
        for part in parts:
            assert part in message, message
        return message


@pytest.fixture
def good(tmp_path: Path) -> Csv:
    return Csv(tmp_path)


ACC, GYR = slice(1, 4), slice(4, 7)


def test_the_good_file_reads(good: Csv) -> None:
    track = good.read().tracks["left_foot"]
    assert track.rate_hz == pytest.approx(100.0)
    assert track.quality.samples == 400
    assert (track.quality.missing, track.quality.doubled, track.quality.backward, track.quality.irregular) == (
        0,
        0,
        0,
        0,
    )
    np.testing.assert_allclose(track.gyr_radps, walk().gyr_radps, rtol=1e-6)


def sidecar(old: str, new: str) -> Callable[[Csv], None]:
    def spoil(good: Csv) -> None:
        good.sidecar = good.sidecar.replace(old, new)

    return spoil


def header(old: str, new: str) -> Callable[[Csv], None]:
    def spoil(good: Csv) -> None:
        good.header = good.header.replace(old, new)

    return spoil


def cells(value: str, *places: tuple[int, int]) -> Callable[[Csv], None]:
    """``value`` in these rows and columns."""

    def spoil(good: Csv) -> None:
        for row, column in places:
            good.rows[row][column] = value

    return spoil


def later(by: float, column: int, rows: slice) -> Callable[[Csv], None]:
    def spoil(good: Csv) -> None:
        for row in good.rows[rows]:
            row[column] = f"{float(row[column]) + by:.6g}"

    return spoil


def swap_stamps(good: Csv) -> None:
    for row in range(2, 80, 3):
        good.rows[row][0], good.rows[row + 1][0] = good.rows[row + 1][0], good.rows[row][0]


def swap_kinds(good: Csv) -> None:
    good.sidecar = good.sidecar.replace("acc =", "was =").replace("gyr =", "acc =").replace("was =", "gyr =")


@pytest.mark.parametrize(
    ("spoil", "parts"),
    [
        (sidecar("m/s^2", "g"), ("looks like m/s^2", 'set acc_unit = "m/s^2"')),
        (sidecar("rad/s", "deg/s"), ("shows movement", 'set gyr_unit = "rad/s"')),
        (swap_kinds, ("columns of acc and gyr are swapped",)),
        (later(-G_MPS2, 3, slice(None)), ("gravity is missing", "raw acceleration")),
        (
            header("gyr_y", "gyro_y"),
            ("has no column 'gyr_y'", "Did you mean 'gyro_y'", "Its columns are: 't', 'acc_x'"),
        ),
        (header("gyr_y", "gyr_x"), ("2 columns 'gyr_x'", "header_lines = 2")),
        (cells("n/a", (100, 2)), ("line 102", "column 'acc_y'", "'n/a' is no number")),
        *(
            (
                cells(value, (20, 5), (30, 6), (30, 1)),
                (f"line 22, column 'gyr_y': {value.lower()} is no measurement (3 such values in 2 rows)",),
            )
            for value in ("nan", "NaN", "inf", "-inf")
        ),
        (
            cells("1.7e308", (20, 5), (21, 5)),
            ("line 22, column 'gyr_y': 1.7e+308 is no measurement (2 such values in 2 rows)",),
        ),
        (
            cells("", (50, 3), (60, 3)),
            ("line 52", "column 'acc_z' is empty and others of the sensor are not (2 such rows)", "all six"),
        ),
        (swap_stamps, ("time goes backward 26 times in 400 samples, first at line 5", "Sort the rows")),
        (later(-2.5, 0, slice(250, None)), ("line 252: the clock jumps back 2.49", "split the file")),
        (cells("3.0", *((row, 0) for row in range(400))), ("its time never advances", "time_column")),
    ],
)
def test_a_fault_is_told_with_its_place_and_the_fix(
    good: Csv, spoil: Callable[[Csv], None], parts: tuple[str, ...]
) -> None:
    spoil(good)
    good.fails(*parts)


# --- units -----------------------------------------------------------------------------------------------


def test_g_declared_as_mps2(good: Csv) -> None:
    good.scale(ACC, 1 / G_MPS2)
    good.fails("left_foot", "looks like g", 'set acc_unit = "g"')
    good.sidecar = good.sidecar.replace("m/s^2", "g")
    np.testing.assert_allclose(good.read().tracks["left_foot"].acc_mps2, walk().acc_mps2, rtol=1e-5, atol=1e-5)


def test_mg_and_raw_counts(good: Csv) -> None:
    good.scale(ACC, 1000 / G_MPS2)
    good.fails('set acc_unit = "mg"')
    good.scale(ACC, 2.048)
    message = good.fails("raw counts", "acc_unit = 0.0047")
    factor = message.split("say acc_unit = ")[1].split()[0]
    good.sidecar = good.sidecar.replace('"m/s^2"', factor)
    np.testing.assert_allclose(good.read().tracks["left_foot"].acc_mps2, walk().acc_mps2, rtol=1e-2, atol=1e-2)


def test_degrees_declared_as_radians(good: Csv) -> None:
    good.scale(GYR, 180 / np.pi)
    good.fails("left_foot", "more than any leg turns", 'set gyr_unit = "deg/s"')
    good.sidecar = good.sidecar.replace("rad/s", "deg/s")
    np.testing.assert_allclose(good.read().tracks["left_foot"].gyr_radps, walk().gyr_radps, rtol=1e-5, atol=1e-5)


def test_a_sensor_that_lies_still_may_turn_little(good: Csv) -> None:
    good.rows = [[row[0], "0.1", "0", "9.8", "0.001", "0", "0"] for row in good.rows]
    good.sidecar = good.sidecar.replace("rad/s", "deg/s")
    assert good.read().tracks["left_foot"].quality.samples == 400


@pytest.mark.parametrize(
    ("spelt", "key"), [("m/s²", "acc_unit"), ("m/s2", "acc_unit"), ("dps", "gyr_unit"), ("°/s", "gyr_unit")]
)
def test_usual_spellings_of_units_are_understood(good: Csv, spelt: str, key: str) -> None:
    good.sidecar = good.sidecar.replace('"m/s^2"' if key == "acc_unit" else '"rad/s"', f'"{spelt}"')
    if key == "gyr_unit":
        good.scale(GYR, 180 / np.pi)
    good.read()


# --- the file ----------------------------------------------------------------------------------------------


def test_missing_files(good: Csv, tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="is not there"):
        read_recording(tmp_path / "walk.csv")
    (tmp_path / "walk.toml").touch()
    with pytest.raises(RecordingError, match=r"none of the formats.*Name the data file"):
        read_recording(tmp_path / "walk.toml")
    (tmp_path / "folder.csv").mkdir()
    with pytest.raises(RecordingError, match="is a folder"):
        read_recording(tmp_path / "folder.csv")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "is empty"),
        ("\n\n", "is empty"),
        ("t,acc_x,acc_y,acc_z,gyr_x,gyr_y,gyr_z\n", "holds a header and no samples"),
        (b"PAR1\0\0\0", "is binary"),
        ("t,acc_x\n0,1\n".encode("utf-16"), "is UTF-16"),
        ("Größe,acc_x\n0,1\n".encode("latin-1"), "is not utf-8 text"),
    ],
)
def test_no_usable_csv(good: Csv, text: str | bytes, message: str) -> None:
    good.fails(message, text=text)


def test_a_byte_order_mark_does_no_harm(good: Csv) -> None:
    good.sidecar = good.sidecar.replace('"t"', '"time"')
    text = good.text().replace("t,acc", "time,acc", 1)
    assert good.read(b"\xef\xbb\xbf" + text.encode()).tracks["left_foot"].quality.samples == 400


def test_another_encoding_can_be_said(good: Csv) -> None:
    good.sidecar = 'encoding = "latin-1"\n' + good.sidecar.replace('"t"', '"Größe"')
    text = good.text().replace("t,acc", "Größe,acc", 1)
    assert good.read(text.encode("latin-1")).tracks["left_foot"].quality.samples == 400
    good.sidecar = good.sidecar.replace("latin-1", "klingon")
    good.fails('encoding = "klingon" is no known encoding')


def test_semicolons_and_decimal_commas(good: Csv) -> None:
    text = good.text().replace(",", ";").replace(".", ",")
    good.fails('separated by ";"', 'delimiter = ";"', text=text)
    good.sidecar = 'delimiter = ";"\n' + good.sidecar
    good.fails("line 2", "'acc_x'", "decimal comma", 'decimal = ","', text=text)
    good.sidecar = 'decimal = ","\n' + good.sidecar
    np.testing.assert_allclose(good.read(text).tracks["left_foot"].gyr_radps, walk().gyr_radps, rtol=1e-6)


def test_a_units_line_under_the_header(good: Csv) -> None:
    text = good.text().replace("\n", "\ns,m/s2,m/s2,m/s2,rad/s,rad/s,rad/s\n", 1)
    good.fails("line 2", "skip_lines_after_header = 1", text=text)
    good.sidecar = "skip_lines_after_header = 1\n" + good.sidecar
    good.read(text)


def test_lines_before_the_header_and_line_numbers_with_blank_lines(good: Csv) -> None:
    good.sidecar = "skip_lines = 2\n" + good.sidecar
    good.rows[10][1] = "nan"
    text = "device,7\nstarted,today\n" + good.text().replace("\n", "\n\n", 1)
    good.fails("line 15, column 'acc_x'", text=text)


def test_more_columns_than_the_header_and_skipping_too_much(good: Csv) -> None:
    good.rows[4].append("1")
    good.fails("line 6 has 8 cells, the header has 7", "decimal comma")
    good.sidecar = "skip_lines = 5000\n" + good.sidecar
    good.fails("has no header line; check skip_lines = 5000")


def test_a_header_of_two_lines(good: Csv) -> None:
    top = "time,a,a,a,g,g,g\n,x,y,z,x,y,z\n"
    text = top + "\n".join(good.text().splitlines()[1:])
    good.sidecar = "header_lines = 2\n" + good.sidecar.replace("acc_", "a_").replace("gyr_", "g_").replace(
        '"t"', '"time"'
    )
    good.sidecar = good.sidecar.replace("a_unit", "acc_unit").replace("g_unit", "gyr_unit")
    assert good.read(text).tracks["left_foot"].quality.samples == 400


def test_a_file_cut_short(good: Csv) -> None:
    text = good.text()
    good.fails("line 401 has", "It is the last line: the file was cut short", text=text[: text.rindex(",") - 3])
    good.rows[7] = good.rows[7][:5]
    message = good.fails("line 9 has 5 cells, the header has 7")
    assert "cut short" not in message


# --- lost samples and time ------------------------------------------------------------------------------------


def test_empty_rows_are_lost_samples(good: Csv) -> None:
    for row in (0, 50, 51, 399):
        good.rows[row][1:] = [""] * 6
    track = good.read().tracks["left_foot"]
    assert (track.quality.samples, track.quality.missing, track.quality.irregular) == (396, 4, 0)
    assert track.t_ns[0] == 10_000_000
    np.testing.assert_allclose(track.acc_mps2[49], walk().acc_mps2[52], rtol=1e-6)


def test_a_sensor_without_any_value_and_a_row_without_time(good: Csv) -> None:
    good.rows[8][0] = ""
    good.fails("line 10 has values and no time in 't' (1 such rows)")
    for row in good.rows:
        row[1:] = [""] * 6
    good.fails("all of its cells are empty")


def test_odd_stamps_are_counted(good: Csv) -> None:
    good.rows[100][0] = good.rows[99][0]
    good.rows[200][0], good.rows[201][0] = good.rows[201][0], good.rows[200][0]
    del good.rows[300:303]
    track = good.read().tracks["left_foot"]
    assert track.quality.samples == 397
    assert (track.quality.doubled, track.quality.backward) == (1, 1)
    assert track.quality.missing == 3 + 1, "three cut out, one doubled instead of in its place"
    assert 0 < track.quality.irregular < 10
    assert np.all(np.diff(track.t_ns) >= 0)
    np.testing.assert_array_equal(track.t_ns, np.maximum.accumulate(track.t_sensor_ns))


def test_a_clock_that_goes_back_in_the_last_rows_costs_these(good: Csv) -> None:
    whole = good.read().tracks["left_foot"]
    for row in good.rows[385:]:
        row[0] = f"{float(row[0]) - 0.4:.6g}"
    for row in good.rows[390:]:
        row[0] = f"{float(row[0]) - 1.5:.6g}"
    track = good.read().tracks["left_foot"]
    assert track.quality.late == 15, "from where it first went back, not from the greatest jump"
    assert (track.quality.samples, track.quality.backward, track.quality.missing) == (385, 0, 0)
    np.testing.assert_array_equal(track.acc_mps2, whole.acc_mps2[:385])
    np.testing.assert_array_equal(track.t_sensor_ns, whole.t_sensor_ns[:385])
    for row in good.rows[370:385]:
        row[0] = f"{float(row[0]) - 1.9:.6g}"
    good.fails("line 372: the clock jumps back 1.8", "split the file")


@pytest.mark.parametrize(("factor", "unit"), [(1e3, "ms"), (1e6, "us"), (1e9, "ns")])
def test_time_in_another_unit(good: Csv, factor: float, unit: str) -> None:
    for row in good.rows:
        row[0] = str(round(float(row[0]) * factor))
    good.fails(f'say time_unit = "{unit}"')
    good.sidecar = f'time_unit = "{unit}"\n' + good.sidecar
    assert good.read().tracks["left_foot"].t_ns[-1] == 3_990_000_000


def test_times_with_a_date(good: Csv) -> None:
    start = np.datetime64("2024-05-06T07:08:09.000000")
    for number, row in enumerate(good.rows):
        row[0] = str(start + np.timedelta64(10_000 * number, "us")).replace("T", " ")
    track = good.read().tracks["left_foot"]
    assert track.rate_hz == pytest.approx(100.0)
    assert track.t_ns[-1] - track.t_ns[0] == 3_990_000_000


def test_nanoseconds_since_1970_stay_exact(good: Csv) -> None:
    stamps = [1_700_000_000_123_456_789 + 10_000_000 * number for number in range(len(good.rows))]
    for stamp, row in zip(stamps, good.rows, strict=True):
        row[0] = str(stamp)
    good.sidecar = 'time_unit = "ns"\n' + good.sidecar
    assert good.read().tracks["left_foot"].t_sensor_ns.tolist() == stamps


def test_times_that_are_no_times(good: Csv) -> None:
    good.rows[5][0] = "1e300"
    good.fails("line 7, column 't'", "is no time")
    good.rows[5][0] = "nan"
    good.fails("line 7, column 't'", "is no time")
    good.rows[5][0] = "soon"
    good.fails("line 7, column 't': 'soon' is no number")


def test_a_stated_rate_that_the_time_column_denies(good: Csv) -> None:
    good.sidecar = "rate_hz = 128\n" + good.sidecar
    good.fails("rate_hz = 128", "runs at 100 Hz", "Correct rate_hz")
    good.sidecar = good.sidecar.replace("128", "101")
    assert good.read().tracks["left_foot"].rate_hz == 101.0


def test_a_rate_without_times(good: Csv) -> None:
    good.sidecar = good.sidecar.replace('time_column = "t"', "rate_hz = 50")
    track = good.read().tracks["left_foot"]
    assert track.t_ns[:3].tolist() == [0, 20_000_000, 40_000_000]
    assert track.duration_s == pytest.approx(7.98)


def test_too_short(good: Csv) -> None:
    good.rows = good.rows[:80]
    good.fails("lasts 0.790 s; a recording needs at least 1 s")
    good.rows = good.rows[:1]
    good.fails("has 1 sample")


def test_clipping_is_counted(good: Csv) -> None:
    good.sidecar += "acc_range_g = 1.6\ngyr_range_dps = 350\n"
    track = good.read().tracks["left_foot"]
    full = (np.abs(track.acc_mps2) >= 1.6 * G_MPS2).any(axis=1) | (np.abs(track.gyr_radps) >= np.radians(350)).any(
        axis=1
    )
    assert 0 < track.quality.clipped == full.sum()
    assert track.acc_range_mps2 == pytest.approx(1.6 * G_MPS2)


def test_sensors_whose_clocks_never_meet(tmp_path: Path) -> None:
    tracks = {"left_foot": walk("left_foot"), "right_foot": walk("right_foot", start_ns=10**12)}
    write_recording(Recording("x", None, tracks), tmp_path / "x.csv")
    with pytest.raises(RecordingError, match=r"left_foot ends 996\.010 s before right_foot starts"):
        read_recording(tmp_path / "x.csv")


# --- the sidecar ------------------------------------------------------------------------------------------------


def change(old: str, new: str) -> Callable[[str], str]:
    return lambda text: text.replace(old, new)


@pytest.mark.parametrize(
    ("spoil", "parts"),
    [
        (
            change("[sensors.left_foot]", "[sensors.left_hand]"),
            ("left_hand", "'left_foot', 'right_foot', 'left_shank'"),
        ),
        (lambda text: text.split("[sensors")[0] + "[sensors]", ("names no sensor", "[sensors.left_foot]")),
        (lambda text: text.split("[sensors")[0], ("sensors", "is required and missing")),
        (change('acc_unit = "m/s^2"', ""), ('acc_unit is missing for left_foot; say acc_unit = "m/s^2" or "g"',)),
        (change('gyr_unit = "rad/s"', ""), ("gyr_unit is missing",)),
        (change('"rad/s"', '"furlong"'), ("walk.toml:3: gyr_unit = 'furlong'", '"rad/s", "deg/s", "mdeg/s", or')),
        (change('time_column = "t"', ""), ("neither a time column nor a rate",)),
        (
            change('["acc_x", "acc_y", "acc_z"]', '["acc_x", "acc_y"]'),
            ("walk.toml:7", "names 2 columns, must name three"),
        ),
        (change('["acc_x", "acc_y", "acc_z"]', '"acc"'), ("walk.toml:7: sensors.left_foot.acc", "a list of three")),
        (change('"acc_y"', '"acc_x"'), ("'acc_x' is named twice",)),
        (
            change("acc =", "accc ="),
            ("walk.toml:7: sensors.left_foot.accc", "is not a setting; allowed are acc, gyr, acc_unit"),
        ),
        (change('"t"', '"acc_x"'), ("'acc_x' is named as a time and as a measurement",)),
        (lambda text: "belt_speed_mps = -1\n" + text, ("walk.toml:1: belt_speed_mps = -1", "greater than 0")),
        (lambda text: 'decimal = ","\n' + text, ("delimiter and decimal",)),
        (lambda text: "rate_hz = 0\n" + text, ("walk.toml:1: rate_hz = 0", "greater than 0")),
        (lambda text: text + "acc_range_g = 8\nacc_range_mps2 = 80\n", ("both given",)),
        (lambda text: text + "gyr_range_dps = 8\ngyr_range_radps = 80\n", ("both given",)),
        (lambda text: text + "gyr_range_degps = 8\n", ("gyr_range_degps", "gyr_range_dps")),
        (lambda text: text + 'mounting = { forward = "+x", up = "-x" }\n', ("lie along the same axis",)),
        (lambda text: text + '[can]\ndbc = "a.dbc"\n', ("[can] is for CAN logs",)),
        (
            lambda text: text + text.split("\n\n")[1].replace("left", "right"),
            ("is given to left_foot and to right_foot",),
        ),
        (change("=", ":"), ("is not valid TOML",)),
        (lambda text: "rate = 5\n" + text, ("walk.toml:1: rate = 5: is not a setting; allowed are name, subject",)),
        (lambda text: text + "mounting = { side = 1 }\n", ("mounting.side", "allowed are place, forward, up")),
        (lambda text: text + "[geometry.left_foot]\nnose = 1\n", ("nose", "allowed are toe_forward_m")),
        (change('"m/s^2"', "true"), ("walk.toml:2: acc_unit = True: must be",)),
        (change('"m/s^2"', "-2.0"), ("walk.toml:2: acc_unit = -2.0: must be",)),
        (lambda text: 'rate_hz = "100"\n' + text, ("walk.toml:1: rate_hz = '100'", "valid number")),
    ],
)
def test_a_wrong_sidecar(good: Csv, spoil: Callable[[str], str], parts: tuple[str, ...]) -> None:
    good.sidecar = spoil(good.sidecar)
    good.fails(*parts)


def test_the_documents_example_is_a_valid_sidecar(tmp_path: Path) -> None:
    text = (Path(__file__).parents[2] / "docs" / "recordings.md").read_text(encoding="utf-8")
    examples = re.findall(r"```toml\n(.*?)```", text, re.S)
    assert len(examples) == 4
    for example in examples:
        (tmp_path / "walk.toml").write_text(example, encoding="utf-8")
        assert load_sidecar(tmp_path / "walk.toml").sensors["left_foot"].acc


def test_a_sidecar_that_is_no_text(good: Csv) -> None:
    good.read()
    good.path.with_suffix(".toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(RecordingError, match=r"walk\.toml: is not text"):
        read_recording(good.path)


def test_what_the_sidecar_says_arrives(good: Csv) -> None:
    good.sidecar = 'name = "n"\nsubject = "s"\nbelt_speed_mps = 1.1\n' + good.sidecar
    good.sidecar += 'mounting = { place = "instep", forward = "-x", up = "+z" }\n[extra]\nshoe = "own"\n'
    recording = good.read()
    assert (recording.name, recording.subject, recording.belt_speed_mps) == ("n", "s", 1.1)
    mounting = {"left_foot": {"place": "instep", "forward": "-x", "up": "+z"}}
    assert recording.extra == {"shoe": "own", "mounting": mounting}


# --- Parquet ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("keep", [0, 3, 8, 100, 1000, -1])
def test_parquet_cut_short(tmp_path: Path, keep: int) -> None:
    path = tmp_path / "walk.parquet"
    write_recording(both_feet(), path)
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(RecordingError, match=r"walk\.parquet: is (empty|cut short|not a Parquet)"):
        read_recording(path)


def test_parquet_damaged_or_no_parquet(tmp_path: Path) -> None:
    path = tmp_path / "walk.parquet"
    write_recording(both_feet(), path)
    data = bytearray(path.read_bytes())
    footer = len(data) - 8 - int.from_bytes(data[-8:-4], "little")
    for place in (footer, 2000):
        damaged = bytearray(data)
        damaged[place : place + 8] = b"\xaa" * 8
        path.write_bytes(damaged)
        with pytest.raises(RecordingError, match=r"is damaged.*Copy or record it again"):
            read_recording(path)
    path.write_text("t,acc_x\n0,1\n")
    with pytest.raises(RecordingError, match=r"is not a Parquet file \(a CSV file must be called \.csv\)"):
        read_recording(path)


def test_parquet_places_are_rows_and_text_is_refused(tmp_path: Path) -> None:
    import pyarrow as pa
    from pyarrow import parquet

    path = tmp_path / "walk.parquet"
    recording = both_feet()
    recording.tracks["left_foot"].acc_mps2[9, 1] = np.nan
    write_recording(recording, path)
    with pytest.raises(RecordingError, match="row 10, column 'left_foot_acc_y': nan"):
        read_recording(path)
    table = parquet.read_table(path)
    table = table.set_column(1, table.column_names[1], pa.array(["x"] * len(table)))
    parquet.write_table(table, path)
    with pytest.raises(RecordingError, match=r"column 'left_foot_acc_x' holds string, not numbers"):
        read_recording(path)
    parquet.write_table(table.drop_columns([table.column_names[2]]), path)
    with pytest.raises(RecordingError, match="has no column"):
        read_recording(path)


# --- Packet counters, sample numbers and device clocks are proposed as time ---


VALUES = [f"{kind}_{axis}" for kind in ("Acc", "Gyr") for axis in "XYZ"]
WALK = Path(__file__).parents[2] / "sim_inputs" / "both_feet_100hz.parquet"
RATE = "// Update Rate: 100.0Hz\n"


def lossy(track: Track, lost: int) -> tuple[Track, np.ndarray]:
    """The track without so many samples, in bursts of 5 to 60, and the numbers of those that are left."""
    random = np.random.default_rng(lost)
    kept = np.ones(track.t_ns.size, bool)
    while (left := lost - np.count_nonzero(~kept)) > 0:
        begin = int(random.integers(100, kept.size - 200))
        burst = min(left, int(random.integers(5, 60)))
        kept[begin + np.flatnonzero(kept[begin:])[:burst]] = False
    left = {name: getattr(track, name)[kept] for name in ("t_ns", "t_sensor_ns", "acc_mps2", "gyr_radps")}
    return replace(track, **left), np.flatnonzero(kept)


def export(path: Path, track: Track, times: dict[str, np.ndarray], above: str = RATE) -> Path:
    values = [np.asarray(each, np.float64) for each in times.values()]
    return put(path, [*times, *VALUES], [*values, track.acc_mps2, track.gyr_radps], above=above)


def test_an_xsens_walk_with_losses_keeps_its_gaps(tmp_path: Path) -> None:
    """Both feet's counters wrap at 16 bits, at different samples; SampleTimeFine stays empty, as it does there."""
    recording = read_recording(WALK)
    for sensor, lost in (("left_foot", 511), ("right_foot", 603)):
        track, numbers = lossy(recording.tracks[sensor], lost)
        path = export(tmp_path / f"{sensor}.csv", track, {"PacketCounter": (64_000 + numbers) % 65_536})
        text = path.read_text().replace("PacketCounter,", "PacketCounter,SampleTimeFine,")
        head, rows = text.split("\n")[:2], text.split("\n")[2:]
        path.write_text("\n".join([*head, *(row.replace(",", ",,", 1) for row in rows)]))
    template = sidecar_template(tmp_path / "left_foot.csv")
    assert 'time_column = "PacketCounter"  # it counts samples, 511 of them missing' in template
    lines = [
        line.removeprefix("# ") if line[2:6] in ("[sen", "file", "acc ", "gyr ") else line
        for line in template.split("\n")
    ]
    (tmp_path / "left_foot.toml").write_text("\n".join(lines))
    read = read_recording(tmp_path / "left_foot.csv")
    assert {name: track.quality.missing for name, track in read.tracks.items()} == {"left_foot": 511, "right_foot": 603}
    calibrations = calibrations_of(recording)[1].calibrations
    strides = analyse(read, calibrations).strides
    assert all(np.count_nonzero([s.foot == foot and not s.valid for s in strides]) >= 5 for foot in read.tracks)


@pytest.mark.parametrize(
    ("name", "turn", "per_sample"),
    [
        ("PacketCounter", 65_536, 1),
        ("Packet number", 256, 1),
        ("sample_no", 10_000, 1),
        ("Frame Index", 2**32, 1),
        ("Counter", 65_536, 2),
        ("Timestamp (ms)", 65_536, 10),
        ("SampleTimeFine", 2**32, 100),
        ("SampleTimeFine", 2**32, 10_000),
    ],
)
def test_counters_that_wrap_are_proposed_and_their_gaps_counted(
    tmp_path: Path, name: str, turn: int, per_sample: int
) -> None:
    track, numbers = lossy(walk(seconds=20.0), 90)
    path = export(tmp_path / "left.csv", track, {name: (turn - 500 * per_sample + numbers * per_sample) % turn})
    read = accept(path).tracks["left_foot"]
    assert read.quality.missing == 90
    np.testing.assert_array_equal(read.t_ns - read.t_ns[0], track.t_ns - track.t_ns[0])
    assert f"time_wraps_at = {turn}" in sidecar_template(path)


def test_a_clock_written_from_the_rows_does_not_hide_what_the_counter_shows(tmp_path: Path) -> None:
    track, numbers = lossy(walk(seconds=20.0), 90)
    even = np.arange(numbers.size) * 0.01
    path = export(tmp_path / "left.csv", track, {"Time": even, "PacketCounter": numbers}, above="")
    assert accept(path).tracks["left_foot"].quality.missing == 90
    assert "rate_hz = 100  # by Time" in sidecar_template(path)


def test_a_number_of_the_row_does_not_hide_what_the_clock_shows(tmp_path: Path) -> None:
    track, numbers = lossy(walk(seconds=20.0), 90)
    path = export(
        tmp_path / "left.csv", track, {"Sample": np.arange(numbers.size), "Time (ms)": numbers * 10}, above=""
    )
    assert accept(path).tracks["left_foot"].quality.missing == 90


def test_without_a_rate_a_counter_asks_one_question(tmp_path: Path) -> None:
    track, numbers = lossy(walk(seconds=20.0), 90)
    path = export(tmp_path / "left.csv", track, {"PacketCounter": numbers}, above="")
    questions = [line for line in sidecar_template(path).split("\n") if "?" in line]
    assert questions == ["rate_hz = 0  # ? samples per second, as the sensor was set"]
    assert accept(path, rate_hz="100").tracks["left_foot"].quality.missing == 90


def test_each_sensor_of_a_file_has_its_own_counter(tmp_path: Path) -> None:
    recording = both_feet(seconds=20.0)
    names, columns = [], []
    for (sensor, track), start in zip(recording.tracks.items(), (65_000, 200), strict=True):
        names += [f"{sensor}_PacketCounter", *(f"{sensor}_{value}" for value in VALUES)]
        columns += [(start + np.arange(2000)) % 65_536, track.acc_mps2, track.gyr_radps]
    read = accept(put(tmp_path / "walk.csv", names, columns, above=RATE))
    starts = [int(track.t_ns[0]) for track in read.tracks.values()]
    assert starts[1] - starts[0] == pytest.approx((65_536 + 200 - 65_000) * 1e7), "the second had wrapped before"


def test_what_a_sidecar_says_of_counters_is_checked(tmp_path: Path) -> None:
    path = export(tmp_path / "left.csv", walk(), {"PacketCounter": np.arange(400)})
    good = sidecar_template(path)
    sidecar = path.with_suffix(".toml")
    sidecar.write_text(good.replace("rate_hz = 100", "#"))
    with pytest.raises(RecordingError, match=r'time_unit = "samples" needs rate_hz'):
        read_recording(path)
    sidecar.write_text(good.replace('time_unit = "samples"', 'time_unit = "samples"\ntime_wraps_at = 256'))
    with pytest.raises(
        RecordingError, match=r"line 259, column 'PacketCounter': 256 is none of 0 to 255; correct time_w"
    ):
        read_recording(path)
    sidecar.write_text(good.replace('"samples"', '"packets"'))
    with pytest.raises(RecordingError, match=r'time_unit = .packets.: must be "s", "ms", "us", "ns", "samples"'):
        read_recording(path)


def test_a_counter_that_was_set_back_is_no_wrap(tmp_path: Path) -> None:
    path = export(tmp_path / "left.csv", walk(seconds=20.0), {"PacketCounter": np.arange(2000) % 900})
    with pytest.raises(RecordingError, match=r"the clock jumps back 8\.990 s"):
        accept(path)


def test_unwrapping_keeps_steps_back() -> None:
    np.testing.assert_array_equal(
        unwrapped(np.array([254.0, 253.0, 255.0, 1.0, 240.0]), 256), [254, 253, 255, 257, 496]
    )
