"""The CANopen port against a node made with the ``canopen`` package, in this process and across processes."""

from __future__ import annotations

import json
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import can
import pytest

from drivers.simulated.record import read_record
from drivers.simulated.spawn import free_bus, why_silent
from drivers.stimulator.bus import LOOPBACK, bus_off_frame, open_bus
from drivers.stimulator.canopen_port import CanOpenSettings, CanOpenStimulator, Sdo, encode_download
from drivers.stimulator.port import StimulatorLost
from fes.config import StimulatorDevice
from fes.signals import StimAlive, StimCommand, StimStatus

pytest.importorskip("canopen", reason="the extra canopen is not installed")
from drivers.simulated.stimulator import canopen as simulated

OPTIONS: dict[str, Any] = {
    "node_id": 5,
    "current_index": simulated.CURRENT_INDEX,
    "width_index": simulated.WIDTH_INDEX,
    "current_step_ma": simulated.CURRENT_STEP_MA,
    "width_step_us": simulated.WIDTH_STEP_US,
    "max_current_ma": 100.0,
    "max_width_us": 500.0,
    "heartbeat_ms": simulated.HEARTBEAT_MS,
}
NO_LOOPBACK = why_silent(free_bus(LOOPBACK))


def virtual(name: str) -> can.BusABC:
    return can.Bus(interface="virtual", channel=name, ignore_config=True)


def test_bus_off_is_a_lost_stimulator(tmp_path: Path) -> None:
    bus = virtual(f"off {tmp_path}")
    with virtual(f"off {tmp_path}") as adapter:
        port = CanOpenStimulator(bus, 7, (0,), CanOpenSettings.from_options(OPTIONS))
        adapter.send(bus_off_frame())
        with pytest.raises(StimulatorLost, match="bus-off"):
            port.poll(0)
        port.close()


class Bench:
    """Port and node; the node lives in the package's own thread, so turns take real time."""

    def __init__(self, name: str, channels: tuple[int, ...] = (0,)) -> None:
        self.device = simulated.CanOpenDevice(virtual(name), 5)
        self.port = CanOpenStimulator(virtual(name), 7, channels, CanOpenSettings.from_options(OPTIONS))
        self.handshake = self.port.open(0, timeout_s=10.0)
        self.statuses: list[StimStatus] = []
        self.alive: list[StimAlive] = []
        self.syncs: list[int] = []

    def turn(self, *levels: tuple[int, float]) -> None:
        """One command of 300 µs, 40 Hz for each (channel, mA); 0 mA is off."""
        t_ns = time.monotonic_ns()
        for channel, current_ma in levels:
            frame = self.port.send(StimCommand(t_ns, channel, current_ma > 0, current_ma, 300.0, 40.0, 60))
            if frame.identifier == 0x80:
                self.syncs.append(t_ns)
        time.sleep(0.02)
        for event in self.port.poll(time.monotonic_ns()):
            if isinstance(event, StimStatus):
                self.statuses.append(event)
            else:
                self.alive.append(event)

    def until(self, what: Callable[[], bool], *levels: tuple[int, float]) -> None:
        end_s = time.monotonic() + 5.0
        while not what() and time.monotonic() < end_s:
            self.turn(*levels)
        assert what()

    def heard(self) -> None:
        """Wait until the node has taken every SYNC of so far, each of which was a pulse on channel 0."""
        self.until(lambda: sum(pulse.channel == 0 for pulse in self.device.pulses) >= len(self.syncs))

    @property
    def faults(self) -> list[str]:
        return [event.fault for event in [*self.statuses, *self.alive] if event.fault]

    def close(self) -> None:
        self.port.close()
        self.device.close()


@pytest.fixture
def bench(request: pytest.FixtureRequest) -> Iterator[Bench]:
    made = Bench(request.node.name, getattr(request, "param", (0,)))
    yield made
    made.close()


def test_every_sync_is_a_pulse_at_what_was_commanded(bench: Bench) -> None:
    for _ in range(50):
        bench.turn((0, 20.25))
    for _ in range(10):
        bench.turn((0, 0.0))
    assert bench.faults == []
    pulses = bench.device.pulses
    assert len(pulses) == len(bench.syncs) >= 20
    assert {(p.channel, p.current_ma, p.pulse_width_us) for p in pulses} == {(0, 20.0, 300.0)}
    assert bench.device.value(simulated.CURRENT_INDEX, 0) == 0  # told off, and pulses stopped before that
    assert bench.alive
    assert {alive.boot_id for alive in bench.alive} == {1}


def test_no_pulse_is_ever_above_the_command(bench: Bench) -> None:
    """Up and down: the device holds a step less, or there is no SYNC."""
    wanted: list[tuple[int, float]] = []
    for step in range(80):
        current_ma = 5.0 + 20.0 * abs((step % 40) - 20) / 20.0
        wanted.append((time.monotonic_ns(), current_ma))
        bench.turn((0, current_ma))
    assert len(bench.device.pulses) >= 15
    for pulse in bench.device.pulses:
        newest = [current for t_ns, current in wanted if t_ns <= pulse.t_ns][-2:]
        assert pulse.current_ma <= max(newest)


@pytest.mark.parametrize("bench", [(0, 2)], indirect=True)
def test_a_channel_that_is_off_holds_nothing_when_another_pulses(bench: Bench) -> None:
    for _ in range(10):
        bench.turn((0, 20.0), (2, 10.0))
    bench.heard()
    off_ns = time.monotonic_ns()
    for _ in range(20):
        bench.turn((0, 20.0), (2, 0.0))
    assert {p.channel for p in bench.device.pulses if p.t_ns > off_ns} == {0}
    assert {p.channel for p in bench.device.pulses} == {0, 2}
    assert bench.faults == []


def test_without_commands_there_is_no_pulse(bench: Bench) -> None:
    bench.until(lambda: len(bench.syncs) > 5, (0, 20.0))
    bench.heard()
    time.sleep(0.3)
    assert len(bench.device.pulses) == len(bench.syncs)


def test_a_restart_is_a_fault_and_ends_the_session(bench: Bench) -> None:
    bench.until(lambda: len(bench.syncs) > 2, (0, 20.0))
    bench.device.restart()
    with pytest.raises(StimulatorLost, match="restarted; its session must be opened again"):
        bench.until(lambda: False, (0, 20.0))
    assert "the stimulator restarted" in bench.faults
    assert bench.alive[-1].boot_id == 2
    with pytest.raises(StimulatorLost, match="restarted"):
        bench.port.poll(time.monotonic_ns())


def test_a_lost_heartbeat_is_a_fault(bench: Bench) -> None:
    bench.until(lambda: len(bench.syncs) > 2, (0, 20.0))
    bench.device.mute()
    bench.until(lambda: any("heartbeat has stopped" in fault for fault in bench.faults), (0, 0.0))


class SelfStarting:
    """A node that needs no start and whose widths are 500 µs at first: answers at once, keeps what SYNC delivers."""

    channel_info = "self-starting"

    def __init__(self) -> None:
        self.waiting: list[can.Message] = []
        self.pulses: list[dict[tuple[int, int], int]] = []
        self.boot()

    def boot(self) -> None:
        self.entries = {(simulated.CURRENT_INDEX, 1): 0, (simulated.WIDTH_INDEX, 1): 250}

    def beat(self, *states: int) -> None:
        self.waiting += [can.Message(arbitration_id=0x705, data=[state], is_extended_id=False) for state in states]

    def send(self, message: can.Message, timeout: float | None = None) -> None:
        if message.arbitration_id == 0x605:
            _, index, subindex, value = struct.unpack_from("<BHBB", message.data)
            self.entries[index, subindex] = value
            answer = struct.pack("<BHBI", 0x60, index, subindex, 0)
            self.waiting.append(can.Message(arbitration_id=0x585, data=answer, is_extended_id=False))
        elif message.arbitration_id == 0x80:
            self.pulses.append(dict(self.entries))

    def recv(self, timeout: float | None = None) -> can.Message | None:
        return self.waiting.pop(0) if self.waiting else None


def opened(node: SelfStarting) -> CanOpenStimulator:
    node.beat(5)
    port = CanOpenStimulator(node, 7, (0,), CanOpenSettings.from_options(OPTIONS))
    port.open(0)
    return port


def walk(port: CanOpenStimulator, t_ns: int, commands: int = 10) -> tuple[int, list[str]]:
    """Commands of 20 mA, 200 µs; the time after them and what was told as a fault."""
    faults: list[str] = []
    for _ in range(commands):
        t_ns += 20_000_000
        port.send(StimCommand(t_ns, 0, True, 20.0, 200.0, 40.0, 60))
        faults += [event.fault for event in port.poll(t_ns) if event.fault]
    return t_ns, faults


@pytest.mark.parametrize(
    ("comes_back", "said"),
    [
        ((0, 5), "the stimulator restarted"),  # it starts by itself: CiA 302
        ((127, 5), "the stimulator was away and may have restarted"),  # the boot-up message was lost
    ],
)
def test_a_node_that_restarts_by_itself_is_told_everything_anew(comes_back: tuple[int, ...], said: str) -> None:
    node = SelfStarting()
    port = opened(node)
    t_ns, faults = walk(port, 0)
    assert (faults, bool(node.pulses)) == ([], True)
    assert {pulse[simulated.WIDTH_INDEX, 1] for pulse in node.pulses} == {100}
    node.boot()
    node.pulses.clear()
    node.beat(*comes_back)
    assert said in [event.fault for event in port.poll(t_ns)]
    with pytest.raises(StimulatorLost, match="opened again"):
        walk(port, t_ns)
    assert node.pulses == []
    t_ns, faults = walk(opened(node), t_ns)
    assert faults == []
    assert {pulse[simulated.WIDTH_INDEX, 1] for pulse in node.pulses} == {100}


def test_a_node_that_was_silent_and_comes_back_is_lost() -> None:
    node = SelfStarting()
    port = opened(node)
    assert "heartbeat has stopped" in [*port.poll(0), *port.poll(10**9)][-1].fault
    node.beat(5)
    assert "was away" in port.poll(10**9)[-1].fault
    with pytest.raises(StimulatorLost, match="opened again"):
        port.poll(10**9)


def test_a_node_that_restarts_while_it_is_opened_has_all_currents_set_to_0_after_it() -> None:
    class TwoChannels(SelfStarting):
        def boot(self) -> None:
            self.entries = {(simulated.CURRENT_INDEX, subindex): 99 for subindex in (1, 2)}

        def send(self, message: can.Message, timeout: float | None = None) -> None:
            super().send(message)
            if message.arbitration_id == 0x605 and not self.restarted:
                self.restarted = True
                self.boot()  # after its answer
                self.beat(0)
            elif self.restarted:
                self.beat(5)

        restarted = False

    node = TwoChannels()
    node.beat(5)
    CanOpenStimulator(node, 7, (0, 1), CanOpenSettings.from_options(OPTIONS)).open(0)
    assert set(node.entries.values()) == {0}


def test_a_refused_value_is_a_fault(bench: Bench) -> None:
    other = CanOpenStimulator(
        virtual("refused"), 7, (0,), CanOpenSettings.from_options(OPTIONS | {"current_index": 0x4000})
    )
    node = simulated.CanOpenDevice(virtual("refused"), 5)
    with pytest.raises(StimulatorLost, match=r"refused object 0x4000:1 \(SDO abort 0x06020000\)"):
        other.open(0, timeout_s=10.0)
    other.close()
    node.close()


def test_nobody_there_says_what_to_check() -> None:
    port = CanOpenStimulator(virtual("nobody"), 7, (0,), CanOpenSettings.from_options(OPTIONS))
    with pytest.raises(StimulatorLost, match=r"no CANopen node 5 was heard.*node number"):
        port.open(0, timeout_s=0.1)
    port.send(StimCommand(0, 0, True, 20.0, 300.0, 40.0, 60))
    (late,) = [e for e in port.poll(101_000_000) if isinstance(e, StimStatus)]
    assert "no answer" in late.fault
    with pytest.raises(ValueError, match="not one of"):
        port.send(StimCommand(0, 1, True, 20.0, 300.0, 40.0, 60))
    with pytest.raises(ValueError, match="current_ma"):
        port.send(StimCommand(0, 0, True, 101.0, 300.0, 40.0, 60))
    assert port.send(StimCommand(0, -1, False, 0.0, 0.0, 0.0, 60)).identifier in (0, 0x605)
    port.close()


def test_a_value_without_an_answer_is_reckoned_with() -> None:
    """It may have arrived: no SYNC for less, and the lower value goes out first."""
    port = CanOpenStimulator(virtual("deaf"), 7, (0,), CanOpenSettings.from_options(OPTIONS))
    sent = []
    for step, current_ma in enumerate((20.0, 20.0, 10.0)):
        t_ns = step * 200_000_000
        sent.append(port.send(StimCommand(t_ns, 0, True, current_ma, 300.0, 40.0, 60)))
        port.poll(t_ns + 150_000_000)
    assert [frame.data.hex() for frame in sent] == ["2f01320196000000", "2f00320128000000", "2f00320114000000"]
    port.close()


def test_an_expedited_download() -> None:
    assert encode_download(5, Sdo(0x3200, 3, 40, 1)) == (0x605, bytes.fromhex("2f00320328000000"))
    assert encode_download(5, Sdo(0x3200, 3, 0x1234, 2)) == (0x605, bytes.fromhex("2b00320334120000"))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"node_id": 0}, "node_id = 0"),
        ({"current_index": 0x1017}, "current_index"),
        ({"width_index": simulated.CURRENT_INDEX}, "are both 0x3200"),
        *(({"value_bytes": value}, "1, 2 or 4") for value in (1.0, True, "1", 3)),
        ({"current_step_ma": 0.0}, "above 0"),
        ({"speed": 1}, "speed"),
    ],
)
def test_settings_out_of_range_are_named(change: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        CanOpenSettings.from_options(OPTIONS | change)
    with pytest.raises(ValueError, match="missing"):
        CanOpenSettings.from_options({"node_id": 1})
    assert StimulatorDevice(device="canopen", options=OPTIONS).options["node_id"] == 5


@pytest.mark.skipif(bool(NO_LOOPBACK), reason=NO_LOOPBACK)
def test_a_node_in_its_own_process(tmp_path: Path) -> None:
    bus = free_bus(LOOPBACK)
    record = tmp_path / "node.jsonl"
    command = [sys.executable, "-m", "drivers.simulated.stimulator.canopen", "--channel", bus.channel, "--node-id", "5"]
    command += ["--port", str(bus.options["port"]), "--record", str(record)]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        assert json.loads(process.stdout.readline())["ready"]
        port = CanOpenStimulator(open_bus(bus), 7, (0,), CanOpenSettings.from_options(OPTIONS))
        port.open(0, timeout_s=10.0)
        syncs = 0
        for _ in range(40):
            frame = port.send(StimCommand(time.monotonic_ns(), 0, True, 20.0, 300.0, 40.0, 60))
            syncs += frame.identifier == 0x80
            time.sleep(0.02)
            assert not [event.fault for event in port.poll(time.monotonic_ns()) if event.fault]
        port.close()
        end_s = time.monotonic() + 10.0
        while len(read_record(record)) < syncs and time.monotonic() < end_s:  # the last may be under way
            time.sleep(0.005)
    finally:
        process.communicate(timeout=10)
    assert process.returncode == 0
    assert len(read_record(record)) == syncs >= 10
