"""An analysis by other methods: each changes what it should, and little; events as they would be known on-line."""

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

from fes.analysis.methods import CAUSAL_EVENT_COLUMNS, Methods, causal_event_rows
from fes.analysis.pipeline import analyse, analyse_chunks, calibrations_of
from fes.analysis.results import Analysis
from fes.cli.main import main
from fes.estimation.events.causal import Decision, OnlineEvent, Rule
from fes.estimation.events.offline import LONGEST_STANCE_S, GaitEvents
from fes.estimation.zupt.detectors import Detector
from fes.notebook import replay
from fes.notebook.results import gather
from fes.recording import Recording, read_recording
from fes.recording.arrays import recording_from_arrays
from fes.recording.chunks import cut_into_chunks
from fes.simulation.truth import load_truth

TRIAL = Path(__file__).resolve().parents[2] / "sim_inputs" / "both_feet_100hz.parquet"
FEET = ("left_foot", "right_foot")


@pytest.fixture(scope="module")
def usual() -> Analysis:
    recording, found = calibrations_of(read_recording(TRIAL))
    return analyse(recording, found.calibrations)


def by(usual: Analysis, methods: Methods) -> Analysis:
    return analyse(usual.recording, usual.calibrations, methods=methods)


def lengths(result: Analysis) -> np.ndarray:
    return np.array([stride.stride_length_m for stride in result.strides if stride.valid])


def apart_m(one: Analysis, other: Analysis, foot: str) -> float:
    return float(np.abs(one.paths[foot].position_m - other.paths[foot].position_m).max())


def test_the_methods_of_every_report_are_the_default(usual: Analysis) -> None:
    same = by(usual, Methods())
    assert np.array_equal(lengths(same), lengths(usual))
    assert all(apart_m(same, usual, foot) == 0.0 for foot in FEET)
    assert usual.causal_event_table().rows() == []
    assert "events_causal" not in usual.tables()


@pytest.mark.parametrize("detector", [d for d in Detector if d is not Detector.SHOE], ids=lambda d: d.name)
def test_another_detector_gives_another_path_and_nearly_the_same_lengths(usual: Analysis, detector: Detector) -> None:
    other = by(usual, Methods(detector=detector))
    assert all(apart_m(other, usual, foot) > 0.1 for foot in FEET)  # headings drift otherwise
    differences = lengths(other) - lengths(usual)
    assert differences.any()
    assert np.abs(differences).max() < 0.07
    assert [change.t_ns for change in other.phases] == [change.t_ns for change in usual.phases]


def test_constrained_strides_are_their_own_and_not_fused(usual: Analysis) -> None:
    constrained = by(usual, Methods(stride_method="constrained"))
    differences = lengths(constrained) - lengths(usual)
    assert 0.001 < np.abs(differences).max() < 0.1
    assert all(apart_m(constrained, usual, foot) == 0.0 for foot in FEET)
    assert all(block.longer is None for block in constrained.blocks.values())


def test_a_path_from_sample_to_sample_has_the_same_lengths_within_millimetres(usual: Analysis) -> None:
    other = by(usual, Methods(per_sample=True))
    assert all(0.0 < apart_m(other, usual, foot) < 0.5 for foot in FEET)
    assert 0.0 < np.abs(lengths(other) - lengths(usual)).max() < 0.002


def test_causal_events_are_those_found_off_line_a_little_later(usual: Analysis) -> None:
    result = by(usual, Methods(causal_events=True))
    table = result.tables()["events_causal"]
    assert table.names == tuple(column.name for column in CAUSAL_EVENT_COLUMNS)
    for rule, most_s in (("instants", 0.03), ("peaks", 0.2)):
        rows = [row for row in table.rows() if row["rule"] == rule and row["foot"] == "left_foot"]
        delays = np.array([row["delay_s"] for row in rows])
        assert np.isfinite(delays).mean() > 0.95
        assert 0.0 < float(np.nanmedian(delays)) < most_s
        assert all(row["t_feature_s"] <= row["t_known_s"] for row in rows)
    slow = [row["delay_s"] for row in table.rows() if row["rule"] == "peaks" and row["event"] == "IC"]
    assert np.nanmedian(slow) > 0.08  # as printed: after a peak and a wait


def test_causal_events_do_not_know_where_a_recording_is_cut(usual: Analysis) -> None:
    recording = usual.recording
    middle = len(recording.tracks["left_foot"].t_ns) // 2
    parts = [
        replace(recording, tracks={name: track.part(rows) for name, track in recording.tracks.items()})
        for rows in (slice(0, middle), slice(middle, None))
    ]
    methods = Methods(causal_events=True)
    chunks = analyse_chunks(cut_into_chunks(parts, around_s=5.0), usual.calibrations, methods=methods)
    decided = {foot: list[tuple[Rule, Decision]]() for foot in FEET}
    for chunk in chunks:
        for foot in FEET:
            decided[foot] += chunk.causal_events[foot]
    whole = by(usual, methods).causal_events
    for foot in FEET:
        for rule in Rule:
            assert [d for r, d in decided[foot] if r is rule] == [d for r, d in whole[foot] if r is rule]


def test_an_event_with_none_near_it_has_no_delay() -> None:
    none, one = np.zeros(0, np.int64), np.array([0], np.int64)
    decisions = [(Rule.INSTANTS, Decision(40_000_000, event, 30_000_000)) for event in OnlineEvent]
    (fo, ic) = causal_event_rows("left_foot", decisions, GaitEvents(one, one, none, np.zeros(0, np.bool_)))
    assert (fo["event"], fo["t_offline_s"], fo["delay_s"]) == ("FO", 0.0, 0.04)
    assert (ic["event"], ic["t_offline_s"], ic["delay_s"]) == ("IC", None, None)
    far = GaitEvents(one + 10**9, one, one + 10**9, np.ones(1, np.bool_))
    assert {row["delay_s"] for row in causal_event_rows("left_foot", decisions, far)} == {None}


def test_the_command_takes_other_methods(tmp_path: Path) -> None:
    options = ["--detector", "are", "--stride-method", "constrained", "--path", "per-sample", "--causal-events"]
    told = CliRunner().invoke(main, ["analyse", str(TRIAL), "--out", str(tmp_path), "--no-report", *options])
    assert told.exit_code == 0, told.output
    (written,) = tmp_path.rglob("events_causal.csv")
    with written.open() as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0]) == [column.name for column in CAUSAL_EVENT_COLUMNS]
    assert {row["rule"] for row in rows} == {"instants", "peaks"}
    assert CliRunner().invoke(main, ["analyse", str(TRIAL), "--detector", "glrt"]).exit_code == 2


# --- Off-line tables carry the off-line instant and the live machine's side by side ---


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
