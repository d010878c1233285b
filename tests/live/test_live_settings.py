"""What a session file says of the live session itself, and what follows from the stimulator that it names."""

from __future__ import annotations

import math
import time
from io import StringIO
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import pytest
from click.testing import CliRunner
from live_parts import MS, FakeStimulator, Lost
from replays import SETTINGS
from rich.console import Console
from test_live_operator import CALIBRATION, FOOT, settings
from test_live_run import SENSOR, run

from drivers.stimulator.open import open_lead_detected_from_ma
from fes.cli.common import UNUSABLE
from fes.cli.replay.command import repeat
from fes.cli.run.command import command as run_command
from fes.cli.run.devices import serial_ports_of
from fes.config import ConfigError, Session, StimulatorDevice, load_exercise, load_session
from fes.config.session import Live
from fes.control.controller import Controller
from fes.gate import gate_of
from fes.live.commands import CommandKind as Kind
from fes.live.commands import OperatorCommand, State
from fes.live.log_pipe import PipedLog
from fes.live.monitor import Electrodes
from fes.live.operator import Operator
from fes.live.session import ExerciseClock, LiveSession, live_header
from fes.live.source import LiveStimulator
from fes.live.status import Status
from fes.live.terminal_view import picture
from fes.report.findings import findings
from fes.report.page import render_report
from fes.report.summary import summarise
from fes.session_log import Note, SessionLogError, SessionRecord, read_session
from fes.session_log.writer import SessionWriter
from fes.signals import (
    NS_PER_S,
    Event,
    ImuSample,
    OperatorAct,
    OperatorAction,
    StimAlive,
    StimCommand,
    StimOpened,
    StimRequest,
    StimStatus,
    SystemFault,
    Tick,
)

STANDS = (0.0, 0.0, 9.81)


def session(folder: Path, text: str) -> Session:
    path = folder / "session.toml"
    path.write_text(f"{SETTINGS.read_text()}\n{text}")
    return load_session(path)


def test_stop_button_stop_file_and_folder_are_settings(tmp_path: Path) -> None:
    text = (
        '[live]\nfolder = "results"\nstop_file = "halt"\n[live.stop_button]\nsource = "can_bit"\nidentifier = 0x1F0\n'
    )
    live = session(tmp_path, text).live
    assert (live.folder, live.stop_file) == ("results", "halt")
    assert live.stop_button is not None
    assert (live.stop_button.identifier, live.stop_button.pressed) == (0x1F0, "high")
    assert load_session(SETTINGS).live == Live()


def test_they_are_of_this_machine_and_in_no_log(tmp_path: Path) -> None:
    named = session(tmp_path, '[live]\nfolder = "results"\n')
    plain = load_session(SETTINGS)
    assert named.model_dump_json() == plain.model_dump_json()  # so a replay is the same, too
    assert "live" not in live_header(named, {}, 1, "", 0)["session"]


def test_a_stop_button_of_another_kind_is_refused_with_its_line(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"session.toml:\d+: live.stop_button.source = 'gpio'"):
        session(tmp_path, '[live.stop_button]\nsource = "gpio"\n')


def test_results_go_below_the_folder_of_the_settings(tmp_path: Path) -> None:
    (tmp_path / "taken").touch()
    text = f'{SETTINGS.read_text()}\n{SENSOR}\n[live]\nfolder = "{tmp_path}/taken/results"\n'
    path = tmp_path / "session.toml"
    path.write_text(text)
    done = CliRunner().invoke(run_command, [str(path)])
    assert done.exit_code == UNUSABLE
    assert "taken/results" in done.output
    code, said = run(tmp_path, text)  # --out counts before it
    assert (code, "taken" in said) == (UNUSABLE, False)


def requested(step_ma: float, intensity: float) -> set[float]:
    controller = Controller(load_session(SETTINGS), {}, current_step_ma=step_ma)
    controller.step(OperatorAct(0, OperatorAction.SET_INTENSITY, intensity))
    controller.step(OperatorAct(1, OperatorAction.TEST_BURST, 0.0))
    asked: list[StimRequest] = []
    for t_ns in range(2, 400_000_000, 5_000_000):
        asked += controller.step(Tick(t_ns)).requests
    return {request.current_ma for request in asked if request.on}


def test_currents_are_decided_in_the_stimulators_steps() -> None:
    whole, half = requested(1.0, 0.55), requested(0.5, 0.55)  # of 30 mA: 16.5
    assert max(half) == 16.5
    assert max(whole) == 16.0
    assert all(current_ma == int(current_ma) for current_ma in whole)


def test_a_burst_in_coarse_steps_that_begins_right_after_a_command_is_let_through_live_and_in_replay(
    tmp_path: Path,
) -> None:
    """30 mA within 150 ms: it begins at once with the device's step, and its ramp counts from there."""
    path, worn, calibrations = tmp_path / "session.feslog", settings(), {FOOT: CALIBRATION}
    log = PipedLog(path, live_header(worn, calibrations, 1, "", 0, 1.0))
    stimulator = FakeStimulator()
    lasting = LiveStimulator(stimulator, Lost, lambda: 0)
    live = LiveSession(worn, calibrations, log, lasting, lambda: 0, current_step_ma=1.0)
    events: list[Event] = [ImuSample(t_ms * MS, FOOT, t_ms * MS, STANDS, (0.001 * t_ms, 0.0, 0.0)) for t_ms in (20, 40)]
    events += [OperatorAct(40 * MS, OperatorAction.ARM), OperatorAct(40 * MS, OperatorAction.SET_INTENSITY, 1.0)]
    events += [OperatorAct(56 * MS, OperatorAction.TEST_BURST, 0.0)]
    events += [ImuSample(t_ms * MS, FOOT, t_ms * MS, STANDS, (0.001 * t_ms, 0.0, 0.0)) for t_ms in (60, 61)]
    for event in events:
        live.runner.handle(event)
    live.runner.all_off()
    log.close({"ended": "complete"})
    assert live.gate.latched == ""
    assert [command.current_ma for command in stimulator.sent if command.on] == [1.0, 1.0]
    assert repeat(path).now.commands == stimulator.sent


@pytest.mark.requirement("SR-14")
def test_a_stimulator_whose_answers_do_not_come_in_time_is_not_armed(tmp_path: Path) -> None:
    """It reports that every 65 ms at the latest; between two reports its heartbeat may come, late as well."""
    worn, calibrations = settings(), {FOOT: CALIBRATION}
    log = PipedLog(tmp_path / "session.feslog", live_header(worn, calibrations, 1, "", 0, 1.0))
    lasting = LiveStimulator(FakeStimulator(), Lost, lambda: 0)
    live = LiveSession(worn, calibrations, log, lasting, lambda: 0)
    said = "the stimulator reports: no answer within 45 ms"
    assert said not in live.operator.checks()
    live.runner.handle(StimStatus(100 * MS, 0, 0, False, 0.0, 0.0, 0.0, fault="no answer within 45 ms"))
    for t_ms, expected in ((165, True), (240, True), (300, False)):
        live.runner.handle(StimAlive(t_ms * MS, 1, 0))
        assert (said in live.operator.checks()) is expected
    log.close({"ended": "complete"})


@pytest.mark.parametrize(
    ("device", "said"),
    [
        ("can", ""),
        ("canopen", ""),
        ("p24_low_level", "electrode not known until the first pulse at 15 mA (channel 0, 3)"),
        ("p24_mid_level", "electrode not known until the first pulse at 15 mA (channel 0, 3)"),
        ("rehastim2", "electrode not known until the first pulse (channel 0, 3)"),
    ],
)
def test_what_a_stimulator_cannot_tell_of_its_electrodes_is_said(
    device: Literal["can", "canopen", "p24_low_level", "p24_mid_level", "rehastim2"], said: str
) -> None:
    from_ma = open_lead_detected_from_ma(StimulatorDevice(device=device, port="/dev/ttyUSB0"))
    electrodes = Electrodes([3, 0], from_ma)
    assert electrodes.unknown() == said
    electrodes.add_event(StimStatus(1, 0, 0, True, (from_ma or 1.0) - 0.5, 300.0, 40.0, fault="open lead"))
    electrodes.add_event(StimStatus(1, 0, 0, False, 0.0, 0.0, 0.0))
    if from_ma:
        electrodes.add_event(StimStatus(1, 0, 0, True, from_ma - 0.5, 300.0, 40.0))
    assert electrodes.unknown() == said
    electrodes.add_event(StimStatus(2, 0, 0, True, from_ma or 1.0, 300.0, 40.0))
    assert electrodes.unknown() == said.replace("0, ", "")
    electrodes.add_event(StimStatus(3, 3, 0, True, 20.0, 300.0, 40.0))
    assert electrodes.unknown() == ""
    electrodes.add_event(StimOpened(4, 9))
    assert electrodes.unknown() == said


OTHER = SENSOR.replace("right", "left")
STIMULATOR = '[stimulator]\ndevice = "rehastim2"\nport = "/dev/nothing-here"\n'
FOOT_SWITCH = '[[foot_switches]]\nfoot = "{}_foot"\nsource = "{}"\nport = "/dev/nothing-here"\n'
BUTTON = '[live.stop_button]\nsource = "serial_cts"\nport = "/dev/nothing-here"\n'
LSL = SENSOR.replace("xbus", "lsl")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (f"{SENSOR}\n{OTHER}", "left_foot and right_foot are both on port /dev/nothing-here"),
        (f"{LSL}\n{OTHER.replace('xbus', 'lsl')}", "both on LSL stream /dev/nothing-here channel acc_x"),
        (
            f'{LSL}options = {{ gyr_z = "w" }}\n' + OTHER.replace("xbus", "lsl") + 'options = { acc_x = "w" }\n',
            "both on LSL stream /dev/nothing-here channel w",
        ),
        (f"{SENSOR}\n{STIMULATOR}", "right_foot and the stimulator are both on port /dev/nothing-here"),
        (f"{STIMULATOR}\n{BUTTON}", "the stop button and the stimulator are both on port /dev/nothing-here"),
        (f"{SENSOR}\n{BUTTON}", "the stop button and right_foot are both on port /dev/nothing-here"),
        (
            f"{STIMULATOR}\n{FOOT_SWITCH.format('left', 'serial_dsr')}",
            "the foot switch of left_foot and the stimulator are both on port /dev/nothing-here",
        ),
        (
            FOOT_SWITCH.format("left", "serial_cts") + BUTTON,
            "the stop button and the foot switch of left_foot are both on input serial_cts of port /dev/nothing-here",
        ),
        (
            FOOT_SWITCH.format("left", "can_bit") + FOOT_SWITCH.format("right", "can_bit"),
            "right_foot and the foot switch of left_foot are both on bit 0 of identifier 0x0",
        ),
    ],
)
def test_nothing_is_fed_by_what_feeds_another(tmp_path: Path, text: str, said: str) -> None:
    with pytest.raises(ConfigError, match=rf"session\.toml: .*{said}; each needs its own"):
        session(tmp_path, text)


def test_what_can_be_shared_may_be(tmp_path: Path) -> None:
    labels = ("acc_x", "acc_y", "acc_z", "gyr_x", "gyr_y", "gyr_z")
    moved = "options = { " + ", ".join(f'{label} = "left_{label}"' for label in labels) + " }\n"
    both = f"{LSL}\n{OTHER.replace('xbus', 'lsl')}{moved}"
    assert len(session(tmp_path, f"{both}\n{STIMULATOR}").sensors) == 2  # a stream is no port
    on_bus = SENSOR.replace("xbus", "xsens_can").replace("/dev/nothing-here", "bus")
    assert len(session(tmp_path, on_bus + on_bus.replace("right", "left")).sensors) == 2
    two_inputs = FOOT_SWITCH.format("left", "serial_cts") + FOOT_SWITCH.format("right", "serial_dsr")
    assert len(session(tmp_path, two_inputs).foot_switches) == 2


def test_the_serial_ports_of_a_session_are_each_named_once(tmp_path: Path) -> None:
    text = (
        f"{SENSOR}\n{SENSOR.replace('right', 'left').replace('xbus', 'lsl')}\n"
        '[stimulator]\ndevice = "rehastim2"\nport = "/dev/nor-here"\n'
    )
    assert serial_ports_of(session(tmp_path, text)) == ["/dev/nothing-here", "/dev/nor-here"]
    assert serial_ports_of(load_session(SETTINGS)) == []


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"stim_session_id": -5}, "stim_session_id = -5"),
        ({"stim_session_id": 65536}, "stim_session_id = 65536"),
        ({"rate_hz": 1e300}, "rate_hz of right_foot is 1e"),
        ({"up": (0.0, 0.0, 0.0)}, "up of right_foot is no unit vector"),
        ({"up": "abc"}, "could not convert"),
        ({"gyr_bias_radps": (math.inf, 0.0, 0.0)}, "a bias of right_foot is not finite"),
        ({"stride_s": "still"}, ""),
        *(({"current_step_ma": step}, "") for step in ("wide", None, [], {}, 0, -0.5, 1e9, True)),
    ],
)
def test_a_log_with_nonsense_for_identifier_step_or_calibration_is_refused(
    tmp_path: Path, change: dict[str, Any], said: str
) -> None:
    header = live_header(load_session(SETTINGS), {FOOT: CALIBRATION}, 1, "", 0)
    (header if change.keys() <= header.keys() else header["calibration"][FOOT]).update(change)
    log = SessionWriter(tmp_path / "s.feslog", header)
    log.event(Tick(1))
    log.close({"ended": "complete"})
    with pytest.raises(SessionLogError, match=f"s.feslog: .* cannot be replayed .*{said}"):
        repeat(tmp_path / "s.feslog")


def test_thresholds_of_the_session_are_on_the_terminal_with_where_they_come_from(tmp_path: Path) -> None:
    changed = settings().model_copy(update={"thresholds": {"rest_share": 0.2, "origin": "fes sweep, 3 walks"}})
    log = PipedLog(tmp_path / "session.feslog", {})
    stimulator = LiveStimulator(FakeStimulator(), Lost, lambda: 0)
    live = LiveSession(changed, {FOOT: CALIBRATION}, log, stimulator, lambda: 0)
    log.close({})
    (line,) = [notice for notice in live.notices.now(0) if "thresholds" in notice]
    assert line == "thresholds of the session: rest_share 0.2 (from: fes sweep, 3 walks)"
    console = Console(file=StringIO(), width=120)
    console.print(picture(Status(0, "off", notices=[line])))
    assert isinstance(console.file, StringIO)
    assert f"! {line}" in console.file.getvalue()


def test_what_the_logs_disk_is_behind_with_is_shown_while_it_lasts_and_its_end_at_once(tmp_path: Path) -> None:
    log = PipedLog(tmp_path / "session.feslog", {})
    stimulator = LiveStimulator(FakeStimulator(), Lost, lambda: 0)
    shown: list[Status] = []
    live = LiveSession(settings(), {FOOT: CALIBRATION}, log, stimulator, time.monotonic_ns)
    live.monitor._publish = lambda datagram: shown.append(Status.decode(datagram))
    turns: list[str] = []

    def check() -> None:
        turns.append(" ".join(live.notices.now(0)))
        if len(turns) == 1:
            log.warning = "the disk does not keep up"
        elif len(turns) == 3:
            log.warning = ""
        elif len(turns) == 5:
            log.path.unlink()

    begin_s = time.monotonic()
    with pytest.raises(SessionLogError, match="has been removed"):
        live.run([], [], [Tick(time.monotonic_ns())], [], check)
    assert time.monotonic() - begin_s < 2.0
    assert ["keep up" in turn for turn in turns[:5]] == [False, True, True, False, False]
    assert shown[-1].state == "fault"
    assert "has been removed" in shown[-1].fault
    assert "begin anew" in shown[-1].remedy
    with pytest.raises(SessionLogError):
        log.close({})
    assert [note.text.split(": ")[-1] for note in read_session(log.path).notes if note.source == "log"] == [
        "the disk does not keep up",
        "the disk keeps up again",
    ]


# --- Exercise: bursts by the clock, without gait, through the same gate; what it may be and does ---


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
