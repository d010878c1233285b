"""What options need: numbers that are numbers, former names, a clock, whether a file or device is there."""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Any

import click


class MonotonicClock:
    """Real time."""

    def now_ns(self) -> int:
        """Monotonic time in ns."""
        return time.monotonic_ns()

    def wait_until_ns(self, t_ns: int) -> None:
        """Sleep until ``t_ns``; returns at once when that has passed."""
        left_ns = t_ns - time.monotonic_ns()
        if left_ns > 0:
            time.sleep(left_ns * 1e-9)


def not_there(path: str | Path) -> str:
    """Why a port or folder cannot be found; "" when it is there."""
    try:
        Path(path).stat()
    except (FileNotFoundError, NotADirectoryError):
        return "there is no such port"
    except (OSError, ValueError) as error:
        return f"cannot be looked for: {getattr(error, 'strerror', None) or error}"
    return ""


def cannot_be_seen(path: str | Path) -> str:
    """Why nobody can tell whether it is there; "" when that can be told, whichever it is."""
    why = not_there(path)
    return why if why.startswith("cannot") else ""


class Number(click.FloatRange):
    """:class:`click.FloatRange` that takes no not-a-number and nothing infinite."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """The number.

        Raises:
            BadParameter: it is none, or out of range.
        """
        number = super().convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"{value} is not a finite number.", param, ctx)
        return number


class RenamedOptions(click.Command):
    """A command some of whose options had another name once: that still works, with a notice on stderr.

    Args:
        former: the name now, by the name that was.
    """

    def __init__(self, *args: Any, former: dict[str, str], **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._former = former

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Put the names of now for those that were."""
        end = args.index("--") if "--" in args else len(args)
        for at, (name, equals, value) in enumerate(argument.partition("=") for argument in args[:end]):
            if now := self._former.get(name):
                click.secho(f"{name} is now called {now}; the old name still works.", fg="yellow", err=True)
                args[at] = f"{now}{equals}{value}"
        return super().parse_args(ctx, args)
