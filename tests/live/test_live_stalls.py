"""A whole live session on a clock of its own: where a stall is found late, the log still names it."""

from __future__ import annotations

import gc
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from live_parts import MS, EverReadable, FakeStimulator, Lost, Raw, SameClock, SetClock
from test_live_operator import CALIBRATION, FOOT, settings

from fes.live.commands import State
from fes.live.session import LiveSession
from fes.live.source import LiveStimulator, SensorStream
from fes.live.status import remedy
from fes.session_log import SessionRecord, SessionWriter, read_session
from fes.signals import NS_PER_S, Event, OperatorAct, OperatorAction, StimAlive, StimStatus

STEP_NS = 10 * MS
WARM_NS = 3 * NS_PER_S
LEASE_EXPIRED = "lease expired"


class Enough(Exception):
    """The session has gone on for as long as the test needs."""


class Standing(EverReadable):
    """Each reading moves the clock on."""

    def __init__(self, clock: SetClock) -> None:
        super().__init__(FOOT)
        self._clock, self._number = clock, 0

    def samples(self, t_ns: int) -> list[Raw]:
        self._number += 1
        self._clock.now_ns += STEP_NS
        living = 0.001 * (self._number % 7)
        return [Raw(FOOT, t_ns, t_ns, (0.0, living, 9.81), (living, 0.0, 0.0))]


class Written(SessionWriter):
    """The session's log without a process of its own, which knows no clock but the machine's."""

    healthy = warning = ""


class OperatorCommand:
    """One act of the operator's, once it is time."""

    def __init__(self, at_ns: int, action: OperatorAction) -> None:
        self._at_ns: int | None = at_ns
        self._action = action

    def fileno(self) -> int | None:
        return None

    def read_events(self, t_ns: int) -> list[Event]:
        if self._at_ns is None or t_ns < self._at_ns:
            return []
        self._at_ns = None
        return [OperatorAct(t_ns, self._action)]


class Held(FakeStimulator):
    """Once the time has come, asking it what has arrived takes 560 ms, and then its lease has expired."""

    def __init__(self, clock: SetClock, at_ns: int) -> None:
        super().__init__()
        self._clock = clock
        self._at_ns: int | None = at_ns

    def poll(self, t_ns: int) -> list[StimStatus | StimAlive]:
        if self._at_ns is None or t_ns < self._at_ns:
            return [StimAlive(t_ns, 1, 0)]
        self._at_ns = None
        self._clock.now_ns += 560 * MS
        return [StimStatus(t_ns, 0, 0, False, 0.0, 0.0, 0.0, fault=LEASE_EXPIRED)]


def run(
    folder: Path, clock: SetClock, stimulator: FakeStimulator, *commands: OperatorCommand
) -> tuple[SessionRecord, LiveSession]:
    """A second of a session that is armed at rest, then of what the test makes happen; its log, and itself."""
    log = Written(folder / "session.feslog", {})
    wrapped = LiveStimulator(stimulator, Lost, clock)
    live = LiveSession(settings(), {FOOT: CALIBRATION}, log, wrapped, clock)
    begin_ns = clock.now_ns
    for command in (OperatorCommand(begin_ns + WARM_NS, OperatorAction.ARM), *commands):
        live.add_input(command)
    states = set()

    def check() -> None:
        states.add(live.operator.state)
        if clock.now_ns > begin_ns + WARM_NS + 2 * NS_PER_S:
            raise Enough

    line = SensorStream(Standing(clock), SameClock, Lost, frozenset({FOOT}))
    with pytest.raises(Enough):
        live.run([line], [], [], [], check)
    assert State.ARMED in states
    log.close(live.summary())
    line.close()
    return read_session(folder / "session.feslog"), live


def said(record: SessionRecord, what: str) -> list[tuple[str, str]]:
    return [(note.severity, note.text) for note in record.notes if what in note.text]


@pytest.mark.requirement("SR-19")
def test_held_up_in_the_middle_of_an_event_it_is_off_and_the_stall_is_named_beside_what_latched(tmp_path: Path) -> None:
    """Stopped and continued by somebody: what the stimulator said meanwhile is heard before the clock is looked at."""
    clock = SetClock()
    record, live = run(tmp_path, clock, Held(clock, clock.now_ns + WARM_NS + NS_PER_S))
    state = live.operator.state
    assert state is State.FAULT
    assert said(record, "off until") == [
        ("fault", f"off until armed again: stimulator fault on channel 0: {LEASE_EXPIRED}")
    ]
    ((severity, text),) = said(record, "stalled")
    assert severity == "warning"
    assert text.startswith("controller stalled for 5")
    assert (record.faults, record.summary["stalls"]) == ([], 1)
    assert live.operator.why_off == f"{text.partition(';')[0]}, then: stimulator fault on channel 0: {LEASE_EXPIRED}"
    assert remedy(live.operator.why_off) == remedy("controller stalled for 50 ms")
    assert record.summary["longest_stall_ms"] >= 560


class Slow:
    """Garbage collection that takes 60 ms."""

    def __init__(self, clock: SetClock) -> None:
        self._clock = clock
        self.collected = 0

    def __call__(self) -> None:
        self.collected += 1
        self._clock.now_ns += 60 * MS


def test_what_the_loop_does_on_purpose_once_it_is_off_is_no_stall(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = SetClock()
    collect = Slow(clock)
    monkeypatch.setattr(gc, "collect", collect)
    stop = OperatorCommand(clock.now_ns + WARM_NS + NS_PER_S, OperatorAction.EMERGENCY_STOP)
    record, live = run(tmp_path, clock, FakeStimulator(), stop)
    assert live.operator.state is State.STOPPED
    assert collect.collected >= 1
    assert said(record, "stalled") == []
    assert record.summary["stalls"] == 0


# --- A live session's memory does not grow: ``live_memory.py``, which can do an hour ---


BENCHMARK = Path(__file__).with_name("live_memory.py")


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="no /proc on this system")
def test_memory_is_flat() -> None:
    done = subprocess.run(
        [sys.executable, str(BENCHMARK), "--minutes", "2"], capture_output=True, text=True, timeout=300, check=False,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    found = json.loads(done.stdout.splitlines()[-1])
    assert found["samples"] > 2 * 500 * 115
    assert found["commands_on"] > 300  # it walked and was stimulated
    assert found["growth_mb"] < 2.0  # of the last minute; 60,000 samples kept would be over 10 MB
