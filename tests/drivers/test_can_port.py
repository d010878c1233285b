"""The port over python-can's in-process bus, with the simulated node at its other end."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import can
import pytest

from drivers.simulated.stimulator.firmware import StimulatorNode, parse_faults
from drivers.stimulator import can_codec
from drivers.stimulator.bus import BusError, open_bus
from drivers.stimulator.can_codec import PROTOCOL_VERSION, Alive, fault_text
from drivers.stimulator.can_port import CanStimulator
from drivers.stimulator.port import SessionUsed, StimulatorLost
from fes.config import Bus
from fes.signals import StimAlive, StimCommand, StimStatus, WireFrame

MS = 1_000_000
BOOT, SESSION = 77, 0x1234


def command(channel: int = 1, on: bool = True, **values: Any) -> StimCommand:
    levels: dict[str, Any] = {"current_ma": 20.0, "pulse_width_us": 300.0, "frequency_hz": 40.0, "validity_ms": 60}
    return StimCommand(t_ns=0, channel=channel, on=on, **(levels | values))


class Bench:
    """Port and node on an in-process bus; the node hears and answers when ``turn`` is called."""

    def __init__(self, faults: str = "", name: str = "bench") -> None:
        self.node = StimulatorNode(BOOT, 0, parse_faults(faults))
        self.bus = can.Bus(interface="virtual", channel=name, ignore_config=True)
        self.port = CanStimulator(can.Bus(interface="virtual", channel=name, ignore_config=True), SESSION)
        self.t_ns = 0

    def send(self, wanted: StimCommand, t_ns: int | None = None) -> WireFrame:
        return self.port.send(replace(wanted, t_ns=self.t_ns if t_ns is None else t_ns))

    def turn(self, t_ns: int) -> None:
        self.t_ns = t_ns
        frames = self.node.advance(t_ns)
        while (message := self.bus.recv(timeout=0.0)) is not None:
            frames += self.node.receive(t_ns, message.arbitration_id, bytes(message.data))
        for identifier, data in frames:
            self.bus.send(can.Message(arbitration_id=identifier, data=data, is_extended_id=False))

    def clock(self) -> int:
        """Time passes for the node whenever the handshake looks at the clock."""
        self.turn(self.t_ns + 100 * MS)
        return self.t_ns

    def close(self) -> None:
        self.port.close()
        self.bus.shutdown()


@pytest.fixture
def bench(request: pytest.FixtureRequest) -> Iterator[Bench]:
    made = Bench(getattr(request, "param", ""), request.node.name)
    yield made
    made.close()


def statuses(events: list[StimStatus | StimAlive]) -> list[StimStatus]:
    return [event for event in events if isinstance(event, StimStatus)]


def test_handshake_returns_what_was_sent_and_heard(bench: Bench) -> None:
    handshake = bench.port.open(t_ns=5, clock_ns=bench.clock)
    assert handshake.boot_id == BOOT
    assert {(f.t_ns, f.identifier, f.data) for f in handshake.frames} == {(5, *can_codec.encode_open(BOOT, SESSION))}
    assert [(alive.t_ns, alive.boot_id) for alive in handshake.alive][-1] == (5, BOOT)
    assert bench.node.session_id == SESSION
    assert bench.node.flags == 0


def test_handshake_names_a_used_session(bench: Bench) -> None:
    bench.node.receive(0, *can_codec.encode_open(BOOT, SESSION))
    bench.node.receive(0, *can_codec.encode_open(BOOT, SESSION + 1))
    with pytest.raises(SessionUsed, match="used before"):
        bench.port.open(0, timeout_s=1e9, clock_ns=bench.clock)  # told at once, not by the time-out


@pytest.mark.parametrize("other", [PROTOCOL_VERSION - 1, PROTOCOL_VERSION + 1])
def test_controller_and_node_of_different_versions_refuse_each_other(bench: Bench, other: int) -> None:
    """Heartbeat and opening read the same in every version: each side can say what is wrong."""
    (answer,) = bench.node.receive(0, *can_codec.encode_open(BOOT, SESSION, other))[-1:]
    alive = can_codec.decode(*answer)
    assert isinstance(alive, Alive)
    assert (alive.version, alive.session_id) == (PROTOCOL_VERSION, 0)
    assert fault_text(alive.faults) == "the controller speaks another protocol version"
    identifier, data = can_codec.encode(Alive(0, other, BOOT, 0, 0, 0))
    bench.bus.send(can.Message(arbitration_id=identifier, data=data, is_extended_id=False))
    with pytest.raises(StimulatorLost, match=f"protocol version {other}, this program {PROTOCOL_VERSION}"):
        bench.port.open(0, timeout_s=0.1, clock_ns=lambda: 0)


def test_every_command_is_answered_however_long_the_session(bench: Bench) -> None:
    """Also where the session identifier that commands carry has gone up, and gone round."""
    for number in range(700):
        if number == 0:
            bench.port.open(0, clock_ns=bench.clock)
        bench.send(command(number % 8, number % 3 != 0))
        bench.turn(bench.t_ns + 10 * MS)
        (status,) = (s for s in statuses(bench.port.poll(bench.t_ns)) if "lease" not in s.fault)
        assert (status.counter, status.fault, bench.port.outstanding) == (number % 128, "", 0)
    assert bench.port.foreign == 0


@pytest.mark.requirement("SR-13")
@pytest.mark.parametrize("kept", [1, 8, 16, 64])
def test_old_answers_in_a_loop_do_not_hide_a_stimulator_that_has_fallen_silent(kept: int) -> None:
    """As a gateway might that repeats what it has; their count of 7 bits comes round, their identifier does not."""
    name = f"loop{kept}"
    bench = Bench(name=name)
    bench.port.close()
    bench.port = CanStimulator(
        can.Bus(interface="virtual", channel=name, ignore_config=True), SESSION, in_real_time=True
    )
    bench.port.open(0, clock_ns=bench.clock)
    sent, loop = [], list[tuple[int, bytes]]()
    for step in range(400):
        t_ns = bench.t_ns = bench.t_ns + 20 * MS
        wanted = bench.send(command())
        frames = bench.node.receive(t_ns, wanted.identifier, wanted.data)
        answers = [frame for frame in frames if frame[0] != can_codec.ALIVE_ID]
        silent = step >= 200
        if not silent:
            loop = [*loop, *answers][-2 * kept :]
        for identifier, data in [frame for frame in frames if frame not in answers] + (loop if silent else answers):
            bench.bus.send(can.Message(arbitration_id=identifier, data=data, is_extended_id=False))
        sent += [status for status in statuses(bench.port.poll(t_ns)) if "no answer within" in status.fault]
        if silent and sent:
            break
    assert step <= 204
    assert sent
    bench.close()


@pytest.mark.parametrize("looped", [0, 1])
def test_the_totals_beside_an_old_answer_do_not_count_for_a_later_one(bench: Bench, looped: int) -> None:
    """16 commands later the low bits of the count are the same; the charge beside that answer is lost."""
    bench.port.open(0, clock_ns=bench.clock)
    answers: list[list[tuple[int, bytes]]] = []
    seen = []
    for step in range(17):
        bench.t_ns += 20 * MS
        wanted = bench.send(command())
        frames = bench.node.receive(bench.t_ns, wanted.identifier, wanted.data)
        answers.append([frame for frame in frames if frame[0] != can_codec.ALIVE_ID])
        said = answers[step] if step < 16 else [*answers[0] * looped, answers[step][1]]
        for identifier, data in said:
            bench.bus.send(can.Message(arbitration_id=identifier, data=data, is_extended_id=False))
        seen += statuses(bench.port.poll(bench.t_ns))
    assert [status.pulses for status in seen][-1] == 0
    assert sum(status.pulses for status in seen) < 40


def test_a_session_without_numbers_left_is_lost(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("drivers.stimulator.can_port.NUMBERS", 5)
    for _ in range(5):
        bench.send(command())
    with pytest.raises(StimulatorLost, match="no numbers left"):
        bench.send(command())


@pytest.mark.parametrize("sent", [1, 127, 128, 140, 300])
def test_a_node_that_has_not_our_session_says_so_and_is_lost(sent: int) -> None:
    """As after a restart: the answer names the identifier that the command carried."""
    port = CanStimulator(can.Bus(interface="virtual", channel="bench", ignore_config=True), SESSION, in_real_time=True)
    node = StimulatorNode(BOOT, 0)
    for number in range(sent + 1):
        wire = port.send(command())
        frames = node.receive(0, wire.identifier, wire.data) if number == sent else []
    frames = [frame for frame in frames if frame[0] != can_codec.ALIVE_ID]  # the heartbeat says so too, but later
    bus = can.Bus(interface="virtual", channel="bench", ignore_config=True)
    for identifier, data in frames:
        bus.send(can.Message(arbitration_id=identifier, data=data, is_extended_id=False))
    assert "session is not open" in statuses(port.poll(0))[-1].fault
    with pytest.raises(StimulatorLost, match="not our session open"):
        port.poll(1)
    port.close()
    bus.shutdown()


def test_status_carries_what_is_delivered_since_the_last_one(bench: Bench) -> None:
    bench.port.open(0, clock_ns=bench.clock)
    start_ns, pulses, charge_uc = bench.t_ns, 0, 0.0
    for step in range(60):
        bench.send(command())
        assert bench.port.outstanding == 1
        bench.turn(start_ns + step * 20 * MS)
        for status in statuses(bench.port.poll(step)):
            assert (status.t_ns, status.on, status.current_ma, status.fault) == (step, True, 20.0, "")
            pulses += status.pulses
            charge_uc += status.charge_uc
        assert bench.port.outstanding == 0
    assert pulses == bench.node.channels[1].pulses == 48
    assert charge_uc == pytest.approx(48 * 6.0)


def test_lost_charge_frames_lose_no_charge(bench: Bench) -> None:
    bench.port.open(0, clock_ns=bench.clock)
    start_ns, pulses = bench.t_ns, 0
    for step in range(400):
        t_ns = start_ns + step * 20 * MS
        wanted = bench.send(command(on=step % 100 != 99, frequency_hz=100.0), t_ns)
        frames = bench.node.receive(t_ns, wanted.identifier, wanted.data)
        for position, (identifier, data) in enumerate(frames):
            if step == 399 or (step * 7 + position) % 3:  # the last status makes up for all before
                bench.bus.send(can.Message(arbitration_id=identifier, data=data, is_extended_id=False))
        while bench.bus.recv(timeout=0.0) is not None:
            pass
        pulses += sum(status.pulses for status in statuses(bench.port.poll(step)))
    assert pulses == bench.node.channels[1].pulses
    assert pulses > 700


@pytest.mark.parametrize("bench", ["electrode=1"], indirect=True)
def test_electrode_fault_is_told_in_words(bench: Bench) -> None:
    bench.port.open(0, clock_ns=bench.clock)
    bench.send(command())
    bench.turn(bench.t_ns + 100 * MS)
    events = bench.port.poll(9)
    assert "output stage fault" in statuses(events)[0].fault
    assert not statuses(events)[0].on
    bench.turn(bench.t_ns + 100 * MS)
    events = bench.port.poll(10)
    assert any("output stage" in event.fault for event in events if isinstance(event, StimAlive))


def test_foreign_frames_do_not_pile_up_and_do_not_hold_the_loop(bench: Bench) -> None:
    bench.port.open(0, clock_ns=bench.clock)
    bench.port.poll(0)
    before = bench.port.foreign
    for number in range(100):
        bench.bus.send(can.Message(arbitration_id=0x300 + number, data=b"x", is_extended_id=False))
    bench.bus.send(can.Message(arbitration_id=can_codec.STATUS_ID, data=bytes(8), is_extended_id=True))
    bench.bus.send(can.Message(arbitration_id=can_codec.STATUS_ID, data=bytes(8), is_extended_id=False))
    bench.send(command())
    bench.turn(bench.t_ns)
    assert len(statuses(bench.port.poll(1))) == 1
    assert bench.port.foreign - before == 102
    for _ in range(1000):
        bench.bus.send(can.Message(arbitration_id=0x300, data=b"x", is_extended_id=False))
    bench.port.poll(2)
    assert bench.port.foreign - before == 102 + 128


class BrokenBus(can.BusABC):
    """Takes nothing, gives one message or an error."""

    channel_info = "broken bus"

    def __init__(self, message: can.Message | None = None) -> None:
        super().__init__(channel="broken")
        self._message = message

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        assert timeout == 0
        raise can.CanOperationError("Transmit buffer full", 105)

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        if self._message is None:
            raise OSError(19, "No such device")
        return self._message, False


def test_a_bus_that_takes_nothing_is_a_lost_stimulator() -> None:
    port = CanStimulator(BrokenBus(), SESSION)
    with pytest.raises(StimulatorLost, match=r"did not take a command.*Transmit buffer full.*termination"):
        port.send(command())
    with pytest.raises(StimulatorLost, match="cannot be read"):
        port.poll(0)
    assert port.outstanding == 0
    port.close()


def test_bus_off_is_a_lost_stimulator() -> None:
    port = CanStimulator(BrokenBus(can.Message(arbitration_id=0x40, is_error_frame=True)), SESSION)
    with pytest.raises(StimulatorLost, match="bus-off"):
        port.poll(0)
    port.close()


@pytest.mark.parametrize(
    ("bus", "words"),
    [
        (Bus(interface="nope"), "not known; one of: .*socketcan"),
        (Bus(interface="socketcan", channel="can99"), "socketcan 'can99' cannot be opened.*ip link"),
        (Bus(interface="pcan", channel="PCAN_USBBUS1"), "pcan.*PCANBasic"),
        (Bus(interface="slcan", channel="/dev/none"), "slcan '/dev/none'.*serial port"),
        (Bus(channel="10.0.0.1"), "multicast address"),
        (Bus(options={"port": "x"}), "multicast"),
        (Bus(options={"channel": "x"}), "bus.options must not hold channel"),
    ],
)
def test_a_bus_that_cannot_be_opened_says_what_to_do(bus: Bus, words: str) -> None:
    with pytest.raises(BusError, match=words):
        open_bus(bus)


def test_a_command_that_was_written_late_has_its_time_all_the_same() -> None:
    bus = can.Bus(interface="virtual", channel="late", ignore_config=True)
    port = CanStimulator(bus, SESSION, in_real_time=True, clock_ns=lambda: 35 * MS)
    port.send(command())
    assert port.poll(80 * MS) == []
    (fault,) = statuses(port.poll(81 * MS))
    assert fault.fault == "no answer within 45 ms"
    port.close()
