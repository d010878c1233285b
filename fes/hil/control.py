"""The scripted operator: orders over a session's control socket, statuses back."""

from __future__ import annotations

import json
import socket
from contextlib import suppress
from pathlib import Path

from fes.live.status import Status


class ScriptedOperator:
    """One end of a control socket; ``status`` is the newest that came, ``answers`` what was refused."""

    def __init__(self, session_socket: Path, own: Path) -> None:
        self.status: Status | None = None
        self.refusals: list[str] = []
        self._to = str(session_socket)
        self._own = own
        own.unlink(missing_ok=True)
        self._link = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._link.bind(str(own))
        self._link.setblocking(False)

    def order(self, ask: str, value: float = 0.0) -> None:
        """Give an order, confirmed; a session that is not there hears nothing."""
        with suppress(OSError):
            self._link.sendto(json.dumps({"ask": ask, "value": value, "confirm": True}).encode(), self._to)

    def watch(self) -> None:
        """Ask for statuses."""
        with suppress(OSError):
            self._link.sendto(b"watch", self._to)

    def listen(self) -> Status | None:
        """Take in what has come; the newest status."""
        while True:
            try:
                datagram = self._link.recv(1 << 16)
            except OSError:
                return self.status
            try:
                self.status = Status.decode(datagram)
            except ValueError:
                with suppress(ValueError):
                    answer = json.loads(datagram)
                    if not answer.get("ok"):
                        self.refusals.append(str(answer.get("why")))

    def forget(self) -> None:
        """The session that told this is gone."""
        self.listen()
        self.status = None

    def close(self) -> None:
        """Release the socket."""
        self._link.close()
        self._own.unlink(missing_ok=True)
