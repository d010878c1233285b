"""The process that writes the session log: ``python -m fes.live.log_process SOCKET_FD FILE_FD``.

A disk that is slow, full or gone holds up this process and nobody else. It writes what it is sent as it comes, answers
``ok BYTES`` for what the operating system has, ``error NUMBER`` when that refuses, and ends when the other end does:
what a killed controller had sent is then in the file.

Every second a thread asks the disk itself for all of it. That may take long (a card, a stick, a busy disk) and holds up
no answer, for nothing depends on it but what a loss of power leaves: ``slow SECONDS`` is said once when it takes very
long. A disk that refuses it is one that refuses to be written.
"""

import contextlib
import errno
import os
import signal
import socket
import sys
import threading
import time
from typing import Final

CHUNK: Final = 1 << 18
SYNC_EVERY_S: Final = 1.0
SLOW_S: Final = 3.0


class Syncing:
    """Waits for the disk in a thread, one at a time."""

    def __init__(self, file: int) -> None:
        self._file = file
        self._thread: threading.Thread | None = None
        self._begun_s = time.monotonic()
        self._reported = False
        self._failed: OSError | None = None

    def poll(self) -> float:
        """Begin what is due; how long one has been waited for (s) when that is to be reported, once; otherwise 0.

        Raises:
            OSError: the disk has refused one.
        """
        now_s = time.monotonic()
        if self._failed is not None:
            raise self._failed
        if self._thread is not None and self._thread.is_alive():
            lasts_s = now_s - self._begun_s
            if lasts_s > SLOW_S and not self._reported:
                self._reported = True
                return lasts_s
        elif now_s - self._begun_s > SYNC_EVERY_S:
            self._begun_s, self._reported = now_s, False
            self._thread = threading.Thread(target=self._wait, daemon=True)
            self._thread.start()
        return 0.0

    def finish(self) -> None:
        """Wait until all is on the disk.

        Raises:
            OSError: it is not.
        """
        if self._thread is not None:
            self._thread.join()
        self._wait()
        if self._failed is not None:
            raise self._failed

    def _wait(self) -> None:
        try:
            os.fsync(self._file)
        except OSError as error:
            if error.errno not in (errno.EINVAL, errno.ENOTSUP):  # what is no disk (a pipe, a terminal) has none
                self._failed = error


def copy(link: socket.socket, file: int) -> int:
    """Move bytes from the socket to the file until it ends; returns an exit status."""
    written, syncing = 0, Syncing(file)
    while True:
        try:
            chunk = memoryview(link.recv(CHUNK))
        except ConnectionResetError:  # it was killed with our answers unread; all that it sent has been read by now
            break
        if not chunk:
            break
        done = 0
        try:
            while done < len(chunk):
                done += os.write(file, chunk[done:])
            slow_s = syncing.poll()
        except OSError as error:
            _answer(link, f"error {error.errno or 5}\n")
            return 1
        written += done
        _answer(link, f"ok {written}\n")
        if slow_s:
            _answer(link, f"slow {slow_s:.0f}\n")
    try:
        syncing.finish()
    except OSError:
        return 1
    return 0


def _answer(link: socket.socket, line: str) -> None:
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
