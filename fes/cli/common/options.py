"""Numbers as options: within a range, and numbers at all; click lets "nan" through every range.

The computer's monotonic clock, handed to what needs one.

Is a file or device there, as far as this user may see? An ordinary user may not look into every folder.
"""

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
