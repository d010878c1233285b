"""The live source over real socket pairs: command, silence, stalls, backlog, loss; and the stimulator's wrapper."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from live_parts import MS, FakeStimulator, Lost, Raw, SameClock, SetClock, SocketImu

from fes.control.clock_sync import SensorClock
from fes.live.commands import CommandKind as Kind
from fes.live.commands import OperatorCommand
from fes.live.inputs import Keyboard, StopFile
from fes.live.source import Input, LiveSource, LiveStimulator, SensorStream
from fes.live.supervision import UNSENT
from fes.signals import (
    Event,
    ImuSample,
    OperatorAct,
    OperatorAction,
    StimAlive,
    StimCommand,
    StimOpened,
    SystemFault,
    Tick,
    WireFrame,
)

FOOT = "right_foot"


def stop(command: OperatorCommand, t_ns: int) -> list[Event]:
    return [OperatorAct(t_ns, OperatorAction.EMERGENCY_STOP)] if command.kind is Kind.STOP else []


class Bench:
    def __init__(self, *, allowed: bool = True) -> None:
        self.imu = SocketImu(FOOT)
        self.ended = False
        self.allowed = allowed
        self.line = SensorStream(self.imu, SameClock, Lost, frozenset({FOOT}))
        self.inputs: list[Input] = []
        self.stimulator: LiveStimulator | None = None

    def source(self, clock: Callable[[], int] = time.monotonic_ns) -> LiveSource:
        return LiveSource([self.line], self.inputs, self.stimulator, clock, lambda: self.ended, lambda: self.allowed)

    def until(self, events: Iterator[Event], kind: type[Event], timeout_s: float = 5.0) -> list[Event]:
        """Events up to and with the first of a kind."""
        seen: list[Event] = []
        end_s = time.monotonic() + timeout_s
        for event in events:
            seen.append(event)
            if isinstance(event, kind):
                return seen
            assert time.monotonic() < end_s, f"no {kind} among {seen[-5:]}"
        raise AssertionError("the source ended")


def test_silence_is_a_tick_every_ten_milliseconds() -> None:
    bench = Bench()
    source = iter(bench.source())
    ticks = [next(source) for _ in range(20)]
    assert all(isinstance(tick, Tick) for tick in ticks)
    span_ms = (ticks[-1].t_ns - ticks[0].t_ns) / MS
    assert 19 * 10 <= span_ms < 19 * 40


def test_a_sample_comes_at_once_and_with_both_times() -> None:
    bench = Bench()
    source = iter(bench.source())
    next(source)
    bench.imu.give(123, (1.0, 2.0, 3.0), (4.0, 5.0, 6.0))
    given_ns = time.monotonic_ns()
    *_, sample = bench.until(source, ImuSample)
    assert isinstance(sample, ImuSample)
    assert (sample.sensor, sample.t_sensor_ns) == (FOOT, 123)
    assert (sample.acc_mps2, sample.gyr_radps) == ((1.0, 2.0, 3.0), (4.0, 5.0, 6.0))
    assert 0 <= sample.t_ns - given_ns < 50 * MS


def test_what_queued_up_before_the_session_is_not_of_it() -> None:
    bench = Bench()
    for number in range(5):
        bench.imu.give(number)
    assert isinstance(next(iter(bench.source())), Tick)


def test_what_queued_up_and_comes_in_pieces_is_not_of_the_session(monkeypatch: pytest.MonkeyPatch) -> None:
    """A terminal may say nothing while the kernel still moves into it what came before (serial_line.Waiting)."""
    bench = Bench()
    raw = Raw(FOOT, 0, 1, (0.0, 0.0, 9.81), (0.0, 0.0, 0.0))
    reads = [number % 9 == 0 for number in range(50)]
    monkeypatch.setattr(bench.imu, "read", lambda t_ns: [raw] if reads and reads.pop(0) else [])
    assert list(bench.line.discard(0)) == []
    assert not any(reads)


def test_times_never_run_backward_through_a_backlog_and_a_stop_overtakes_it() -> None:
    """Every event costs a millisecond; a key hit in the middle of a backlog of 200 samples is not behind it."""
    bench = Bench()
    clock = SetClock()
    read_end, write_end = os.pipe()
    bench.inputs = [Keyboard(read_end, stop)]
    source = iter(bench.source(clock))
    next(source)
    for number in range(200):
        bench.imu.give(number)
    events: list[Event] = []
    while len([event for event in events if isinstance(event, ImuSample)]) < 200:
        events.append(next(source))
        clock.now_ns += MS
        if len(events) == 10:
            os.write(write_end, b" ")
    times = [event.t_ns for event in events]
    assert times == sorted(times)
    (place,) = [number for number, event in enumerate(events) if isinstance(event, OperatorAct)]
    assert 10 <= place <= 10 + 33
    stamps = [event.t_sensor_ns for event in events if isinstance(event, ImuSample)]
    assert stamps == list(range(200)), "none is lost, and each says when it was"
    os.close(write_end)


@pytest.mark.requirement("SR-19")
@pytest.mark.parametrize("allowed", [True, False])
def test_a_stall_is_noticed_before_anything_else_is_handled(allowed: bool) -> None:
    bench = Bench(allowed=allowed)
    clock = SetClock()
    source = bench.source(clock)
    events = iter(source)
    next(events)
    bench.imu.give(0)
    clock.now_ns += 200 * MS
    first = next(events)
    assert source.stalls == 1
    assert source.longest_stall_ns == pytest.approx(200 * MS, abs=MS)
    if allowed:
        assert isinstance(first, SystemFault)
        assert "stalled for 200 ms" in first.text
        assert first.t_ns == clock.now_ns
    else:
        assert isinstance(first, ImuSample)


@pytest.mark.requirement("SR-19")
def test_a_turn_of_thirty_nine_milliseconds_is_no_stall() -> None:
    bench = Bench()
    clock = SetClock()
    source = bench.source(clock)
    events = iter(source)
    for _ in range(5):
        clock.now_ns += 39 * MS
        assert isinstance(next(events), Tick)
    assert source.stalls == 0


@pytest.mark.requirement("SR-09")
def test_an_unplugged_sensor_is_a_fault_and_comes_back_by_itself() -> None:
    bench = Bench()
    source = iter(bench.source())
    next(source)
    bench.imu.give(1)
    bench.until(source, ImuSample)
    bench.imu.unplug()
    *_, fault = bench.until(source, SystemFault)
    assert isinstance(fault, SystemFault)
    assert "right_foot: sensor lost: unplugged" in fault.text
    bench.imu.away = False
    end_s = time.monotonic() + 5
    while bench.line.port is None:
        event = next(source)
        assert not isinstance(event, (SystemFault, OperatorAct)), "no second fault, no arming"
        assert time.monotonic() < end_s
    bench.imu.give(77)
    *_, sample = bench.until(source, ImuSample)
    assert isinstance(sample, ImuSample)
    assert sample.t_sensor_ns == 77
    assert bench.line.losses == 1


def test_a_sensor_that_nothing_depends_on_is_lost_without_a_fault() -> None:
    bench = Bench()
    bench.line = SensorStream(bench.imu, SameClock, Lost, frozenset({"left_foot"}))
    bench.imu.unplug()
    assert list(bench.line.read(5)) == []
    assert bench.line.port is None


def test_a_line_that_falls_silent_is_opened_again() -> None:
    bench = Bench()
    bench.imu.give(1)
    assert len(list(bench.line.read(1000 * MS))) == 1
    assert list(bench.line.supervise(1999 * MS)) == []
    (fault,) = bench.line.supervise(2001 * MS)
    assert isinstance(fault, SystemFault)
    assert bench.line.port is None


class SharedLine:
    """Two feet on one line; ``given`` comes with the next reading."""

    sensors = ("left_foot", "right_foot")

    def __init__(self) -> None:
        self.serials: dict[str, str] = {}
        self.notices: list[str] = []
        self.given: list[Raw] = []

    def give(self, t_ns: int, *sensors: str, stamp_ns: int | None = None) -> None:
        stamp_ns = t_ns if stamp_ns is None else stamp_ns
        self.given += [Raw(sensor, t_ns, stamp_ns, (0.0, 0.0, 9.81), (0.0, 0.0, 0.0)) for sensor in sensors]

    def fileno(self) -> int | None:
        return None

    def read(self, t_ns: int) -> list[Raw]:
        found, self.given = self.given, []
        return found

    def reopen(self) -> None:
        """At once."""

    def close(self) -> None:
        """Nothing is held."""


@pytest.mark.requirement("SR-09")
@pytest.mark.parametrize(("needed", "told"), [("left_foot", True), ("right_foot", False)])
def test_one_of_two_sensors_on_a_line_that_falls_silent_is_a_fault_if_it_is_needed(needed: str, told: bool) -> None:
    port = SharedLine()
    line = SensorStream(port, SameClock, Lost, frozenset({needed}))
    faults: list[Event] = []
    for t_ns in range(1000 * MS, 5000 * MS, 10 * MS):
        port.give(t_ns, *(port.sensors if t_ns <= 2000 * MS else ("right_foot",)))
        faults += [event for event in (*line.read(t_ns), *line.supervise(t_ns)) if isinstance(event, SystemFault)]
        if faults:
            break
    if told:
        (fault,) = faults
        assert isinstance(fault, SystemFault)
        assert fault.text == "left_foot: sensor lost: nothing has come from left_foot for a second"
        assert fault.t_ns == 3000 * MS
    else:
        assert (faults, line.losses) == ([], 0)


@pytest.mark.requirement("SR-09")
@pytest.mark.parametrize(
    ("stamp_ns", "within_ms"),
    [
        (lambda t_ns: t_ns - 600 * MS, 7_500),  # a link that stalled and goes on with a full buffer
        (lambda t_ns: t_ns - 900 * MS, 7_500),
        (lambda t_ns: t_ns + 7_200_000 * MS, 30),  # the computer was suspended: its clock stood still meanwhile
        (lambda t_ns: t_ns - 20_000 * MS, 30),  # the sensor restarted
        (lambda t_ns: t_ns + 500 * MS, 30),  # its clock was set
    ],
)
@pytest.mark.parametrize("needed", [True, False])
def test_late_data_never_turn_fresh_by_a_new_mapping(
    stamp_ns: Callable[[int], int], within_ms: int, needed: bool
) -> None:
    port = SharedLine()
    line = SensorStream(port, SensorClock, Lost, frozenset({"left_foot"} if needed else ()))
    since_ns = 20_000 * MS
    faults: list[SystemFault] = []
    for t_ns in range(1000 * MS, 30_000 * MS, 10 * MS):
        port.give(t_ns, "left_foot", stamp_ns=t_ns if t_ns <= since_ns else stamp_ns(t_ns))
        port.give(t_ns, "right_foot")
        events = [*line.read(t_ns), *line.supervise(t_ns)]
        faults += [event for event in events if isinstance(event, SystemFault)]
        if faults:
            assert not [each for each in events if isinstance(each, ImuSample)], "nor is what came with it"
            break
    if not needed:
        assert (faults, line.losses) == ([], 0), "what drives no channel stops nobody's therapy"
        return
    (fault,) = faults
    assert "left_foot: sensor lost: the clock of left_foot jumped, or all that it sends comes late" in fault.text
    assert fault.t_ns - since_ns <= within_ms * MS
    assert line.port is None


def test_a_sensor_that_is_still_away_after_the_line_was_opened_again_takes_the_other_away_no_more() -> None:
    port = SharedLine()
    line = SensorStream(port, SameClock, Lost, frozenset({"left_foot"}))
    port.give(0, *port.sensors)
    assert len(list(line.read(0))) == 2
    assert len(list(line.supervise(1000 * MS))) == 1
    t_ns, end_s = 1000 * MS, time.monotonic() + 5
    while line.port is None:
        t_ns += 10 * MS
        assert list(line.supervise(t_ns)) == []
        assert time.monotonic() < end_s
    for _ in range(300):
        t_ns += 10 * MS
        port.give(t_ns, "right_foot")
        assert len(list(line.read(t_ns))) == 1
        assert list(line.supervise(t_ns)) == []
    assert line.losses == 1


def test_the_time_that_nobody_listened_is_no_silence() -> None:
    bench = Bench()
    bench.imu.give(1)
    assert len(list(bench.line.read(1000 * MS))) == 1
    bench.imu.give(2)
    assert list(bench.line.discard(9000 * MS)) == []
    assert list(bench.line.supervise(9000 * MS)) == []
    assert list(bench.line.read(9001 * MS)) == []
    assert bench.line.port is bench.imu


def test_the_end_of_the_keys_is_told_once_and_costs_no_time() -> None:
    bench = Bench()
    read_end, write_end = os.pipe()
    told_ns: list[int] = []

    def gone(t_ns: int) -> list[Event]:
        told_ns.append(t_ns)
        return []

    keys = Keyboard(read_end, stop, gone)
    bench.inputs = [keys]
    os.close(write_end)
    source = iter(bench.source())
    ticks = [next(source) for _ in range(10)]
    assert all(isinstance(tick, Tick) for tick in ticks)
    assert ticks[-1].t_ns - ticks[0].t_ns >= 90 * MS
    assert keys.fileno() is None
    assert len(told_ns) == 1


@pytest.mark.requirement("SR-16")
def test_a_stop_file_stops_once_and_forbids_arming_while_it_is_there(tmp_path: Path) -> None:
    bench = Bench()
    file = StopFile(tmp_path / "stop", stop)
    bench.inputs = [file]
    source = iter(bench.source())
    next(source)
    assert file.not_ready() == ""
    made_ns = time.monotonic_ns()
    file.path.touch()
    *_, act = bench.until(source, OperatorAct)
    assert act.t_ns - made_ns < 50 * MS
    assert all(isinstance(next(source), Tick) for _ in range(5))
    assert "remove it" in file.not_ready()
    file.path.unlink()
    next(source)
    next(source)
    assert file.not_ready() == ""


def remove_folder(path: Path) -> None:
    path.parent.rmdir()


@pytest.mark.requirement("SR-16")
@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (remove_folder, "cannot appear: its folder is not there"),
        (lambda path: (remove_folder(path), path.parent.touch()), "cannot be looked for: Not a directory"),
        (lambda path: path.symlink_to(path.parent / "nowhere"), "remove it"),
        (lambda path: path.symlink_to(path), "remove it"),
        (lambda path: path.mkdir(), "remove it"),
    ],
)
@pytest.mark.parametrize("from_the_start", [True, False])
def test_a_stop_file_that_cannot_appear_or_leads_nowhere_stops(
    tmp_path: Path, spoil: Callable[[Path], object], says: str, from_the_start: bool
) -> None:
    path = tmp_path / "folder" / "stop"
    path.parent.mkdir()
    file = StopFile(path, stop)
    if not from_the_start:
        assert (file.read_events(0), file.not_ready()) == ([], "")
    spoil(path)
    assert [type(event) for event in file.read_events(1)] == [OperatorAct]
    assert says in file.not_ready()
    assert file.read_events(2) == []


def test_a_stop_file_whose_name_is_no_unicode_stops_and_can_be_told_of(tmp_path: Path) -> None:
    origins: list[str] = []
    file = StopFile(tmp_path / os.fsdecode(b"st\xf6p"), lambda command, t_ns: origins.append(command.origin) or [])
    file.path.touch()
    file.read_events(0)
    assert origins == ["file st\\udcf6p"]
    assert file.not_ready().isprintable()
    file.not_ready().encode()


# --- the stimulator ----------------------------------------------------------------------------------------


def command(t_ns: int, *, on: bool = True) -> StimCommand:
    return StimCommand(t_ns, 0, on, 20.0 * on, 300.0 * on, 40.0 * on, 60)


def test_a_command_that_has_grown_old_does_not_go_out_but_off_always_does() -> None:
    clock, line = SetClock(), FakeStimulator()
    stimulator = LiveStimulator(line, Lost, clock)
    assert stimulator.send(command(clock.now_ns - 39 * MS)).identifier != UNSENT
    late = stimulator.send(command(clock.now_ns - 41 * MS))
    assert (late.identifier, late.data) == (UNSENT, b"")
    assert stimulator.send(command(clock.now_ns - 500 * MS, on=False)).identifier != UNSENT
    assert [sent.on for sent in line.sent] == [True, False]
    (fault,) = stimulator.events(clock.now_ns)
    assert isinstance(fault, SystemFault)
    assert "41 ms late" in fault.text
    assert not list(stimulator.events(clock.now_ns))


def test_a_lost_stimulator_is_one_fault_and_is_opened_again_under_another_session() -> None:
    clock, line = SetClock(), FakeStimulator(broken="bus-off")
    stimulator = LiveStimulator(line, Lost, clock)
    assert stimulator.send(command(clock.now_ns)).identifier == UNSENT
    assert stimulator.send(command(clock.now_ns)).identifier == UNSENT
    assert stimulator.poll(clock.now_ns) == []
    assert line.closed
    assert not stimulator.is_open
    (fault,) = stimulator.events(clock.now_ns)
    assert isinstance(fault, SystemFault)
    assert fault.text == "stimulator lost: bus-off"
    frames: list[WireFrame] = []
    stimulator.on_frame = frames.append
    line.broken = ""
    end_s = time.monotonic() + 5
    events: list[Event] = []
    while not events:
        clock.now_ns += 10 * MS
        events = list(stimulator.events(clock.now_ns))
        assert time.monotonic() < end_s
        time.sleep(0.001)
    assert events == [StimOpened(clock.now_ns, 4711)]
    assert [frame.data for frame in frames] == [b"hello"], "the new handshake is told of too"
    assert stimulator.is_open
    stimulator.send(command(clock.now_ns, on=False))
    assert len(line.sent) == 1
    line.answers.append(StimAlive(1, 2, 3))
    assert stimulator.poll(1) == [StimAlive(1, 2, 3)]


def test_a_line_that_cannot_be_heard_is_lost_too() -> None:
    clock, line = SetClock(), FakeStimulator()
    stimulator = LiveStimulator(line, Lost, clock)
    line.broken = "cannot be read"
    assert stimulator.poll(clock.now_ns) == []
    assert [type(event) for event in stimulator.events(clock.now_ns)] == [SystemFault]


@pytest.mark.requirement("SR-28")
def test_another_sensor_that_answers_where_one_was_lost_stays_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    imu = SocketImu()
    imu.serials = {FOOT: "0A"}
    line = SensorStream(imu, SameClock, Lost, frozenset({FOOT}))
    imu.unplug()
    assert [type(event) for event in line.read(0)] == [SystemFault]
    imu.away, imu.serials = False, {FOOT: "0B"}

    def tried(since_ns: int) -> None:
        for turn in range(200):
            list(line.supervise(since_ns + turn * 100 * MS))
            time.sleep(0.002)

    tried(0)
    assert line.port is None
    assert line.why_lost == "right_foot: sensor lost: another one answers (0B, it was 0A)"
    monkeypatch.setattr(imu, "reopen", lambda: None)
    imu.serials = {FOOT: "0A"}
    tried(40_000 * MS)
    assert line.port is imu
