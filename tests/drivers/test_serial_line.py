"""The line under the ports: never waits, and every way of losing it has one name."""

from __future__ import annotations

import os
import socket
import time
import tty
from collections.abc import Iterator
from pathlib import Path

import pytest
import serial

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
