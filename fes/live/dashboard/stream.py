"""The loop's end of the link to the dashboard's process, both ways; it waits for nobody and has no clock.

What goes between a session and its dashboard's process over a socket pair: the first byte says what it is.

To the dashboard: who is there (HELLO, once), the status that the terminal view gets too (STATUS, ten times a second),
what has happened since (DETAIL, with each status), and that it is over (END). To the session: commands, as JSON.
"""

import json
import socket
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from math import isfinite
from typing import Any, Final

import msgpack
import numpy as np

from fes.control.runner import MEASURES_NOTED
from fes.live.commands import CommandKind, CommandRefused, OperatorCommand, State, command_of_message
from fes.live.inputs import Execute
from fes.live.status import Status
from fes.session_log import Note
from fes.signals import Event, StimCommand, StimStatus, StrideResult
from fes.stimulation.onset import EACH_ONSET
from fes.walk_record import MARK
from statemachine.phases import PhaseChange

LEVELS: Final = 4096  # ten seconds of eight channels at 50 Hz
STRIDES: Final = 80
PHASES: Final = 256
NOTES: Final = 60
NS_PER_MS: Final = 1e6


class StateBuffer:
    """Fill it with :meth:`status` and :meth:`detail`; :meth:`since` is what one browser has not seen yet.

    Times go out as ms since ``origin_ns``, the first status's.
    """

    def __init__(self) -> None:
        self.newest: Status | None = None
        self.heard_ns: int | None = None
        self.ended = ""
        self.origin_ns: int | None = None
        self.number = 0
        kept = {"sent": LEVELS, "answered": LEVELS, "phases": PHASES, "strides": STRIDES, "notes": NOTES}
        self._rings: dict[str, deque[tuple[int, Any]]] = {name: deque(maxlen=most) for name, most in kept.items()}

    def status(self, status: Status, heard_ns: int) -> None:
        """The newest status, and when it came."""
        if self.origin_ns is None:
            self.origin_ns = status.t_ns
        self.newest = status
        self.heard_ns = heard_ns

    def detail(self, happened: Mapping[str, Sequence[Any]]) -> None:
        """What has happened; see :func:`fes.live.dashboard.stream.read_detail`."""
        self.number += 1
        for name, values in happened.items():
            if name == "strides":
                shown = [stride | {"t_ms": self._ms(stride.pop("t_end_ns"))} for stride in values]
            else:
                shown = [[self._ms(t_ns), *rest] for t_ns, *rest in values]
            self._rings[name].extend((self.number, value) for value in shown)

    def end(self, why: str) -> None:
        """The session is over."""
        self.ended = self.ended or why

    def since(self, number: int, now_ns: int) -> dict[str, Any]:
        """A frame: all that came after ``number``, and the newest status with its age."""
        rings = {name: [value for n, value in ring if n > number] for name, ring in self._rings.items()}
        frame: dict[str, Any] = {name: fresh for name, fresh in rings.items() if fresh}
        if self.newest is not None and self.heard_ns is not None:
            frame["status"] = self.newest.plain() | {"t_ms": self._ms(self.newest.t_ns)}
            frame["age_ms"] = round((now_ns - self.heard_ns) / NS_PER_MS)
        if self.ended:
            frame["ended"] = self.ended
        return frame

    def _ms(self, t_ns: int) -> float:
        return round((t_ns - (self.origin_ns or 0)) / NS_PER_MS, 1)


HELLO: Final = b"H"
STATUS: Final = b"S"
DETAIL: Final = b"D"
END: Final = b"E"
LARGEST: Final = 1 << 18
POINTS: Final = 48  # of a stride's path: more cannot be told apart on a screen
NAMES: Final = ("sent", "answered", "phases", "strides", "notes")
STRIDE: Final = (
    *("foot", "number", "t_end_ns", "stride_length_m", "clearance_m", "toe_clearance_m", "speed_mps"),
    *("valid", "reason"),
)


def hello(about: dict[str, Any]) -> bytes:
    """The first message: plain data."""
    return HELLO + json.dumps(about).encode()


def detail(happened: Mapping[str, Iterable[Any]]) -> bytes:
    """The message of what has happened since the last one, by name.

    ``sent`` is what the gate let out, ``answered`` what the stimulator says it delivers: (ns, channel, mA; 0: off).
    ``phases`` are (ns, foot, phase), ``notes`` (ns, severity or "mark", text), ``strides``
    :class:`fes.signals.StrideResult`.
    """
    plain = [list(map(_shown, happened[name])) if name == "strides" else list(happened[name]) for name in NAMES]
    return DETAIL + bytes(msgpack.packb(plain))


def read_hello(message: bytes) -> dict[str, Any]:
    """Back from the message. ValueError: it is none."""
    if message[:1] != HELLO:
        raise ValueError("the first message must be the session's")
    return dict(json.loads(message[1:]))


def read_detail(message: bytes) -> dict[str, list[Any]]:
    """Back from the message: lists by name; strides as dicts, None for NaN, their path x forward and z up in turn (m).

    ValueError: it is none.
    """
    try:
        happened = dict(zip(NAMES, msgpack.unpackb(message[1:]), strict=True))
        for stride in happened["strides"]:
            path_m = np.frombuffer(stride["path_m"], "<f4").astype(float)
            missing = [name for name, value in stride.items() if isinstance(value, float) and not isfinite(value)]
            stride |= dict.fromkeys(missing)
            stride["path_m"] = np.round(path_m, 4).tolist()
    except (TypeError, ValueError, AttributeError, KeyError, msgpack.UnpackException) as error:
        raise ValueError(f"no detail: {error}") from error
    return happened


def _shown(stride: StrideResult) -> dict[str, object]:
    """A stride's numbers as they are shown; made in the loop, so its path goes as packed numbers."""
    path = stride.trajectory_m[:: max(len(stride.trajectory_m) // POINTS, 1), ::2].astype("<f4")
    numbers = {name: getattr(stride, name) for name in STRIDE}
    return numbers | {"path_m": path.tobytes() if np.isfinite(path).all() else b""}


LEVELS_KEPT: Final = 1024  # while nobody reads: two seconds of eight channels
STRIDES_KEPT: Final = 32
NOTES_KEPT: Final = 64
AT_ONCE: Final = 8  # messages read
LONGEST_MESSAGE: Final = 512  # a mark of 80 characters, each of four bytes, and what is around it
RESUME_MESSAGE: Final = b'{"ask":"resume","confirm":true}'
ALLOWED: Final = frozenset(
    CommandKind(kind) for kind in ("stop", "arm", "disarm", "pause", "up", "down", "ground", "ground_free", "mark")
)
ORIGIN: Final = "dashboard"


class DashboardStream:
    """Give it what is logged; :meth:`send` sends it. A dashboard that does not read misses statuses, and old levels.

    ``link``, one end of a SOCK_SEQPACKET pair, is made non-blocking. ``lost``: why its process is gone; "" while it is
    there. ``dropped``: how many statuses it missed.
    """

    def __init__(self, link: socket.socket) -> None:
        link.setblocking(False)
        self.link = link
        self.lost = ""
        self.dropped = 0
        kept = {"sent": LEVELS_KEPT, "answered": LEVELS_KEPT, "strides": STRIDES_KEPT}
        self._happened: dict[str, deque[Any]] = {name: deque(maxlen=kept.get(name, NOTES_KEPT)) for name in NAMES}

    def event(self, event: Event) -> None:
        """Of all events only the stimulator's answers are shown as they are."""
        if isinstance(event, StimStatus):
            self._happened["answered"].append((event.t_ns, event.channel, event.current_ma if event.on else 0.0))

    def command(self, command: StimCommand) -> None:
        """What the gate let out."""
        self._happened["sent"].append((command.t_ns, command.channel, command.current_ma if command.on else 0.0))

    def phase(self, change: PhaseChange) -> None:
        """A foot came into a phase."""
        self._happened["phases"].append((change.t_ns, change.foot, change.destination.name.lower()))

    def stride(self, result: StrideResult) -> None:
        """A stride is complete."""
        self._happened["strides"].append(result)

    def note(self, note: Note) -> None:
        """What a person should know; not each stride's measures and onset, of which the log has every value."""
        if note.source in (MEASURES_NOTED, EACH_ONSET):
            return
        kind = MARK if note.source == MARK else note.severity
        self._happened["notes"].append((note.t_ns, kind, note.text))

    def send(self, status: bytes) -> None:
        """Send the status and what has gathered, as far as the dashboard's process takes it now."""
        if self.lost:
            return
        try:
            self.link.send(STATUS + status)  # first: where this does not go, encoding the rest is not worth while
            self.link.send(detail(self._happened))
        except BlockingIOError:
            self.dropped += 1
            return
        except OSError as error:
            self.lost = error.strerror or str(error)
        for each in self._happened.values():
            each.clear()

    def receive(self) -> list[bytes]:
        """The messages that have come, at most a few."""
        messages: list[bytes] = []
        while len(messages) < AT_ONCE and not self.lost:
            try:
                message = self.link.recv(LONGEST_MESSAGE)
            except BlockingIOError:
                break
            except OSError as error:
                message, self.lost = b"", error.strerror or str(error)
            if not message:
                self.lost = self.lost or "its process has ended"
                break
            messages.append(message)
        return messages


@dataclass(eq=False)
class DashboardCommands:
    """An input of the live session (see ``fes.live.sensors.Input``).

    The dashboard's process is not trusted: of all commands only those in ALLOWED exist here, what leads to more current
    needs its confirmation again, *pause* never goes on, and however much comes, a turn executes one stop, before
    anything else, or a few others. ``on_refused`` gets the time and the reason for a message that is no command.
    """

    stream: DashboardStream
    execute: Execute
    state: Callable[[], State]
    on_refused: Callable[[int, str], None] = lambda t_ns, text: None

    def fileno(self) -> int | None:
        """While the dashboard's process is there."""
        return None if self.stream.lost else self.stream.link.fileno()

    def read_events(self, t_ns: int) -> list[Event]:
        """Execute what has come; a stop among it comes first and puts the rest aside."""
        commands: list[OperatorCommand] = []
        for message in self.stream.receive():
            try:
                if (command := self._command(message)) is not None:
                    commands.append(command)
            except CommandRefused as error:
                self.on_refused(t_ns, f"the dashboard sent what is no command: {error}")
        stop = next((command for command in commands if command.kind is CommandKind.STOP), None)
        return [event for command in ([stop] if stop else commands) for event in self.execute(command, t_ns)]

    def _command(self, message: bytes) -> OperatorCommand | None:
        """The command; None where it means nothing as the session stands.

        CommandRefused: it is none that the dashboard may give.
        """
        if message == RESUME_MESSAGE:
            return OperatorCommand(CommandKind.PAUSE, origin=ORIGIN) if self.state() is State.PAUSED else None
        command = command_of_message(message)
        if command.kind not in ALLOWED:
            raise CommandRefused(f"{command.kind} is not for the dashboard")
        if command.kind is CommandKind.PAUSE and self.state() is State.PAUSED:
            return None  # pressed on two pages at once: the second must not go on
        return replace(command, origin=ORIGIN)
