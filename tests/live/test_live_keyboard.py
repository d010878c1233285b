"""Keys over real pseudo-terminals: the terminal's mode, what is left of it, what counts as a command."""

from __future__ import annotations

import itertools
import os
import pty
import select
import signal
import subprocess
import sys
import termios
import time
from collections.abc import Callable, Iterator

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from fes.live.commands import CommandKind as Kind
from fes.live.commands import OperatorCommand
from fes.live.inputs import Keyboard
from fes.signals import Event

SESSION = """
import os, sys, time
from fes.live.inputs import Keyboard, Terminal
with Terminal(0):
    keys = Keyboard(0, lambda command, t_ns: [command.kind])
    print("ready", flush=True)
    asked = []
    while not asked:
        asked = keys.read_events(0)
        time.sleep(0.005)
    print("asked", *asked, flush=True)
    keys.close()
"""


@pytest.fixture
def pair() -> Iterator[tuple[int, int]]:
    master, slave = pty.openpty()
    yield master, slave
    os.close(master)
    os.close(slave)


class Carried:
    """Keeps the commands."""

    def __init__(self) -> None:
        self.commands: list[OperatorCommand] = []

    def __call__(self, command: OperatorCommand, t_ns: int) -> list[Event]:
        self.commands.append(command)
        return []

    @property
    def asks(self) -> list[Kind]:
        return [command.kind for command in self.commands]


def read_until(master: int, text: bytes, timeout_s: float = 20.0) -> bytes:
    heard, end_s = b"", time.monotonic() + timeout_s
    while text not in heard:
        assert time.monotonic() < end_s, heard
        if select.select([master], [], [], 0.1)[0]:
            heard += os.read(master, 4096)
    return heard


def wait_for(what: Callable[[], bool], timeout_s: float = 10.0) -> None:
    end_s = time.monotonic() + timeout_s
    while not what():
        assert time.monotonic() < end_s
        time.sleep(0.005)


def waits_for_enter(descriptor: int) -> bool:
    return bool(termios.tcgetattr(descriptor)[3] & termios.ICANON)


@pytest.mark.requirement("SR-16")
def test_after_ctrl_z_and_fg_the_space_bar_stops_without_enter() -> None:
    """The shell's part, which stops the job, takes the terminal back into its own mode and goes on, is played here."""
    pid, master = pty.fork()
    if pid == 0:
        os.execv(sys.executable, [sys.executable, "-c", SESSION])
    try:
        read_until(master, b"ready")
        assert not waits_for_enter(master)
        os.kill(pid, signal.SIGSTOP)
        assert os.WIFSTOPPED(os.waitpid(pid, os.WUNTRACED)[1])
        mode = termios.tcgetattr(master)
        mode[3] |= termios.ICANON | termios.ECHO
        termios.tcsetattr(master, termios.TCSANOW, mode)
        os.kill(pid, signal.SIGCONT)
        wait_for(lambda: not waits_for_enter(master))
        os.write(master, b" ")
        read_until(master, b"asked stop")
    finally:
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)
        os.close(master)


def test_the_terminal_is_left_as_it_was(pair: tuple[int, int]) -> None:
    """Its mode, and that reading from it waits, which the shell and the view share."""
    master, slave = pair
    session = subprocess.Popen((sys.executable, "-c", SESSION), stdin=slave, stdout=slave)
    read_until(master, b"ready")
    assert os.get_blocking(slave), "nor is it changed meanwhile"
    assert not waits_for_enter(slave)
    os.write(master, b" ")
    assert session.wait(10) == 0
    assert os.get_blocking(slave)
    assert waits_for_enter(slave)


def test_a_pipe_is_left_as_it_was() -> None:
    read_end, write_end = os.pipe()
    carried = Carried()
    keys = Keyboard(read_end, carried)
    assert keys.read_events(0) == []  # and does not wait
    os.write(write_end, b"p")
    keys.read_events(0)
    assert carried.asks == [Kind.PAUSE]
    keys.close()
    keys.close()
    assert os.get_blocking(read_end)
    assert (keys.fileno(), keys.read_events(0)) == (None, [])
    os.close(read_end)
    os.close(write_end)


def test_a_terminal_that_has_gone_is_the_end_of_the_keys() -> None:
    master, slave = pty.openpty()
    keys = Keyboard(slave, Carried())
    os.close(master)
    assert keys.read_events(0) == []
    assert keys.fileno() is None
    keys.close()
    os.close(slave)


SEQUENCES = {
    "Shift+Down in rxvt": b"\x1b[b",
    "Delete": b"\x1b[3~",
    "Ctrl+Up": b"\x1b[1;5A",
    "Ctrl+Up in rxvt": b"\x1bOa",
    "Alt+a": b"\x1ba",
    "keypad 0": b"\x1bOp",
    "F5": b"\x1b[15~",
    "F1 on a Linux console": b"\x1b[[A",
    "F1 with eight-bit controls": b"\x8fP",
    "Shift+Down with eight-bit controls": b"\x9bb",
}
AGAIN_MS = 200


def typed_in_pieces(pieces: list[tuple[bytes, int]]) -> list[Kind]:
    """What keys command that come over a pipe, each piece so many ms after the one before."""
    read_end, write_end = os.pipe()
    carried, t_ns = Carried(), 0
    keys = Keyboard(read_end, carried)
    for piece, pause_ms in pieces:
        t_ns += pause_ms * 1_000_000
        os.write(write_end, piece)
        keys.read_events(t_ns)
    os.close(write_end)
    keys.close()
    os.close(read_end)
    return carried.asks


@pytest.mark.parametrize("name", SEQUENCES)
def test_a_key_that_is_no_letter_is_no_order_however_its_bytes_come(name: str) -> None:
    sequence = SEQUENCES[name]
    assert typed_in_pieces([(sequence, 0)]) == []
    for cut in range(1, len(sequence)):
        assert typed_in_pieces([(sequence[:cut], 0), (sequence[cut:], 30)]) == []
        assert typed_in_pieces([(sequence[:cut], 0), (b" ", 1), (sequence[cut:], 30)]) == [Kind.STOP]
    assert typed_in_pieces([(sequence, 0), (b"p", AGAIN_MS)]) == [Kind.PAUSE], "and then keys count again"


@pytest.mark.requirement("SR-16")
@given(st.binary(max_size=60), st.lists(st.integers(1, 59), max_size=4))
@example(b"[b a", [1, 2])
@example(b"a\x1b", [1])  # the end of one sequence and the beginning of the next in one piece
def test_behind_an_escape_nothing_is_an_order_but_a_stop_always(rest: bytes, cuts: list[int]) -> None:
    typed = b"\x1b" + rest
    edges = [0, *sorted(set(cuts)), len(typed)]
    pieces = [typed[a:b] for a, b in itertools.pairwise(edges) if typed[a:b]]
    asked = typed_in_pieces([(piece, 40 * bool(number)) for number, piece in enumerate(pieces)])
    assert set(asked) == ({Kind.STOP} if b" " in rest else set())


@pytest.mark.requirement("SR-16")
@given(st.binary(max_size=60), st.binary(max_size=60))
def test_a_space_anywhere_is_a_stop_and_comes_first(before: bytes, after: bytes) -> None:
    assert typed_in_pieces([(before + b" " + after, 0)])[0] is Kind.STOP
