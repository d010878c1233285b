"""What options need: kinds that recur, numbers that are numbers, whether a file is there."""

import math
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final, TypeVar

import click

PATH: Final = click.Path(path_type=Path)
SIDE: Final = click.Choice(["left", "right"])
SENSOR_KINDS: Final = ("xbus", "ximu3", "capture2go", "witmotion")  # those that are simulated on lines of bytes
STIMULATORS: Final = ("can", "p24_low_level", "rehastim2")  # those that are simulated

Command = TypeVar("Command", bound=Callable[..., Any])


def choice(*names: str, of: Sequence[str], help: str | None = None) -> Callable[[Command], Command]:
    """An option that takes one of a few values, by default the first of them."""
    return click.option(*names, type=click.Choice(of), default=of[0], show_default=True, help=help)


def out_option(help: str = "Results go below.") -> Callable[[Command], Command]:
    """``--out``: a folder, by default ``out``."""
    return click.option("--out", type=PATH, default=Path("out"), show_default=True, help=help)


def given_options() -> set[str]:
    """The parameters of the command that stood on its command line."""
    context = click.get_current_context()
    on_the_line = click.core.ParameterSource.COMMANDLINE
    return {name for name in context.params if context.get_parameter_source(name) is on_the_line}


def utc_now() -> str:
    """For a log's header."""
    return datetime.now(UTC).isoformat(timespec="seconds")


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
        """The number. Raises BadParameter: it is none, or out of range."""
        number = super().convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"{value} is not a finite number.", param, ctx)
        return number
