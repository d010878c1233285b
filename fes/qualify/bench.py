"""What a device is qualified with: time that passes, and a person who does what is asked and reads what is shown."""

import os
import select
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Protocol

import click

from fes.signals import NS_PER_S

LOOK_S: Final = 0.001  # between two looks at a line that nothing can be waited on for
STDIN: Final = 0


class NotQualified(RuntimeError):
    """It could not be gone through to the end; the message says why and what to do."""


class Clock(Protocol):
    """Time, and waiting for a line."""

    def now_ns(self) -> int:
        """Monotonic time in ns."""

    def wait(self, until_ns: int, descriptor: int | None) -> None:
        """Until then, or until something may have come."""


class Person(Protocol):
    """Who handles the device. ``key`` names a step or a reading, for a person who is simulated."""

    def does(self, key: str, instruction: str) -> None:
        """Show what is to be done; return when they are about to do it."""


class Striker(Person, Protocol):
    """Who handles a sensor, and strikes a key with it."""

    def struck_ns(self) -> int | None:
        """When they struck the key since the last call; None: not yet. Never waits."""


class Reader(Person, Protocol):
    """Who handles a stimulator, and reads an oscilloscope."""

    def reads(self, key: str, question: str, unit: str) -> float:
        """What they read."""


class RealTime:
    """The computer's own."""

    @staticmethod
    def now_ns() -> int:
        """CLOCK_MONOTONIC."""
        return time.monotonic_ns()

    def wait(self, until_ns: int, descriptor: int | None) -> None:
        """By select, where there is something to select."""
        left_s = max(0.0, (until_ns - self.now_ns()) / NS_PER_S)
        lines = [] if descriptor is None else [descriptor]
        select.select(lines, [], [], left_s if lines else min(left_s, LOOK_S))


@dataclass(eq=False)
class TerminalPerson:
    """A person at the terminal; lines come from the descriptor ``keys``."""

    keys: int = STDIN
    clock_ns: Callable[[], int] = time.monotonic_ns

    def does(self, key: str, instruction: str) -> None:
        """Wait for the Enter key."""
        click.echo(f"{instruction}\n  Enter when ready …", err=True)
        self._line()

    def reads(self, key: str, question: str, unit: str) -> float:
        """Ask until a number comes."""
        while True:
            click.echo(f"  {question} ({unit}): ", nl=False, err=True)
            try:
                return float(self._line().replace(",", "."))
            except ValueError:
                click.echo("  That is no number; once more.", err=True)

    def struck_ns(self) -> int | None:
        """The Enter key's time."""
        if not select.select([self.keys], [], [], 0)[0]:
            return None
        struck_ns = self.clock_ns()
        self._line()
        return struck_ns

    def _line(self) -> str:
        line = b""
        while not line.endswith(b"\n"):
            byte = os.read(self.keys, 1)
            if not byte:
                raise NotQualified("nobody is there any more who does the steps (stdin has ended)")
            line += byte
        return line.decode(errors="replace").strip()
