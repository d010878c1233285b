"""The loop's end of the link to the dashboard's process, both ways; it waits for nobody and has no clock."""

import socket
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Final

from fes.control.runner import MEASURES_NOTED
from fes.live.commands import CommandKind, CommandRefused, OperatorCommand, State, command_of_message
from fes.live.dashboard.frames import NAMES, STATUS, detail
from fes.live.inputs import Execute
from fes.session_log import Note
from fes.signals import Event, StimCommand, StimStatus, StrideResult
from fes.stimulation.onset import EACH_ONSET
from fes.walk_record import MARK
from statemachine.phases import PhaseChange

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
    """An input of the live session (see ``fes.live.source.Input``).

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
