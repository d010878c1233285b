"""Exercise: bursts by the clock, without gait, through the same gate; what it may be and does, and what is said."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import pytest
from live_parts import MS
from replays import SETTINGS

from fes.config import ConfigError, Session, load_exercise, load_session
from fes.control.controller import Controller
from fes.gate import gate_of
from fes.live.calibrating import ExerciseClock
from fes.live.commands import CommandKind as Kind
from fes.live.commands import OperatorCommand, State
from fes.live.operator import Operator
from fes.live.session import live_header
from fes.report.findings import findings
from fes.report.page import render_report
from fes.report.summary import summarise
from fes.session_log import Note, SessionRecord
from fes.signals import NS_PER_S, Event, OperatorAct, OperatorAction, StimAlive, StimCommand, SystemFault, Tick

CYCLE = "[exercise]\non_s = 1.0\noff_s = 2.0\nrise_s = 0.3\nfall_s = 0.2\ncount = 3\n"
TICK_NS = 10 * MS


def described(folder: Path, text: str = CYCLE) -> Path:
    path = folder / "session.toml"
    path.write_text(f"{SETTINGS.read_text()}\n{text}")
    return path


class Bench:
    """A session of exercise on a clock that the test moves."""

    def __init__(self, session: Session) -> None:
        self.session = session
        self.controller, self.gate = Controller(session, {}), gate_of(session, {})
        self.notes: list[Note] = []
        self.events: list[Event] = []
        self.commands: list[StimCommand] = []
        self.t_ns = 0
        self.operator = Operator(
            session, self.controller, self.gate, {}, {}, self.notes.append, lambda: self.t_ns
        )  # fmt: skip
        assert session.exercise is not None
        self.clock = ExerciseClock(session.exercise, self.operator)

    def handle(self, event: Event) -> None:
        self.events.append(event)
        self.gate.observe(event)
        self.commands += [self.gate.judge(event.t_ns, request) for request in self.controller.step(event).requests]
        self.operator.follow(event)

    def order(self, kind: Kind) -> None:
        for event in self.operator.execute(OperatorCommand(kind), self.t_ns):
            self.handle(event)

    def go(self, seconds: float) -> None:
        for _ in range(round(seconds * NS_PER_S / TICK_NS)):
            self.t_ns += TICK_NS
            for event in self.clock.read_events(self.t_ns):
                self.handle(event)
            self.handle(Tick(self.t_ns))

    def armed(self, raised: int = 20) -> Bench:
        self.go(2.5)
        self.order(Kind.ARM)
        assert self.operator.state is State.ARMED, self.operator.message
        for _ in range(raised):
            self.t_ns += 200 * MS
            self.order(Kind.UP)
        return self

    def bursts(self) -> list[tuple[float, float, float]]:
        """Of channel 0: when it began (s), how long it was (s), its greatest current (mA)."""
        found: list[tuple[float, float, float]] = []
        begun_ns, most_ma = None, 0.0
        for command in (each for each in self.commands if each.channel == 0):
            if command.on:
                begun_ns = command.t_ns if begun_ns is None else begun_ns
                most_ma = max(most_ma, command.current_ma)
            elif begun_ns is not None:
                found.append((begun_ns / NS_PER_S, (command.t_ns - begun_ns) / NS_PER_S, most_ma))
                begun_ns, most_ma = None, 0.0
        return found


@pytest.fixture
def bench(tmp_path: Path) -> Bench:
    return Bench(load_exercise(described(tmp_path)))


def test_it_counts_its_bursts_with_ramps_and_pauses_and_then_it_is_disarmed(bench: Bench) -> None:
    bench.armed().go(12.0)
    bursts = bench.bursts()
    assert [length for _, length, _ in bursts] == pytest.approx([1.5] * 3, abs=0.05)
    begun = [begin for begin, _, _ in bursts]
    assert [b - a for a, b in pairwise(begun)] == pytest.approx([3.5, 3.5], abs=0.03)
    assert {most for _, _, most in bursts} == {30.0}
    on = [command for command in bench.commands if command.on]
    assert on[0].current_ma == 0.5
    steps = [b.current_ma - a.current_ma for a, b in pairwise(on) if b.t_ns - a.t_ns < NS_PER_S]
    assert max(steps) <= 30.0 / 0.3 * 0.02 + 0.5
    assert not [command.refused for command in bench.commands if command.refused not in ("", "not armed")]
    assert bench.gate.latched == ""
    assert bench.operator.state is State.SHADOW
    assert "done: 3 of 3 bursts" in [note.text for note in bench.notes]
    bench.armed().go(2.0)
    assert bench.operator.message == "exercise: burst 1 of 3"  # another set


def test_nothing_begins_unarmed_or_at_intensity_0(bench: Bench) -> None:
    bench.go(5.0)
    bench.order(Kind.ARM)
    bench.go(5.0)
    assert bench.bursts() == []
    assert not any(isinstance(event, OperatorAct) and event.action is OperatorAction.EXERCISE for event in bench.events)


@pytest.mark.requirement("SR-16")
@pytest.mark.parametrize("how", ["stop", "fault", "pause"])
def test_a_stop_a_fault_and_a_pause_end_a_burst_at_once_and_hold_the_count(bench: Bench, how: str) -> None:
    bench.armed().go(0.5)
    assert bench.commands[-1].on
    if how == "fault":
        bench.handle(SystemFault(bench.t_ns, "stimulator lost: unplugged"))
    else:
        bench.order(Kind.STOP if how == "stop" else Kind.PAUSE)
    bench.handle(Tick(bench.t_ns))
    off_from = len(bench.commands)
    bench.go(5.0)
    assert not any(command.on for command in bench.commands[off_from - 1 :])
    if how == "pause":
        bench.order(Kind.PAUSE)
    else:
        bench.armed()
    bench.go(12.0)
    assert len(bench.bursts()) == 3


@pytest.mark.requirement("SR-01")
def test_the_gate_judges_as_ever(bench: Bench) -> None:
    """Whoever asks again and again, the channel's minute, its time on and its pause hold."""
    bench.armed()
    for _ in range(40):
        bench.handle(OperatorAct(bench.t_ns, OperatorAction.EXERCISE, 0.0))
        bench.go(0.4)
    channel = bench.session.channels[0]
    assert all(length <= channel.limits.max_on_s for _, length, _ in bench.bursts())
    bench.handle(StimAlive(bench.t_ns, 7, 0, "overheated"))
    assert bench.gate.latched == "stimulator fault: overheated"


def test_the_log_holds_every_burst_as_an_act_and_gives_the_same_commands_again(bench: Bench) -> None:
    bench.armed().go(12.0)
    again = Bench(bench.session)
    controller, gate = Controller(bench.session, {}), gate_of(bench.session, {})
    for event in bench.events:
        gate.observe(event)
        again.commands += [gate.judge(event.t_ns, request) for request in controller.step(event).requests]
    assert again.commands == bench.commands
    acts = [event for event in bench.events if isinstance(event, OperatorAct)]
    assert sum(act.action is OperatorAction.EXERCISE for act in acts) == 3


def test_the_report_has_a_section_of_its_own_and_no_word_of_gait(bench: Bench) -> None:
    bench.armed().go(12.0)
    header = live_header(bench.session, {}, 7, "2026-11-20T10:00:00+00:00", 0)
    assert header["kind"] == "exercise"
    acts = [event for event in bench.events if isinstance(event, OperatorAct)]
    record = SessionRecord(header, complete=True, commands=bench.commands, acts=acts, notes=bench.notes)
    summary = summarise(record)
    assert summary.exercise is not None
    assert (summary.exercise.done, summary.exercise.count) == (3, 3)
    assert (summary.feet, summary.channels[0].bursts, summary.channels[0].bursts_outside) == ({}, 3, 0)
    told = findings(summary)
    assert not [finding.text for finding in told if finding.level in ("alert", "warning")]
    assert "Exercise: 3 of 3 bursts asked for." in [finding.text for finding in told]
    assert not any("stride" in finding.text for finding in told)
    page = render_report(record)
    assert '<section id="exercise">' in page
    assert "3 of 3; each rises over 0.3 s, holds for 1.0 s and falls over 0.2 s; 2.0 s later comes the next" in page


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", r"no \[exercise\] table"),
        (CYCLE.replace("on_s = 1.0", "on_s = 2.9"), "over 'Tibialis anterior, right''s max_on_s = 3"),
        (CYCLE.replace("off_s = 2.0", "off_s = 0.05"), "min_off_s = 0.1"),
        (CYCLE.replace("rise_s = 0.3", "rise_s = 0.01"), "over this channel's limit"),
        (CYCLE + "channels = [5]", "no channel"),
        (CYCLE.replace("count = 3", "count = 0"), "greater than or equal to 1"),
        (CYCLE.replace("count = 3\n", ""), "required"),
    ],
)
def test_an_exercise_that_would_break_a_limit_is_refused(tmp_path: Path, text: str, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        load_exercise(described(tmp_path, text))


@pytest.mark.requirement("SR-09")
def test_a_walking_session_knows_nothing_of_exercise(tmp_path: Path) -> None:
    session = load_session(described(tmp_path))
    assert session.exercise is None
    assert session == load_session(SETTINGS)
    assert "exercise" not in session.model_dump(mode="json")
    controller = Controller(session, {})
    controller.step(OperatorAct(0, OperatorAction.SET_INTENSITY, 1.0))
    controller.step(OperatorAct(MS, OperatorAction.EXERCISE, 0.0))
    assert not any(request.on for k in range(9) for request in controller.step(Tick(k * TICK_NS)).requests)
