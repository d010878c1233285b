"""How a CSV that nobody has described is laid out: where its header and its rows are, and what stands above them.

Devices and spreadsheets put lines of their own above the header (``sep=,``, the device, the rate), units under it, and
write commas where others write points. The rows tell: numbers in the same columns, line after line, to the end.
"""

from __future__ import annotations

import csv
import re
from collections import Counter
from dataclasses import dataclass, fields
from pathlib import Path

from fes.recording import csv_text
from fes.recording.csv_text import NUMBER, Dialect
from fes.recording.tracks import RecordingError

_STYLES = ((",", "."), (";", ","), (";", "."), ("\t", "."), ("\t", ","), ("|", "."), ("|", ","))
_LOOKED_AT_BYTES = 65_536
_LOOKED_AT_LINES = 200
_TAIL = 20  # rows that tell how a row looks
_UNIT_CELL = re.compile(
    r"\W*(n/?a|raw|u?ncal|cal|no ?units?|[munµμ]?s(ec)?|m?g|m ?/ ?\(?s.{0,4}|(m?deg|°|º|rad)( ?/ ?s(ec)?)?|m?dps|"
    r"[munµ]?[vt]|gauss|°?c|k?pa|hz|%)\W*",
    re.IGNORECASE,
)


@dataclass(frozen=True)
class Layout:
    """What the text of a file tells of itself.

    Attributes:
        dialect: for reading it.
        names: of its columns.
        units: of its columns where a line under the header gives them; "" elsewhere.
        above: (line number from 1, text) of what stands over the header.
        filled: names of the columns that hold numbers.
    """

    dialect: Dialect
    names: list[str]
    units: dict[str, str]
    above: list[tuple[int, str]]
    filled: set[str]


def settings_of(dialect: Dialect) -> dict[str, object]:
    """The sidecar's settings for a layout: those that are not the default."""
    return {
        setting.name: getattr(dialect, setting.name)
        for setting in fields(Dialect)
        if getattr(dialect, setting.name) != setting.default
    }


def csv_layout(path: Path) -> Layout:
    """Return how a CSV is laid out.

    Raises:
        RecordingError: it is empty, binary, UTF-16, or has rows and no header.
    """
    encoding = csv_text.likely_encoding(path)
    csv_text.header(path, Dialect(encoding=encoding))  # says what keeps it from being text at all
    lines = _first_lines(path, encoding)
    best, delimiter, decimal = max(
        ((_tail_score(lines, *style), *style) for style in _STYLES), key=lambda scored: scored[0]
    )
    cells = [_cells(line, delimiter) for line in lines]
    first = _first_row(cells, decimal) if best else min(1, len(lines))
    if first == 0:
        raise RecordingError(
            f"{path}: has no header: its first line holds numbers. Write a line of column names on top of it, such as "
            f"{delimiter.join(('time_ms', 'acc_x', 'acc_y', 'acc_z', 'gyr_x', 'gyr_y', 'gyr_z'))}"
        )
    start, count, units_row = _header(cells, first)
    dialect = Dialect(delimiter, decimal, encoding, start, count, first - start - count)
    names = csv_text.header(path, dialect)
    units = {name: unit.strip() for name, unit in zip(names, cells[units_row], strict=False)} if units_row else {}
    rows = cells[first:][-_TAIL:]
    filled = {name for index, name in enumerate(names) if any(_number(row, index, decimal) for row in rows)}
    above = [(number, text.strip()) for number, text in enumerate(lines[:start], start=1) if text.strip()]
    return Layout(dialect, names, units, above, filled if best else set(names))


def _first_lines(path: Path, encoding: str) -> list[str]:
    with path.open("rb") as file:
        start = file.read(_LOOKED_AT_BYTES)
    text = start.decode("utf-8-sig" if encoding == "utf-8" else encoding, errors="replace")
    lines = text.splitlines()
    if len(start) == _LOOKED_AT_BYTES and len(lines) > 1:
        lines.pop()  # cut in the middle
    return lines[:_LOOKED_AT_LINES]


def _cells(line: str, delimiter: str) -> list[str]:
    return next(csv.reader([line], delimiter=delimiter), [])


def _is_number(cell: str, decimal: str) -> bool:
    return bool(NUMBER.fullmatch(cell.replace(decimal, ".") if decimal != "." else cell))


def _number(row: list[str], index: int, decimal: str) -> bool:
    return index < len(row) and _is_number(row[index], decimal)


def _tail_score(lines: list[str], delimiter: str, decimal: str) -> int:
    """Numbers in the last rows, were they laid out so; rows of one cell are none."""
    rows = [_cells(line, delimiter) for line in lines if line.strip()][-_TAIL:]
    return sum(_is_number(cell, decimal) for row in rows if len(row) > 1 for cell in row)


def _first_row(cells: list[list[str]], decimal: str) -> int:
    """Index of the first line of the numbers that go on to the last line."""
    tail = [row for row in cells if any(cell.strip() for cell in row)][-_TAIL:]
    width = Counter(len(row) for row in tail).most_common(1)[0][0]
    like = [row for row in tail if len(row) == width]
    columns = [index for index in range(width) if 2 * sum(_number(row, index, decimal) for row in like) > len(like)]
    first = len(cells)
    for line in range(len(cells) - 1, -1, -1):
        row = cells[line]
        if not any(cell.strip() for cell in row):
            continue
        held = [row[index] for index in columns if index < len(row) and row[index].strip()]
        if line < len(cells) - 2 and (len(row) != width or not held or any(not _is_number(c, decimal) for c in held)):
            break
        first = line
    return first


def _header(cells: list[list[str]], first: int) -> tuple[int, int, int]:
    """(line, number of lines, line of units or 0) of the header above the first row; lines from 0."""
    above = [line for line in range(first) if any(cell.strip() for cell in cells[line])]
    if not above:
        return 0, 1, 0
    width = len(cells[first]) if first < len(cells) else len(cells[above[-1]])
    block = [above[-1]]
    for line in reversed(above[:-1]):
        if len(block) == 4 or line != block[0] - 1 or abs(len(cells[line]) - width) > 1:
            break
        block.insert(0, line)
    full = [line for line in block if 2 * sum(bool(cell.strip()) for cell in cells[line]) > width] or block[-1:]
    names = [line for line in full if not _is_units(cells[line])] or full[:1]
    units_row = next((line for line in full if line > names[-1]), 0)
    return names[0], names[-1] - names[0] + 1, units_row  # names above each other tell the columns apart together


def _is_units(row: list[str]) -> bool:
    held = [cell for cell in row if cell.strip()]
    return bool(held) and all(_UNIT_CELL.fullmatch(cell) for cell in held)
