"""Serial lines, and a CAN adapter on one: nobody ever waits, and every way of losing them has one name."""

from __future__ import annotations

import os
import select
import socket
import statistics
import time
import tty
from collections.abc import Iterator
from pathlib import Path
from typing import cast

import can
import pytest
import serial

from drivers.stimulator.bus import open_bus
from drivers.stimulator.can_port import CanStimulator
from drivers.stimulator.port import StimulatorLost
from drivers.stimulator.serial_line import (
    SCIENCEMODE2,
    SCIENCEMODE4,
    LineSettings,
    SerialLine,
    Waiting,
    latency_hint,
    open_line,
)
from fes.config import Bus
from fes.live.source import LiveStimulator, ReopenedLine
from fes.signals import StimCommand, SystemFault


@pytest.fixture
def pty() -> Iterator[tuple[int, str]]:
    own, other = os.openpty()
    tty.setraw(other)
    name = os.ttyname(other)
    yield own, name
    for descriptor in (own, other):
        os.close(descriptor)


@pytest.mark.parametrize("settings", [SCIENCEMODE2, SCIENCEMODE4])
def test_bytes_go_both_ways(pty: tuple[int, str], settings: LineSettings) -> None:
    own, name = pty
    line = open_line(name, settings)
    assert line.read() == b""
    line.write(b"\xf0\x0f\x81\x11\x13")
    assert os.read(own, 100) == b"\xf0\x0f\x81\x11\x13"
    os.write(own, b"\x11\x13\x00\x03\x0d\x0a")
    line.wait(1.0)
    assert line.read() == b"\x11\x13\x00\x03\x0d\x0a"
    assert line.fileno() > 2
    assert line.name == name
    line.close()
    line.close()
    open_line(name, settings).close()  # and again


def fill(line: SerialLine) -> None:
    for _ in range(100_000):
        line.write(b"x" * 97)


def test_a_line_that_takes_no_more_is_lost_at_once(pty: tuple[int, str]) -> None:
    _, name = pty
    line = open_line(name, SCIENCEMODE2)
    begin_s = time.monotonic()
    with pytest.raises(StimulatorLost, match=r"took \d+ of 97 bytes.*flow control"):
        fill(line)
    assert time.monotonic() - begin_s < 5.0
    line.close()


def read_on(line: SerialLine) -> None:
    """As a loop does."""
    for _ in range(10):
        line.read()


def test_the_other_end_gone_is_a_lost_stimulator() -> None:
    own, other = os.openpty()
    tty.setraw(other)
    line = open_line(os.ttyname(other), SCIENCEMODE2)
    os.close(other)
    os.close(own)
    with pytest.raises(StimulatorLost, match=r"Check cable"):
        read_on(line)
    with pytest.raises(StimulatorLost, match="did not take a command"):
        line.write(b"x")
    line.close()
    with pytest.raises(StimulatorLost):
        line.read()


def test_an_empty_terminal_is_rarely_read_and_what_waits_always_found(pty: tuple[int, str]) -> None:
    own, name = pty
    line = serial.Serial(name, timeout=1.0)
    waiting = Waiting(line)
    looks = [waiting.nothing() for _ in range(90)]
    assert looks.count(False) == 10  # for an end that is gone does not show in the number of bytes
    os.write(own, b"x")
    assert line.read() == b"x"
    os.write(own, b"yz")
    assert line.read() == b"y"
    assert not waiting.nothing()
    line.close()


def test_a_tcp_line() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        line = open_line(f"socket://127.0.0.1:{server.getsockname()[1]}", SCIENCEMODE4)
        host, _ = server.accept()
        host.sendall(b"abc")
        line.wait(1.0)
        assert line.read() == b"abc"
        assert line.read() == b""
        line.write(b"def")
        assert host.recv(10) == b"def"
        host.close()
        line.wait(1.0)
        with pytest.raises(StimulatorLost, match="the other end is gone"):
            line.read()
        line.close()


def test_only_one_host_may_open_a_port(pty: tuple[int, str]) -> None:
    _, name = pty
    line = open_line(name, SCIENCEMODE2)
    with pytest.raises(StimulatorLost, match="no other program using it"):
        open_line(name, SCIENCEMODE2)
    line.close()


@pytest.mark.parametrize("port", ["/dev/tty-not-there", "socket://127.0.0.1:1", "nonsense://x", "/dev/null"])
def test_a_port_that_cannot_be_opened_says_what_to_do(port: str) -> None:
    with pytest.raises(StimulatorLost, match=r"stimulator\.port = .* cannot be opened.*plugged in"):
        open_line(port, SCIENCEMODE2)


def test_any_descriptor_will_do() -> None:
    one, other = socket.socketpair()
    line = SerialLine("pair", one.detach())
    other.sendall(b"x")
    line.wait(1.0)
    assert line.read() == b"x"
    line.close()
    other.close()


def test_the_latency_timer_is_looked_at(tmp_path: Path) -> None:
    timer = tmp_path / "ttyUSB0" / "latency_timer"
    timer.parent.mkdir()
    timer.write_text("16\n")
    assert "16 ms" in latency_hint("/dev/ttyUSB0", tmp_path)
    assert str(timer) in latency_hint("/dev/ttyUSB0", tmp_path)
    timer.write_text("1\n")
    assert latency_hint("/dev/ttyUSB0", tmp_path) == ""
    assert latency_hint("/dev/ttyACM0", tmp_path) == ""


# --- a serial CAN adapter -----------------------------------------------------------------------------------


MS = 1_000_000


class Adapter:
    """The other end of the line, and the bus that this program opened on it."""

    def __init__(self) -> None:
        self.end, slave = os.openpty()
        tty.setraw(slave)
        os.set_blocking(self.end, False)
        settings = Bus(interface="slcan", channel=os.ttyname(slave), options={"bitrate": 500000, "sleep_after_open": 0})
        self.bus = open_bus(settings)
        os.close(slave)

    def heard(self, lines: int) -> list[bytes]:
        """So many lines; the kernel hands over what was written a moment later, and not all at once."""
        got, end_s = b"", time.monotonic() + 10.0
        while got.count(b"\r") < lines and time.monotonic() < end_s:
            if select.select([self.end], [], [], 1.0)[0]:
                got += os.read(self.end, 65536)
        return got.split(b"\r")

    def close(self) -> None:
        self.bus.shutdown()
        if self.end >= 0:
            os.close(self.end)


@pytest.fixture
def adapter() -> Iterator[Adapter]:
    made = Adapter()
    yield made
    made.close()


def test_the_channel_is_opened_and_frames_go_out_and_come_in(adapter: Adapter) -> None:
    assert adapter.heard(5) == [b"C", b"S6", b"", b"O", b"O", b""]
    adapter.bus.send(can.Message(arbitration_id=0x120, data=b"\x01\xab", is_extended_id=False), timeout=0)
    assert adapter.heard(1) == [b"t120201AB", b""]
    os.write(adapter.end, b"z\r\r\at1FF100\rt1F0")
    first = adapter.bus.recv(timeout=1)
    assert first is not None
    assert (first.arbitration_id, bytes(first.data)) == (0x1FF, b"\0")
    assert adapter.bus.recv(timeout=0) is None
    os.write(adapter.end, b"201FF\rT000001F0111\r")
    second, third = adapter.bus.recv(timeout=1), adapter.bus.recv(timeout=1)
    assert second is not None
    assert third is not None
    assert (second.arbitration_id, bytes(second.data), second.is_extended_id) == (0x1F0, b"\x01\xff", False)
    assert (third.arbitration_id, bytes(third.data), third.is_extended_id) == (0x1F0, b"\x11", True)


def test_lines_that_are_no_frames_are_passed_over(adapter: Adapter) -> None:
    os.write(adapter.end, b"t\rt12\rtXYZ100\rt120F00\rt1209\r\xff\xfe\r\rq\rT0000\rt1202zz11\rt12310A\r")
    message = adapter.bus.recv(timeout=1)
    assert message is not None
    while message.arbitration_id != 0x123:  # one or the other of them may look like a frame
        message = adapter.bus.recv(timeout=1)
        assert message is not None
    assert bytes(message.data) == b"\x0a"


def test_nothing_to_read_takes_no_time(adapter: Adapter) -> None:
    took_s = []
    for _ in range(10):
        began_s = time.monotonic()
        for _ in range(20):
            assert adapter.bus.recv(timeout=0) is None
        took_s.append(time.monotonic() - began_s)
    assert min(took_s) < 0.01  # python-can's own waits a millisecond for each; the machine may stop us now and then
    began_s = time.monotonic()
    assert adapter.bus.recv(timeout=0.05) is None
    assert time.monotonic() - began_s > 0.05


def test_an_adapter_that_does_not_read_is_named_and_nobody_waits_for_it() -> None:
    calls_s = [calls_until_lost_s() for _ in range(5)]
    last_s, usual_s = min(each[-1] for each in calls_s), min(map(statistics.median, calls_s))
    print(f"a call took {1e3 * usual_s:.2f} ms, the one that found the adapter lost {1e3 * last_s:.1f} ms")
    assert usual_s < 0.01
    assert last_s < 0.04  # of five: the machine may stop us now and then


def calls_until_lost_s() -> list[float]:
    """How long each command took until an adapter that does not read was lost."""
    adapter, now_ns = Adapter(), 1_000 * MS
    line = cast(ReopenedLine, CanStimulator(adapter.bus, 7))  # which nobody opens again here
    live = LiveStimulator(line, StimulatorLost, lambda: now_ns)
    took_s: list[float] = []
    while live.is_open and len(took_s) < 20_000:
        began_s = time.monotonic()
        live.send(StimCommand(now_ns, 0, True, 20.0, 300.0, 40.0, 60))
        took_s.append(time.monotonic() - began_s)
    (fault,) = live.events(now_ns)
    assert isinstance(fault, SystemFault)
    assert "stimulator lost" in fault.text
    assert "the adapter takes no frames" in fault.text
    adapter.close()
    return took_s


def test_an_adapter_that_is_gone_is_an_error_of_the_bus_and_the_port_is_released(adapter: Adapter) -> None:
    os.close(adapter.end)
    adapter.end = -1
    with pytest.raises(can.CanOperationError, match="adapter"):
        adapter.bus.recv(timeout=1)
    with pytest.raises(can.CanOperationError, match="adapter"):
        adapter.bus.send(can.Message(arbitration_id=1, is_extended_id=False), timeout=0)
    adapter.bus.shutdown()
    adapter.bus.shutdown()
    with pytest.raises(can.CanError):
        adapter.bus.fileno()
