"""Exit codes, and errors that end a command with a message instead of a traceback."""

from __future__ import annotations

from typing import IO, Any, Final, NoReturn

import click

OK: Final = 0
FAILED: Final = 1  # it ran, and what it checked is not right
UNUSABLE: Final = 2  # wrong arguments or input; nothing was done
STOPPED: Final = 3  # it ended early: a device was lost, the disk is full
INTERRUPTED: Final = 130  # Ctrl-C


class Problem(click.ClickException):
    """Ends the command: the message says what is wrong, where, and what to do."""

    exit_code = UNUSABLE

    def show(self, file: IO[Any] | None = None) -> None:
        """On stderr, in red where there are colours."""
        click.secho(f"Error: {self.message}", fg="red", err=True)


class StoppedEarly(Problem):
    """Ends the command after it had begun."""

    exit_code = STOPPED


def fail(error: Exception, kind: type[Problem] = Problem) -> NoReturn:
    """End the command with an exception's own words."""
    raise kind(str(error)) from error
