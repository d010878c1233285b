"""What brings an operator's commands, and switches: keys, the control socket, the stop file, the stop button."""

import json
import os
import signal
import socket
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from types import FrameType
from typing import Any, Final, Protocol, Self

from fes.live.commands import ESCAPE, CommandKind, CommandRefused, OperatorCommand, command_of_message, commands_of_keys
from fes.signals import Event, FootSwitchEvent

Execute = Callable[[OperatorCommand, int], list[Event]]
"""Executes a command at a time (ns); see :meth:`fes.live.operator.Operator.execute`."""

MESSAGES_AT_ONCE: Final = 32
SUBSCRIBERS: Final = 4
SOCKET_MODE: Final = 0o600


class Control:
    """A datagram socket that takes commands and answers them; who sends ``watch`` gets every status from then on.

    Only its owner may write to it. Answers and status are dropped where the other side does not read.
    """

    def __init__(self, path: Path, execute: Execute) -> None:
        """Bind. OSError: the path is taken, too long (107 bytes), or cannot be made."""
        self._path = path
        self._execute = execute
        self._watchers: list[str] = []
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        before = os.umask(0o777 & ~SOCKET_MODE)
        try:
            self._socket.bind(str(path))
        finally:
            os.umask(before)

    def fileno(self) -> int | None:
        """Readable with commands."""
        return self._socket.fileno()

    def read_events(self, t_ns: int) -> list[Event]:
        """Execute what has come."""
        events: list[Event] = []
        for _ in range(MESSAGES_AT_ONCE):
            try:
                message, sender = self._socket.recvfrom(4096)
            except OSError:
                break
            answer = b'{"ok":true}'
            if message == b"watch":
                self._watchers = [*(name for name in self._watchers if name != sender), sender][-SUBSCRIBERS:]
            else:
                try:
                    events += self._execute(command_of_message(message), t_ns)
                except CommandRefused as error:
                    answer = b'{"ok":false,"why":' + json.dumps(str(error)).encode() + b"}"
            self._send(answer, sender)
        return events

    def publish(self, status: bytes) -> None:
        """Send the status to everybody who watches."""
        for watcher in list(self._watchers):
            self._send(status, watcher)

    def close(self) -> None:
        """Close and remove the socket."""
        self._socket.close()
        with suppress(OSError):
            self._path.unlink()

    def _send(self, message: bytes, to: str | None) -> None:
        if not to:
            return
        try:
            self._socket.sendto(message, to)
        except BlockingIOError:
            return
        except OSError:
            self._watchers = [name for name in self._watchers if name != to]


class StopFile:
    """A file whose appearance is an emergency stop; while it is there, arming is refused.

    So is it where it could not appear or be seen: its folder is missing, is none, or may not be looked into.
    """

    def __init__(self, path: Path, execute: Execute) -> None:
        self.path = path
        self._execute = execute
        self._not_ready = ""

    def fileno(self) -> int | None:
        """None: a file on any file system is looked for, not waited for."""
        return None

    def read_events(self, t_ns: int) -> list[Event]:
        """A stop when the file has appeared, or can no longer be looked for."""
        was, self._not_ready = self._not_ready, self._reason()
        if was or not self._not_ready:
            return []
        return self._execute(OperatorCommand(CommandKind.STOP, origin=f"file {printable(self.path.name)}"), t_ns)

    def not_ready(self) -> str:
        """Why it forbids arming; "" when it does not."""
        return self._not_ready

    def _reason(self) -> str:
        shown = f"the stop file {printable(str(self.path))}"
        try:
            try:
                self.path.lstat()  # a link that leads nowhere is there too
            except FileNotFoundError:
                return "" if self.path.parent.is_dir() else f"{shown} cannot appear: its folder is not there; make it"
        except (OSError, ValueError) as error:
            return f"{shown} cannot be looked for: {getattr(error, 'strerror', None) or error}"
        return f"{shown} is there; remove it"


class SwitchLine(Protocol):
    """A switch behind a line; see ``drivers.switches``."""

    def fileno(self) -> int | None:
        """Readable when it may have changed; None: it is asked every turn."""

    def read(self) -> bool | None:
        """Whether it is pressed, as far as is known now; None: nothing is known yet, or it is lost."""


class StopSwitch:
    """A hardware button: pressed, or lost after it was known, it is an emergency stop."""

    def __init__(self, line: SwitchLine, execute: Execute) -> None:
        self._line = line
        self._execute = execute
        self._pressed: bool | None = None

    def fileno(self) -> int | None:
        """As its line's."""
        return self._line.fileno()

    def read_events(self, t_ns: int) -> list[Event]:
        """A stop when it goes down or goes missing."""
        was, self._pressed = self._pressed, self._line.read()
        if self._pressed is False or self._pressed == was:
            return []
        stop = OperatorCommand(CommandKind.STOP, origin="button" if self._pressed else "button lost")
        return self._execute(stop, t_ns)

    def not_ready(self) -> str:
        """Why it forbids arming; "" when it does not."""
        if self._pressed is None:
            return "nothing is heard of the stop button"
        return "the stop button is pressed" if self._pressed else ""


class FootSwitchInput:
    """A switch under a foot: each change is an event, and silence; no release of which nobody knows when it was."""

    def __init__(self, foot: str, line: SwitchLine) -> None:
        self._foot = foot
        self._line = line
        self._pressed: bool | None = None
        self._reported: bool | None = None

    def fileno(self) -> int | None:
        """As its line's."""
        return self._line.fileno()

    def read_events(self, t_ns: int) -> list[Event]:
        """The change, if there was one. A foot that is found lifted after a silence may long have been."""
        was, self._pressed = self._pressed, self._line.read()
        if self._pressed is None:
            return [] if was is None else [FootSwitchEvent(t_ns, self._foot, None)]
        if self._pressed == self._reported or (was is None and not self._pressed):
            return []
        self._reported = self._pressed
        return [FootSwitchEvent(t_ns, self._foot, self._pressed)]


class WitnessInput:
    """What the witness of the foot sensors says (``fes.live.witness_process``); ``distrust`` gets what surely lies.

    It is heard for as long as its process lives: a session goes on without it, and says so.
    """

    def __init__(self, link: socket.socket, distrust: Callable[[int, str], list[Event]]) -> None:
        self._link: socket.socket | None = link
        self._distrust = distrust
        self._lies: dict[str, str] = {}
        self._unknown: dict[str, str] = {}

    def fileno(self) -> int | None:
        """While there is one."""
        return None if self._link is None else self._link.fileno()

    def read_events(self, t_ns: int) -> list[Event]:
        """A lie that was not told before."""
        if self._link is None:
            return []
        try:
            said = json.loads(self._link.recv(4096))
            sensor, lies, unknown = str(said["sensor"]), str(said["lies"]), str(said["unknown"])
        except BlockingIOError:
            return []
        except (OSError, ValueError, KeyError, TypeError):  # its end, or no message of its own
            self._link = None
            return []
        before, self._lies[sensor], self._unknown[sensor] = self._lies.get(sensor, ""), lies, unknown
        return self._distrust(t_ns, f"{sensor}: {lies}") if lies and not before else []

    def now(self) -> list[str]:
        """What lies, and of which sensor it cannot be told yet."""
        if self._link is None:
            return ["the witness has ended: whether a foot's sensor can be trusted is not known"]
        unknown = "whether this sensor can be trusted is not known yet"
        lying = [f"{sensor}: {lies}; lengths and clearance are wrong" for sensor, lies in self._lies.items() if lies]
        return lying + [f"{sensor}: {unknown} ({why})" for sensor, why in self._unknown.items() if why]


def printable(text: str) -> str:
    """The same, with escapes for what is no Unicode: a file's name may be any bytes, a log's text may not."""
    return text.encode("utf-8", "backslashreplace").decode()


ESCAPE_NS: Final = 200_000_000  # a sequence's pieces lie closer together, two keys that a person means hardly


class Terminal:
    """Puts a terminal into a mode in which keys come at once and unseen; Ctrl-C stays what it is.

    Enter it in the main thread: after Ctrl-Z and ``fg`` it sets the mode again, which the shell has changed meanwhile.
    """

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self._before: list[Any] | None = None
        self._handler_before: Callable[[int, FrameType | None], object] | int | None = None

    def __enter__(self) -> Self:
        if os.isatty(self._descriptor):
            import termios
            import tty

            self._before = termios.tcgetattr(self._descriptor)
            tty.setcbreak(self._descriptor, termios.TCSANOW)  # what was typed already, a stop perhaps, must stay
            if threading.current_thread() is threading.main_thread():
                self._handler_before = signal.signal(signal.SIGCONT, self._continued)
        return self

    def __exit__(self, *_: object) -> None:
        if self._handler_before is not None:
            signal.signal(signal.SIGCONT, self._handler_before)
        if self._before is not None:
            import termios

            termios.tcsetattr(self._descriptor, termios.TCSANOW, self._before)

    def _continued(self, number: int, frame: object) -> None:
        import termios
        import tty

        with suppress(OSError, termios.error):  # the terminal is gone, or is none that a shell takes and gives back
            if os.tcgetpgrp(self._descriptor) == os.getpgrp():
                tty.setcbreak(self._descriptor, termios.TCSANOW)


class Keyboard:
    """Keys from a terminal, or from whatever the descriptor is.

    ``gone`` is called once when they have ended, and the stop key with them; it returns the events that come of it.
    An escape sequence may come in pieces: for 0.2 s after an escape only a stop counts.
    """

    def __init__(self, descriptor: int, execute: Execute, gone: Callable[[int], list[Event]] = lambda t_ns: []) -> None:
        self._execute = execute
        self._gone = gone
        self._escape_until_ns: int | None = None
        self._given = descriptor
        self._own = _opened_again(descriptor)
        self._was_blocking = os.get_blocking(descriptor)
        self._descriptor: int | None = descriptor if self._own is None else self._own
        if self._own is None:
            os.set_blocking(descriptor, False)

    def fileno(self) -> int | None:
        """While it is open."""
        return self._descriptor

    def read_events(self, t_ns: int) -> list[Event]:
        """The commands in what was typed."""
        if self._descriptor is None:
            return []
        try:
            typed = os.read(self._descriptor, 256)
        except BlockingIOError:
            return []
        except OSError:
            typed = b""
        if not typed:
            self._descriptor = None
            return self._gone(t_ns)
        goes_on = self._escape_until_ns is not None and t_ns < self._escape_until_ns
        if ESCAPE.search(typed):
            self._escape_until_ns = t_ns + ESCAPE_NS
        if goes_on:
            typed = b"\x1b" + typed
        return [event for command in commands_of_keys(typed) for event in self._execute(command, t_ns)]

    def close(self) -> None:
        """Leave the descriptor as it was."""
        self._descriptor = None
        with suppress(OSError):
            if self._own is not None:
                os.close(self._own)
            else:
                os.set_blocking(self._given, self._was_blocking)
        self._own = None


def _opened_again(descriptor: int) -> int | None:
    """The same terminal through an opening of its own; None where there is none, or it may not be opened.

    Whether reading waits belongs to the opening, and the shell's opening is shared with whatever runs afterwards.
    """
    if not os.isatty(descriptor):
        return None
    try:
        return os.open(os.ttyname(descriptor), os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC)
    except OSError:
        return None


def standard_keys() -> int | None:
    """Standard input where it can bring keys: a terminal or a pipe, not an empty device."""
    try:
        descriptor = sys.stdin.fileno()
    except (AttributeError, OSError, ValueError):
        return None
    return descriptor if os.isatty(descriptor) else None
