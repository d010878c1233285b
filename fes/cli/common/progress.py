"""Ctrl-C between two events rather than in the middle of one; how far a replay has come, on stderr."""

import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any, Self

SIGNALS = (signal.SIGINT, signal.SIGTERM, *((signal.SIGHUP,) if hasattr(signal, "SIGHUP") else ()))


class Interrupt:
    """While entered, SIGINT, SIGTERM and SIGHUP are only remembered for :meth:`check`; a second one acts at once."""

    def __init__(self) -> None:
        self._asked = False
        self._before: dict[signal.Signals, Any] = {}

    def check(self) -> None:
        """Raise KeyboardInterrupt if there was a signal."""
        if self._asked:
            raise KeyboardInterrupt

    def _remember(self, number: int, frame: FrameType | None) -> None:
        if self._asked:
            raise KeyboardInterrupt
        self._asked = True

    def __enter__(self) -> Self:
        self._before = {number: signal.signal(number, self._remember) for number in SIGNALS}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)


STEP_NS = 250_000_000


@contextmanager
def replay_progress(what: str, begin_ns: int, end_ns: int, quiet: bool) -> Iterator[Callable[[int], None]]:
    """A bar over the recording's time; what it gives is called with the time (ns) that has been reached."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    of_total = TextColumn("{task.completed:.0f} of {task.total:.0f} s")
    columns = (TextColumn("{task.description}"), BarColumn(), of_total, TimeRemainingColumn())
    hidden = quiet or not sys.stderr.isatty()
    shown_ns = begin_ns
    with Progress(*columns, console=Console(stderr=True), disable=hidden, transient=True) as bar:
        task = bar.add_task(what, total=max(1e-9 * (end_ns - begin_ns), 1e-3))

        def reached(t_ns: int) -> None:
            nonlocal shown_ns
            if t_ns - shown_ns >= STEP_NS:
                shown_ns = t_ns
                bar.update(task, completed=1e-9 * (t_ns - begin_ns))

        yield reached
