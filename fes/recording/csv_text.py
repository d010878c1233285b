"""The text side of a CSV file: its header, where its rows are, and what exactly is wrong when it cannot be read."""

from __future__ import annotations

import codecs
import csv
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import zip_longest
from pathlib import Path

from fes.recording.tracks import RecordingError

NUMBER = re.compile(r"\s*[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?\s*|\s*[+-]?(nan|inf|infinity)\s*", re.IGNORECASE)
_DECIMAL_COMMA = re.compile(r"\s*[+-]?\d+,\d+([eE][+-]?\d+)?\s*")
_DELIMITERS = (",", ";", "\t", "|")
_ENCODING_BYTES = 1_000_000


@dataclass(frozen=True)
class Dialect:
    """How the text is laid out; the names are the sidecar's keys."""

    delimiter: str = ","
    decimal: str = "."
    encoding: str = "utf-8"
    skip_lines: int = 0
    header_lines: int = 1
    skip_lines_after_header: int = 0

    @property
    def first_data_line(self) -> int:
        """Line number (from 1) of the first sample, blank lines apart."""
        return self.skip_lines + self.header_lines + self.skip_lines_after_header + 1


def lines(path: Path, dialect: Dialect) -> Iterator[tuple[int, list[str]]]:
    """Yield (line number from 1, cells) of the header and of every row that is not blank.

    A header of several lines comes as one: the names above each other joined by “_”.

    Raises:
        RecordingError: the file cannot be read or is not text of this encoding.
    """
    encoding = "utf-8-sig" if dialect.encoding.lower() in ("utf-8", "utf8") else dialect.encoding
    try:
        with path.open(encoding=encoding, newline="") as file:
            for _ in range(dialect.skip_lines):
                next(file, "")
            reader = csv.reader(file, delimiter=dialect.delimiter)
            stacked = [next(reader, []) for _ in range(dialect.header_lines)]
            if any(stacked):
                yield dialect.skip_lines + 1, _joined(stacked)
            for cells in reader:
                number = reader.line_num + dialect.skip_lines
                if cells and number >= dialect.first_data_line:
                    yield number, cells
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise RecordingError(
            f"{path}: is not {dialect.encoding} text; "
            f'save it as UTF-8, or say encoding = "cp1252" (or what it is) in the sidecar'
        ) from error
    except LookupError as error:
        raise RecordingError(f'{path}: encoding = "{dialect.encoding}" is no known encoding; try "utf-8"') from error
    except csv.Error as error:
        raise RecordingError(f"{path}: is not a CSV file: {error}") from error


def likely_encoding(path: Path) -> str:
    """Return “utf-8” where a file's start is that, and what older programs write otherwise.

    Raises:
        RecordingError: the file cannot be read.
    """
    try:
        with path.open("rb") as file:
            start = file.read(_ENCODING_BYTES)
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror or error}") from error
    for encoding in ("utf-8", "cp1252"):
        try:
            codecs.getincrementaldecoder(encoding)().decode(start)  # a letter cut in two at the end is no fault
        except UnicodeDecodeError:
            continue
        return encoding
    return "latin-1"


def _joined(stacked: list[list[str]]) -> list[str]:
    names = zip_longest(*([cell.strip() for cell in cells] for cells in stacked), fillvalue="")
    return ["_".join(part for part in parts if part) for parts in names]


def header(path: Path, dialect: Dialect) -> list[str]:
    """Return the column names, without the spaces around them.

    Raises:
        RecordingError: empty, binary or otherwise no CSV.
    """
    try:
        with path.open("rb") as file:
            start = file.read(4096)
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror or error}") from error
    if not start.strip():
        raise RecordingError(f"{path}: is empty; a recording has a header line and a line per sample")
    if start[:2] in (b"\xff\xfe", b"\xfe\xff"):
        raise RecordingError(f"{path}: is UTF-16 text; save it as UTF-8 (in a spreadsheet: “CSV UTF-8”)")
    if b"\0" in start:
        raise RecordingError(f"{path}: is binary, not CSV; a Parquet file must be called .parquet")
    for _, cells in lines(path, dialect):
        return cells
    raise RecordingError(f"{path}: has no header line; check skip_lines = {dialect.skip_lines} in the sidecar")


def other_delimiter(path: Path, dialect: Dialect, wanted: list[str]) -> str:
    """Return the delimiter under which more of the wanted columns appear, "" if there is none."""
    found = {}
    for delimiter in _DELIMITERS:
        names = header(path, replace(dialect, delimiter=delimiter))
        found[delimiter] = len(set(names) & set(wanted))
    best = max(found, key=lambda delimiter: found[delimiter])
    return best if found[best] > found[dialect.delimiter] else ""


def line_of_row(path: Path, dialect: Dialect, row: int) -> int:
    """Return the line number of a data row (counted from 0)."""
    for index, (number, _) in enumerate(lines(path, dialect)):
        if index == row + 1:
            return number
    return dialect.first_data_line + row


def find_fault(path: Path, dialect: Dialect, wanted: list[str]) -> str:
    """Say what keeps the file from being read: the first line with too few or too many cells, or with no number.

    Returns "" if no such line is found.
    """
    names: list[str] = []
    fault = ""
    for number, cells in lines(path, dialect):
        if fault:
            return fault  # a later line exists: the fault is not at the end
        if not names:
            names = cells
            places = [(names.index(name), name) for name in wanted if name in names]
            continue
        if len(cells) != len(names):
            fault = _wrong_count(path, number, len(cells), len(names), dialect)
            continue
        for place, name in places:
            cell = cells[place].replace(dialect.decimal, ".")
            if cells[place] and not NUMBER.fullmatch(cell):
                return _no_number(path, number, name, cells[place], number == dialect.first_data_line)
    if fault:
        return f"{fault} It is the last line: the file was cut short. Delete that line, or copy the file again."
    return ""


def _wrong_count(path: Path, number: int, cells: int, names: int, dialect: Dialect) -> str:
    hint = ""
    if dialect.delimiter == "," and cells > names:
        hint = ' If numbers have a decimal comma, fields need another delimiter: save the file with ";" between them.'
    return f"{path}: line {number} has {cells} cells, the header has {names}.{hint}"


def _no_number(path: Path, number: int, name: str, cell: str, first: bool) -> str:
    message = f"{path}: line {number}, column {name!r}: {cell[:40]!r} is no number."
    if _DECIMAL_COMMA.fullmatch(cell):
        return f'{message} It has a decimal comma: say decimal = "," in the sidecar.'
    if first:
        return f"{message} If that line holds units or a second header, say skip_lines_after_header = 1 in the sidecar."
    return f"{message} Correct it, or leave all of the sensor's cells of that line empty if the sample is lost."
