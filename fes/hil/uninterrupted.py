"""Ctrl-C waits until a process that is being started, or ended, is in somebody's hands."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Final

SIGNALS: Final = (signal.SIGINT, signal.SIGTERM, *((signal.SIGHUP,) if hasattr(signal, "SIGHUP") else ()))


@contextmanager
def uninterrupted() -> Iterator[None]:
    """While entered, SIGINT, SIGTERM and SIGHUP wait; they act on leaving.

    A KeyboardInterrupt inside ``subprocess.Popen``, or between its return and the name that it is kept under, leaves a
    process that nobody ends. Signals that are ignored, or end this process without a word, are left as they are: so
    the started process inherits what it would have. Outside the main thread, where none acts, this does nothing.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[int] = []
    waits = False

    def remember(number: int, frame: FrameType | None) -> None:
        if waits:
            came.append(number)
        else:  # between two changes of handlers: what this one does may end them half-way
            before[number](number, frame)

    before = {int(number): handler for number in SIGNALS if callable(handler := signal.getsignal(number))}
    for number in before:
        signal.signal(number, remember)
    try:
        waits = True
        yield
    finally:
        waits = False
        for number, handler in before.items():
            signal.signal(number, handler)
        for number in dict.fromkeys(came):
            signal.raise_signal(number)
