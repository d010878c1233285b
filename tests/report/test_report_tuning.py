"""Tuning and charge in summary, table and report: what the log says, and what the controller booked."""

from __future__ import annotations

import json
from dataclasses import replace
from io import StringIO
from pathlib import Path

import pytest
from report_records import T0, S, channel, header, walk
from rich.console import Console
from test_one_process import run

from fes.report.findings import findings, session_json
from fes.report.page import render_report
from fes.report.stimulation import TuningRow, dose_rows, tuning_rows
from fes.report.summary import summarise
from fes.report.tables import summary_block
from fes.session_log import Note, SessionRecord, read_session

TEXTS = {
    "change": "toe clearance 4 mm (target 12–35) in this stride: current 30.0 → 32.0 mA",
    "suggestion": "suggested: toe clearance 4 mm: current 30.0 → 32.0 mA",
    "skip": "stride 17 skipped: the foot turned by 34°",
    "roll_back": "toe clearance 4 mm has got worse with the last changes: rolled back, current 32.0 → 30.0 mA",
    "frozen": "tuning is frozen (on demand); the settings stay as they are",
    "fault": "stride 9: something has changed that stimulation did not: most likely the electrodes; look at it",
    "hint": "response per charge has fallen to 74 % of what it was at first",
}


def notes() -> list[Note]:
    return [Note(T0 + n * S, "info", "tuning", f"channel {n % 2}: {text}") for n, text in enumerate(TEXTS.values())] + [
        Note(T0, "info", "session", "channel 0: suggested: no")
    ]


def test_a_fault_changes_the_settings_only_where_it_says_how() -> None:
    rows = {row.kind: row for row in tuning_rows(notes(), T0)}
    assert [kind for kind, row in rows.items() if row.changes] == ["change", "roll_back"]
    more = Note(T0, "warning", "tuning", f"channel 0: {TEXTS['fault']}. {TEXTS['change']}")
    assert [(row.kind, row.changes) for row in tuning_rows([more], T0)] == [("fault", True)]


def test_every_kind_of_note_is_told_apart() -> None:
    rows = tuning_rows(notes(), T0)
    assert [row.kind for row in rows] == list(TEXTS)
    assert rows[1] == TuningRow(1.0, 1, "suggestion", TEXTS["suggestion"])
    more = ["back to the session's settings, tuning is frozen: x", "still going back: x", "tuning goes on"]
    kinds = [row.kind for row in tuning_rows([Note(0, "info", "tuning", f"channel 0: {text}") for text in more], 0)]
    assert kinds == ["roll_back", "roll_back", "frozen"]
    asks = [
        "toe 1 mm is not reached at the upper bound",
        "toe 1 mm is not reached below the upper bound",
        "stride 10 skipped: lasts 9 s; 10 strides in a row have taught nothing and the settings stay as they are",
        "stride 4: pitch gets worse by what lifts the toe and is left out: look at the sensor's calibration",
    ]
    told = tuning_rows([Note(0, "info", "tuning", f"channel 0: {text}") for text in asks], 0)
    assert [row.kind for row in told] == ["hint"] * 4
    joined = [Note(0, "warning", "tuning", f"channel 0: {TEXTS['fault']}. {text}") for text in (asks[0], asks[3])]
    assert [row.kind for row in tuning_rows(joined, 0)] == ["fault"] * 2
    assert tuning_rows([Note(0, "info", "tuning", "of no channel")], 0) == (
        TuningRow(0.0, -1, "change", "of no channel"),
    )


@pytest.fixture(scope="module")
def ran(tmp_path_factory: pytest.TempPathFactory) -> SessionRecord:
    _, log = run(tmp_path_factory.mktemp("tuned"), "tuned.feslog", 26.0)
    return read_session(log)


def test_how_far_it_was_commanded_stands_beside_the_bounds(ran: SessionRecord) -> None:
    summary = summarise(ran)
    (row,) = summary.reached
    on = [command for command in ran.commands if command.on]
    assert row.current_ma == max(command.current_ma for command in on)
    assert row.pulse_width_us == max(command.pulse_width_us for command in on)
    assert row.within
    assert f"{row.text}." in " ".join(finding.text for finding in findings(summary) if finding.level == "good")
    beyond = replace(row, most_ma=row.current_ma - 1.0, spent_from_s=7.0)
    assert not beyond.within
    assert beyond.text.endswith("µs); at its upper bound first at 7.0 s")


def test_suggestions_are_told_where_nothing_was_changed() -> None:
    said = [Note(T0 + n * S, "info", "tuning", f"channel 0: {TEXTS['suggestion']}") for n in (4, 9)]
    told = [finding.text for finding in findings(summarise(replace(walk(), notes=said)))]
    (text,) = [each for each in told if "suggestion" in each]
    assert "tuning made 2 suggestions and no change" in text
    assert "The last, at 9.0 s: toe clearance 4 mm: current 30.0 → 32.0 mA." in text


def test_the_ledger_of_the_log_is_that_of_the_controller(ran: SessionRecord) -> None:
    booked = ran.summary["dose"]["0"]
    (row,) = summarise(ran).dose
    assert row.session_mc == pytest.approx(1e-3 * booked["session_uc"])
    assert row.session_mc == pytest.approx(1e-3 * sum(status.charge_uc for status in ran.statuses))
    assert (row.pulses, row.steps, row.estimated) == (booked["pulses"], booked["steps"], False)
    assert row.median_step_uc == pytest.approx(booked["median_step_uc"], rel=0.01)
    assert row.greatest_step_uc == pytest.approx(booked["greatest_step_uc"], rel=0.05)
    assert sum(row.by_minute_mc) == pytest.approx(row.session_mc)
    assert len(row.by_minute_mc) == 1


def test_summary_table_and_report_show_it(ran: SessionRecord) -> None:
    summary = summarise(ran)
    console = Console(width=400, record=True, file=StringIO())
    console.print(summary_block(summary))
    shown = console.export_text()
    assert "µC a step (median; most" in shown
    assert "tuning made" in shown
    plain = json.loads(json.dumps(session_json(summary)))
    assert plain["dose"][0]["session_mc"] > 1.0
    assert {row["kind"] for row in plain["tuning"]} >= {"change", "skip"}
    report = render_report(ran)
    for words in (
        "Charge of each electrode pair",
        "Toe clearance and target, Tibialis anterior",
        "What the tuning set, Tibialis anterior",
        "12.0 → 14.0 mA",
    ):
        assert words in report
    assert render_report(ran) == report


def test_a_session_without_tuning_has_its_charge_and_no_tuning(tmp_path: Path) -> None:
    record = walk()
    assert summarise(record).tuning == ()
    report = render_report(record)
    assert "Charge of each electrode pair" in report
    assert 'id="tuning"' not in report
    silent = replace(record, statuses=[], commands=[])
    assert summarise(silent).dose == ()
    assert "Charge of each electrode pair" not in render_report(silent)


def test_hostile_texts_are_shown_as_text() -> None:
    record = replace(walk(), notes=[Note(T0 + S, "info", "tuning", "channel 0: <script>alert(1)</script>")])
    assert "<script>alert(1)" not in render_report(record)
    nobody = replace(record, header=header([channel(0, "left_foot", "<b>x</b>")]))
    assert "<b>x</b>" not in render_report(nobody)
    assert len(dose_rows(record, None, T0)) >= 1  # settings that cannot be read: by the channels' numbers
