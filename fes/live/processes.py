"""Helper processes: started and ended by the session; each ends with the one that started it, however that went.

Here too: what the operating system is asked for so that the loop is on time, and what each refusal costs. Figures from
runs on a shared two-core machine (500 Hz loop, three busy processes beside it): an ordinary process missed 5,429 of
10,000 ticks, one under SCHED_FIFO 19; a full garbage collection over 200,000 objects took 45 ms.
"""

import ctypes
import gc
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Final, Self

LOOK_EVERY_S: Final = 0.25
END_S: Final = 3.0
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


def joined() -> tuple[socket.socket, int, list[str]]:
    """For a helper's main: its end of the link, its parent's number, its further arguments; Ctrl-C is the session's."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    return socket.socket(fileno=int(sys.argv[1])), int(sys.argv[2]), sys.argv[3:]


def start_helper(
    module: str, theirs: socket.socket, *arguments: object, also: Sequence[int] = (), **streams: Any
) -> subprocess.Popen[bytes]:
    """Run a module, which :func:`joined` tells what it is given; this process closes that end of the link.

    ``also``: further descriptors that it takes over; ``streams``: what becomes of its output, as Popen has it.
    """
    with theirs:
        return subprocess.Popen(
            [sys.executable, "-m", module, *map(str, (theirs.fileno(), os.getpid(), *arguments))],
            pass_fds=(theirs.fileno(), *also),
            stdin=subprocess.DEVNULL,
            start_new_session=True,
            **streams,
        )


class HelperProcess:
    """A module that helps the session while this is entered; ``link`` takes and gives datagrams and never blocks.

    An empty datagram, or the link's end, says that the session is over. Further arguments: see :func:`start_helper`.
    """

    farewell = b""

    def __init__(self, module: str, *arguments: object, **further: Any) -> None:
        self.link, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.link.setblocking(False)
        self.process = start_helper(module, theirs, *arguments, **further)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """Say over the link that the session is over; kill the process if it does not read, or not end in time."""
        try:
            self.link.settimeout(0.5)
            self.link.send(self.farewell)
        except OSError:
            self.process.kill()  # it has ended, or does not read
        try:
            self.process.wait(END_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        self.link.close()


PRIORITY: Final = 20
_MCL_CURRENT, _MCL_FUTURE = 1, 2


@dataclass(frozen=True, slots=True)
class Grant:
    """One thing asked for: whether it was given (``refused`` is "" then), what it costs to go without, the remedy."""

    name: str
    refused: str
    cost: str
    remedy: str

    def __str__(self) -> str:
        return f"{self.name}: granted" if not self.refused else f"{self.name}: {self.refused}; {self.cost}"


def fixed_priority() -> Grant:
    """SCHED_FIFO for the calling thread."""
    refused = ""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(PRIORITY))
    except (AttributeError, OSError) as error:
        refused = f"refused ({getattr(error, 'strerror', None) or error})"
    return Grant(
        "fixed priority (SCHED_FIFO)",
        refused,
        "on a busy machine decisions come tens of milliseconds late and the gate stops stimulation for old data",
        "add '@realtime - rtprio 50' to /etc/security/limits.conf and the user to that group, or run with CAP_SYS_NICE",
    )


def locked_memory() -> Grant:
    """All pages, present and future, kept in memory."""
    refused = ""
    try:
        libc = ctypes.CDLL(None, use_errno=True)
        # under a limit, locking future pages too would make a later allocation fail in mid-session
        import resource  # here, for a replay, which imports this, runs where it is not

        unlimited = os.geteuid() == 0 or resource.getrlimit(resource.RLIMIT_MEMLOCK)[0] == resource.RLIM_INFINITY
        if libc.mlockall(_MCL_CURRENT | (_MCL_FUTURE if unlimited else 0)):
            refused = f"refused ({os.strerror(ctypes.get_errno())})"
    except (OSError, AttributeError) as error:
        refused = f"not available here ({error})"
    return Grant(
        "locked memory (mlockall)",
        refused,
        "a page that was swapped out costs milliseconds when it is next touched",
        "add '@realtime - memlock unlimited' to /etc/security/limits.conf",
    )


def touched_buffers() -> None:
    """Use linear algebra once: its library fetches its buffers at first use, 14 ms where memory is locked."""
    import numpy as np  # here, for the log's writer runs without it

    matrix = np.arange(6000.0).reshape(1000, 6) % 7.0 + np.eye(1000, 6)
    square = matrix.T @ matrix
    np.linalg.lstsq(matrix, matrix[:, 0])
    np.linalg.eigh(square)
    np.linalg.solve(square, square[0])
    np.linalg.svd(matrix, full_matrices=False)


def frozen_garbage() -> Grant:
    """Everything alive is taken out of garbage collection, and collection no longer starts by itself."""
    gc.collect()
    gc.freeze()
    gc.disable()
    sys.setswitchinterval(0.0005)  # a helper thread that opens a device gives way within half a millisecond
    return Grant("garbage collector frozen", "", "", "")


def become_real_time() -> tuple[Grant, ...]:
    """Ask for all of it, once everything is loaded and compiled; what was refused is in the answers."""
    grants = frozen_garbage(), locked_memory(), fixed_priority()
    touched_buffers()
    return grants
