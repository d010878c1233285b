"""A closed-loop run as people see it: a live picture in a terminal, plain lines elsewhere."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Final, Self

import click

from fes.hil.closed_loop.one_process import outcome
from fes.signals import NS_PER_S
from fes.simulation.forward import VirtualStride

if TYPE_CHECKING:
    from rich.console import Console, Group
    from rich.live import Live

STRIDES_SHOWN: Final = 14
FEWEST_STRIDES: Final = 5  # in a low terminal; rather fewer texts
TEXTS_SHOWN: Final = 4
BAR_MM: Final = 30.0
BAR: Final = 30


def stride_line(stride: VirtualStride) -> str:
    """One stride in one line."""
    return (
        f"{stride.t_flat_ns / NS_PER_S:6.1f} s  stride {stride.number:3d}  toe {1e3 * stride.toe_clearance_m:5.1f} mm  "
        f"{stride.charge_uc:4.0f} µC  {outcome(stride)}"
    )


class LoopView:
    """Use as a context manager; :meth:`stride`, :meth:`text` and :meth:`state` show what happens.

    Args:
        title: above the picture.
        live: draw a picture; None: where stdout is a terminal.
        quiet: show nothing.
    """

    def __init__(self, title: str, *, live: bool | None = None, quiet: bool = False) -> None:
        self._title = title
        self._draws = not quiet and (sys.stdout.isatty() if live is None else live)
        self._prints = not quiet and not self._draws
        self._live: Live | None = None
        self._strides: list[VirtualStride] = []
        self._texts: list[str] = []
        self._state = ""

    def stride(self, stride: VirtualStride) -> None:
        """A stride of the affected foot is complete."""
        self._strides = [*self._strides, stride][-STRIDES_SHOWN:]
        if self._prints:
            click.echo(stride_line(stride))
        self._draw()

    def text(self, t_s: float, text: str) -> None:
        """A text about the tuning or the patient."""
        self._texts = [*self._texts, f"{t_s:6.1f} s  {text}"][-TEXTS_SHOWN:]
        if self._prints:
            click.echo(f"{t_s:6.1f} s  → {text}")
        self._draw()

    def state(self, text: str) -> None:
        """Where the session stands; lines are printed only when it changes."""
        if text != self._state and self._prints:
            click.echo(f"          session: {text}")
        self._state = text
        self._draw()

    def __enter__(self) -> Self:
        if self._draws:
            from rich.live import Live

            self._live = Live(auto_refresh=False, transient=False)
            self._live.start()
        elif self._prints:
            click.echo(self._title)
        return self

    def __exit__(self, *_: object) -> None:
        if self._live is not None:
            self._live.stop()

    def _draw(self) -> None:
        if self._live is not None:
            self._live.update(self.picture(self._live.console), refresh=True)

    def picture(self, console: Console) -> Group:
        """One frame, no higher than the terminal: what was said last is never cut off; older strides make room."""
        from rich.console import Group
        from rich.table import Table
        from rich.text import Text

        colours = {"stumbled": "bold red", "dragged": "red", "low": "yellow", "clears": "green"}
        above = [Text(self._title, "bold"), Text(self._state, "cyan")]
        below = [Text(text, "dim") for text in self._texts[:-1]] + [Text(text) for text in self._texts[-1:]]

        def lines(texts: list[Text]) -> int:
            return sum(len(text.wrap(console, console.width)) for text in texts)

        room = console.height - lines(above) - 2  # the table's head, and the cursor's line
        while len(below) > 1 and room - lines(below) < FEWEST_STRIDES:
            below.pop(0)
        shown = self._strides[-min(max(room - lines(below), 1), STRIDES_SHOWN) :]
        table = Table("stride", "toe clearance", "mm", "charge (µC)", "", box=None, pad_edge=False)
        for stride in shown:
            height_mm, what = 1e3 * stride.toe_clearance_m, outcome(stride)
            filled = round(min(max(height_mm, 0.0), BAR_MM) / BAR_MM * BAR)
            bar = Text("━" * filled + " " * (BAR - filled), colours[what])
            said = Text(what, colours[what])
            table.add_row(str(stride.number), bar, f"{height_mm:.0f}", f"{stride.charge_uc:.0f}", said)
        return Group(*above, table, *below)
