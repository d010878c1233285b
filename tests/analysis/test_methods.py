"""An analysis by other methods: each changes what it should, and little; events as they would be known on-line."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from fes.analysis.methods import CAUSAL_EVENT_COLUMNS, CausalEvents, Methods, causal_event_rows
from fes.analysis.pipeline import analyse, analyse_chunks, calibrations_of
from fes.analysis.results import Analysis
from fes.cli.main import main
from fes.estimation.events.causal import Decision, OnlineEvent, Rule
from fes.estimation.events.offline import GaitEvents
from fes.estimation.zupt.detectors import Detector
from fes.recording import read_recording
from fes.recording.chunks import cut_into_chunks

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


def test_an_event_with_none_near_it_has_no_delay(usual: Analysis) -> None:
    none, one = np.zeros(0, np.int64), np.array([0], np.int64)
    decisions = [(Rule.INSTANTS, Decision(40_000_000, event, 30_000_000)) for event in OnlineEvent]
    (fo, ic) = causal_event_rows("left_foot", decisions, GaitEvents(one, one, none, np.zeros(0, np.bool_)))
    assert (fo["event"], fo["t_offline_s"], fo["delay_s"]) == ("FO", 0.0, 0.04)
    assert (ic["event"], ic["t_offline_s"], ic["delay_s"]) == ("IC", None, None)
    far = GaitEvents(one + 10**9, one, one + 10**9, np.ones(1, np.bool_))
    assert {row["delay_s"] for row in causal_event_rows("left_foot", decisions, far)} == {None}
    assert CausalEvents(usual.calibrations["left_foot"]).advance(none, np.zeros((0, 3)), np.zeros((0, 3))) == []


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
