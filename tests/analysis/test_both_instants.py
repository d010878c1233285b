"""Off-line tables carry the off-line instant and the live machine's side by side, in every table and file format."""

from __future__ import annotations

import csv
import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from pyarrow import parquet
from replays import TRIALS, trial
from shank_walks import shank_walk

from fes.analysis.pipeline import analyse, analyse_chunks, calibrations_of
from fes.analysis.results import Analysis
from fes.cli.main import main
from fes.estimation.events.offline import LONGEST_STANCE_S
from fes.notebook import replay
from fes.notebook.results import gather
from fes.recording import Recording
from fes.recording.arrays import recording_from_arrays
from fes.recording.chunks import cut_into_chunks
from fes.simulation.truth import load_truth

ENTRIES = {"T1": "t_pre_swing", "T2": "t_swing", "T3": "t_loading_response", "T4": "t_stance"}
FOOT = "right_foot"


@pytest.fixture(scope="module")
def result() -> Analysis:
    return analyse(trial("negard_patient2"))


def test_a_stride_has_both_and_the_off_line_ones_are_near_the_truth(result: Analysis) -> None:
    rows = result.stride_table().rows()
    true = [s for s in load_truth(TRIALS / "negard_patient2.parquet").strides if s.walking]
    pairs = [(row, s) for row in rows for s in true if row["t_start_s"] < s.t_swing_s < row["t_end_s"]]
    assert len(pairs) == len(true) == 45
    for name, most_s in (("t_pre_swing", 0.03), ("t_swing", 0.01), ("t_loading_response", 0.01), ("t_stance", 0.03)):
        off_line = np.array([row[f"{name}_s"] - getattr(s, f"{name}_s") for row, s in pairs])
        assert abs(np.median(off_line)) < most_s
    for row, stride in zip(rows, result.strides, strict=True):
        for name in ENTRIES.values():
            assert row[f"{name}_live_s"] == 1e-9 * getattr(stride, f"{name}_ns")
        times = [row[f"{name}_s"] for name in ENTRIES.values()]
        assert times == sorted(times)


def test_the_first_heel_rise_and_the_last_foot_flat_are_found_where_the_foot_stands(result: Analysis) -> None:
    events = result.events[FOOT]
    assert events.heel_rise_ns is not None
    assert events.foot_flat_ns is not None
    assert events.heel_rise_ns[0] < events.fo_ns[0] < events.ic_ns[-1] <= events.foot_flat_ns[-1]
    track = result.recording.tracks[FOOT]
    cut_ns = int(events.ic_ns[-1] + 1e9 * (LONGEST_STANCE_S - 0.1))
    short = analyse(
        replace(result.recording, tracks={FOOT: track.part(slice(0, int(np.searchsorted(track.t_ns, cut_ns))))}),
        result.calibrations,
    )
    rows = short.event_table().rows()
    assert rows[-1]["t_initial_contact_s"] == pytest.approx(1e-9 * events.ic_ns[-1])
    assert short.offline_entries[-1, -1] < short.events[FOOT].ic_ns[-1], "nobody knows what followed"


def test_a_phase_change_has_both_and_those_of_no_swing_have_the_live_one_alone() -> None:
    result = analyse(trial("not_walking"))
    rows = result.phase_table().rows()
    of_swings = {(row["foot"], row["t_swing_s"]) for row in result.stride_table()}
    assert [row["t_live_s"] for row in rows] == [1e-9 * change.t_ns for change in result.phases]
    kinds = {row["transition"] for row in rows}
    assert "T5" in kinds
    assert all(math.isnan(row["t_s"]) for row in rows if row["transition"] in ("T5", "T6", "NONE"))
    off = [(row["foot"], row["t_s"]) for row in rows if row["transition"] == "T2" and not math.isnan(row["t_s"])]
    assert {(foot, t_s) for foot, t_s in of_swings if not math.isnan(t_s)} <= set(off)


@pytest.mark.parametrize("kind", ["csv", "parquet", "json"])
def test_every_file_format_has_both(tmp_path: Path, result: Analysis, kind: str) -> None:
    path = str(TRIALS / "negard_patient2.parquet")
    wanted = ["--out", str(tmp_path), "--format", kind, "--no-report", "--json"]
    done = CliRunner().invoke(main, ["analyse", path, *wanted])
    assert done.exit_code == 0, done.output
    shown = json.loads(done.stdout)["strides"]
    assert all(row["live"]["loading_response_live_s"] > 0.0 for row in shown)
    for name, rows in (
        ("strides", result.stride_table().rows()),
        ("phases", result.phase_table().rows()),
        ("events", result.event_table().rows()),
    ):
        read = table(next(tmp_path.glob(f"*/{name}.{kind}")))
        assert list(read[0]) == list(rows[0])
        live = [column for column in rows[0] if column.endswith("live_s")]
        assert live
        for column in (*live, *(c.replace("_live_s", "_s") for c in live)):
            for written, row in zip(read, rows, strict=True):
                value = math.nan if written[column] in (None, "") else float(written[column])
                assert value == pytest.approx(row[column], abs=0.0, nan_ok=True)


def table(path: Path) -> list[dict[str, Any]]:
    if path.suffix == ".parquet":
        rows: list[dict[str, Any]] = parquet.read_table(path).to_pylist()
        return rows
    with path.open() as file:
        return list(json.load(file) if path.suffix == ".json" else csv.DictReader(file))


def test_python_has_both_and_a_session_the_live_ones_alone(result: Analysis) -> None:
    tables = gather([result])
    assert {"t_s", "t_live_s"} <= set(tables.phases.names)
    assert {f"{name}_live_s" for name in ENTRIES.values()} <= set(tables.strides.names)
    assert {"t_foot_off_live_s", "t_initial_contact_live_s"} <= set(tables.events.names)
    late_s = tables.events["t_initial_contact_live_s"] - tables.events["t_initial_contact_s"]
    assert np.nanmax(np.abs(late_s)) < 0.2
    log = replay(trial("negard_patient2"))
    assert not [name for name in (*log.strides.names, *log.phases.names) if "live" in name]
    np.testing.assert_allclose(log.phases["t_s"], tables.phases["t_live_s"], atol=1e-9)


def test_a_shank_has_the_live_ones_alone() -> None:
    walk = shank_walk(standing_s=3.0, noise=0.02)
    result = analyse(recording_from_arrays({"left_shank": walk.acc}, {"left_shank": walk.gyr}, walk.rate_hz))
    rows = result.stride_table().rows()
    assert rows
    assert all(math.isnan(row["t_swing_s"]) and row["t_swing_live_s"] > 0.0 for row in rows if row["valid"])
    assert all(math.isnan(row["t_s"]) for row in result.phase_table().rows())


def test_a_recording_in_pieces_has_the_same() -> None:
    recording = trial("negard_patient2")
    _, found = calibrations_of(recording)
    track = recording.tracks[FOOT]
    half = len(track.t_ns) // 2
    halves: list[Recording] = [replace(recording, tracks={FOOT: track.part(part)}) for part in
                               (slice(half), slice(half, None))]  # fmt: skip
    pieces = list(analyse_chunks(cut_into_chunks(halves, around_s=12.0), found.calibrations))
    rows = [row for piece in pieces for row in piece.phase_table().rows()]
    whole = analyse(recording, found.calibrations).phase_table().rows()
    assert [(row["t_live_s"], row["transition"]) for row in rows] == [(r["t_live_s"], r["transition"]) for r in whole]
    np.testing.assert_allclose([row["t_s"] for row in rows], [row["t_s"] for row in whole], atol=0.011)
