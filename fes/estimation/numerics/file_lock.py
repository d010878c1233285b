"""A lock between processes on an open file; the system lets go of it when the file is closed or the process ends."""

from typing import IO

try:
    from fcntl import LOCK_EX, LOCK_NB, flock
except ImportError:  # Windows
    import errno
    import msvcrt
    import os

    def lock(file: IO[str], *, wait: bool = True) -> None:
        """As below, on the first byte, which need not be there."""
        mode = getattr(msvcrt, "LK_LOCK" if wait else "LK_NBLCK")
        while True:
            os.lseek(file.fileno(), 0, os.SEEK_SET)
            try:
                getattr(msvcrt, "locking")(file.fileno(), mode, 1)  # noqa: B009 - typed on Windows alone
                return
            except OSError as error:
                if not wait and error.errno == errno.EACCES:
                    raise BlockingIOError(*error.args) from error
                if error.errno != errno.EDEADLK:  # what it says after ten seconds of waiting
                    raise

else:

    def lock(file: IO[str], *, wait: bool = True) -> None:
        """Lock a file against other processes.

        Raises:
            BlockingIOError: another process has it, and ``wait`` is False.
            OSError: this file system has no locks.
        """
        flock(file, LOCK_EX if wait else LOCK_EX | LOCK_NB)
