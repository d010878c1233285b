"""Converted logs hold what the log holds, in formats that other programs read."""

from __future__ import annotations

import csv
import dataclasses
import json
import math
import sys
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from pyarrow import parquet

from fes.cli.main import main
from fes.evaluation.reference.read import read_references
from fes.session_log import Note, Received, SessionRecord, SessionWriter, read_session
from fes.session_log.export import SINGLES, Column, Exported, batches, epoch_offset_ns, to_csv, to_mcap, to_parquet
from fes.signals import (
    FootSwitchEvent,
    ImuSample,
    OperatorAct,
    OperatorAction,
    StimAlive,
    StimCommand,
    StimOpened,
    StimStatus,
    StrideResult,
    SystemFault,
    Tick,
    WireFrame,
)
from statemachine.phases import Phase, PhaseChange, Transition

CREATED = "2026-03-01T10:00:00+00:00"
CREATED_NS = 1_772_359_200 * 10**9


def everything(path: Path, seconds: float = 2.0, created: str = CREATED) -> Path:
    """A log with each kind of record, samples at 200 Hz."""
    writer = SessionWriter(path, {"format": 1, "created": created, "session": {"name": "ü"}, "unknown": float("nan")})
    for k in range(int(200 * seconds)):
        t_ns = 10**9 + k * 5_000_000
        for sensor in ("left_foot", "right_shank"):
            writer.event(ImuSample(t_ns, sensor, t_ns - 1000, (0.1 * k, -2.0, 9.81), (0.25, math.nan, -0.5)))
        writer.latency(t_ns, 50_000 + k)
        writer.flush_due(t_ns)
        if k % 4 == 0:
            command = StimCommand(t_ns, 0, k % 8 == 0, 10.5, 200.0, 40.0, 60, 'too "fast", really' if k == 4 else "")
            writer.command(command, WireFrame(t_ns, 0x123, bytes([k % 256, 1])))
            writer.event(StimStatus(t_ns, 0, k % 16, True, 10.5, 200.0, 40.0, 2, 1.5, ""))
    writer.received(Received(2 * 10**9, b"\x0f\xf0"))
    writer.event(Tick(2 * 10**9))
    writer.event(OperatorAct(2 * 10**9, OperatorAction.SET_INTENSITY, 0.5))
    writer.event(StimAlive(2 * 10**9, 7, 0))
    writer.event(StimOpened(2 * 10**9, 9))
    writer.event(FootSwitchEvent(2 * 10**9, "left_foot", True))
    writer.event(FootSwitchEvent(2 * 10**9, "left_foot", None))
    writer.event(SystemFault(2 * 10**9, "left_foot lost"))
    writer.note(Note(2 * 10**9, "warning", "gate", "two\nlines, and a comma"))
    writer.phase(PhaseChange(15 * 10**8, "left_foot", Transition.T1, Phase.STANCE, Phase.PRE_SWING))
    path_m, pitch, roll = np.arange(9.0).reshape(3, 3), np.array([0.0, 0.5, 0.25]), np.array([0.0, 0.1, 0.0])
    ends = (10**9, 2 * 10**9)
    stride = StrideResult("left_foot", 1, *ends, 1.0, 0.1, 0.0, 0.0, 1.0, 1, None, 3, 4)
    writer.stride(dataclasses.replace(stride, trajectory_m=path_m, pitch_rad=pitch, roll_rad=roll))
    writer.close({"done": True})
    return path


@pytest.fixture
def log(tmp_path: Path) -> Path:
    return everything(tmp_path / "session.feslog")


def counts(record: SessionRecord) -> dict[str, int]:
    """Rows that each table must have."""
    out = {f"imu_{sensor}": len(arrays.t_ns) for sensor, arrays in record.samples.items()}
    out |= {
        "latency": len(record.latency_ns),
        "ticks": len(record.ticks_ns),
        "operator": len(record.acts),
        "statuses": len(record.statuses),
        "heartbeats": len(record.alive),
        "phases": len(record.phases),
        "strides": len(record.strides),
        "stride_paths": sum(len(stride.pitch_rad) for stride in record.strides),
        "commands": len(record.commands),
        "frames": len(record.frames),
        "notes": len(record.notes),
        "reopened": len(record.reopened),
        "foot_switches": len(record.switches),
        "system_faults": len(record.faults),
        "received": len(record.received),
    }
    return {name: rows for name, rows in out.items() if rows}


def csv_rows(folder: Path, table: str) -> list[dict[str, str]]:
    with (folder / f"{table}.csv").open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def test_csv_holds_everything(log: Path, tmp_path: Path) -> None:
    record, folder = read_session(log), tmp_path / "csv"
    exported = to_csv(log, folder)
    assert exported.rows == counts(record)
    assert {path.stem: len(csv_rows(folder, path.stem)) for path in folder.glob("*.csv")} == counts(record)
    imu = csv_rows(folder, "imu_left_foot")
    assert list(imu[0]) == [
        "t_ns",
        "t_sensor_ns",
        *(f"acc_{axis}_mps2" for axis in "xyz"),
        *(f"gyr_{axis}_radps" for axis in "xyz"),
    ]
    arrays = record.samples["left_foot"]
    assert [int(row["t_ns"]) for row in imu] == arrays.t_ns.tolist()
    assert [float(row["acc_x_mps2"]) for row in imu] == arrays.acc_mps2[:, 0].tolist()
    assert {row["gyr_y_radps"] for row in imu} == {""}, "what is not known is empty"
    commands = csv_rows(folder, "commands")
    assert [row["on"] == "true" for row in commands] == [command.on for command in record.commands]
    assert commands[1]["refused"] == 'too "fast", really'
    assert csv_rows(folder, "notes")[0]["text"] == "two\nlines, and a comma"
    assert csv_rows(folder, "frames")[1]["data"] == "0401"
    assert csv_rows(folder, "received")[0]["data"] == "0ff0"
    assert [row["pressed"] for row in csv_rows(folder, "foot_switches")] == ["true", ""]
    (phase,) = csv_rows(folder, "phases")
    assert (phase["transition"], phase["source"], phase["destination"], phase["phase"]) == (
        "T1",
        "STANCE",
        "PRE_SWING",
        "1",
    )
    (stride,) = csv_rows(folder, "strides")
    assert (stride["t_swing_ns"], stride["stride_length_m"], stride["valid"]) == ("", "1.0", "true")
    assert [row["t_ns"] for row in csv_rows(folder, "stride_paths")] == ["1000000000", "1500000000", "2000000000"]
    assert [row["roll_rad"] for row in csv_rows(folder, "stride_paths")] == ["0.0", "0.10000000149011612", "0.0"]
    about = json.loads((folder / "session.json").read_text(), parse_constant=pytest.fail)
    assert about["summary"] == {"done": True}
    assert about["header"]["unknown"] is None


def test_parquet_holds_everything_with_units(log: Path, tmp_path: Path) -> None:
    record, folder = read_session(log), tmp_path / "parquet"
    assert to_parquet(log, folder).rows == counts(record)
    tables = {path.stem: parquet.read_table(path) for path in folder.glob("*.parquet")}
    assert {name: table.num_rows for name, table in tables.items()} == counts(record)
    imu = tables["imu_right_shank"]
    assert imu.schema.field("acc_x_mps2").metadata == {b"unit": "m/s²".encode()}
    assert imu.schema.field("t_ns").metadata == {b"unit": b"ns"}
    assert json.loads(imu.schema.metadata[b"session_header"])["session"]["name"] == "ü"
    assert imu.column("t_sensor_ns").to_pylist() == record.samples["right_shank"].t_sensor_ns.tolist()
    np.testing.assert_array_equal(imu.column("gyr_y_radps"), record.samples["right_shank"].gyr_radps[:, 1])
    assert tables["commands"].column("current_ma").to_pylist() == [10.5] * len(record.commands)
    assert tables["strides"].column("t_swing_ns").to_pylist() == [None]
    assert tables["foot_switches"].column("pressed").to_pylist() == [True, None]
    assert tables["stride_paths"].column("y_m").to_pylist() == [1.0, 4.0, 7.0]


def mcap_messages(path: Path) -> dict[str, list[tuple[int, dict[str, Any]]]]:
    from mcap.reader import make_reader

    found: dict[str, list[tuple[int, dict[str, Any]]]] = {}
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file, validate_crcs=True).iter_messages():
            assert schema is not None
            assert (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
            value = json.loads(message.data, parse_constant=pytest.fail)
            assert set(json.loads(schema.data)["properties"]) == set(value)
            found.setdefault(channel.topic, []).append((message.log_time, value))
    return found


def test_mcap_is_read_back_whole(log: Path, tmp_path: Path) -> None:
    from mcap.reader import make_reader

    record, target = read_session(log), tmp_path / "session.mcap"
    assert to_mcap(log, target).rows == counts(record)
    messages = mcap_messages(target)
    names = {f"/imu/{name[4:]}" if name.startswith("imu_") else f"/{name}": n for name, n in counts(record).items()}
    assert {topic: len(found) for topic, found in messages.items()} == names
    times = [time for time, _ in messages["/imu/left_foot"]]
    assert times == [CREATED_NS + t - 10**9 for t in record.samples["left_foot"].t_ns.tolist()]
    first = messages["/imu/left_foot"][1][1]
    assert (first["acc_x_mps2"], first["gyr_y_radps"]) == (record.samples["left_foot"].acc_mps2[1, 0], None)
    assert messages["/strides"][0][0] == CREATED_NS + 10**9
    with target.open("rb") as file:
        reader = make_reader(file)
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        assert summary.statistics.message_count == sum(counts(record).values())
        assert {chunk.compression for chunk in summary.chunk_indexes} == {"zstd"}
        about = {item.name: item.metadata for item in reader.iter_metadata()}
    assert json.loads(about["fes_session"]["header"])["created"] == CREATED
    assert json.loads(about["fes_summary"]["rows"]) == counts(record)


def test_mcap_times_without_a_date(tmp_path: Path) -> None:
    log = everything(tmp_path / "undated.feslog", 0.1, created="yesterday")
    to_mcap(log, tmp_path / "undated.mcap")
    times = [time for time, _ in mcap_messages(tmp_path / "undated.mcap")["/imu/left_foot"]]
    assert times[:3] == [0, 5_000_000, 10_000_000]


def test_a_live_header_says_when_it_was_made() -> None:
    assert epoch_offset_ns({"created": CREATED, "created_t_ns": 5}, 99) == (CREATED_NS - 5, True)
    assert epoch_offset_ns({"created": CREATED}, 99) == (CREATED_NS - 99, True)
    assert epoch_offset_ns({}, 99) == (-99, False)


def test_every_field_of_every_record_has_a_column() -> None:
    left_out = {"trajectory_m", "pitch_rad", "roll_rad", "left_over"}
    for kind, table in SINGLES.items():
        assert {item.name for item in dataclasses.fields(kind)} - left_out <= {c.name for c in table.columns}
        assert table.time in {column.name for column in table.columns}
    units = {c.name: c.unit for table in SINGLES.values() for c in table.columns}
    assert (units["current_ma"], units["charge_uc"], units["speed_mps"], units["on"]) == ("mA", "µC", "m/s", "")
    assert Column("on", "bool").unit == ""


@pytest.mark.parametrize("form", ["csv", "parquet", "mcap"])
def test_nothing_is_overwritten(form: str, log: Path, tmp_path: Path) -> None:
    runner = CliRunner()
    assert runner.invoke(main, ["convert", str(log), "--to", form]).exit_code == 0
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    again = runner.invoke(main, ["convert", str(log), "--to", form])
    assert again.exit_code == 2
    assert "not overwritten" in again.output
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


@pytest.mark.parametrize("form", ["csv", "parquet", "mcap"])
def test_a_damaged_log_gives_what_is_whole(form: str, log: Path, tmp_path: Path) -> None:
    data = bytearray(log.read_bytes())
    data[len(data) // 2] ^= 1
    damaged = tmp_path / "damaged.feslog"
    damaged.write_bytes(data[:-5])
    result = CliRunner().invoke(main, ["convert", str(damaged), "--to", form, "--json"])
    assert result.exit_code == 0
    assert "fes recover" in result.stderr
    rows, whole = json.loads(result.stdout)["rows"], counts(read_session(log))
    assert all(0 <= whole[name] - rows[name] < 30 for name in whole)
    assert sum(whole.values()) > sum(rows.values())


def test_what_is_no_log(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("t,x\n1,2\n3,4\n")
    for form in ("csv", "parquet", "mcap"):
        for name, says in (("a.csv", "not a session log"), ("gone.feslog", "cannot be read")):
            args = ["convert", str(tmp_path / name), "--to", form, "--out", str(tmp_path / f"{name}-{form}")]
            result = CliRunner().invoke(main, args)
            assert result.exit_code == 2
            assert says in result.output
            assert not (tmp_path / f"{name}-{form}").exists()


def test_without_the_mcap_library(log: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mcap.writer", None)
    result = CliRunner().invoke(main, ["convert", str(log), "--to", "mcap"])
    assert result.exit_code == 2
    assert "pip install 'fes-gait[mcap]'" in result.output
    assert not log.with_suffix(".mcap").exists()


def test_the_ending_of_out_tells_the_format(log: Path, tmp_path: Path) -> None:
    result = CliRunner().invoke(main, ["convert", str(log), "--out", str(tmp_path / "x.mcap")])
    assert result.exit_code == 0
    assert (tmp_path / "x.mcap").read_bytes()[1:5] == b"MCAP"


def test_memory_does_not_grow_with_the_log(tmp_path: Path) -> None:
    peaks = []
    for seconds in (60.0, 240.0):
        log = everything(tmp_path / f"{seconds}.feslog", seconds)
        tracemalloc.start()
        exported = Exported()
        total = sum(len(batch) for batch in batches(log, exported, rows=2000))
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
        assert total == sum(exported.rows.values()) == sum(counts(read_session(log)).values())
    assert peaks[1] < 1.5 * peaks[0]


# --- A session log as C3D: read back with the library ---


ezc3d = pytest.importorskip("ezc3d", reason="writing C3D is an extra")
S = 10**9
FEET = ("left_foot", "right_foot")
CYCLE = (
    (0.20, Transition.T1, Phase.STANCE, Phase.PRE_SWING),
    (0.35, Transition.T2, Phase.PRE_SWING, Phase.SWING),
    (0.80, Transition.T3, Phase.SWING, Phase.LOADING_RESPONSE),
    (0.95, Transition.T4, Phase.LOADING_RESPONSE, Phase.STANCE),
)


def signal(t_s: float, axis: int) -> float:
    return (axis + 1) * math.sin(2.0 * math.pi * 1.5 * t_s)


def written(path: Path, seconds: float = 70.0, drift: float = 50e-6) -> Path:
    """Two feet at 100 Hz whose samples arrive late by up to 8 ms; the left one's clock drifts; 0.5 s missing."""
    writer = SessionWriter(path, {"format": 1, "session": {"name": "made"}})
    late = np.random.default_rng(1).uniform(0.0, 0.008, round(100 * seconds))
    for k, delay_s in enumerate(late.tolist()):
        t_s = 0.01 * k
        arrived = 5 * S + round(1e9 * (t_s + delay_s))
        for foot in FEET:
            if foot == "right_foot" and 10.0 <= t_s < 10.5:
                continue
            stamp = round(1e9 * t_s * (1.0 + (drift if foot == "left_foot" else 0.0)))
            acc = tuple(signal(t_s, axis) for axis in range(3))
            writer.event(ImuSample(arrived, foot, stamp, acc, (0.5, 0.25, math.nan if k == 50 else -t_s)))
        if 20.0 <= t_s < 21.0 and k % 2 == 0:
            writer.command(StimCommand(arrived, 0, True, 20.0, 200.0, 40.0, 60), WireFrame(arrived, 1, b""))
        writer.flush_due(arrived)
    for second in range(round(seconds) - 1):
        for share, transition, source, destination in CYCLE:
            writer.phase(
                PhaseChange(5 * S + round(1e9 * (second + share)), FEET[second % 2], transition, source, destination)
            )
    way = np.column_stack([np.linspace(0.0, 1.2, 50), np.zeros(50), 0.05 * np.sin(np.linspace(0.0, math.pi, 50))])
    ends = (6 * S, 7 * S, 1.2, 0.05, 0.0, 0.0, 1.0, None, None, None, None)
    writer.stride(StrideResult("left_foot", 1, *ends, trajectory_m=way, pitch_rad=way[:, 2]))
    writer.close({})
    return path


def converted(log: Path, *options: str) -> Any:
    result = CliRunner().invoke(main, ["convert", str(log), "--to", "c3d", *options])
    assert result.exit_code == 0, result.output
    return ezc3d.c3d(str(log.with_suffix(".c3d")))


def test_signals_current_phases_and_ways_are_the_logs(tmp_path: Path) -> None:
    file = converted(written(tmp_path / "walk.feslog"))
    group = file["parameters"]["ANALOG"]
    labels, units = group["LABELS"]["value"], group["UNITS"]["value"]
    rate_hz = group["RATE"]["value"][0]
    assert rate_hz == 100.0
    rows = dict(zip(labels, file["data"]["analogs"][0], strict=True))
    assert units[labels.index("left_foot.AccX")] == "m/s^2"
    assert units[labels.index("right_foot.GyrZ")] == "rad/s"
    t_s = np.arange(len(rows["left_foot.AccX"])) / rate_hz
    for foot in FEET:
        present = rows[f"{foot}.Present"] > 0.5
        assert np.mean(~present) == pytest.approx(0.0 if foot == "left_foot" else 0.5 / 70.0, abs=0.001)
        for axis, letter in enumerate("XYZ"):
            truth = (axis + 1) * np.sin(2.0 * np.pi * 1.5 * t_s)
            # the common times may lie a few milliseconds beside the true ones: nobody knows the mean delay
            assert np.max(np.abs(rows[f"{foot}.Acc{letter}"] - truth)[present]) < (axis + 1) * 9.5 * 0.006
    assert np.all(np.isfinite(np.asarray(list(rows.values()))))
    current = rows["stimulation.0"]
    assert set(np.unique(current)) == {0.0, 20.0}
    on_s = t_s[current > 0.0]
    assert on_s[0] == pytest.approx(20.0, abs=0.02)
    assert on_s[-1] == pytest.approx(21.05, abs=0.03)
    assert set(np.unique(rows["left_foot.Phase"])) == {0.0, 1.0, 2.0, 3.0}
    points = file["data"]["points"]
    assert file["parameters"]["POINT"]["LABELS"]["value"] == ["left_foot.sensor"]
    seen = np.isfinite(points[0, 0])
    assert np.mean(seen) == pytest.approx(1.0 / 70.0, abs=0.001)
    assert np.nanmax(points[0, 0]) == pytest.approx(1200.0, rel=0.02)
    assert np.nanmax(points[2, 0]) == pytest.approx(50.0, rel=0.01)


def test_events_come_back_as_a_reference_in_minutes_and_seconds(tmp_path: Path) -> None:
    log = written(tmp_path / "walk.feslog")
    converted(log)
    events = read_references([log.with_suffix(".c3d")]).events
    assert len(events) == 2 * 69
    assert [(one.foot, one.what) for one in events[:4]] == [
        ("left_foot", "FO"), ("left_foot", "IC"), ("right_foot", "FO"), ("right_foot", "IC"),
    ]  # fmt: skip
    spacing = np.diff([one.t_s for one in events if one.what == "IC"])
    np.testing.assert_allclose(spacing, 1.0, atol=1e-4)
    assert events[-1].t_s == pytest.approx(68.8, abs=0.02)


def test_a_long_session_stays_within_what_the_format_counts(tmp_path: Path) -> None:
    path = tmp_path / "long.feslog"
    writer = SessionWriter(path, {"format": 1, "session": {"name": "made"}})
    for k in range(70_000):
        writer.event(ImuSample(k * 10**7, "left_foot", k * 10**7, (0.0, 0.0, 9.81), (0.0, 0.0, 0.0)))
        writer.flush_due(k * 10**7)
    writer.close({})
    file = converted(path)
    assert file["parameters"]["POINT"]["RATE"]["value"][0] == 50.0
    assert file["data"]["analogs"].shape[2] == 70_000


def test_nothing_is_overwritten_and_an_empty_session_is_said(tmp_path: Path) -> None:
    log = written(tmp_path / "walk.feslog", 3.0)
    target = log.with_suffix(".c3d")
    target.write_bytes(b"mine")
    result = CliRunner().invoke(main, ["convert", str(log), "--to", "c3d"])
    assert result.exit_code == 2
    assert "not overwritten" in result.output
    assert target.read_bytes() == b"mine"
    empty = tmp_path / "empty.feslog"
    SessionWriter(empty, {"format": 1, "session": {"name": "made"}}).close({})
    result = CliRunner().invoke(main, ["convert", str(empty), "--to", "c3d"])
    assert result.exit_code == 2
    assert "no sensor's samples" in result.output
    result = CliRunner().invoke(main, ["convert", str(log), "--to", "c3d", "--out", str(tmp_path / "no" / "a.c3d")])
    assert result.exit_code == 2
    assert "cannot be written" in result.output
