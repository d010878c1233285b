"""Starting and ending the view's process."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from types import TracebackType
from typing import Final, Self

END: Final = b""  # an empty datagram


class ViewProcess:
    """The view while entered; ``link`` takes status datagrams and never blocks."""

    def __init__(self) -> None:
        self.link, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.link.setblocking(False)
        try:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "fes.live.terminal_view", str(theirs.fileno()), str(os.getpid())],
                pass_fds=(theirs.fileno(),),
                stdin=subprocess.DEVNULL,
                start_new_session=True,
            )
        finally:
            theirs.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self.link.settimeout(0.5)
            self.link.send(END)
        except OSError:
            self.process.kill()  # it has ended, or does not read
        self.link.close()
        try:
            self.process.wait(2.0)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
