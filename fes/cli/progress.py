"""How far a replay has come, on stderr; silent where nobody watches."""

from __future__ import annotations

import sys
from types import TracebackType
from typing import Self

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

STEP_NS = 250_000_000


class ReplayProgress:
    """A bar over the recording's time."""

    def __init__(self, what: str, begin_ns: int, end_ns: int, quiet: bool) -> None:
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

    def at(self, t_ns: int) -> None:
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
