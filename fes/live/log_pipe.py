"""The session log as the loop sees it: bytes pushed to the writing process, never waiting for it."""

import errno
import os
import socket
import subprocess
import sys
from pathlib import Path
from typing import Any, Final

from fes.session_log import SessionLogError
from fes.session_log.writer import RecordBuffer, create

BUFFER_BYTES: Final = 1 << 20
LATE_NS: Final = 500_000_000  # bytes that the writing process has had this long and not written
CLOSE_WAIT_S: Final = 10.0
START_WAIT_S: Final = 20.0


class PipedLog(RecordBuffer):
    """A session log written by a process of its own.

    Every method but ``close`` raises SessionLogError once the writer has died, its disk is full, or it has not kept up
    for half a second. What it had been sent is readable; at most the last 50 ms were not sent yet.
    """

    def __init__(self, path: Path, header: dict[str, Any]) -> None:
        """Create the file, start its writer, wait until that has written the header.

        Raises:
            SessionLogError: the file is there already, cannot be made or written, or the header is not plain data.
        """
        super().__init__(path, header)
        file = create(self.path)
        self._link, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            command = [sys.executable, "-m", "fes.live.log_process", str(theirs.fileno()), str(file)]
            self.process = subprocess.Popen(
                command, pass_fds=(theirs.fileno(), file), stdin=subprocess.DEVNULL, start_new_session=True
            )
        finally:
            theirs.close()
            os.close(file)
        self._link.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, BUFFER_BYTES)
        self._link.setblocking(False)
        self._outgoing = bytearray()
        self._sent, self._written = 0, 0
        self._answers = b""
        self._behind_since_ns: int | None = None
        self.warning = ""  # what a person should know; who shows it empties it
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

        Raises:
            SessionLogError: not all of it is on the disk.
        """
        if self._closed:
            return
        self._closed = True
        try:
            if not self._fault:
                self._finish(summary)
                self._link.settimeout(CLOSE_WAIT_S)
                self._link.sendall(self._outgoing)
                self._link.shutdown(socket.SHUT_WR)
                while self._link.recv(1 << 16):  # what it still answers; unread, it would be a reset to the writer
                    pass
        except OSError as error:
            self._fault = self._why(error)
        finally:
            self._link.close()
        try:
            status = self.process.wait(CLOSE_WAIT_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            status = self.process.wait()
        if self._fault or status:
            raise SessionLogError(self._fault or f"{self.path}: may be incomplete on disk")
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
        *lines, self._answers = (self._answers + heard).split(b"\n")
        for line in lines:
            word, number = line.split()
            if word == b"error":
                raise OSError(int(number), os.strerror(int(number)))
            if word == b"slow":
                self.warning = (
                    f"{self.path}: the disk has not finished for {int(number)} s; the operating system has all that "
                    "was logged, a loss of power would lose what came since"
                )
            else:
                self._written, self._behind_since_ns = int(number), None
