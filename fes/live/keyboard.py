"""Keys: the terminal's mode while a session runs, and the orders in what is typed."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from types import TracebackType
from typing import Any, Final, Self

from fes.live.inputs import Carry
from fes.live.orders import ESCAPE, orders_of_keys
from fes.signals import Event

ESCAPE_NS: Final = 200_000_000  # a sequence's pieces lie closer together, two keys that a person means hardly


class Terminal:
    """Puts a terminal into a mode in which keys come at once and unseen; Ctrl-C stays what it is.

    Enter it in the main thread: after Ctrl-Z and ``fg`` it sets the mode again, which the shell has changed meanwhile.
    """

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self._before: Any = None
        self._handler_before: Any = None

    def __enter__(self) -> Self:
        if os.isatty(self._descriptor):
            import termios

            self._before = termios.tcgetattr(self._descriptor)
            self._set()
            if threading.current_thread() is threading.main_thread():
                self._handler_before = signal.signal(signal.SIGCONT, self._continued)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._handler_before is not None:
            signal.signal(signal.SIGCONT, self._handler_before)
        if self._before is not None:
            import termios

            termios.tcsetattr(self._descriptor, termios.TCSANOW, self._before)

    def _set(self) -> None:
        import termios
        import tty

        tty.setcbreak(self._descriptor, termios.TCSANOW)  # what was typed already, a stop perhaps, must stay

    def _continued(self, number: int, frame: object) -> None:
        import termios

        with suppress(OSError, termios.error):  # the terminal is gone, or is none that a shell takes and gives back
            if os.tcgetpgrp(self._descriptor) == os.getpgrp():
                self._set()


class Keyboard:
    """Keys from a terminal, or from whatever the descriptor is.

    Args:
        gone: told, once, that they have ended: the stop key with them; its events are what that makes happen.

    An escape sequence may come in pieces: for 0.2 s after an escape only a stop counts.
    """

    def __init__(self, descriptor: int, carry: Carry, gone: Callable[[int], list[Event]] = lambda t_ns: []) -> None:
        self._carry = carry
        self._gone = gone
        self._escape_until_ns: int | None = None
        self._given = descriptor
        self._own = _opened_again(descriptor)
        self._was_blocking = os.get_blocking(descriptor)
        self._descriptor: int | None = descriptor if self._own is None else self._own
        if self._own is None:
            os.set_blocking(descriptor, False)

    def fileno(self) -> int | None:
        """While it is open."""
        return self._descriptor

    def take(self, t_ns: int) -> list[Event]:
        """The orders in what was typed."""
        if self._descriptor is None:
            return []
        try:
            typed = os.read(self._descriptor, 256)
        except BlockingIOError:
            return []
        except OSError:
            typed = b""
        if not typed:
            self._descriptor = None
            return self._gone(t_ns)
        goes_on = self._escape_until_ns is not None and t_ns < self._escape_until_ns
        if ESCAPE.search(typed):
            self._escape_until_ns = t_ns + ESCAPE_NS
        if goes_on:
            typed = b"\x1b" + typed
        return [event for order in orders_of_keys(typed) for event in self._carry(order, t_ns)]

    def close(self) -> None:
        """Leave the descriptor as it was."""
        self._descriptor = None
        with suppress(OSError):
            if self._own is not None:
                os.close(self._own)
            else:
                os.set_blocking(self._given, self._was_blocking)
        self._own = None


def _opened_again(descriptor: int) -> int | None:
    """The same terminal through an opening of its own; None where there is none, or it may not be opened.

    Whether reading waits belongs to the opening, and the shell's is also the view's and of whatever runs afterwards.
    """
    if not os.isatty(descriptor):
        return None
    try:
        return os.open(os.ttyname(descriptor), os.O_RDONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_CLOEXEC)
    except OSError:
        return None


def standard_keys() -> int | None:
    """Standard input where it can bring keys: a terminal or a pipe, not an empty device."""
    try:
        descriptor = sys.stdin.fileno()
    except (AttributeError, OSError, ValueError):
        return None
    return descriptor if os.isatty(descriptor) else None
