"""The text side of a CSV file: where its header and rows are, and what exactly is wrong when it cannot be read.

A file that nobody has described may be laid out in many ways. Devices and spreadsheets put lines of their own above the
header (``sep=,``, the device, the rate), units under it, and write commas where others write points. The rows tell:
numbers in the same columns, line after line, to the end.
"""

import codecs
import csv
import re
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from itertools import islice, zip_longest
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
                names = zip_longest(*([cell.strip() for cell in cells] for cells in stacked), fillvalue="")
                yield dialect.skip_lines + 1, ["_".join(filter(None, parts)) for parts in names]
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


def guess_encoding(path: Path) -> str:
    """Return “utf-8” where a file's start is that, and what older programs write otherwise.

    Raises:
        RecordingError: the file cannot be read.
    """
    start = _start(path, _ENCODING_BYTES)
    for encoding in ("utf-8", "cp1252"):
        with suppress(UnicodeDecodeError):
            codecs.getincrementaldecoder(encoding)().decode(start)  # a letter cut in two at the end is no fault
            return encoding
    return "latin-1"


def _start(path: Path, size: int) -> bytes:
    try:
        with path.open("rb") as file:
            return file.read(size)
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror or error}") from error


def header(path: Path, dialect: Dialect) -> list[str]:
    """Return the column names, without the spaces around them.

    Raises:
        RecordingError: empty, binary or otherwise no CSV.
    """
    start = _start(path, 4096)
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
    best = max(found, key=found.__getitem__)
    return best if found[best] > found[dialect.delimiter] else ""


def line_of_row(path: Path, dialect: Dialect, row: int) -> int:
    """Return the line number of a data row (counted from 0)."""
    found = next(islice(lines(path, dialect), row + 1, None), None)
    return found[0] if found else dialect.first_data_line + row


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
            fault = f"{path}: line {number} has {len(cells)} cells, the header has {len(names)}."
            if dialect.delimiter == "," and len(cells) > len(names):
                remedy = 'fields need another delimiter: save the file with ";" between them.'
                fault += f" If numbers have a decimal comma, {remedy}"
            continue
        for place, name in places:
            cell = cells[place].replace(dialect.decimal, ".")
            if cells[place] and not NUMBER.fullmatch(cell):
                remedy = "Correct it, or leave all of the sensor's cells of that line empty if the sample is lost."
                if _DECIMAL_COMMA.fullmatch(cells[place]):
                    remedy = 'It has a decimal comma: say decimal = "," in the sidecar.'
                elif number == dialect.first_data_line:
                    remedy = (
                        "If that line holds units or a second header, say skip_lines_after_header = 1 in the sidecar."
                    )
                return f"{path}: line {number}, column {name!r}: {cells[place][:40]!r} is no number. {remedy}"
    if fault:
        return f"{fault} It is the last line: the file was cut short. Delete that line, or copy the file again."
    return ""


_STYLES = ((",", "."), (";", ","), (";", "."), ("\t", "."), ("\t", ","), ("|", "."), ("|", ","))
_SAMPLE_BYTES = 65_536
_SAMPLE_LINES = 200
_TAIL = 20  # rows that tell how a row looks
_UNIT_CELL = re.compile(
    r"\W*(n/?a|raw|u?ncal|cal|no ?units?|[munµμ]?s(ec)?|m?g|m ?/ ?\(?s.{0,4}|(m?deg|°|º|rad)( ?/ ?s(ec)?)?|m?dps|"
    r"[munµ]?[vt]|gauss|°?c|k?pa|hz|%)\W*",
    re.IGNORECASE,
)


@dataclass(frozen=True)
class Layout:
    """What the text of a file tells of itself; ``filled``: the columns that hold ``numbers``, so many in the last rows.

    ``units`` of columns are those that a line under the header gives, "" elsewhere; ``above`` is what stands over the
    header, as (line number from 1, text).
    """

    dialect: Dialect
    names: list[str]
    units: dict[str, str]
    above: list[tuple[int, str]]
    filled: set[str]
    numbers: int = 1


def settings_of(dialect: Dialect) -> dict[str, object]:
    """The sidecar's settings for a layout: those that are not the default."""
    return {each.name: value for each in fields(Dialect) if (value := getattr(dialect, each.name)) != each.default}


def has_rows(path: Path) -> bool:
    """Is it text whose lines hold numbers, in columns?"""
    try:
        return bool(csv_layout(path).numbers)
    except RecordingError:
        return False


def csv_layout(path: Path) -> Layout:
    """Return how a CSV is laid out. Raises RecordingError: it is empty, binary, UTF-16, or has rows and no header."""
    encoding = guess_encoding(path)
    header(path, Dialect(encoding=encoding))  # says what keeps it from being text at all
    start = _start(path, _SAMPLE_BYTES)
    lines = start.decode("utf-8-sig" if encoding == "utf-8" else encoding, errors="replace").splitlines()
    if len(start) == _SAMPLE_BYTES and len(lines) > 1:
        lines.pop()  # cut in the middle
    lines = lines[:_SAMPLE_LINES]
    scored = ((_tail_score(lines, *style), *style) for style in _STYLES)
    best, delimiter, decimal = max(scored, key=lambda style: style[0])
    cells = [_cells(line, delimiter) for line in lines]
    first = _first_row(cells, decimal) if best else min(1, len(lines))
    if first == 0 and not any(_is_number(cell, decimal) for cell in cells[0]):
        first = 1  # of one line below, no column says which of them hold numbers
    if first == 0:
        example = delimiter.join(("time_ms", "acc_x", "acc_y", "acc_z", "gyr_x", "gyr_y", "gyr_z"))
        what = "has no header: its first line holds numbers. Write a line of column names on top of it, such as"
        raise RecordingError(f"{path}: {what} {example}")
    begin, count, units_row = _header(cells, first)
    dialect = Dialect(delimiter, decimal, encoding, begin, count, first - begin - count)
    names = header(path, dialect)
    units = {name: unit.strip() for name, unit in zip(names, cells[units_row], strict=False)} if units_row else {}
    rows = cells[first:][-_TAIL:]
    filled = {name for index, name in enumerate(names) if any(_number(row, index, decimal) for row in rows)}
    above = [(number, text.strip()) for number, text in enumerate(lines[:begin], start=1) if text.strip()]
    return Layout(dialect, names, units, above, filled if best else set(names), best)


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
