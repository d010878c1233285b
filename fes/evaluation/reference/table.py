"""A reference's CSV as columns in SI units: any delimiter, decimal comma, units in the names of the columns.

What a reference knows: events, strides, paths of markers, a belt's speed; times in s on its own clock.
"""

from __future__ import annotations

import csv
import math
import re
from collections import Counter
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

import numpy as np

from fes.signals import FloatArray

EVENTS: Final = ("IC", "FO")  # initial contact, foot off
POINTS: Final = ("sensor", "heel", "toe")


class ReferenceError(ValueError):
    """A reference cannot be used; the message names the file, the place and what would be right."""


@dataclass(frozen=True, slots=True, order=True)
class ReferenceEvent:
    """Initial contact (``IC``) or foot off (``FO``) of one foot."""

    t_s: float
    foot: str
    what: str


@dataclass(frozen=True, slots=True)
class ReferenceStride:
    """One stride of one foot; ``values`` by the names of :data:`fes.evaluation.reference.evaluation.QUANTITIES`, SI.

    ``usable`` is False where the reference itself says that its numbers do not hold (a belt that changes its speed).
    """

    foot: str
    t_start_s: float
    t_end_s: float
    values: dict[str, float]
    usable: bool = True


@dataclass(frozen=True, slots=True, order=True)
class ReferenceEnd:
    """Where a walk ended, seen from where it began: horizontal ``distance_m`` and ``height_m``, NaN if not known."""

    foot: str
    distance_m: float
    height_m: float


@dataclass(frozen=True, slots=True, eq=False)
class MarkerPath:
    """Where a point of a foot was: (N,) increasing times and (N, 3) in m, z up; NaN rows where it was not seen.

    ``frame`` is "lab" (a treadmill's belt moves below it) or "ground" (the ground, or the belt's own frame).
    """

    foot: str
    point: str
    t_s: FloatArray
    position_m: FloatArray
    frame: str = "ground"

    @property
    def rate_hz(self) -> float:
        """One over the usual (median) interval."""
        return 1.0 / float(np.median(np.diff(self.t_s)))


@dataclass(frozen=True, eq=False)
class Reference:
    """All that one or several reference files say; events and strides in order of time."""

    sources: tuple[str, ...] = ()  # the files, for people
    events: tuple[ReferenceEvent, ...] = ()
    strides: tuple[ReferenceStride, ...] = ()
    paths: tuple[MarkerPath, ...] = ()  # one per foot and point
    belt: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))  # time (s) and speed (m/s); empty where unknown
    notes: tuple[str, ...] = ()  # what was assumed on reading, in words
    ends: tuple[ReferenceEnd, ...] = ()  # where whole walks ended

    def __bool__(self) -> bool:
        return bool(self.events or self.strides or self.paths or len(self.belt) or self.ends)

    def joined(self, other: Reference) -> Reference:
        """Both together. ReferenceError: both hold the same marker, or a belt."""
        twice = {(p.foot, p.point) for p in self.paths} & {(p.foot, p.point) for p in other.paths}
        if twice or (len(self.belt) and len(other.belt)):
            what = " ".join(next(iter(twice))).replace("_", " ") if twice else "the belt's speed"
            raise ReferenceError(
                f"{', '.join(other.sources)}: {what} is in {', '.join(self.sources)} as well; keep one"
            )
        return Reference(
            self.sources + other.sources,
            tuple(sorted(self.events + other.events)),
            tuple(sorted(self.strides + other.strides, key=lambda stride: stride.t_start_s)),
            self.paths + other.paths,
            self.belt if len(self.belt) else other.belt,
            self.notes + other.notes,
            self.ends + other.ends,
        )

    def shifted(self, lag_s: float) -> Reference:
        """The same on a clock that is ``lag_s`` ahead: every time plus ``lag_s``."""
        return replace(
            self,
            events=tuple(replace(e, t_s=e.t_s + lag_s) for e in self.events),
            strides=tuple(replace(s, t_start_s=s.t_start_s + lag_s, t_end_s=s.t_end_s + lag_s) for s in self.strides),
            paths=tuple(replace(path, t_s=path.t_s + lag_s) for path in self.paths),
            belt=self.belt + np.array([lag_s, 0.0]),
        )


MOST_BYTES: Final = 500_000_000
# to SI
UNITS: Final = {"ns": 1e-9, "us": 1e-6, "ms": 1e-3, "s": 1.0, "sec": 1.0, "mm": 1e-3, "cm": 1e-2, "m": 1.0}
UNITS.update({"deg": math.pi / 180.0, "rad": 1.0, "mps": 1.0, "kmh": 1.0 / 3.6})
_SIDES: Final = {"left": "left_foot", "l": "left_foot", "right": "right_foot", "r": "right_foot"}


@dataclass(frozen=True)
class Table:
    """Columns of text by name, in lower case without unit; ``factor`` says what brings each to SI."""

    path: Path
    columns: dict[str, list[str]]
    factor: dict[str, float]
    decimal: str
    first_line: int

    @property
    def rows(self) -> int:
        """How many rows there are."""
        return len(next(iter(self.columns.values())))

    def line(self, row: int) -> str:
        """Where a row is in the file, for messages."""
        return f"{self.path}:{self.first_line + row}"

    def first_of(self, *names: str) -> str | None:
        """The first of these columns that is there."""
        return next((name for name in names if name in self.columns), None)

    def numbers(self, name: str) -> FloatArray:
        """A column (N,) in SI units, NaN for empty cells. ReferenceError: a cell is no number."""
        out = np.empty(self.rows)
        for row, text in enumerate(self.columns[name]):
            try:
                out[row] = float(text.replace(",", ".") if self.decimal == "," else text) if text else np.nan
            except ValueError:
                raise ReferenceError(f"{self.line(row)}: column {name!r} holds {text!r}, which is no number") from None
        return out * self.factor[name]

    def flags(self, name: str) -> list[bool]:
        """A column of yes and no, 1 and 0, true and false; empty is no."""
        return [text.strip().lower() in ("yes", "1", "true", "y", "1.0") for text in self.columns[name]]

    def feet(self, default: str | None) -> list[str]:
        """The foot of every row: a column ``foot`` or ``side``, else ``default``.

        ReferenceError: neither is there, or a cell names no foot.
        """
        name = self.first_of("foot", "side", "leg", "limb")
        if name is None:
            if default is None:
                raise ReferenceError(
                    f"{self.path}: has no column 'foot', and the recording has two feet; say --foot left or right"
                )
            return [default] * self.rows
        feet = []
        for row, text in enumerate(self.columns[name]):
            foot = foot_of(text)
            if foot is None:
                raise ReferenceError(f"{self.line(row)}: {text!r} is no foot; left or right is")
            feet.append(foot)
        return feet


def foot_of(text: str) -> str | None:
    """``left_foot`` or ``right_foot`` for left, L, left_foot, Left Foot …; None for anything else."""
    return _SIDES.get(re.sub(r"[ _-]?(foot|leg|shank|sensor)$", "", text.strip().lower()))


def read_columns(path: Path) -> Table:
    """Read a CSV; its first line that is not a comment (``#``) names the columns.

    A last part of a name that is a unit (``_mm``, ``(ms)``, ``[m]``) is taken off and applied; without one a column is
    in SI.

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
    twice = next((name for name, count in Counter(name for name, _ in names).items() if count > 1), None)
    if twice is not None:
        raise ReferenceError(f"{path}: names the column {twice!r} twice")
    columns = {name: [row[k].strip() for row in rows[1:]] for k, (name, _) in enumerate(names)}
    commas = any(re.fullmatch(r"[+-]?\d+,\d+", cell.strip()) for row in rows[1:51] for cell in row)
    return Table(path, columns, dict(names), "," if delimiter != "," and commas else ".", skipped + 2)


def _name(cell: str) -> tuple[str, float]:
    """Name in lower case without unit, and the factor to SI."""
    text = re.sub(r"[\s.-]+", "_", re.sub(r"[\[\]()]", " ", cell.strip().lower()).strip().replace("/", ""))
    base, _, last = text.rpartition("_")
    return (base, UNITS[last]) if base and last in UNITS else (text, 1.0)
