"""What the benchmarks' command lines have in common: options, the console, the tables for a page, the last word."""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks.lib.figures import NO_RECORDINGS, Figures, Result, digest

PIPED_COLUMNS = 220  # where there is no terminal: enough for every table
# Options that change where or how fast, not what is measured.
ASIDE = ("--json", "--raw", "--data", "--jobs", "--peers", "--processes")


def parser_of(text: str | None, data: Path | None = None) -> argparse.ArgumentParser:
    """The benchmark's own text as it stands, and ``--json``; ``--data`` where ``data`` says where recordings are."""
    parser = argparse.ArgumentParser(description=text, formatter_class=argparse.RawDescriptionHelpFormatter)
    if data is not None:
        parser.add_argument("--data", type=Path, default=data, help="folder of the recordings")
    parser.add_argument("--json", type=Path, help="write the results here as well")
    return parser


def publish(
    tables: Sequence[Table], options: argparse.Namespace, notes: Sequence[str] = (), folder: Path | None = None
) -> None:
    """Print tables and lines; with ``--json`` keep them for a page of ``docs/`` (:mod:`figures`).

    ``folder`` is where the recordings are, of whom ``--data`` does not ask.
    """
    console = Console(width=None if sys.stdout.isatty() else PIPED_COLUMNS)
    for table in tables:
        console.print(table)
    for line in notes:
        console.print(line, markup=False)
    if options.json is None:
        return
    folder = getattr(options, "data", folder)
    data = {}
    if folder is not None and folder.is_dir():
        data["data folder"] = digest(path for path in folder.rglob("*") if path.suffix in (".npz", ".mat", ".csv"))
    Result(_command(sys.argv), [_figures(table) for table in tables], data, notes=list(notes)).keep(options.json)


def _figures(table: Table) -> Figures:
    rows = zip(*([str(cell) for cell in column.cells] for column in table.columns), strict=True)
    return Figures(
        str(table.title or ""), [str(column.header) for column in table.columns], [list(row) for row in rows]
    )


def _command(typed: Sequence[str]) -> str:
    words, kept = iter(typed[1:]), []
    for word in words:
        if word in ASIDE:
            next(words, None)
        elif not word.startswith(tuple(f"{name}=" for name in ASIDE)):
            kept.append(word)
    return shlex.join(["python", "/".join(("benchmarks", *Path(typed[0]).resolve().parts[-2:])), *kept])


def spread(values: Sequence[float], form: str = "+.0f", edges: str = "") -> str:
    """Median [5 %, 95 %] of those that are known; a dash where there are none."""
    known = np.asarray(values, dtype=float)
    known = known[np.isfinite(known)]
    if not len(known):
        return "–"
    low, middle, high = np.percentile(known, (5, 50, 95))
    return f"{middle:{form}} [{low:{edges or form}}, {high:{edges or form}}]"


def table_of(title: str, columns: Iterable[str], rows: Iterable[Sequence[str]]) -> Table:
    """A table of rows of text."""
    table = Table(*columns, title=title or None)
    for row in rows:
        table.add_row(*row)
    return table


def mean_sd(values: Sequence[float], digits: int, unit: float = 1.0) -> str:
    """Mean ± SD of those that are known, in so many digits; a dash where there are not two."""
    known = unit * np.asarray(values, dtype=float)
    known = known[np.isfinite(known)]
    return f"{known.mean():+.{digits}f} ± {known.std(ddof=1):.{digits}f}" if len(known) > 1 else "–"


def no_recordings(folder: Path) -> int:
    """Say that there is nothing to measure on; the exit code."""
    print(f"No recordings in {folder}; set FES_DATA or give --data.", file=sys.stderr)
    return NO_RECORDINGS


def verdict(held: bool) -> int:
    """Say whether the bars hold; the exit code."""
    print("The bars hold." if held else "The bars do not hold.")
    return 0 if held else 1
