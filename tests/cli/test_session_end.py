"""What `fes run` says and writes at its end."""

from __future__ import annotations

from pathlib import Path

import pytest
import report_records as make
from rich.console import Console

from fes.cli.common import StoppedEarly
from fes.cli.run.command import finish, write_report
from fes.report.summary import summarise
from fes.report.tables import closing_block
from fes.session_log import Note, SessionRecord, SessionWriter
from fes.signals import OperatorAct, OperatorAction


def said_of(record: SessionRecord) -> list[str]:
    console = Console(width=200, record=True)
    console.print(closing_block(summarise(record)))
    return console.export_text().splitlines()


def test_a_good_session_is_told_in_a_few_lines() -> None:
    record = make.walk(20)
    record.acts = [OperatorAct(make.at(1.0), OperatorAction.TEST_BURST, 0.0)]
    lines = said_of(record)
    assert len(lines) <= 10
    text = "\n".join(lines)
    assert "left foot: 20 strides (20 valid), 0.63 ± 0.02 m" in text
    assert "TA left: 18 bursts" in text
    assert "mC" in text
    assert "by hand: 1 test burst" in text
    assert lines[-1].startswith("✓ no fault")


def test_what_to_look_at_comes_with_it_and_what_is_much_is_counted() -> None:
    record = make.walk(20)
    record.notes += [Note(make.at(t_s), "fault", "gate", "controller stalled for 50 ms") for t_s in (3, 4)]
    record.complete = False
    for number in range(12):
        record.summary[f"check {number}"] = {}
    lines = said_of(record)
    assert len(lines) <= 14
    assert any("2 faults noted" in line and "Close other programs" in line for line in lines)
    assert any("no proper end" in line for line in lines)
    assert not any("no fault" in line for line in lines)


def write_log(record: SessionRecord, path: Path) -> Path:
    log = SessionWriter(path, record.header)
    for change in record.phases:
        log.phase(change)
    for stride in record.strides:
        log.stride(stride)
    log.close({"ended": "complete"})
    return path


def test_the_report_stands_beside_the_log_and_what_happened_is_said(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    write_report(write_log(make.walk(6), tmp_path / "session.feslog"))
    said = capfd.readouterr().out
    assert "left foot: 6 strides (6 valid)" in said
    assert (tmp_path / "report.html").read_text(encoding="utf-8").count("<html") == 1


def test_an_alarm_comes_before_the_report_and_is_followed_by_it(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    said: list[str] = []
    monkeypatch.setattr("fes.cli.run.command.write_report", lambda path: said.append(capfd.readouterr().err))
    with pytest.raises(StoppedEarly):
        finish(tmp_path / "session.feslog", "the disk is full", report=True)
    assert len(said) == 1
    assert "ALARM" in said[0]


def test_a_log_of_which_no_report_can_be_made_ends_in_words(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    write_report(tmp_path / "session.feslog")
    said = capfd.readouterr()
    assert "There is no report" in said.err
    assert "Traceback" not in said.out + said.err
