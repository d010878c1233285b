"""The dashboard's process: ``python -m fes.live.dashboard LINK_FD PARENT_PID LISTENING_FD``; it decides nothing."""

import asyncio
import os
import secrets
import socket
import sys
import time
from collections import deque
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

import uvicorn

from fes.live.dashboard.access import Access, link_address, write_link
from fes.live.dashboard.frames import DETAIL, END, LARGEST, STATUS, StateBuffer, read_detail, read_hello
from fes.live.dashboard.server import CONNECTIONS, Connection, Server
from fes.live.processes import joined
from fes.live.status import Status

STOP: Final = b'{"ask":"stop"}'
PRESSES: Final = 64  # remembered: each comes over both ways, web socket and request
AGAIN_S: Final = 0.005
TRIES: Final = 2000
NICE: Final = -10  # a stop is not to wait behind whatever else the machine does; where that is not granted, it does
FAREWELL_S: Final = 0.2
WEB: Final[dict[str, Any]] = {
    **{"log_config": None, "access_log": False, "lifespan": "off", "loop": "asyncio", "http": Connection},
    **{"ws": "websockets-sansio", "ws_max_size": 2048, "ws_ping_interval": 5.0, "ws_ping_timeout": 10.0},
    **{"ws_per_message_deflate": False, "proxy_headers": False, "server_header": False, "date_header": False},
    **{"backlog": CONNECTIONS // 2, "timeout_keep_alive": 60, "timeout_graceful_shutdown": 1},
}


def new_token() -> str:
    """A token, a secret, an identifier."""
    return secrets.token_urlsafe(24)


class SessionLink:
    """The link to the session on one side, the server on the other."""

    def __init__(self, listening: socket.socket, link: socket.socket) -> None:
        self._link = link
        about = read_hello(link.recv(LARGEST))
        link.setblocking(False)
        self._port = int(listening.getsockname()[1])
        self._listening = listening
        self._url_file = Path(about.pop("url_file"))
        self._access = Access(about.pop("token"), new_token)
        self._buffer = StateBuffer()
        self._server = Server(
            self._buffer, self._access, about, self._port, new_token, self.stop, self._send, self._write_next_link
        )
        self._web = uvicorn.Server(uvicorn.Config(self._server.app, **WEB))
        self._presses: deque[str] = deque(maxlen=PRESSES)
        self._pending = False

    async def run(self) -> None:
        """Serve until the session is over."""
        asyncio.get_running_loop().add_reader(self._link.fileno(), self._hear)
        await self._web.serve(sockets=[self._listening])

    def stop(self, press: str) -> None:
        """Hand a stop on; ``press`` is the same for both ways of one press, "" for a stop that has no other way."""
        if press and press in self._presses:
            return
        self._presses.append(press)
        if not self._pending:
            self._hand_on(TRIES)

    def _hand_on(self, tries: int) -> None:
        """Now, and where the link is full, again until it is through."""
        self._pending = not self._send(STOP) and tries > 0 and not self._buffer.ended
        if self._pending:
            asyncio.get_running_loop().call_later(AGAIN_S, self._hand_on, tries - 1)

    def _send(self, message: bytes) -> bool:
        try:
            self._link.send(message)
        except OSError:
            return False
        return True

    def _hear(self) -> None:
        """All that the session has sent; its end is the dashboard's, after a word of farewell."""
        while not self._buffer.ended:
            try:
                message = self._link.recv(LARGEST)
            except BlockingIOError:
                break
            except OSError:
                message = b""
            with suppress(ValueError):  # of another version: shown is what is understood
                self._receive(message)
        self._server.changed()

    def _receive(self, message: bytes) -> None:
        kind = message[:1]
        if kind == STATUS:
            self._buffer.status(Status.decode(message[1:]), time.monotonic_ns())
        elif kind == DETAIL:
            self._buffer.detail(read_detail(message))
        elif kind == END or not message:
            self._buffer.end(message[1:].decode() or "The session's process has ended unexpectedly.")
            loop = asyncio.get_running_loop()
            loop.remove_reader(self._link.fileno())
            farewell_s = FAREWELL_S if self._server.browsers else 0.0
            loop.call_later(farewell_s, setattr, self._web, "should_exit", True)

    def _write_next_link(self) -> None:
        """The link was used: the file holds the next one."""
        with suppress(OSError):
            write_link(self._url_file, link_address(self._port, self._access.token))


def main() -> int:
    """Serve until the session closes its end."""
    link, _, (served,) = joined()
    os.umask(0o077)
    with suppress(AttributeError, OSError):
        os.setpriority(os.PRIO_PROCESS, 0, NICE)
    with link, socket.socket(fileno=int(served)) as listening:
        asyncio.run(SessionLink(listening, link).run())
    return 0


if __name__ == "__main__":
    sys.exit(main())
