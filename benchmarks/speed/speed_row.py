"""One figure of the speed table, and the table for people."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby

from rich.console import Console
from rich.table import Table

PIPED_COLUMNS = 130


@dataclass(frozen=True)
class Row:
    """``value`` in ``unit``; ``bar`` is the most that it may be, with ``higher`` the least; ``note`` for people."""

    group: str
    what: str
    value: float
    unit: str = ""
    bar: float | None = None
    higher: bool = False
    note: str = ""

    @property
    def met(self) -> bool | None:
        """None without a bar; a figure that could not be had (NaN) meets none."""
        if self.bar is None:
            return None
        return self.value >= self.bar if self.higher else self.value <= self.bar

    def cells(self) -> list[str]:
        """What, figure, bar, met, note as text."""
        sign = "≥" if self.higher else "≤"
        bar = "" if self.bar is None else f"{sign} {shown(self.bar)}"
        met = {None: "", True: "yes", False: "NO"}[self.met]
        return [self.what, f"{shown(self.value)} {self.unit}".rstrip(), bar, met, self.note]


def shown(value: float) -> str:
    """Three digits that count."""
    if value != value:
        return "–"
    if abs(value) >= 1e6:
        return f"{value / 1e6:.3g} M"
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"


def print_rows(rows: Sequence[Row], title: str) -> int:
    """Print the table; 1 if a bar is missed, else 0."""
    table = Table("what", "figure", "bar", "met", "note", title=title)
    for group, members in groupby(rows, lambda row: row.group):
        table.add_section()
        table.add_row(f"[bold]{group}[/]")
        for row in members:
            table.add_row(*row.cells(), style="red" if row.met is False else "")
    Console(width=None if sys.stdout.isatty() else PIPED_COLUMNS).print(table)
    return int(any(row.met is False for row in rows))
