"""Helper processes: started and ended by the session; each ends with the one that started it, however that went."""

import ctypes
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any, Final, Self

LOOK_EVERY_S: Final = 0.25
STUCK_S: Final = 0.5  # what is still busy so long after the parent's death is stuck in a write that nobody reads
_PR_SET_PDEATHSIG: Final = 1


def orphaned(parent: int) -> bool:
    """Whether the process that started this one is gone; asked at least every :data:`LOOK_EVERY_S`."""
    return os.getppid() != parent


def end_with(parent: int) -> None:
    """Where the system tells of a parent's death, half a second later end even in the middle of a write.

    :func:`orphaned` alone does not see it while this process waits for a terminal that is held up.
    """
    _once_orphaned(parent, lambda: signal.setitimer(signal.ITIMER_REAL, STUCK_S))  # SIGALRM, left as it is, ends it


def interrupted_with(parent: int) -> None:
    """Where the system tells of a parent's death, be interrupted by it as by SIGTERM: in order, all switched off."""
    _once_orphaned(parent, lambda: signal.raise_signal(signal.SIGTERM))


def _once_orphaned(parent: int, act: Callable[[], object]) -> None:
    """Linux tells of it by a signal; by SIGCONT, for one that is stopped would never hear of another."""

    def check(number: int, frame: object) -> None:
        if orphaned(parent):
            act()

    signal.signal(signal.SIGCONT, check)
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, int(signal.SIGCONT), 0, 0, 0)
    check(0, None)  # it may have died before it was asked for


def end_helper(process: subprocess.Popen[bytes], link: socket.socket, farewell: bytes, wait_s: float) -> None:
    """Say over the link that the session is over; kill the process if it does not read, or not end in time."""
    try:
        link.settimeout(0.5)
        link.send(farewell)
    except OSError:
        process.kill()  # it has ended, or does not read
    try:
        process.wait(wait_s)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
    link.close()


def start_helper(
    module: str, theirs: socket.socket, *arguments: object, also: Sequence[int] = (), **streams: Any
) -> subprocess.Popen[bytes]:
    """Run a module with the number of its end of a link as first argument; this process closes that end.

    ``also``: further descriptors that it takes over; ``streams``: what becomes of its output, as Popen has it.
    """
    with theirs:
        return subprocess.Popen(
            [sys.executable, "-m", module, *map(str, (theirs.fileno(), *arguments))],
            pass_fds=(theirs.fileno(), *also),
            stdin=subprocess.DEVNULL,
            start_new_session=True,
            **streams,
        )


class HelperProcess:
    """A module that helps the session while this is entered; ``link`` takes and gives datagrams and never blocks.

    It is given its end of the link, this process's number and ``arguments``; an empty datagram, or the link's end,
    says that the session is over.
    """

    def __init__(self, module: str, *arguments: str, kind: socket.SocketKind = socket.SOCK_DGRAM) -> None:
        self.link, theirs = socket.socketpair(socket.AF_UNIX, kind)
        self.link.setblocking(False)
        self.process = start_helper(module, theirs, os.getpid(), *arguments)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        end_helper(self.process, self.link, b"", 2.0)
