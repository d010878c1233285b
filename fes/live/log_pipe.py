"""The session log as the loop sees it: bytes pushed to the writing process, never waiting for it."""

import errno
import os
import socket
import subprocess
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

from fes.live.processes import start_helper
from fes.session_log import SessionLogError
from fes.session_log.writer import RecordBuffer, create

BUFFER_BYTES: Final = 1 << 20
LATE_NS: Final = 500_000_000  # bytes that the writing process has had this long and not written
CLOSE_WAIT_S: Final = 10.0
KILL_WAIT_S: Final = 1.0
START_WAIT_S: Final = 20.0


class FileGone(OSError):
    """The log's file is no longer in its place; its writer goes on beside it."""


class PipedLog(RecordBuffer):
    """A session log written by a process of its own.

    Every method but ``close`` raises SessionLogError once the writer has died, its disk is full, it has not kept up
    for half a second, or its file is no longer in its place. What it had been sent is readable; at most the last 50 ms
    were not sent yet. A file that was removed or replaced is written anew beside its place, up to the end: ``path`` is
    then that one's. ``warning``: what a person should know of the disk while it holds.
    """

    def __init__(self, path: Path, header: dict[str, Any]) -> None:
        """Create the file, start its writer, wait until that has written the header.

        SessionLogError: the file is there already, cannot be made or written, or the header is not plain data.
        """
        super().__init__(path, header)
        file = create(self.path)
        self._link, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            self.process = start_helper("fes.live.log_process", theirs, file, self.path.absolute(), also=(file,))
        finally:
            os.close(file)
        self._link.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, BUFFER_BYTES)
        self._link.setblocking(False)
        self._outgoing = bytearray()
        self._sent, self._written = 0, 0
        self._answers = b""
        self._behind_since_ns: int | None = None
        self.warning = ""
        self._gone = False  # the file from its place, while its writer lives
        self._closed = False
        self.flush()
        self._link.settimeout(START_WAIT_S)  # before the session begins there is time to wait
        try:
            while self._written < self._sent:
                self._hear()
        except OSError as error:
            self._fault = self._why(error)
            self.process.kill()
            self.process.wait()
            self._link.close()
            raise SessionLogError(self._fault) from error
        self._link.setblocking(False)

    def flush_due(self, t_monotonic_ns: int) -> bool:
        """Send what has gathered if 50 ms have passed, and see whether the writer is well."""
        flushed = super().flush_due(t_monotonic_ns)
        try:
            self._push()
            self._hear()
            if self._written >= self._sent and not self._outgoing:
                self._behind_since_ns = None
            elif self._behind_since_ns is None:
                self._behind_since_ns = t_monotonic_ns
            elif t_monotonic_ns - self._behind_since_ns > LATE_NS:
                raise OSError(errno.ETIMEDOUT, "the process that writes it does not keep up")
        except OSError as error:
            self._fault = self._why(error)
            raise SessionLogError(self._fault) from error
        return flushed

    @property
    def healthy(self) -> str:
        """Why nothing can be logged any more; "" while it can."""
        return self._fault

    def close(self, summary: dict[str, Any]) -> None:
        """Send the summary as the last record and wait until the writer has ended. Closing again does nothing.

        SessionLogError: not all of it is on the disk.
        """
        if self._closed:
            return
        self._closed = True
        fault, place = self._fault, self.path
        try:
            if not fault or self._gone:
                self._fault = ""
                self._finish(summary)
                self._link.settimeout(CLOSE_WAIT_S)
                self._link.sendall(self._outgoing)
                self._outgoing.clear()
                self._link.shutdown(socket.SHUT_WR)
                self._hear_the_end()
        except OSError as error:
            self._fault = self._why(error)
        except SessionLogError:
            pass  # its words are the fault's
        finally:
            self._link.close()
        try:
            status = self.process.wait(CLOSE_WAIT_S if not self._fault else KILL_WAIT_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            status = 1
            with suppress(subprocess.TimeoutExpired):  # one that waits for its disk cannot even be killed
                status = self.process.wait(KILL_WAIT_S) or 1
        if self._gone:
            kept = f"all that was logged is in {self.path}" if self.path != place else "it could not be saved"
            self._fault = f"{fault or self._fault}; {kept}"
        elif self._fault or status:
            self._fault = fault or self._fault or f"{self.path}: may be incomplete on disk"
        if self._fault:
            raise SessionLogError(self._fault)
        self._fault = f"{self.path}: is closed already; nothing more can be logged"

    def _deliver(self, encoded: bytearray) -> None:
        self._outgoing += encoded
        self._push()

    def _push(self) -> None:
        while self._outgoing:
            try:
                sent = self._link.send(self._outgoing, socket.MSG_NOSIGNAL)
            except BlockingIOError:
                return
            self._sent += sent
            del self._outgoing[:sent]

    def _hear(self) -> None:
        try:
            heard = self._link.recv(1 << 16)
        except BlockingIOError:
            return
        if not heard:
            raise OSError(errno.EPIPE, "the process that writes it has ended")
        self._take(heard)

    def _hear_the_end(self) -> None:
        """What it still answers; unread, it would be a reset to the writer."""
        while heard := self._link.recv(1 << 16):
            with suppress(FileGone):
                self._take(heard)
        with suppress(FileGone):
            self._take(b"")

    def _take(self, heard: bytes) -> None:
        *lines, self._answers = (self._answers + heard).split(b"\n")
        for number, line in enumerate(lines):
            word, _, told = line.partition(b" ")
            if word == b"error":
                raise OSError(int(told), os.strerror(int(told)))
            if word == b"gone":
                self._answers = b"\n".join((*lines[number + 1 :], self._answers))
                self._gone = True
                self._fault = f"{self.path}: {os.fsdecode(told)}; start a new session"
                raise FileGone(errno.ESTALE, os.fsdecode(told))
            if word == b"saved":
                self.path = Path(os.fsdecode(told))
            elif word == b"slow":
                behind = f"{self.path}: the disk does not keep up; the operating system has all that was logged, "
                self.warning = f"{behind}a loss of power would lose what came since" if float(told) else ""
            else:
                self._written, self._behind_since_ns = int(told), None

    def _why(self, error: OSError) -> str:
        return self._fault if isinstance(error, FileGone) else super()._why(error)
