"""Writing the session log while the session runs: never waits for a disk's cache, never loses what it wrote."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from fes.session_log.buffer import RecordBuffer
from fes.session_log.record import SessionLogError, not_made


def create(path: Path) -> int:
    """Make a new session log's file; its descriptor, for writing.

    Raises:
        SessionLogError: the file is there already or cannot be made.
    """
    try:
        return os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_CLOEXEC", 0), 0o644)
    except OSError as error:
        raise not_made(path, error, "choose another name or move it") from error


class SessionWriter(RecordBuffer):
    """An open session log, written by this process.

    Records go to the operating system when 64 KiB are full or when :meth:`flush_due` finds 50 ms passed; from then on
    they outlive the process (and, after :meth:`close`, the machine).
    """

    def __init__(self, path: Path, header: dict[str, Any]) -> None:
        """Create the file and store the header at once.

        Raises:
            SessionLogError: the file is there already, cannot be made, or the header is not plain data.
        """
        super().__init__(path, header)
        self._fd = create(self.path)
        try:
            self.flush()
        except SessionLogError:
            os.close(self._fd)
            self._fd = -1
            raise

    def _deliver(self, encoded: bytearray) -> None:
        with memoryview(encoded) as pending:
            written = 0
            while written < len(pending):
                written += os.write(self._fd, pending[written:])

    def close(self, summary: dict[str, Any]) -> None:
        """Write the summary as the last record, wait for the disk, close. Closing again does nothing.

        Raises:
            SessionLogError: the disk refused a write (now or before) or the summary is not plain data; the file is
                closed all the same, without its end.
        """
        if self._fd < 0:
            return
        try:
            self._finish(summary)
            os.fsync(self._fd)
        except (TypeError, ValueError) as error:
            if isinstance(error, SessionLogError):
                raise
            raise SessionLogError(f"{self.path}: the summary cannot be stored: {error}") from error
        except OSError as error:
            raise SessionLogError(f"{self.path}: may be incomplete on disk: {error.strerror or error}") from error
        finally:
            os.close(self._fd)
            self._fd = -1
            self._fault = self._fault or f"{self.path}: is closed already; nothing more can be logged"
