"""Opening a lost device again without holding up the loop: in a thread of its own, later each time it fails."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Final, Generic, TypeVar

Port = TypeVar("Port")

FIRST_PAUSE_NS: Final = 250_000_000
LONGEST_PAUSE_NS: Final = 4_000_000_000


class Reopening(Generic[Port]):
    """Attempts at opening something, one at a time, with pauses that double from 0.25 s up to 4 s."""

    def __init__(self, opener: Callable[[], Port], t_ns: int) -> None:
        self._opener = opener
        self._pause_ns = FIRST_PAUSE_NS
        self._next_ns = t_ns + FIRST_PAUSE_NS
        self._thread: threading.Thread | None = None
        self._opened: list[Port] = []
        self.why_not = ""

    def poll(self, t_ns: int) -> Port | None:
        """Begin or collect an attempt; what was opened, once."""
        if self._thread is not None:
            if self._thread.is_alive():
                return None
            self._thread = None
            if self._opened:
                return self._opened.pop()
            self._next_ns = t_ns + self._pause_ns
            self._pause_ns = min(2 * self._pause_ns, LONGEST_PAUSE_NS)
        if t_ns >= self._next_ns:
            self._thread = threading.Thread(target=self._attempt, daemon=True)
            self._thread.start()
        return None

    def _attempt(self) -> None:
        try:
            self._opened.append(self._opener())
        except Exception as error:  # whatever a driver raises, the next attempt comes later
            self.why_not = str(error)
