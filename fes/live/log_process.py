"""The process that writes the session log: ``python -m fes.live.log_process SOCKET_FD FILE_FD``.

A disk that is slow, full or gone holds up this process and nobody else. It writes what it is sent as it comes, answers
``ok BYTES`` for what the operating system has, ``error NUMBER`` when that refuses, and ends when the other end does:
what a killed controller had sent is then in the file.
"""

from __future__ import annotations

import contextlib
import errno
import os
import signal
import socket
import sys
import time
from typing import Final

CHUNK: Final = 1 << 18
SYNC_EVERY_S: Final = 1.0


def copy(link: socket.socket, file: int) -> int:
    """Move bytes from the socket to the file until it ends; returns an exit status."""
    written, synced_s = 0, time.monotonic()
    while chunk := _next(link):
        with memoryview(chunk) as view:
            done = 0
            try:
                while done < len(view):
                    done += os.write(file, view[done:])
                if time.monotonic() - synced_s > SYNC_EVERY_S:
                    synced_s = time.monotonic()
                    _sync(file)
            except OSError as error:
                _say(link, f"error {error.errno or 5}\n")
                return 1
        written += done
        _say(link, f"ok {written}\n")
    try:
        _sync(file)
    except OSError:
        return 1
    return 0


def _next(link: socket.socket) -> bytes:
    """What comes next; nothing when the other end is gone, however it went."""
    try:
        return link.recv(CHUNK)
    except ConnectionResetError:  # it was killed with our answers unread; all that it sent has been read by now
        return b""


def _sync(file: int) -> None:
    """Wait for the disk; what is no disk (a pipe, a terminal) has none."""
    try:
        os.fsync(file)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP):
            raise


def _say(link: socket.socket, line: str) -> None:
    with contextlib.suppress(OSError):  # the controller is gone: write on
        link.send(line.encode(), socket.MSG_NOSIGNAL)


def main() -> int:
    """Run until the controller's end closes; Ctrl-C is the controller's business."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    link_fd, file = int(sys.argv[1]), int(sys.argv[2])
    with socket.socket(fileno=link_fd) as link:
        return copy(link, file)


if __name__ == "__main__":
    sys.exit(main())
