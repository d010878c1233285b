"""The process that writes the session log: ``python -m fes.live.log_process SOCKET_FD PARENT_PID FILE_FD PATH``.

A disk that is slow, full or gone holds up this process and nobody else. It writes what it is sent as it comes, answers
``ok BYTES`` for what the operating system has, ``error NUMBER`` when that refuses, and ends when the other end does:
what a killed controller had sent is then in the file.

A thread asks the disk itself for all of it, again and again. That may take long (a card, a stick, a busy disk) and
holds up no answer, for nothing depends on it but what a loss of power leaves: ``slow SECONDS`` is said when it takes
long, ``slow 0`` when it no longer does. A disk that refuses it is one that refuses to be written.

After every write it looks whether the file is still the one at its path, and as long as what was written. Where it is
not, it says ``gone WHY``, copies what the open file still holds to a new one, says ``saved PATH`` and goes on there.
"""

import contextlib
import errno
import os
import socket
import sys
import tempfile
import threading
import time
from itertools import count
from pathlib import Path
from typing import Final

from fes.live.processes import joined

CHUNK: Final = 1 << 18
# a disk that hangs has been said to after both of them: within a second
SYNC_EVERY_S: Final = 0.3
SLOW_S: Final = 0.5


class Syncing:
    """Waits for the disk in a thread, one at a time."""

    def __init__(self, file: int) -> None:
        self._file = file
        self._thread: threading.Thread | None = None
        self._begun_s = time.monotonic()
        self._reported = False
        self._lasted_s = 0.0
        self._failed: OSError | None = None

    def poll(self) -> float | None:
        """Begin what is due; how long the disk has been waited for (s) once that is long, 0 once it no longer is.

        None where there is nothing new to say of it.

        OSError: the disk has refused.
        """
        now_s = time.monotonic()
        if self._failed is not None:
            raise self._failed
        waits = self._thread is not None and self._thread.is_alive()
        if waits:
            self._lasted_s = now_s - self._begun_s
        slow, before = self._lasted_s > SLOW_S, self._reported
        if waits and not slow:
            return None
        if not waits and now_s - self._begun_s > SYNC_EVERY_S:
            self._begun_s, self._lasted_s = now_s, 0.0
            self._thread = threading.Thread(target=self._wait, daemon=True)
            self._thread.start()
        self._reported = slow
        return None if slow == before else self._lasted_s if slow else 0.0

    def finish(self) -> None:
        """Wait until all is on the disk. OSError: it is not."""
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


def misplaced(file: int, path: Path, written: int) -> str:
    """What has become of the log's file, which was given ``written`` bytes; "" while it is in its place."""
    here = os.fstat(file)
    if here.st_size != written:
        return "has been cut short or written to by another program"
    try:
        there = path.stat()
    except OSError:
        return "has been removed or moved"
    return "" if (there.st_dev, there.st_ino) == (here.st_dev, here.st_ino) else "has been replaced"


def save(file: int, path: Path) -> tuple[int, Path]:
    """Copy what an open file holds to a new one beside its path, or where none can be made among temporary files.

    OSError: it can be made in neither place, or not written.
    """
    failed = OSError(errno.EIO, os.strerror(errno.EIO))
    for folder in (path.parent, Path(tempfile.gettempdir())):
        try:
            folder.mkdir(parents=True, exist_ok=True)
            names = (folder / f"{path.stem}.saved{f'-{n}' if n else ''}{path.suffix}" for n in count())
            free = next(name for name in names if not name.exists())
            copied, done = os.open(free, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_APPEND, 0o644), 0
            while part := os.pread(file, CHUNK, done):
                done += os.write(copied, part)
            return copied, free
        except OSError as error:
            failed = error
    raise failed


def copy(link: socket.socket, file: int, path: Path) -> int:
    """Move bytes from the socket to the file until it ends; returns an exit status."""
    written, syncing = 0, Syncing(file)  # of this file
    answered, more = 0, True
    while more:
        try:
            chunk = memoryview(link.recv(CHUNK))
        except ConnectionResetError:  # it was killed with our answers unread; all that it sent has been read by now
            chunk = memoryview(b"")
        more = bool(chunk)
        done = 0
        try:
            while done < len(chunk):
                done += os.write(file, chunk[done:])
            written += done
            answered += done
            if why := misplaced(file, path, written):
                _answer(link, f"gone {why}\n")
                file, path = save(file, path)
                written, syncing = os.fstat(file).st_size, Syncing(file)
                _answer(link, f"saved {path}\n")
            slow_s = syncing.poll() if more else None
            if not more:
                syncing.finish()
        except OSError as error:
            _answer(link, f"error {error.errno or errno.EIO}\n")
            return 1
        _answer(link, f"ok {answered}\n")
        if slow_s is not None:
            _answer(link, f"slow {slow_s:.1f}\n")
    return 0


def _answer(link: socket.socket, line: str) -> None:
    with contextlib.suppress(OSError):  # the controller is gone: write on
        link.send(line.encode(), socket.MSG_NOSIGNAL)


def main() -> int:
    """Run until the controller's end closes."""
    link, _, (file, path) = joined()
    with link:
        return copy(link, int(file), Path(path))


if __name__ == "__main__":
    sys.exit(main())
