"""A process ends with the one that started it, however that went: nobody is left to tell it otherwise."""

from __future__ import annotations

import ctypes
import os
import signal
from collections.abc import Callable
from contextlib import suppress
from typing import Final

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

    def told(number: int, frame: object) -> None:
        if orphaned(parent):
            act()

    signal.signal(signal.SIGCONT, told)
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, int(signal.SIGCONT), 0, 0, 0)
    told(0, None)  # it may have died before it was asked for
