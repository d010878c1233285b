"""A session's marks: in the log, the tables, the report and a replay, and never in what stimulates."""

from __future__ import annotations

import csv
import json
import socket
import unicodedata
from collections.abc import Iterator
from pathlib import Path

import pytest
import report_records as make
from hypothesis import example, given
from hypothesis import strategies as st
from replays import SETTINGS, write_cut
from test_live_operator import Bench
from test_report import no_loads

from fes.cli.replay.command import Options, repeat, replay_recording
from fes.live.commands import (
    FORMULA,
    LONGEST_MARK,
    CommandRefused,
    OperatorCommand,
    State,
    command_of_message,
    commands_of_keys,
    mark_text,
)
from fes.live.commands import CommandKind as Kind
from fes.live.dashboard.access import Access
from fes.live.dashboard.frames import DETAIL, LARGEST, read_detail
from fes.live.dashboard.server import MessageHandler
from fes.live.dashboard.stream import DashboardCommands, DashboardStream
from fes.live.status import Status
from fes.report.page import render_report
from fes.report.summary import summarise
from fes.session_log import Note, SessionWriter, read_session
from fes.session_log.codec import encode
from fes.session_log.export import to_csv
from fes.session_log.framing import MAGIC, LogScan, framed
from fes.signals import NS_PER_S, StrideResult
from fes.walk_record import MARK

HOSTILE = "</script><img src=x onerror=alert(1)>"


def marks_of(bench: Bench) -> list[tuple[int, str]]:
    return [(note.t_ns, note.text) for note in bench.notes if note.source == MARK]


def test_a_mark_is_a_note_and_no_event_wherever_the_session_stands() -> None:
    bench = Bench()
    assert bench.command(Kind.MARK) == []
    bench.armed()
    before = bench.gate.armed, bench.operator.state, bench.controller.intensity
    told = OperatorCommand(Kind.MARK, origin="control", text="brace on")
    assert bench.operator.execute(told, bench.t_ns) == []
    assert [text for _, text in marks_of(bench)] == ["mark 1", "brace on"]
    assert marks_of(bench)[-1][0] == bench.t_ns
    assert (bench.gate.armed, bench.operator.state, bench.controller.intensity) == before
    assert bench.operator.message == "marked: brace on"
    bench.stand(3.1)
    assert bench.operator.message == "armed; + raises the intensity"


def test_a_flood_of_marks_is_two_a_second_and_hides_no_refusal() -> None:
    bench = Bench().armed()
    bench.command(Kind.CHANNEL, 6.0)
    refused, before = bench.operator.message, len(bench.notes)
    for _ in range(1000):
        bench.command(Kind.MARK)
    assert len(bench.notes) == before + 1
    assert bench.operator.message == refused
    bench.stand(0.6)
    bench.command(Kind.MARK)
    assert len(marks_of(bench)) == 2
    bench.stand(10.1)
    assert bench.operator.message == "armed; + raises the intensity"


def test_m_marks_and_no_way_needs_a_confirmation() -> None:
    assert commands_of_keys(b"m") == [OperatorCommand(Kind.MARK)]
    marked = OperatorCommand(Kind.MARK, 0.0, "control", "brace on")
    assert command_of_message(b'{"ask":"mark","text":"brace on"}') == marked
    assert command_of_message(b'{"ask":"up","confirm":true,"text":"x"}').text == ""


@given(st.text(max_size=2 * LONGEST_MARK) | st.integers() | st.none() | st.lists(st.text()))
@example("brace on")
@example("\x1b]0;owned\x07 on\r\n\u202egnihton\u2066 \ud800 \u2028x")
@example('=HYPERLINK("//x")')
@example("\u200b+1")
@example("x" * (LONGEST_MARK + 1))
def test_a_marks_text_is_one_short_line_or_refused(said: object) -> None:
    shown = [each for each in said if unicodedata.category(each)[0] not in "CZ"] if isinstance(said, str) else []
    bad = not isinstance(said, str) or len(said) > LONGEST_MARK or bool(shown and shown[0] in FORMULA)
    if bad:
        with pytest.raises(CommandRefused):
            mark_text(said)
        return
    text = mark_text(said)
    assert [each for each in text if each != " "] == shown
    assert text == " ".join(text.split())
    assert text.splitlines() in ([], [text])
    assert text.encode().decode() == text
    assert mark_text(text) == text


# --- the live page ------------------------------------------------------------------------------------------


@pytest.fixture
def pair() -> Iterator[tuple[DashboardStream, socket.socket]]:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with ours, theirs:
        theirs.setblocking(False)
        yield DashboardStream(ours), theirs


def handler(access: Access, mode: str = "live") -> MessageHandler:
    about = {"mode": mode, "most_intensity": 0.6, "intensity_step": 0.05}
    return MessageHandler(access, about, lambda t_ns: (Status(0, "running"), 0), lambda: "fresh")


def test_whoever_has_a_link_marks_and_a_replay_and_a_stranger_do_not(
    pair: tuple[DashboardStream, socket.socket],
) -> None:
    longest = "🦶" * LONGEST_MARK  # four bytes a character: the longest message there is
    access = Access("link", lambda: "secret")
    page = handler(access)
    said = json.dumps({"ask": "mark", "text": longest}, ensure_ascii=False)
    assert "no valid link" in str(page.handle(said, 0).reply)
    page.handle('{"token":"link"}', 0)
    outcome = page.handle(said, 0)
    stream, theirs = pair
    theirs.send(outcome.command)
    carried: list[OperatorCommand] = []
    commands = DashboardCommands(stream, lambda command, t_ns: carried.append(command) or [], lambda: State.RUNNING)
    assert commands.read_events(0) == []
    assert carried == [OperatorCommand(Kind.MARK, 0.0, "dashboard", longest)]
    for text in ("x" * (LONGEST_MARK + 1), "=1+1", 7, ["x"]):
        answer = page.handle(json.dumps({"ask": "mark", "text": text}), 0)
        assert answer.command == b""
        assert "a mark" in str(answer.reply)
    played = handler(Access("other", lambda: "secret"), "replay")
    played.handle('{"token":"other"}', 0)
    assert "only be stopped" in str(played.handle(said, 0).reply)


def test_the_page_is_told_that_a_note_is_a_mark(pair: tuple[DashboardStream, socket.socket]) -> None:
    stream, theirs = pair
    stream.note(Note(7, "info", MARK, "fault"))
    stream.send(Status(t_ns=7, state="shadow").encode())
    theirs.recv(LARGEST)
    message = theirs.recv(LARGEST)
    assert message[:1] == DETAIL
    assert read_detail(message)["notes"] == [[7, "mark", "fault"]]


# --- log, tables, report, replay ----------------------------------------------------------------------------


def test_marks_are_a_table_and_a_stride_carries_the_last_one_before_it_began(tmp_path: Path) -> None:
    writer = SessionWriter(tmp_path / "session.feslog", {})
    writer.stride(StrideResult("left_foot", 1, 0, NS_PER_S))
    writer.note(Note(2 * NS_PER_S, "info", MARK, "brace, on"))
    writer.note(Note(2 * NS_PER_S, "info", "session", "another"))
    writer.note(Note(4 * NS_PER_S, "info", MARK, "turned"))
    writer.stride(StrideResult("left_foot", 2, 3 * NS_PER_S, 5 * NS_PER_S))
    writer.stride(StrideResult("left_foot", 3, 5 * NS_PER_S, 6 * NS_PER_S))
    writer.close({})
    to_csv(tmp_path / "session.feslog", tmp_path / "tables")

    def rows(table: str) -> list[dict[str, str]]:
        with (tmp_path / "tables" / f"{table}.csv").open(encoding="utf-8", newline="") as file:
            return list(csv.DictReader(file))

    assert rows("marks") == [{"t_ns": "2000000000", "text": "brace, on"}, {"t_ns": "4000000000", "text": "turned"}]
    assert [row["text"] for row in rows("notes")] == ["another"]
    assert [row["mark"] for row in rows("strides")] == ["", "brace, on", "turned"]


def test_the_report_has_marks_on_its_time_line_and_in_a_list_whatever_they_say() -> None:
    record = make.walk(6)
    record.notes += [Note(make.at(2.0), "info", MARK, "brace on"), Note(make.at(4.0), "info", MARK, HOSTILE)]
    summary = summarise(record)
    assert [(round(mark.time_s, 3), mark.text) for mark in summary.marks] == [(2.0, "brace on"), (4.0, HOSTILE)]
    assert {row.mark for row in summary.strides} == {"", "brace on", HOSTILE}
    for mark in summary.marks:
        assert mark.strides == sum(row.valid and row.mark == mark.text for row in summary.strides) > 0
    assert not any(notice.source == MARK for notice in summary.notices)
    page = no_loads(render_report(record))
    assert "marks" in page.ids
    assert "img" not in page.tags
    assert HOSTILE in page.text
    drawn = json.loads(page.scripts[0])["marks"]
    assert [(each["t_s"], each["name"]) for each in drawn] == [(2.0, "brace on"), (4.0, HOSTILE[:32])]
    assert "marks" not in no_loads(render_report(make.walk(6))).ids


def test_thousands_of_marks_leave_the_report_small() -> None:
    record = make.walk(6)
    without = len(render_report(record))
    record.notes += [Note(make.at(1.0) + k * NS_PER_S // 1000, "info", MARK, "x" * LONGEST_MARK) for k in range(5000)]
    html = render_report(record)
    assert "The first 200 of 5000" in html
    assert len(html) < without + 200_000


def test_a_replay_of_a_log_with_marks_is_the_same_and_keeps_them(tmp_path: Path) -> None:
    options = Options(session=SETTINGS, out=tmp_path, stimulator="none", report=False, as_json=True)
    log = replay_recording(write_cut(tmp_path), options)
    target, records, marks = tmp_path / "marked.feslog", list[bytes](), 0
    for number, (kind, payload) in enumerate(LogScan(log)):
        if number % 50 == 1:
            marks += 1
            records.append(framed(*encode(Note(number, "info", MARK, f"mark {marks}"))))
        records.append(framed(kind, bytes(payload)))
    target.write_bytes(MAGIC + b"".join(records))
    before, again = repeat(log), repeat(target)
    assert before.difference == again.difference == ""
    assert again.commands == before.commands > 0
    assert again.now.frames == before.now.frames
    assert len(summarise(read_session(target)).marks) == marks > 5
