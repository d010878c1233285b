"""What controller and supervisor say to each other: one datagram holds one request, or its answer, and records.

A datagram is ``u32 number | u8 what | i64 time`` and records, each ``u8 kind | u16 bytes | payload``. The
controller's: the events that its gate has observed since its last one, and for :attr:`What.COMMAND` the command behind
them. The supervisor's, under the request's number: what it did by itself (commands, each with its frame) and its
faults, then what was asked for. Payloads are the session log's, but for samples, which are of a fixed size here.

The controller's end of the supervisor: in the place of the stimulator's port, which the supervisor alone holds.

What is observed gathers and goes with the next request, so that a sample costs no system call of its own. A request
waits for its answer, :data:`ANSWER_NS` at most; then the line counts as lost.
"""

from __future__ import annotations

import itertools
import json
import socket
import struct
from collections.abc import Callable, Mapping
from contextlib import suppress
from enum import IntEnum
from typing import Any, Final, NamedTuple, Protocol

from fes.config import ConfigError, Session
from fes.live.processes import HelperProcess
from fes.session_log import Received
from fes.session_log.codec import Rare, decode, encode
from fes.session_log.framing import RecordType
from fes.signals import SENSORS, Event, ImuSample, StimAlive, StimCommand, StimStatus, SystemFault, Vector3, WireFrame

MOST_BYTES: Final = 1 << 16  # of a datagram
UNSENT: Final = 0  # the identifier of a frame that did not go out
OWN: Final = "by the supervisor: "  # begins the reason of a command that the controller did not ask for
MALFORMED: Final = (struct.error, ValueError, KeyError, IndexError, TypeError, OverflowError)
_HEAD = struct.Struct("<IBq")
_RECORD = struct.Struct("<BH")
_SAMPLE = struct.Struct("<qBq6d")
_WHOLE_SAMPLE = struct.Struct("<BHqBq6d")
_LINE = struct.Struct("<Id")
_LINE_KIND: Final = 200  # beyond the log's own
_NUMBER_OF: Final = {sensor: number for number, sensor in enumerate(SENSORS)}


class What(IntEnum):
    """What a datagram asks, or how what it asked for went."""

    NOTHING = 0  # events only; is not answered
    COMMAND = 1
    POLL = 2
    OPEN = 3
    CLOSE = 4  # is not answered
    DONE = 10
    LOST = 11  # the line; the last value is a SystemFault that says why
    IMPOSSIBLE = 12  # ValueError; likewise


class LineOpened(NamedTuple):
    """The stimulator's session was opened under this identifier; its step between two currents."""

    session_id: int
    current_step_ma: float


Value = Rare | ImuSample | LineOpened


class Datagram(NamedTuple):
    """One of either side; an answer's time is when what was asked had been done."""

    number: int
    what: What
    t_ns: int
    values: list[Value]


def packed(value: Value) -> bytes:
    """A value as a record."""
    if isinstance(value, ImuSample):
        t_ns, sensor, t_sensor_ns, acc, gyr = value
        number = _NUMBER_OF[sensor]
        return _WHOLE_SAMPLE.pack(RecordType.SAMPLES, _SAMPLE.size, t_ns, number, t_sensor_ns, *acc, *gyr)
    kind, payload = (_LINE_KIND, _LINE.pack(*value)) if isinstance(value, LineOpened) else encode(value)
    return _RECORD.pack(kind, len(payload)) + payload


def datagram(number: int, what: What, t_ns: int, records: bytes | bytearray) -> bytes:
    """A request or an answer with its records, as :func:`packed` makes them."""
    return _HEAD.pack(number & 0xFFFF_FFFF, what, t_ns) + records


def unpacked(data: bytes) -> Datagram:
    """The inverse.

    Raises:
        one of MALFORMED: it is none.
    """
    if len(data) > MOST_BYTES:
        raise ValueError("longer than any")
    number, what, t_ns = _HEAD.unpack_from(data)
    values: list[Value] = []
    view, at = memoryview(data), _HEAD.size
    while at < len(view):
        kind, length = _RECORD.unpack_from(view, at)
        at += _RECORD.size + length
        if at > len(view):
            raise ValueError("a record is cut off")
        payload = view[at - length : at]
        if kind == RecordType.SAMPLES:
            t_sample_ns, sensor, t_sensor_ns, ax, ay, az, p, q, r = _SAMPLE.unpack(payload)
            values.append(ImuSample(t_sample_ns, SENSORS[sensor], t_sensor_ns, (ax, ay, az), (p, q, r)))
        elif kind == _LINE_KIND:
            values.append(LineOpened(*_LINE.unpack(payload)))
        else:
            values.append(decode(kind, payload))
    return Datagram(number, What(what), t_ns, values)


MODULE: Final = "fes.cli.run.supervisor"
ANSWER_NS: Final = 30_000_000  # less than the 40 ms for which the loop may be away
OPEN_NS: Final = 60_000_000_000  # eight identifiers tried on the slowest device
TOO_BUSY: Final = "this computer is too busy: end other programs, then start again"
POLL_NS: Final = 5_000_000  # of the events' time, between two looks at what the stimulator says
HELD_NS: Final = 1_000_000  # what was observed longer ago goes at once, so that no command waits for its observing
GATHERED_NS: Final = 10_000_000  # while the line is lost, and nothing is asked
GATHERED_BYTES: Final = MOST_BYTES // 4  # of a backlog, all of one time
BUFFER_BYTES: Final = 1 << 20


class StimulatorLine(Protocol):
    """An open stimulator; see ``drivers.stimulator.port``."""

    @property
    def heard(self) -> bytes:
        """What the last ``poll`` read, where the bytes that go out depend on that: it belongs in the log."""

    def send(self, command: StimCommand) -> WireFrame:
        """Write at once."""

    def poll(self, t_ns: int) -> list[StimStatus | StimAlive]:
        """What has arrived."""

    def close(self) -> None:
        """Release the line."""


class SessionOpened(NamedTuple):
    """The stimulator's session was opened: what its handshake sent and heard, its step between two currents."""

    session_id: int
    current_step_ma: float
    frames: tuple[WireFrame, ...]
    alive: tuple[StimAlive, ...]


class SupervisedLine:
    """A :class:`StimulatorLine` whose port is the supervisor's; ``lost`` says that it is gone.

    ``on_own`` gets each command that the supervisor sent by itself, with its frame, ``on_fault`` why it did.
    """

    def __init__(self, link: socket.socket, lost: type[Exception]) -> None:
        self.heard = b""
        self.on_own: Callable[[StimCommand, WireFrame], None] = lambda command, frame: None
        self.on_fault: Callable[[str], None] = lambda text: None
        self._link, self._lost = link, lost
        self._numbers = itertools.count(1)
        self._gathered = bytearray()
        self._since_ns = 0
        self._polled_ns: int | None = None
        self._failed = ""
        link.setblocking(True)  # within the time that it is given
        link.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, BUFFER_BYTES)

    def open(self, t_ns: int) -> SessionOpened:
        """Have the port opened, at first or again, and wait for that; only ever called while nothing else is asked.

        Raises:
            ConfigError: the session cannot be served by this device.
            ``lost``: the device cannot be reached.
        """
        self._wait_at_most(OPEN_NS)
        try:
            values = self._ask(What.OPEN, t_ns)
        except ValueError as error:
            raise ConfigError(str(error)) from None
        finally:
            self._wait_at_most(ANSWER_NS)
        self._polled_ns = None
        line = values[0]
        assert isinstance(line, LineOpened)
        frames = tuple(value for value in values if isinstance(value, WireFrame))
        alive = tuple(value for value in values if isinstance(value, StimAlive))
        return SessionOpened(line.session_id, line.current_step_ma, frames, alive)

    def observe(self, event: Event) -> None:
        """What the controller's gate observes, in order; the stimulator's answers the supervisor has heard itself."""
        if isinstance(event, StimStatus | StimAlive):
            return
        if not self._gathered:
            self._since_ns = event.t_ns
        self._gathered += packed(event)
        if event.t_ns - self._since_ns > GATHERED_NS or len(self._gathered) > GATHERED_BYTES:
            self._tell(What.NOTHING, event.t_ns)

    def send(self, command: StimCommand) -> WireFrame:
        """Have it judged and written; a frame of identifier 0 where the supervisor refuses it.

        Raises:
            ``lost``: the line did not take it, or the supervisor does not answer.
            ValueError: the device cannot express it.
        """
        frame = self._ask(What.COMMAND, command.t_ns, packed(command))[-1]
        assert isinstance(frame, WireFrame)
        return frame

    def poll(self, t_ns: int) -> list[StimStatus | StimAlive]:
        """What has arrived; asked for once in :data:`POLL_NS` of the events' time, see :func:`is_due`."""
        self.heard = b""
        if not is_due(t_ns, self._polled_ns):
            if t_ns - self._since_ns >= HELD_NS and self._gathered:
                self._tell(What.NOTHING, t_ns)
            return []
        self._polled_ns = t_ns
        values = self._ask(What.POLL, t_ns)
        self.heard = b"".join(value.data for value in values if isinstance(value, Received))
        return [value for value in values if isinstance(value, StimStatus | StimAlive)]

    def close(self) -> None:
        """Have the port released."""
        self._tell(What.CLOSE, 0)

    def _tell(self, what: What, t_ns: int, more: bytes = b"") -> int:
        number = next(self._numbers) & 0xFFFF_FFFF
        gathered = bytearray()
        if what is not What.OPEN:  # which is asked in another thread than what is observed
            gathered, self._gathered = self._gathered, gathered
        try:
            self._link.send(datagram(number, what, t_ns, gathered + more), socket.MSG_DONTWAIT | socket.MSG_NOSIGNAL)
        except OSError as error:  # what it misses now it never gets: its gate knows less than ours
            self._failed = f"the supervisor's process does not listen ({error.strerror}); start a new session"
        return number

    def _ask(self, what: What, t_ns: int, more: bytes = b"") -> list[Any]:
        number = self._tell(what, t_ns, more)
        while True:
            if self._failed:
                raise self._lost(self._failed)
            try:
                data = self._link.recv(MOST_BYTES + 1)
            except BlockingIOError:
                late = f"does not answer within {ANSWER_NS // 1_000_000} ms"
                if what is What.OPEN:
                    late = f"is not ready within {OPEN_NS // 1_000_000_000} s; {TOO_BUSY}"
                raise self._lost(f"the supervisor {late}") from None
            except OSError:  # it has ended with a datagram of ours unread
                data = b""
            if not data:
                self._failed = "the supervisor's process has ended; start a new session"
                continue
            answer = unpacked(data)
            values = self._without_untold(answer, number)
            if answer.number == number:
                return values

    def _without_untold(self, answer: Datagram, number: int) -> list[Any]:
        """What was asked for, once what the supervisor did by itself is told. Raises as the answer says."""
        values: list[Any] = answer.values
        failed = answer.what is not What.DONE
        why = values.pop().text if failed else ""
        while values and isinstance(values[0], StimCommand | SystemFault):
            value = values.pop(0)
            if isinstance(value, SystemFault):
                self.on_fault(value.text)
            else:
                frame = values.pop(0)
                if answer.number == number:  # else the line was given up meanwhile, and the session with it
                    self.on_own(value, frame)
        if failed and answer.number == number:
            raise (ValueError if answer.what is What.IMPOSSIBLE else self._lost)(why)
        return values

    def _wait_at_most(self, time_ns: int) -> None:
        seconds, rest_ns = divmod(time_ns, 1_000_000_000)
        self._link.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, struct.pack("ll", seconds, rest_ns // 1000))


def is_due(t_ns: int, polled_ns: int | None, every_ns: int = POLL_NS) -> bool:
    """Whether the line is looked at after an event of this time: a replay must look when the session did."""
    return polled_ns is None or t_ns - polled_ns >= every_ns


class SupervisorProcess(HelperProcess):
    """The supervisor's process while entered. It takes a second to start, so begin early; then :meth:`line_of`."""

    def __init__(self) -> None:
        super().__init__(MODULE)
        self._begun = False

    def line_of(
        self,
        session: Session,
        up: Mapping[str, Vector3],
        shank_phase_sensors: Mapping[str, str],
        stop_file: str,
        lost: type[Exception],
    ) -> SupervisedLine:
        """The line, still to be opened, of a session: what :func:`fes.gate.gate_of` needs, and the stop file."""
        settings = {"session": session.model_dump(mode="json"), "up": dict(up), "stop_file": stop_file}
        line, self._begun = SupervisedLine(self.link, lost), True
        with suppress(OSError):  # it has ended already: the opening says so
            self.link.send(json.dumps(settings | {"shank_phase_sensors": dict(shank_phase_sensors)}).encode())
        return line

    def __exit__(self, *error: object) -> None:
        if not self._begun:
            self.process.kill()
        super().__exit__(*error)
