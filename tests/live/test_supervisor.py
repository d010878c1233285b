"""The supervisor's judgement, by datagrams and a set clock; and the controller's end of it, over a real socket pair."""

from __future__ import annotations

import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from gate_bench import make_channel
from live_parts import MS, FakeStimulator, Lost, SetClock

from fes.config import ConfigError
from fes.gate import SafetyGate
from fes.live.inputs import StopFile
from fes.live.supervision import (
    OWN,
    UNSENT,
    Datagram,
    LineOpened,
    SupervisedLine,
    Value,
    What,
    datagram,
    is_due,
    packed,
    unpacked,
)
from fes.live.supervisor import LOOK_NS, MOST_VALUES_PER_S, SILENT_NS, PortOpened, Supervisor, serve
from fes.session_log import Received
from fes.signals import (
    Event,
    FootSwitchEvent,
    ImuSample,
    OperatorAct,
    OperatorAction,
    StimAlive,
    StimCommand,
    StimOpened,
    StimStatus,
    SystemFault,
    Tick,
    WireFrame,
)

FOOT = "left_foot"
Pair = tuple[SupervisedLine, socket.socket]
ON_MA = 20.0


@dataclass
class Port(FakeStimulator):
    """A stimulator with a session; ``cannot`` is what it cannot express."""

    session_id: int = 7
    current_step_ma: float = 0.5
    cannot: str = ""

    def send(self, command: StimCommand) -> WireFrame:
        if self.cannot:
            raise ValueError(self.cannot)
        return super().send(command)


def asked_for(t_ns: int, channel: int = 0, current_ma: float = ON_MA, *, on: bool = True) -> StimCommand:
    return StimCommand(t_ns, channel, on, current_ma * on, 300.0 * on, 40.0 * on, 60)


@dataclass
class Rig:
    """A controller's datagrams; ``own`` and ``faults`` are what the supervisor tells of itself."""

    stop_file: StopFile | None = None
    port: Port = field(default_factory=Port)
    opens: Callable[[int], PortOpened] = lambda t_ns: PortOpened(Port(session_id=8), (), ())
    own: list[tuple[StimCommand, WireFrame]] = field(default_factory=list)
    faults: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.clock = SetClock(step_ns=0)
        gate = SafetyGate((make_channel(), make_channel(1)), max_data_age_ms=40, validity_ms=60)
        opened = PortOpened(self.port, (), (StimAlive(0, 1, 0),))
        self.supervisor = Supervisor(gate, opened, lambda t_ns: self.opens(t_ns), Lost, self.stop_file, self.clock)
        self.number = 0

    @property
    def gate(self) -> SafetyGate:
        return self.supervisor.gate

    def ask(self, what: What, *values: Value) -> Datagram | None:
        self.number += 1
        data = datagram(self.number, what, self.clock.now_ns, b"".join(map(packed, values)))
        return self.take(self.supervisor.answer(data))

    def take(self, data: bytes) -> Datagram | None:
        """An answer without what the supervisor did by itself, which is kept."""
        if not data:
            return None
        answer = unpacked(data)
        values = answer.values
        asked_for = [values.pop()] if answer.what is not What.DONE else []
        while values and isinstance(values[0], StimCommand | SystemFault):
            value = values.pop(0)
            if isinstance(value, SystemFault):
                self.faults.append(value.text)
            else:
                assert isinstance(value, StimCommand)
                frame = values.pop(0)
                assert isinstance(frame, WireFrame)
                self.own.append((value, frame))
        assert answer.number == self.number
        return answer._replace(values=values + asked_for)

    def wait(self, ms: float) -> None:
        """Let time pass while the foot walks and its samples come."""
        for _ in range(round(ms / 5)):
            self.clock.now_ns += 5 * MS
            t_ns = self.clock.now_ns
            swings = 1.0 if t_ns // (150 * MS) != (t_ns - 5 * MS) // (150 * MS) else 0.0
            noise = 1e-9 * (t_ns % 1_000_003)
            self.ask(What.NOTHING, ImuSample(t_ns, FOOT, t_ns, (noise, 0.0, 9.8), (0.0, 0.0, swings + noise)))
            self.supervisor.supervise()

    def act(self, action: OperatorAction) -> None:
        self.ask(What.NOTHING, OperatorAct(self.clock.now_ns, action))

    def send(self, command: StimCommand) -> WireFrame:
        answer = self.ask(What.COMMAND, command)
        assert answer is not None
        assert answer.what is What.DONE, answer
        (frame,) = answer.values
        assert isinstance(frame, WireFrame)
        return frame

    def in_a_burst(self) -> Rig:
        self.wait(300)
        self.act(OperatorAction.ARM)
        for channel in (0, 1):
            self.send(asked_for(self.clock.now_ns, channel, on=False))
        self.wait(20)
        self.send(asked_for(self.clock.now_ns, current_ma=0.5))
        self.wait(20)
        assert self.send(asked_for(self.clock.now_ns)).identifier != UNSENT
        assert self.port.sent[-1].on
        return self

    def assert_off(self, why: str) -> None:
        """By its own commands, for all channels that were ever commanded, and latched."""
        assert [(sent.channel, sent.on) for sent in self.port.sent[-2:]] == [(0, False), (1, False)]
        assert not self.gate.armed
        assert why in self.gate.latched
        self.ask(What.POLL)
        assert [frame.data for _, frame in self.own] == [bytes([0, 0]), bytes([1, 0])]
        assert all(command.refused.startswith(OWN) and why in command.refused for command, _ in self.own)


# --- what is right goes out as it came ---------------------------------------------------------------------


def test_what_both_gates_let_out_goes_out_as_asked_and_its_frame_comes_back() -> None:
    rig = Rig().in_a_burst()
    assert rig.port.sent[-1] == asked_for(rig.clock.now_ns)
    assert not rig.own
    assert not rig.faults


def test_nothing_goes_out_that_the_controller_was_not_armed_for() -> None:
    rig = Rig()
    rig.wait(300)
    assert rig.send(asked_for(rig.clock.now_ns, current_ma=0.5)).identifier == UNSENT
    assert not rig.port.sent
    rig.ask(What.POLL)
    assert rig.faults == ["supervisor: not armed"]


def test_every_record_comes_through_as_it_was() -> None:
    values: list[Value] = [
        ImuSample(5, "right_shank", 4, (0.1, -0.2, 9.81), (1.0, 2.0, float("inf"))),
        Tick(6),
        OperatorAct(7, OperatorAction.TRIGGER, 1.0, "why"),
        StimOpened(8, 65535),
        FootSwitchEvent(9, "left_foot", None),
        SystemFault(10, "ä fault"),
        StimStatus(11, 1, 3, True, 12.3, 301.0, 39.7, 2, 0.6, "open lead"),
        StimAlive(12, 77, 3, ""),
        Received(13, b"\x00\xff"),
        LineOpened(65535, 1.0 / 3.0),
        asked_for(14),
        WireFrame(15, 0x120, b"12345678"),
    ]
    data = datagram(2**32 + 3, What.POLL, -1, b"".join(map(packed, values)))
    assert unpacked(data) == Datagram(3, What.POLL, -1, values)


def test_answers_of_the_stimulator_are_heard_by_the_supervisor_itself() -> None:
    rig = Rig().in_a_burst()
    status = StimStatus(rig.clock.now_ns, 0, 1, True, 20.0, 300.0, 40.0, fault="open lead")
    rig.port.answers, rig.port.heard = [status], b"raw"
    answer = rig.ask(What.POLL)
    assert answer is not None
    assert answer.values == [Received(rig.clock.now_ns, b"raw"), status]
    assert "open lead" in rig.gate.latched


# --- a controller that is not right ------------------------------------------------------------------------


@pytest.mark.requirement("SR-24")
def test_a_command_over_a_limit_becomes_off_whatever_the_controller_says() -> None:
    rig = Rig().in_a_burst()
    sent = len(rig.port.sent)
    rig.wait(20)
    assert rig.send(asked_for(rig.clock.now_ns, current_ma=31.0)).identifier == UNSENT
    rig.assert_off("31 mA")
    assert len(rig.port.sent) == sent + 2
    assert "supervisor: channel 0" in rig.faults[0]
    assert rig.send(asked_for(rig.clock.now_ns, current_ma=0.5)).identifier == UNSENT, "latched"


@pytest.mark.requirement("SR-24")
@pytest.mark.parametrize("ahead_ms", [-41, 1], ids=["late", "ahead"])
def test_a_command_of_another_time_is_not_executed(ahead_ms: int) -> None:
    rig = Rig().in_a_burst()
    rig.wait(20)
    assert rig.send(asked_for(rig.clock.now_ns + ahead_ms * MS)).identifier == UNSENT
    rig.assert_off("ms late")


@pytest.mark.requirement("SR-24")
def test_a_command_on_data_that_have_grown_old_is_not_executed() -> None:
    rig = Rig().in_a_burst()
    for _ in range(3):
        rig.clock.now_ns += 15 * MS
        rig.ask(What.POLL, Tick(rig.clock.now_ns))
    assert rig.send(asked_for(rig.clock.now_ns)).identifier == UNSENT
    rig.assert_off("left_foot data 45 ms old")


@pytest.mark.requirement("SR-24")
def test_a_silent_controller_is_off_before_the_lease_ends_and_a_slow_one_is_not() -> None:
    rig = Rig().in_a_burst()
    rig.clock.now_ns += SILENT_NS
    rig.supervisor.supervise()
    assert rig.gate.armed
    rig.clock.now_ns += LOOK_NS
    rig.supervisor.supervise()
    rig.assert_off("controller stalled for 45 ms")
    assert rig.faults == ["supervisor: controller stalled for 45 ms"]


def test_one_that_is_not_armed_may_be_silent() -> None:
    rig = Rig()
    rig.wait(300)
    rig.clock.now_ns += 10 * SILENT_NS
    rig.supervisor.supervise()
    assert not rig.gate.latched


@pytest.mark.requirement("SR-24")
@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\x00" * 12,
        datagram(1, What.POLL, 0, b"")[:-1],
        datagram(1, What.COMMAND, 0, packed(Tick(1))),
        datagram(1, What.COMMAND, 0, b""),
        datagram(1, What.NOTHING, 0, packed(asked_for(1))),
        datagram(1, What.NOTHING, 0, packed(StimAlive(1, 1, 0))),
        datagram(1, What.NOTHING, 0, packed(Tick(1))[:-1]),
        datagram(1, What.NOTHING, 0, b"\xc9\x00\x00"),
        datagram(1, What.DONE, 0, b""),
        datagram(1, What.NOTHING, 0, packed(OperatorAct(1, OperatorAction.ARM)).replace(b"arm", b"amr")),
        bytes(70_000),
    ],
)
def test_what_is_no_record_switches_off_and_that_controller_is_never_believed_again(data: bytes) -> None:
    rig = Rig().in_a_burst()
    assert rig.supervisor.answer(data) == b""
    rig.assert_off("no record")
    assert "start a new session" in rig.faults[0]
    rig.wait(600)
    rig.act(OperatorAction.ARM)
    assert not rig.gate.armed
    assert rig.send(asked_for(rig.clock.now_ns, current_ma=0.5)).identifier == UNSENT


@pytest.mark.requirement("SR-24")
def test_a_flood_switches_off() -> None:
    rig = Rig().in_a_burst()
    for _ in range(MOST_VALUES_PER_S // 1000 + 1):
        rig.ask(What.NOTHING, *[Tick(rig.clock.now_ns)] * 1000)
    rig.assert_off("more than any session")


@pytest.mark.requirement("SR-24")
def test_an_event_dated_ahead_switches_off() -> None:
    rig = Rig().in_a_burst()
    rig.ask(What.NOTHING, Tick(rig.clock.now_ns + 1))
    rig.assert_off("dated an event ahead")


@pytest.mark.requirement("SR-24")
def test_a_stop_that_the_controller_tells_of_and_does_not_follow_is_followed() -> None:
    rig = Rig().in_a_burst()
    rig.act(OperatorAction.EMERGENCY_STOP)
    assert rig.port.sent[-1].on, "the controller is given the time to do it"
    rig.wait(20)
    assert rig.port.sent[-1].on
    rig.wait(5)
    rig.assert_off("emergency stop")


@pytest.mark.requirement("SR-24")
def test_the_stop_file_needs_no_controller(tmp_path: Path) -> None:
    path = tmp_path / "stop"
    rig = Rig(StopFile(path, lambda command, t_ns: [SystemFault(t_ns, command.origin)])).in_a_burst()
    path.touch()
    rig.clock.now_ns += LOOK_NS
    rig.supervisor.supervise()
    rig.assert_off("emergency stop")
    rig.wait(20)
    rig.act(OperatorAction.ARM)
    assert "remove it" in rig.gate.latched
    path.unlink()
    rig.wait(10)
    rig.act(OperatorAction.ARM)
    assert rig.gate.armed


@pytest.mark.requirement("SR-24")
def test_an_arming_that_was_on_its_way_when_it_switched_off_arms_nothing() -> None:
    rig = Rig().in_a_burst()
    armed_ns = rig.clock.now_ns
    rig.clock.now_ns += SILENT_NS + LOOK_NS
    rig.supervisor.supervise()
    rig.ask(What.NOTHING, OperatorAct(armed_ns + 1, OperatorAction.ARM))
    assert not rig.gate.armed
    rig.wait(20)
    rig.act(OperatorAction.ARM)
    assert rig.gate.armed


@pytest.mark.requirement("SR-24")
def test_a_controller_that_has_ended_leaves_all_off_and_the_line_released() -> None:
    rig = Rig().in_a_burst()
    rig.supervisor.end("the controller has ended")
    assert [(sent.channel, sent.on) for sent in rig.port.sent[-2:]] == [(0, False), (1, False)]
    assert rig.port.closed


# --- a line that is not right ------------------------------------------------------------------------------


def test_a_lost_line_and_what_it_cannot_express_are_told_apart() -> None:
    rig = Rig().in_a_burst()
    rig.port.cannot = "too fine"
    answer = rig.ask(What.COMMAND, asked_for(rig.clock.now_ns, on=False))
    assert answer == Datagram(
        rig.number, What.IMPOSSIBLE, rig.clock.now_ns, [SystemFault(rig.clock.now_ns, "too fine")]
    )
    rig.port.cannot, rig.port.broken = "", "bus-off"
    answer = rig.ask(What.POLL)
    assert answer == Datagram(rig.number, What.LOST, rig.clock.now_ns, [SystemFault(rig.clock.now_ns, "bus-off")])


def test_where_its_own_off_does_not_get_out_the_line_counts_as_lost() -> None:
    rig = Rig().in_a_burst()
    rig.port.broken = "bus-off"
    rig.clock.now_ns += SILENT_NS + LOOK_NS
    rig.supervisor.supervise()
    rig.port.broken = ""
    answer = rig.ask(What.POLL)
    assert answer is not None
    assert (answer.what, answer.values) == (What.LOST, [SystemFault(rig.clock.now_ns, "bus-off")])


def test_a_line_is_opened_again_while_the_gate_goes_on_observing() -> None:
    opening = threading.Event()

    def opens(t_ns: int) -> PortOpened:
        opening.wait(10)
        return PortOpened(Port(session_id=8), (WireFrame(t_ns, 1, b"hello"),), ())

    rig = Rig(opens=opens).in_a_burst()
    rig.ask(What.CLOSE)
    assert rig.port.closed
    rig.ask(What.OPEN)
    asked = rig.number
    rig.wait(100)
    assert rig.gate.armed, "what it was told meanwhile is no silence"
    opening.set()
    while not (data := rig.supervisor.supervise()):
        rig.clock.now_ns += LOOK_NS
        rig.ask(What.NOTHING, Tick(rig.clock.now_ns))
        time.sleep(0.001)
    answer = unpacked(data)
    assert (answer.number, answer.values[0]) == (asked, LineOpened(8, 0.5))


# --- the controller's end ----------------------------------------------------------------------------------


@contextmanager
def linked(rig: Rig) -> Iterator[SupervisedLine]:
    """A line to a supervisor that serves in a thread, with the time on the wall."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    rig.supervisor._clock_ns = time.monotonic_ns
    serving = threading.Thread(target=serve, args=(theirs, rig.supervisor))
    serving.start()
    line = SupervisedLine(ours, Lost)
    line._wait_at_most(10_000_000_000)  # a thread of this test may be held up
    try:
        yield line
    finally:
        ours.close()
        serving.join(10)
        theirs.close()
    assert rig.port.closed


def samples(line: SupervisedLine, begin_ns: int, end_ns: int) -> None:
    for t_ns in range(begin_ns, end_ns, 5 * MS):
        noise = 1e-9 * (t_ns % 1_000_003)
        line.observe(ImuSample(t_ns, FOOT, t_ns, (noise, 0.0, 9.8), (0.0, 0.0, 1.0 + noise)))


def test_the_line_sends_asks_and_tells_what_the_supervisor_did_by_itself() -> None:
    rig = Rig()
    own: list[StimCommand] = []
    faults: list[str] = []
    with linked(rig) as line:
        line.on_own, line.on_fault = lambda command, frame: own.append(command), faults.append
        now_ns = time.monotonic_ns()
        samples(line, now_ns - 300 * MS, now_ns)
        line.observe(OperatorAct(now_ns, OperatorAction.ARM))
        line.observe(StimAlive(now_ns, 99, 0))  # of these it has its own
        assert line.send(asked_for(now_ns, current_ma=0.5)).identifier != UNSENT
        rig.port.answers = [StimAlive(now_ns, 1, 0)]
        rig.port.heard = b"raw"
        assert line.poll(now_ns) == [StimAlive(now_ns, 1, 0)]
        assert line.heard == b"raw"
        assert line.poll(now_ns + 4 * MS) == []
        assert line.heard == b""
        assert line.send(asked_for(now_ns, current_ma=99.0)).identifier == UNSENT
        line.poll(time.monotonic_ns() + 5 * MS)
        rig.port.cannot = "too fine"
        with pytest.raises(ValueError, match="too fine"):
            line.send(asked_for(now_ns, on=False))
    assert [command.on for command in rig.port.sent] == [True, False]
    assert [command.refused.startswith(OWN) for command in own] == [True]
    assert len(faults) == 1
    assert "99 mA" in faults[0]


def test_the_line_opens_again_and_says_why_it_cannot() -> None:
    rig = Rig()
    fails: list[Exception] = [Lost("nobody answers")]

    def opens(t_ns: int) -> PortOpened:
        if fails:
            raise fails.pop()
        return PortOpened(Port(session_id=8), (WireFrame(t_ns, 1, b"hello"),), (StimAlive(t_ns, 3, 0),))

    rig.opens = opens
    with linked(rig) as line:
        line.close()
        with pytest.raises(Lost, match="is not open"):
            line.send(asked_for(5))
        with pytest.raises(Lost, match="nobody answers"):
            line.open(5)
        opened = line.open(5)
    assert (opened.session_id, opened.current_step_ma) == (8, 0.5)
    assert (opened.frames, opened.alive) == ((WireFrame(5, 1, b"hello"),), (StimAlive(5, 3, 0),))


@pytest.fixture
def pair() -> Iterator[Pair]:
    """A line, and the end of its link that the test has in the supervisor's place."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with ours, theirs:
        yield SupervisedLine(ours, Lost), theirs


def test_settings_that_the_device_cannot_serve_are_unusable_settings(pair: Pair) -> None:
    line, theirs = pair
    theirs.send(datagram(1, What.IMPOSSIBLE, 0, packed(SystemFault(0, "no such option"))))
    with pytest.raises(ConfigError, match="no such option"):
        line.open(0)


def test_a_supervisor_that_does_not_answer_or_is_gone_is_a_lost_line(pair: Pair) -> None:
    line, theirs = pair
    line._wait_at_most(1 * MS)
    with pytest.raises(Lost, match="does not answer"):
        line.poll(0)
    theirs.send(datagram(1, What.DONE, 0, packed(StimAlive(0, 1, 0))))  # to what was given up
    theirs.close()
    with pytest.raises(Lost, match="new session"):
        line.poll(100 * MS)
    with pytest.raises(Lost, match="new session"):
        line.send(asked_for(0))
    line.close()


def test_while_the_line_is_lost_its_gate_is_told_all_the_same(pair: Pair) -> None:
    line, theirs = pair
    theirs.setblocking(False)
    told: list[Event] = [Tick(5 * k * MS) for k in range(4)]
    for event in told:
        line.observe(event)
    assert unpacked(theirs.recv(4096)).values == told
    with pytest.raises(BlockingIOError):
        theirs.recv(4096)


def test_a_backlog_of_one_time_goes_in_datagrams_that_the_supervisor_takes() -> None:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with ours, theirs:
        theirs.setblocking(False)
        line = SupervisedLine(ours, Lost)
        backlog = [ImuSample(5, FOOT, k, (0.0, 0.0, 9.8), (0.0, 0.0, 0.0)) for k in range(2_000)]
        for sample in backlog:
            line.observe(sample)
        line.close()
        heard: list[Value] = []
        while (data := unpacked(theirs.recv(1 << 20))).what is not What.CLOSE:
            heard += data.values
    assert heard + data.values == backlog


def test_opening_in_its_thread_leaves_alone_what_is_observed_meanwhile(pair: Pair) -> None:
    line, theirs = pair
    line.observe(Tick(1))
    theirs.send(datagram(1, What.DONE, 0, packed(LineOpened(1, 0.5))))
    line.open(2)
    assert unpacked(theirs.recv(4096)).values == []
    line.close()
    assert unpacked(theirs.recv(4096)).values == [Tick(1)]


def test_a_supervisor_that_reads_nothing_is_told_nothing_more(pair: Pair) -> None:
    line, _ = pair
    for k in range(200_000):
        line.observe(Tick(20 * k * MS))
        if line._failed:
            break
    with pytest.raises(Lost, match="does not listen"):
        line.poll(0)


def test_a_replay_looks_at_the_line_when_the_session_did() -> None:
    assert is_due(0, None)
    assert not is_due(5 * MS - 1, 0)
    assert is_due(5 * MS, 0)
    assert is_due(1, 0, every_ns=0), "an old log's"


def test_the_wait_is_the_systems_own(pair: Pair) -> None:
    """What was there before the time was over is read, however late this process is."""
    line, _ = pair
    line._wait_at_most(1_500_000_000)
    assert struct.unpack("ll", line._link.getsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, 16))[0] == 1
