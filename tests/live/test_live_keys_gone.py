"""The keyboard, and with it the stop key, goes in mid-session: nobody may go on believing that it is there."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from live_parts import FakeStimulator, Lost
from test_live_operator import CALIBRATION, FOOT, settings

from fes.live.commands import State
from fes.live.inputs import StopFile
from fes.live.log_pipe import PipedLog
from fes.live.session import LiveSession
from fes.live.stimulator import LiveStimulator, Opened
from fes.session_log import read_session
from fes.signals import OperatorAct, OperatorAction


def not_again() -> Opened:
    raise Lost("not opened again here")


@pytest.fixture
def live(tmp_path: Path) -> Iterator[LiveSession]:
    log = PipedLog(tmp_path / "session.feslog", {})
    stimulator = LiveStimulator(FakeStimulator(), not_again, Lost, time.monotonic_ns)
    yield LiveSession(settings(), {FOOT: CALIBRATION}, log, stimulator, time.monotonic_ns)
    log.close({})


def without_keys(live: LiveSession) -> list[object]:
    """What their end makes happen."""
    read_end, write_end = os.pipe()
    os.close(write_end)
    live.add_keys(read_end)
    keys = live._inputs[-1]
    events = [*keys.read_events(5), *keys.read_events(6)]
    for event in events:
        live.runner.handle(event)
        live.operator.follow(event)
    os.close(read_end)
    return list(events)


def test_it_is_noted_and_shown_with_what_else_stops(live: LiveSession, tmp_path: Path) -> None:
    live.add_input(StopFile(tmp_path / "stop", live.operator.execute))
    live.add_control(tmp_path / "c.sock")
    assert without_keys(live) == []
    said = "the keyboard is gone; stop by file or control socket"
    assert live.operator.message == said
    assert said in live.notices.now(0), "with every status from now on"
    assert live.operator.state is not State.STOPPED
    live._log.close({})
    (note,) = [note for note in read_session(tmp_path / "session.feslog").notes if note.severity == "warning"]
    assert note.text == said


@pytest.mark.requirement("SR-16")
def test_where_nothing_else_stops_it_is_a_stop_and_nothing_arms(live: LiveSession) -> None:
    assert without_keys(live) == [OperatorAct(5, OperatorAction.EMERGENCY_STOP)]
    assert live.operator.state is State.STOPPED
    assert live.gate.latched == "emergency stop"
    assert "the keyboard is gone, and there is no other stop" in "; ".join(live.operator.reasons_not_ready(7))
