"""What the operating system is asked for so that the loop is on time, and what each refusal costs.

Figures from runs on a shared two-core machine (500 Hz loop, three busy processes beside it): an ordinary process missed
5,429 of 10,000 ticks, one under SCHED_FIFO 19; a full garbage collection over 200,000 objects took 45 ms.
"""

import ctypes
import gc
import os
import sys
from dataclasses import dataclass
from typing import Final

import numpy as np

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
