"""A time limit that holds whatever a piece of work hangs in: its process is ended, as by a crash."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

_SOONEST_S: Final = 1e-3  # no time left is no timer
_due_s: dict[int, float] = {}  # by thread: a worker may have several
_lock = threading.Lock()


@contextmanager
def ended_after(limit_s: float | None) -> Iterator[None]:
    """While entered, this process ends after ``limit_s``; None: never.

    By a signal whose handler is left as it is: neither a read that waits for ever nor a compiled loop that lets
    nobody else have a turn can keep it from that.
    """
    if limit_s is None:
        yield
        return
    _set(time.monotonic() + limit_s)
    try:
        yield
    finally:
        _set(None)


def _set(due_s: float | None) -> None:
    with _lock:
        _due_s.pop(threading.get_ident(), None)
        if due_s is not None:
            _due_s[threading.get_ident()] = due_s
        left_s = [max(each - time.monotonic(), _SOONEST_S) for each in _due_s.values()]
        signal.setitimer(signal.ITIMER_REAL, min(left_s, default=0.0))
