"""The loop's end of the way to the page: remembers what the log passes by, sends it with each status, never waits."""

from __future__ import annotations

import socket
from collections import deque
from typing import Final

from fes.live.dashboard.frames import STATUS, Level, detail
from fes.session_log import Note
from fes.signals import Event, StimCommand, StimStatus, StrideResult
from statemachine.phases import PhaseChange

LEVELS_KEPT: Final = 1024  # while the page does not read: two seconds of eight channels
STRIDES_KEPT: Final = 32
NOTES_KEPT: Final = 64


class DashboardStream:
    """Give it what is logged; :meth:`tell` sends. A page that does not read misses statuses, and old levels.

    Args:
        link: one end of a SOCK_SEQPACKET pair; it is made non-blocking.
    """

    def __init__(self, link: socket.socket) -> None:
        link.setblocking(False)
        self.link = link
        self.lost = ""
        self.dropped = 0
        self._sent: deque[Level] = deque(maxlen=LEVELS_KEPT)
        self._answered: deque[Level] = deque(maxlen=LEVELS_KEPT)
        self._phases: deque[tuple[int, str, str]] = deque(maxlen=NOTES_KEPT)
        self._strides: deque[StrideResult] = deque(maxlen=STRIDES_KEPT)
        self._notes: deque[tuple[int, str, str]] = deque(maxlen=NOTES_KEPT)

    def event(self, event: Event) -> None:
        """Of all events only the stimulator's answers are shown as they are."""
        if isinstance(event, StimStatus):
            self._answered.append((event.t_ns, event.channel, event.current_ma if event.on else 0.0))

    def command(self, command: StimCommand) -> None:
        """What the gate let out."""
        self._sent.append((command.t_ns, command.channel, command.current_ma if command.on else 0.0))

    def phase(self, change: PhaseChange) -> None:
        """A foot came into a phase."""
        self._phases.append((change.t_ns, change.foot, change.destination.name.lower()))

    def stride(self, result: StrideResult) -> None:
        """A stride is complete."""
        self._strides.append(result)

    def note(self, note: Note) -> None:
        """What a person should know."""
        self._notes.append((note.t_ns, note.severity, note.text))

    def tell(self, status: bytes) -> None:
        """Send the status and what has gathered, as far as the page's process takes it now.

        ``lost`` says afterwards why nothing can be told any more; "" while it can.
        """
        if self.lost:
            return
        gathered = self._sent, self._answered, self._phases, self._strides, self._notes
        try:
            self.link.send(STATUS + status)  # first: where this does not go, encoding the rest is not worth while
            self.link.send(detail(*gathered))
        except BlockingIOError:
            self.dropped += 1
            return
        except OSError as error:
            self.lose(error.strerror or str(error))
        for each in gathered:
            each.clear()

    def lose(self, why: str) -> None:
        """The page's process is gone."""
        self.lost = self.lost or why
