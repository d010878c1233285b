"""Ctrl-C between two events rather than in the middle of one; how far a replay has come, on stderr."""

from __future__ import annotations

import signal
import sys
from types import FrameType, TracebackType
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

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)


STEP_NS = 250_000_000


class ReplayProgress:
    """A bar over the recording's time."""

    def __init__(self, what: str, begin_ns: int, end_ns: int, quiet: bool) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

        self._begin_ns = begin_ns
        self._shown_ns = begin_ns
        self._bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.completed:.0f} of {task.total:.0f} s"),
            TimeRemainingColumn(),
            console=Console(stderr=True),
            disable=quiet or not sys.stderr.isatty(),
            transient=True,
        )
        self._task = self._bar.add_task(what, total=max(1e-9 * (end_ns - begin_ns), 1e-3))

    def reached(self, t_ns: int) -> None:
        """The replay has reached ``t_ns``."""
        if t_ns - self._shown_ns >= STEP_NS:
            self._shown_ns = t_ns
            self._bar.update(self._task, completed=1e-9 * (t_ns - self._begin_ns))

    def __enter__(self) -> Self:
        self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bar.stop()
