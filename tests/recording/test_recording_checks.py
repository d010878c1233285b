"""Every fault a recording can have is refused (or counted) with the file, the place and the fix."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from test_recording import both_feet, walk

from fes.recording import Recording, RecordingError, read_recording, write_recording
from fes.recording.sidecar import load_sidecar
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


# --- units -----------------------------------------------------------------------------------------------


def test_g_declared_as_mps2(good: Csv) -> None:
    good.scale(ACC, 1 / G_MPS2)
    good.fails("left_foot", "looks like g", 'set acc_unit = "g"')
    good.sidecar = good.sidecar.replace("m/s^2", "g")
    np.testing.assert_allclose(good.read().tracks["left_foot"].acc_mps2, walk().acc_mps2, rtol=1e-5, atol=1e-5)


def test_mps2_declared_as_g(good: Csv) -> None:
    good.sidecar = good.sidecar.replace("m/s^2", "g")
    good.fails("looks like m/s^2", 'set acc_unit = "m/s^2"')


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


def test_radians_declared_as_degrees(good: Csv) -> None:
    good.sidecar = good.sidecar.replace("rad/s", "deg/s")
    good.fails("shows movement", 'set gyr_unit = "rad/s"')


def test_a_sensor_that_lies_still_may_turn_little(good: Csv) -> None:
    good.rows = [[row[0], "0.1", "0", "9.8", "0.001", "0", "0"] for row in good.rows]
    good.sidecar = good.sidecar.replace("rad/s", "deg/s")
    assert good.read().tracks["left_foot"].quality.samples == 400


def test_acc_and_gyr_swapped(good: Csv) -> None:
    good.sidecar = good.sidecar.replace("acc =", "was =").replace("gyr =", "acc =").replace("was =", "gyr =")
    good.fails("columns of acc and gyr are swapped")


def test_gravity_subtracted(good: Csv) -> None:
    for row in good.rows:
        row[3] = f"{float(row[3]) - G_MPS2:.6g}"
    good.fails("gravity is missing", "raw acceleration")


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


def test_missing_columns_suggest_near_names(good: Csv) -> None:
    good.header = good.header.replace("gyr_y", "gyro_y")
    good.fails("has no column 'gyr_y'", "Did you mean 'gyro_y'", "Its columns are: 't', 'acc_x'")


def test_a_column_that_is_there_twice(good: Csv) -> None:
    good.header = good.header.replace("gyr_y", "gyr_x")
    good.fails("2 columns 'gyr_x'", "header_lines = 2")


def test_semicolons_and_decimal_commas(good: Csv) -> None:
    text = good.text().replace(",", ";").replace(".", ",")
    good.fails('separated by ";"', 'delimiter = ";"', text=text)
    good.sidecar = 'delimiter = ";"\n' + good.sidecar
    good.fails("line 2", "'acc_x'", "decimal comma", 'decimal = ","', text=text)
    good.sidecar = 'decimal = ","\n' + good.sidecar
    np.testing.assert_allclose(good.read(text).tracks["left_foot"].gyr_radps, walk().gyr_radps, rtol=1e-6)


def test_text_in_a_column(good: Csv) -> None:
    good.rows[100][2] = "n/a"
    good.fails("line 102", "column 'acc_y'", "'n/a' is no number")


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


@pytest.mark.parametrize(("value", "shown"), [("nan", "nan"), ("NaN", "nan"), ("inf", "inf"), ("-inf", "-inf")])
def test_not_finite(good: Csv, value: str, shown: str) -> None:
    good.rows[20][5] = good.rows[30][6] = good.rows[30][1] = value
    good.fails(f"line 22, column 'gyr_y': {shown} is no measurement (3 such values in 2 rows)")


def test_absurd_numbers(good: Csv) -> None:
    good.rows[20][5], good.rows[21][5] = "1.7e308", "1.7e308"
    good.fails("line 22, column 'gyr_y': 1.7e+308 is no measurement (2 such values in 2 rows)")


# --- lost samples and time ------------------------------------------------------------------------------------


def test_empty_rows_are_lost_samples(good: Csv) -> None:
    for row in (0, 50, 51, 399):
        good.rows[row][1:] = [""] * 6
    track = good.read().tracks["left_foot"]
    assert (track.quality.samples, track.quality.missing, track.quality.irregular) == (396, 4, 0)
    assert track.t_ns[0] == 10_000_000
    np.testing.assert_allclose(track.acc_mps2[49], walk().acc_mps2[52], rtol=1e-6)


def test_partly_empty_rows_are_refused(good: Csv) -> None:
    good.rows[50][3] = good.rows[60][3] = ""
    good.fails("line 52", "column 'acc_z' is empty and others of the sensor are not (2 such rows)", "all six")


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


def test_time_that_goes_back_too_often(good: Csv) -> None:
    for row in range(2, 80, 3):
        good.rows[row][0], good.rows[row + 1][0] = good.rows[row + 1][0], good.rows[row][0]
    good.fails("time goes backward 26 times in 400 samples, first at line 5", "Sort the rows")


def test_a_clock_that_restarts(good: Csv) -> None:
    for row in good.rows[250:]:
        row[0] = f"{float(row[0]) - 2.5:.6g}"
    good.fails("line 252: the clock jumps back 2.49", "split the file")


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


def test_time_that_stands_still(good: Csv) -> None:
    for row in good.rows:
        row[0] = "3.0"
    good.fails("its time never advances", "time_column")


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
