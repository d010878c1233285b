"""Long recordings piece by piece: read, analysed, written; what is cut makes no difference to phases and strides."""

from __future__ import annotations

import csv
import gc
import json
import math
import weakref
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st
from pyarrow import parquet

from fes.analysis.parameters.gait import pooled, statistic
from fes.analysis.pipeline import analyse, analyse_chunks, calibrations_of
from fes.calibration.recording import calibrate_all, save
from fes.cli import analyse as cli_analyse
from fes.cli.common import TableFile, write_table
from fes.cli.main import main
from fes.recording import Recording, RecordingError, read, read_recording, write_recording
from fes.recording.chunks import cut_into_chunks, recording_chunks
from fes.recording.read import follow_recording

TRIAL = Path(__file__).resolve().parents[2] / "sim_inputs" / "both_feet_100hz.parquet"


@pytest.fixture(scope="module")
def walk():
    recording, found = calibrations_of(read_recording(TRIAL))
    return recording, found.calibrations, analyse(recording, found.calibrations)


def parts_of(recording: Recording, cuts: list[int]) -> list[Recording]:
    """The recording in parts that end before these rows."""
    edges = [0, *sorted(set(cuts)), max(track.t_ns.size for track in recording.tracks.values())]
    return [
        replace(recording, tracks={name: track.part(slice(a, b)) for name, track in recording.tracks.items()})
        for a, b in pairwise(edges)
    ]


@settings(max_examples=6, deadline=None)
@given(st.lists(st.integers(1, 6_400), min_size=1, max_size=3))
def test_wherever_a_recording_is_cut_phases_and_strides_stay_to_the_bit(walk, cuts):
    recording, calibrations, whole = walk
    pieces = list(analyse_chunks(cut_into_chunks(parts_of(recording, cuts), around_s=5.0), calibrations))
    order = lambda change: (change.t_ns, change.foot)  # noqa: E731
    assert sorted((c for p in pieces for c in p.phases), key=order) == sorted(whole.phases, key=order)
    name = lambda stride: (stride.foot, stride.number)  # noqa: E731
    strides, expected = sorted((s for p in pieces for s in p.strides), key=name), sorted(whole.strides, key=name)
    for stride, other in zip(strides, expected, strict=True):
        for field in ("t_start_ns", "t_end_ns", "valid", "clearance_m", "turn_rad", "t_swing_ns"):
            assert getattr(stride, field) == getattr(other, field) or math.isnan(getattr(stride, field))
    assert {foot: counts.used for foot, counts in pieces[-1].counts.items()} == {
        foot: counts.used for foot, counts in whole.counts.items()
    }


def test_two_pieces_show_the_same_events_lengths_and_path(walk):
    recording, calibrations, whole = walk
    pieces = list(analyse_chunks(cut_into_chunks(parts_of(recording, [4_000]), around_s=15.0), calibrations))
    key = lambda row: (row["foot"], row["t_mid_swing_s"])  # noqa: E731
    events = sorted((row for p in pieces for row in p.event_table().rows()), key=key)
    for row, other in zip(events, sorted(whole.event_table().rows(), key=key), strict=True):
        assert row["t_initial_contact_s"] == pytest.approx(other["t_initial_contact_s"], abs=1e-6)
        assert row["foot_strike_angle_rad"] == pytest.approx(other["foot_strike_angle_rad"], abs=1e-6, nan_ok=True)
    lengths = {(s.foot, s.number): s.stride_length_m for p in pieces for s in p.strides if s.valid}
    apart = [lengths[s.foot, s.number] - s.stride_length_m for s in whole.strides if s.valid]
    assert np.sqrt(np.mean(np.square(apart))) < 0.005
    rows = [row for p in pieces for row in p.path_table().rows()]
    times = sorted((row["foot"], row["t_s"]) for row in rows)
    assert times == sorted((row["foot"], row["t_s"]) for row in whole.path_table().rows())
    for foot in whole.paths:  # the path goes on where it was, without a jump
        own = sorted((row for row in rows if row["foot"] == foot), key=lambda row: row["t_s"])
        steps = [math.hypot(b["x_m"] - a["x_m"], b["y_m"] - a["y_m"]) for a, b in pairwise(own)]
        assert max(steps) < 0.7


def test_a_recording_that_is_one_piece_is_analysed_as_a_whole(walk):
    recording, calibrations, whole = walk
    (only,) = analyse_chunks(cut_into_chunks([recording]), calibrations)
    assert only.path_table().rows() == whole.path_table().rows()
    assert only.event_table().rows() == whole.event_table().rows()
    np.testing.assert_equal(only.stride_table().rows(), whole.stride_table().rows())


def test_pieces_that_are_done_with_are_not_kept(walk):
    recording, calibrations, _ = walk
    held: list[weakref.ref[np.ndarray]] = []

    def watched():
        for piece in cut_into_chunks(iter_parts(recording), around_s=2.0):
            held.append(weakref.ref(piece.recording.tracks["left_foot"].acc_mps2))
            yield piece

    kept = []
    for _ in analyse_chunks(watched(), calibrations):
        gc.collect()
        kept.append(sum(ref() is not None for ref in held))
    assert len(kept) == 6
    assert max(kept) <= 2  # this one, and the one being let go


def iter_parts(recording: Recording):
    size = max(track.t_ns.size for track in recording.tracks.values())
    for begin in range(0, size, -(-size // 6)):
        part = slice(begin, begin + -(-size // 6))
        yield replace(recording, tracks={name: track.part(part) for name, track in recording.tracks.items()})


@pytest.mark.parametrize("part_s", [7.3, 30.0, 61.0])
def test_a_file_read_in_parts_holds_the_same_samples(part_s, monkeypatch):
    monkeypatch.setattr(read, "FIRST_ROWS", 1000)
    whole = read_recording(TRIAL)
    parts = list(follow_recording(TRIAL, part_s))
    assert len(parts) == math.ceil(whole.tracks["left_foot"].t_ns.size / 100.0 / part_s)
    for name, track in whole.tracks.items():
        for field in ("t_ns", "t_sensor_ns", "acc_mps2", "gyr_radps"):
            joined = np.concatenate([getattr(part.tracks[name], field) for part in parts])
            assert np.array_equal(joined, getattr(track, field))
        assert {part.tracks[name].rate_hz for part in parts} == {track.rate_hz}


@settings(max_examples=20, deadline=None)
@given(st.lists(st.integers(1, 6_400), min_size=1, max_size=5))
def test_every_sample_is_one_piece_s_own(walk, cuts):
    recording = walk[0]
    pieces = list(cut_into_chunks(parts_of(recording, cuts), around_s=3.0))
    for name, track in recording.tracks.items():
        own = [piece.recording.tracks[name].t_sensor_ns[piece.own(piece.recording.tracks[name])] for piece in pieces]
        assert np.array_equal(np.concatenate(own), track.t_sensor_ns)


def test_a_fault_late_in_the_file_is_told_with_its_row(tmp_path, monkeypatch):
    monkeypatch.setattr(read, "FIRST_ROWS", 1000)
    path = tmp_path / "walk.parquet"
    write_recording(read_recording(TRIAL), path)
    table = parquet.read_table(path)
    damaged = table.column("left_foot_gyr_x").to_numpy().copy()
    damaged[5_876] = np.inf
    place = table.column_names.index("left_foot_gyr_x")
    parquet.write_table(table.set_column(place, "left_foot_gyr_x", [damaged]), path)
    with pytest.raises(RecordingError, match=r"row 5877, column 'left_foot_gyr_x'"):
        list(recording_chunks(path, chunk_s=20.0, whole_s=60.0))


@pytest.mark.parametrize("kind", ["csv", "parquet", "json"])
def test_a_long_recording_s_tables_are_those_of_a_short_one(kind, tmp_path, monkeypatch, walk):
    monkeypatch.setattr(read, "FIRST_ROWS", 1000)
    monkeypatch.setattr(cli_analyse, "recording_chunks", partial(recording_chunks, chunk_s=35.0, whole_s=60.0))
    report = [] if kind == "csv" else ["--no-report"]
    done = CliRunner().invoke(main, ["analyse", str(TRIAL), "--out", str(tmp_path), "--format", kind, *report])
    assert done.exit_code == 0, done.output
    (folder,) = tmp_path.iterdir()
    names = {"strides", "phases", "events", "path", "parameters", "parameters_summary", "mean_stride"}
    reports = {"report-01.html", "report-02.html"} if kind == "csv" else set()
    assert {file.name for file in folder.iterdir()} == {f"{name}.{kind}" for name in names} | reports
    strides = read_table(folder / f"strides.{kind}")
    assert len(strides) == len(walk[2].strides)
    assert {(row["foot"], int(row["number"])) for row in strides} == {(s.foot, s.number) for s in walk[2].strides}
    assert len(read_table(folder / f"path.{kind}")) == len(walk[2].path_table().rows())
    assert "Chunks" in done.output


def test_a_long_recording_as_json(tmp_path, monkeypatch):
    monkeypatch.setattr(read, "FIRST_ROWS", 1000)
    monkeypatch.setattr(cli_analyse, "recording_chunks", partial(recording_chunks, chunk_s=35.0, whole_s=60.0))
    done = CliRunner().invoke(main, ["analyse", str(TRIAL), "--out", str(tmp_path), "--json", "--no-report"])
    told = json.loads(done.stdout)
    assert len(told["pieces"]) == 2
    assert told["parameters"]["feet"]["left_foot"]["stride_length_common_m"]["n"] > 20


@pytest.mark.parametrize("stored", [False, True])
def test_feet_that_are_not_labelled_are_named_in_every_piece(stored, tmp_path, monkeypatch, walk):
    monkeypatch.setattr(read, "FIRST_ROWS", 1000)
    monkeypatch.setattr(cli_analyse, "recording_chunks", partial(recording_chunks, chunk_s=35.0, whole_s=60.0))
    path = tmp_path / "walk.parquet"
    feet = {"foot_a": "right_foot", "foot_b": "left_foot"}
    tracks = {name: replace(walk[0].tracks[foot], sensor=name) for name, foot in feet.items()}
    write_recording(replace(walk[0], tracks=tracks, geometry={}), path)
    options = ["--calibration", str(tmp_path / "known.json")] if stored else []
    if stored:
        save(calibrate_all(read_recording(path)), tmp_path / "known.json")
    out = tmp_path / "out"
    done = CliRunner().invoke(main, ["analyse", str(path), "--out", str(out), "--no-report", *options])
    assert done.exit_code == 0, done.output
    strides = read_table(next(out.iterdir()) / "strides.csv")
    assert {(row["foot"], int(row["number"])) for row in strides} == {(s.foot, s.number) for s in walk[2].strides}


def test_a_sensor_that_falls_silent_does_not_end_the_analysis(tmp_path, monkeypatch, walk):
    monkeypatch.setattr(read, "FIRST_ROWS", 1000)
    monkeypatch.setattr(cli_analyse, "recording_chunks", partial(recording_chunks, chunk_s=25.0, whole_s=60.0))
    path = tmp_path / "walk.parquet"
    write_recording(walk[0], path)
    table = parquet.read_table(path)
    for name in [name for name in table.column_names if name.startswith("right_foot")]:
        values = table.column(name).to_pylist()
        table = table.set_column(
            table.column_names.index(name), name, [values[:4_000] + [None] * (len(values) - 4_000)]
        )
    parquet.write_table(table, path)
    done = CliRunner().invoke(main, ["analyse", str(path), "--out", str(tmp_path / "out"), "--no-report"])
    assert done.exit_code == 0, done.output
    strides = read_table(next((tmp_path / "out").iterdir()) / "strides.csv")
    ends = {foot: max(float(row["t_end_s"]) for row in strides if row["foot"] == foot) for foot in walk[1]}
    assert ends["right_foot"] < 40.0
    assert ends["left_foot"] > 55.0


def read_table(path: Path) -> list[dict[str, object]]:
    if path.suffix == ".json":
        return list(json.loads(path.read_text()))
    if path.suffix == ".parquet":
        return list(parquet.read_table(path).to_pylist())
    with path.open() as file:
        return list(csv.DictReader(file))


@pytest.mark.parametrize("suffix", [".csv", ".json", ".parquet"])
def test_a_table_that_grows_is_the_same_as_one_written_at_once(suffix, tmp_path):
    rows = [{"a": k, "b": math.nan if k < 3 else 0.5 * k, "c": f"é{k}"} for k in range(7)]
    write_table(rows, tmp_path / f"once{suffix}")
    with TableFile(tmp_path / f"grown{suffix}") as file:
        for begin, end in ((0, 3), (3, 3), (3, 7)):
            file.add(rows[begin:end])
    assert read_table(tmp_path / f"grown{suffix}") == read_table(tmp_path / f"once{suffix}")
    write_table([], tmp_path / f"none{suffix}")
    assert read_table(tmp_path / f"none{suffix}") == []


VALUES = st.lists(st.floats(-1e3, 1e3), max_size=20)


@settings(deadline=None)
@given(VALUES, VALUES)
def test_statistics_put_together_are_those_of_all(one, other):
    found, expected = pooled(statistic(one), statistic(other)), statistic([*one, *other])
    assert found.n == expected.n
    assert found.mean == pytest.approx(expected.mean, rel=1e-9, abs=1e-9, nan_ok=True)
    assert found.sd == pytest.approx(expected.sd, rel=1e-6, abs=1e-6, nan_ok=True)
