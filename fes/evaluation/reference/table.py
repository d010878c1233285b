"""A reference's CSV as columns in SI units: any delimiter, decimal comma, units in the names of the columns."""

from __future__ import annotations

import csv
import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from fes.evaluation.reference.types import ReferenceError
from fes.signals import FloatArray

MOST_BYTES: Final = 500_000_000
UNITS: Final = {
    "ns": ("s", 1e-9),
    "us": ("s", 1e-6),
    "ms": ("s", 1e-3),
    "s": ("s", 1.0),
    "sec": ("s", 1.0),
    "mm": ("m", 1e-3),
    "cm": ("m", 1e-2),
    "m": ("m", 1.0),
    "deg": ("rad", math.pi / 180.0),
    "rad": ("rad", 1.0),
    "mps": ("mps", 1.0),
    "kmh": ("mps", 1.0 / 3.6),
}
_SIDES: Final = {"left": "left_foot", "l": "left_foot", "right": "right_foot", "r": "right_foot"}


@dataclass(frozen=True)
class Table:
    """Columns of text by name, in lower case without unit; ``factor`` says what brings each to SI."""

    path: Path
    columns: dict[str, list[str]]
    factor: dict[str, float]
    unit: dict[str, str]
    decimal: str
    first_line: int

    @property
    def rows(self) -> int:
        """How many rows there are."""
        return len(next(iter(self.columns.values())))

    def first_of(self, *names: str) -> str | None:
        """The first of these columns that is there."""
        return next((name for name in names if name in self.columns), None)

    def numbers(self, name: str) -> FloatArray:
        """A column (N,) in SI units, NaN for empty cells.

        Raises:
            ReferenceError: a cell is no number.
        """
        out = np.empty(self.rows)
        for row, text in enumerate(self.columns[name]):
            try:
                out[row] = float(text.replace(",", ".") if self.decimal == "," else text) if text else np.nan
            except ValueError:
                raise ReferenceError(
                    f"{self.path}:{self.first_line + row}: column {name!r} holds {text!r}, which is no number"
                ) from None
        return out * self.factor[name]

    def flags(self, name: str) -> list[bool]:
        """A column of yes and no, 1 and 0, true and false; empty is no."""
        return [text.strip().lower() in ("yes", "1", "true", "y", "1.0") for text in self.columns[name]]

    def feet(self, default: str | None) -> list[str]:
        """The foot of every row: a column ``foot`` or ``side``, else ``default``.

        Raises:
            ReferenceError: neither is there, or a cell names no foot.
        """
        name = self.first_of("foot", "side", "leg", "limb")
        if name is None:
            if default is None:
                raise ReferenceError(
                    f"{self.path}: has no column 'foot', and the recording has two feet; say --foot left or right"
                )
            return [default] * self.rows
        found = [foot_of(text) for text in self.columns[name]]
        if None in found:
            row = found.index(None)
            raise ReferenceError(
                f"{self.path}:{self.first_line + row}: {self.columns[name][row]!r} is no foot; left or right is"
            )
        return [foot for foot in found if foot is not None]


def foot_of(text: str) -> str | None:
    """``left_foot`` or ``right_foot`` for left, L, left_foot, Left Foot …; None for anything else."""
    return _SIDES.get(re.sub(r"[ _-]?(foot|leg|shank|sensor)$", "", text.strip().lower()))


def read_columns(path: Path) -> Table:
    """Read a CSV; its first line that is not a comment (``#``) names the columns.

    A last part of a name that is a unit (``_mm``, ``(ms)``, ``[m]``) is taken off and applied; without one a column is
    in SI.

    Raises:
        ReferenceError: the file is missing, empty, no text, or ragged.
    """
    if not path.is_file():
        raise ReferenceError(f"{path}: {'is a folder' if path.is_dir() else 'is not there'}. Name a reference's file.")
    if path.stat().st_size > MOST_BYTES:
        raise ReferenceError(f"{path}: is larger than {MOST_BYTES // 1_000_000} MB; cut it to the walk")
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError:
        raise ReferenceError(f"{path}: is no text in UTF-8; export it as CSV in UTF-8") from None
    except OSError as error:
        raise ReferenceError(f"{path}: cannot be read: {error.strerror or error}") from error
    skipped = next((k for k, line in enumerate(lines) if line.strip() and not line.startswith("#")), len(lines))
    if len(lines) - skipped < 2:
        raise ReferenceError(f"{path}: holds no row below a line of column names")
    header = lines[skipped]
    delimiter = max(";\t,", key=header.count)
    try:
        rows = [row for row in csv.reader(lines[skipped:], delimiter=delimiter) if any(cell.strip() for cell in row)]
    except csv.Error as error:
        raise ReferenceError(f"{path}: cannot be read as CSV: {error}") from error
    names = [_name(cell) for cell in rows[0]]
    wrong = next((k for k, row in enumerate(rows) if len(row) != len(names)), None)
    if wrong is not None:
        raise ReferenceError(
            f"{path}:{skipped + wrong + 1}: has {len(rows[wrong])} cells, the names above are {len(names)}"
        )
    twice = next((name for name, _, _ in names if [n for n, _, _ in names].count(name) > 1), None)
    if twice is not None:
        raise ReferenceError(f"{path}: names the column {twice!r} twice")
    columns = {name: [row[k].strip() for row in rows[1:]] for k, (name, _, _) in enumerate(names)}
    return Table(
        path,
        columns,
        {name: factor for name, _, factor in names},
        {name: unit for name, unit, _ in names},
        "," if delimiter != "," and _has_decimal_comma(rows[1:]) else ".",
        skipped + 2,
    )


def _name(cell: str) -> tuple[str, str, float]:
    """Name in lower case without unit, SI unit, factor."""
    text = re.sub(r"[\s.-]+", "_", re.sub(r"[\[\]()]", " ", cell.strip().lower()).strip().replace("/", ""))
    base, _, last = text.rpartition("_")
    if base and last in UNITS:
        unit, factor = UNITS[last]
        return base, unit, factor
    return text, "", 1.0


def _has_decimal_comma(rows: list[list[str]]) -> bool:
    return any(re.fullmatch(r"[+-]?\d+,\d+", cell.strip()) for row in rows[:50] for cell in row)
