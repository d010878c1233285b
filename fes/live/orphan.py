"""A helper process ends with the session that started it, however that went: nobody is left to be told otherwise."""

from __future__ import annotations

import ctypes
import os
import signal
from contextlib import suppress
from typing import Final

LOOK_EVERY_S: Final = 0.25
STUCK_S: Final = 0.5  # what is still busy so long after the parent's death is stuck in a write that nobody reads
_PR_SET_PDEATHSIG: Final = 1


def orphaned(parent: int) -> bool:
    """Whether the process that started this one is gone; asked at least every :data:`LOOK_EVERY_S`."""
    return os.getppid() != parent


def end_with(parent: int) -> None:
    """Where the system tells of a parent's death (Linux), half a second later end even in the middle of a write.

    :func:`orphaned` alone does not see it while this process waits for a terminal that is held up.
    """

    def told(number: int, frame: object) -> None:
        if orphaned(parent):
            signal.setitimer(signal.ITIMER_REAL, STUCK_S)  # SIGALRM is left as it is: it ends the process

    signal.signal(signal.SIGUSR1, told)
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, int(signal.SIGUSR1), 0, 0, 0)
    told(0, None)  # it may have died before it was asked for
