"""The terminal's tables: every number is there, the width is kept, nothing in a log is taken for markup."""

from __future__ import annotations

import io
from dataclasses import replace

import pytest
import report_records as make
from rich.console import Console

from fes.report.summary import summarise
from fes.report.tables import stride_table, summary_block
from fes.session_log import Note, SessionRecord
from fes.signals import StimCommand


def shown(renderable, width: int = 100) -> list[str]:
    console = Console(width=width, file=io.StringIO(), color_system=None)
    console.print(renderable)
    return console.file.getvalue().splitlines()


def test_a_row_per_stride_with_its_numbers():
    lines = shown(stride_table(summarise(make.walk(5))))
    rows = [line.split() for line in lines if line.startswith(("L ", "R "))]
    assert len(rows) == 10
    assert rows[-1][:2] == ["R", "4"]
    by_name = dict(zip(("foot", "no", "start", "length", "clear"), rows[0], strict=False))
    stride = make.walk(5).strides[0]
    assert by_name["length"] == f"{stride.stride_length_m:.2f}"
    assert by_name["clear"] == f"{stride.clearance_m * 100:.1f}"
    assert rows[-1][-4] == "4"  # onset, ms
    assert rows[-1][-2] == "20.0"  # peak, mA


@pytest.mark.parametrize(("count", "number", "width"), [(0, 0, 80), (3, 0, 80), (120, 0, 80), (3, 20_000, 100)])
def test_no_number_is_cut_in_80_columns_nor_a_long_session_in_100(count, number, width):
    record = make.walk(count)
    record.strides = [replace(stride, number=stride.number + number, reason="slow") for stride in record.strides]
    record.strides[:1] = [replace(stride, valid=False) for stride in record.strides[:1]]
    lines = shown(stride_table(summarise(record)), width)
    assert all(len(line) <= width for line in lines)
    assert not any("…" in line for line in lines)


def test_limit_shows_the_last_strides_and_says_so():
    lines = shown(stride_table(summarise(make.walk(10)), limit=4))
    assert sum(line.startswith(("L ", "R ")) for line in lines) == 4
    assert "The last 4 of 20 strides" in lines[0]


def test_reasons_are_told_below_the_table_and_are_not_markup():
    record = make.walk(4)
    record.strides[2] = replace(record.strides[2], valid=False, reason="[red]turned[/red] by 50°")
    record.commands.append(StimCommand(record.strides[-1].t_start_ns + 5, 1, False, 0, 0, 0, 60, "not armed [/]"))
    record.notes.append(Note(make.at(1), "fault", "gate", "[bold]latched"))
    record.header["session"]["name"] = "[link=x]trial"
    summary = summarise(record)
    text = "\n".join(shown(stride_table(summary)))
    assert "note 1: left out: [red]turned[/red] by 50°" in text
    assert "note 2: gate: not armed [/]" in text
    block = "\n".join(shown(summary_block(summary)))
    assert "[bold]latched" in block
    assert "[link=x]trial" in block


def test_summary_is_about_a_dozen_lines_and_says_what_matters():
    lines = shown(summary_block(summarise(make.walk(20))))
    text = "\n".join(lines)
    assert len(lines) <= 14
    assert "40 of 40 swings passed all four phases" in text
    assert "never outside pre-swing … loading response" in text
    assert "belt 0.45 m/s" in text
    assert "99 % within" in text


def test_an_empty_session_still_has_a_summary():
    text = "\n".join(shown(summary_block(summarise(SessionRecord({})))))
    assert "no proper end" in text
    assert "No stride was found" in text
