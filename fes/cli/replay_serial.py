"""A serial stimulator's port repeated from a session log: the same port, told what the line brought when it did."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress

from drivers.stimulator.open import SERIAL, open_stimulator
from drivers.stimulator.port import StimulatorLost
from drivers.stimulator.sciencemode_port import ScienceModePort
from drivers.stimulator.serial_line import Line
from fes.config import Session
from fes.journal import Received
from fes.live.stimulator import UNSENT
from fes.signals import Event, StimAlive, StimCommand, StimOpened, StimStatus, WireFrame


class LoggedLine:
    """A :class:`drivers.stimulator.serial_line.Line` with nobody behind it: it brings what it is given."""

    name = "the session log"

    def __init__(self) -> None:
        self.brings = b""

    def write(self, data: bytes) -> None:
        """It goes nowhere."""

    def read(self) -> bytes:
        """What it was given since the last call."""
        data, self.brings = self.brings, b""
        return data

    def wait(self, timeout_s: float) -> None:
        """There is nothing to wait for."""

    def fileno(self) -> int:
        """None."""
        return -1

    def close(self) -> None:
        """Nothing is held."""


class SerialSink:
    """Encodes as the session's serial port did, from what that heard: its queue, its questions, its numbers.

    ``sent`` says by command whether the session gave it to the port; a line that was lost got none.

    Raises:
        ConfigError: the log's settings are not such a device's.
    """

    def __init__(self, session: Session) -> None:
        self.sent: Sequence[bool] = ()
        self._session = session
        self._number = 0
        self._line = LoggedLine()
        self._port = self._open(0)

    def told(self, inputs: Iterable[Event | Received | WireFrame], session_id: int) -> Iterator[Event]:
        """The log's events, while the port is told what lies between them.

        The session looked at the line after every event that was no answer of the stimulator's own; what it then found
        is in the log before the answers that it made of it.
        """
        greeted: list[WireFrame] = []
        begun, looked_ns = False, None
        for each in inputs:
            if isinstance(each, WireFrame):
                if each.identifier in self._port.greetings:
                    greeted.append(each)
                continue
            if not begun:
                self._resume(session_id, greeted)
                begun = True
            if isinstance(each, Received):
                self._line.brings += each.data
                continue
            self._look(looked_ns)
            if isinstance(each, StimOpened):
                self._resume(each.session_id, greeted)
            yield each
            looked_ns = None if isinstance(each, StimStatus | StimAlive) else each.t_ns
        self._look(looked_ns)

    def commands_of(self, frames: Iterable[WireFrame]) -> list[WireFrame]:
        """Of all frames those of commands, one each: all but the handshakes'."""
        return [frame for frame in frames if frame.identifier not in self._port.greetings]

    def send(self, command: StimCommand) -> WireFrame:
        """The frame that the session sent, or left out."""
        number, self._number = self._number, self._number + 1
        if number < len(self.sent) and not self.sent[number]:
            return WireFrame(command.t_ns, UNSENT, b"")
        return self._port.send(command)

    def poll(self, t_ns: int) -> list[StimStatus | StimAlive]:
        """Its answers are events in the log."""
        return []

    def _look(self, t_ns: int | None) -> None:
        if t_ns is not None:
            with suppress(StimulatorLost):  # as it was then, and the log says so
                self._port.poll(t_ns)

    def _resume(self, session_id: int, greeted: list[WireFrame]) -> None:
        self._line = LoggedLine()
        self._port = self._open(session_id)
        self._port.resume(greeted)
        greeted.clear()

    def _open(self, session_id: int) -> ScienceModePort:
        line: Line = self._line
        port = open_stimulator(self._session.stimulator, self._session, session_id, lambda name, settings: line)
        assert isinstance(port, ScienceModePort), "a serial device"
        return port


def repeats_bytes(session: Session, header: Mapping[str, object]) -> bool:
    """Whether a log holds all that the session's serial port went by; those of before that was kept do not."""
    return session.stimulator.device in SERIAL and header.get("heard") is True
