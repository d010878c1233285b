"""Starting and ending the page's process; its link, which is good for one browser once."""

from __future__ import annotations

import secrets
import socket
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

from fes.config import Session
from fes.live.dashboard.frames import END, hello
from fes.live.dashboard.network_guard import ADDRESS_LOOPBACK as LOOPBACK
from fes.live.dashboard.network_guard import link_address, write_link
from fes.live.dashboard.stream import DashboardStream
from fes.live.operator import INTENSITY_STEP

LINK_NAME: Final = "page.url"
TROUBLE_NAME: Final = "page.log"
OVER: Final = "The session has ended. Stimulation is off."
SLOW_MS: Final = 10_000


def about_session(session: Session, mode: str) -> dict[str, Any]:
    """What the page has to know before anything happens: channels, bounds. ``mode``: live or replay."""
    return {
        "mode": mode,
        "name": session.name,
        "most_intensity": session.stimulation.intensity,
        "intensity_step": INTENSITY_STEP,
        "feet": sorted({str(channel.foot) for channel in session.channels}),
        "channels": [
            {
                "number": channel.number,
                "name": channel.name,
                "foot": str(channel.foot),
                "current_ma": channel.current_ma,
                "most_ma": channel.limits.max_current_ma,
            }
            for channel in session.channels
        ],
    }


class PageProcess:
    """The page while entered. ``url`` opens it once; the file ``page.url`` in the folder always has the next link.

    Args:
        about: see :func:`about_session`.
        port: 0 takes a free one.

    Raises:
        OSError: the port is taken, or the folder cannot be written.
    """

    def __init__(self, folder: Path, about: dict[str, Any], port: int = 0) -> None:
        token = secrets.token_urlsafe(24)
        self.over = OVER
        self._trouble = folder / TROUBLE_NAME
        self._url_file = folder / LINK_NAME
        with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as listening:
            listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            if hasattr(socket, "TCP_USER_TIMEOUT"):  # a browser that stopped reading is let go
                listening.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, SLOW_MS)
            listening.bind((LOOPBACK, port))
            listening.listen(64)
            self.port = int(listening.getsockname()[1])
            self.url = link_address(self.port, token)
            write_link(self._url_file, self.url)
            ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
            with theirs, self._trouble.open("wb") as trouble:
                self.process = subprocess.Popen(
                    [sys.executable, "-m", "fes.live.dashboard", str(listening.fileno()), str(theirs.fileno())],
                    pass_fds=(listening.fileno(), theirs.fileno()),
                    stdin=subprocess.DEVNULL,
                    stdout=trouble,
                    stderr=trouble,
                    start_new_session=True,
                )
        # the token goes this way: a command line can be read by everybody on the machine
        ours.send(hello({**about, "token": token, "url_file": str(self._url_file.absolute())}))
        self.feed = DashboardStream(ours)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        link = self.feed.link
        try:
            link.settimeout(0.5)
            link.send(END + self.over.encode())
        except OSError:
            self.process.kill()  # it has ended, or does not read
        try:
            self.process.wait(3.0)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        link.close()
        with suppress(OSError):
            self._url_file.unlink(missing_ok=True)
            if not self._trouble.stat().st_size:
                self._trouble.unlink()
