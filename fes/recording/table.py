"""CSV or Parquet → columns as numbers; what is wrong with the file as a file is said here."""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from fes.recording import csv_layout as csv_text
from fes.recording.containers import container_of, container_table
from fes.recording.csv_layout import Dialect
from fes.recording.tracks import RecordingError
from fes.signals import FloatArray, IntArray

if TYPE_CHECKING:
    import pyarrow as pa

TABLE_SUFFIXES = (".csv", ".parquet")
DEFAULT_DIALECT = Dialect()
_PARQUET_MAGIC = b"PAR1"
_BATCH_ROWS = 65_536


class Table:
    """Columns of a file, or of rows of it from ``first`` on; ``path`` is where they are from, for messages.

    ``is_csv``: as ``dialect`` says; ``container``: they are named ``stream.channel``.
    """

    def __init__(
        self,
        path: Path,
        table: pa.Table,
        first: int = 0,
        *,
        is_csv: bool = False,
        dialect: Dialect = DEFAULT_DIALECT,
        container: bool = False,
    ) -> None:
        self.path, self.first, self.is_csv = path, first, is_csv
        self._table, self._dialect, self._container = table, dialect, container
        self._times: dict[tuple[str, float, int | None], IntArray] = {}
        self.rows = int(table.num_rows)

    @classmethod
    def read(cls, path: Path, wanted: list[str], times: list[str], dialect: Dialect) -> Table:
        """The wanted columns of a file; ``times``: those of them that are times.

        Raises:
            RecordingError: the file is no readable CSV or Parquet, is empty, or lacks a column.
        """
        container = bool(container_of(path))
        is_csv = not container and not is_parquet(path)
        if container:
            whole, _ = container_table(path)
            _check_names(path, whole.column_names, wanted)
            table = whole.select(list(dict.fromkeys(wanted)))
        else:
            table = _read_csv(path, wanted, times, dialect) if is_csv else _read_parquet(path, wanted)
        if table.num_rows == 0:
            raise RecordingError(f"{path}: holds a header and no samples")
        return cls(path, table, is_csv=is_csv, dialect=dialect, container=container)

    @classmethod
    def parts(cls, path: Path, wanted: list[str], rows: int) -> Iterator[Table]:
        """A Parquet file's tables of so many rows each, the last of what is left; no more is read than is asked for.

        Raises:
            RecordingError: as :meth:`read`.
        """
        import pyarrow as pa
        from pyarrow import parquet

        _check_names(path, parquet_names(path), wanted)
        first, taken, batches, size = 0, 0, list[Any](), min(rows, _BATCH_ROWS)
        with _damage_explained(path), parquet.ParquetFile(path, page_checksum_verification=True) as file:
            # one row group after the other: of all at once the reader keeps more
            groups = (file.iter_batches(size, [group], wanted) for group in range(file.num_row_groups))
            for batch in chain.from_iterable(groups):
                while batch.num_rows:
                    head = batch.slice(0, rows - taken)
                    batches.append(head)
                    taken, batch = taken + head.num_rows, batch.slice(head.num_rows)
                    if taken == rows:
                        table, batches = pa.Table.from_batches(batches), []
                        del head
                        yield cls(path, table, first)
                        del table
                        pa.default_memory_pool().release_unused()
                        first, taken = first + rows, 0
        if batches:
            yield cls(path, pa.Table.from_batches(batches), first)

    def place(self, row: int) -> str:
        """Return where a row is, for messages: “line 17” of a CSV file, “row 16” (from 1) of Parquet."""
        if self.is_csv:
            return f"line {csv_text.line_of_row(self.path, self._dialect, row)}"
        return f"row {self.first + row + 1}"

    def numbers(self, name: str) -> FloatArray:
        """Return a column as (rows,) float64, NaN where empty.

        Raises:
            RecordingError: the column does not hold numbers.
        """
        import pyarrow as pa

        column = self._table.column(name)
        try:
            column = column if column.type == pa.float64() else column.cast(pa.float64(), safe=False)
            return np.asarray(column.to_numpy(), dtype=np.float64)
        except (pa.ArrowInvalid, pa.ArrowNotImplementedError) as error:
            fault = csv_text.find_fault(self.path, self._dialect, [name]) if self.is_csv else ""
            raise RecordingError(fault or f"{self.path}: column {name!r} holds {column.type}, not numbers") from error

    def vectors(self, names: tuple[str, ...]) -> tuple[FloatArray, float]:
        """Return three columns of numbers as (rows, 3) float64, NaN where empty, and their :func:`greatest_size`.

        Raises:
            RecordingError: a column does not hold numbers.
        """
        import pyarrow as pa

        from fes.estimation.numerics.filters import into_rows  # here, for who only writes recordings needs no compiler

        columns, out = [self._table.column(name) for name in names], np.empty((self.rows, 3))
        same = columns[0].type in (pa.float32(), pa.float64()) and all(c.type == columns[0].type for c in columns)
        axes = [c.to_numpy() for c in columns] if same else [self.numbers(name) for name in names]
        for axis in axes:
            axis.flags.writeable = False  # as what is Arrow's own is: to the compiler that is another kind
        x, y, z = axes
        return out, into_rows(x, y, z, out)

    def check_stream(self, names: tuple[str, ...], where: str) -> None:
        """Refuse a sensor's columns (its time too) of several streams: their rows are not of one instant."""
        streams = {name.rpartition(".")[0] for name in names}
        if self._container and len(streams) > 1:
            what = "its columns must be of one stream; save acceleration and rotation rate as one"
            raise RecordingError(f"{where}: is put together from the streams {', '.join(sorted(streams))}: {what}")

    def empty(self, name: str) -> npt.NDArray[np.bool_] | None:
        """Return where a column's cells are empty, None if nowhere."""
        column = self._table.column(name)
        return np.asarray(column.is_null().to_numpy(), dtype=bool) if column.null_count else None

    def times_ns(self, name: str, unit_ns: float, wraps_at: int | None = None) -> IntArray:
        """Return a time column as (rows,) nanoseconds, 0 where empty; to be read only, sensors may share it.

        ``wraps_at``: a counter begins anew at 0 after one less than this.

        Raises:
            RecordingError: the column does not hold times.
        """
        key = name, unit_ns, wraps_at
        if key not in self._times:
            self._times[key] = self._times_ns(name, unit_ns, wraps_at)
        return self._times[key]

    def _times_ns(self, name: str, unit_ns: float, wraps_at: int | None) -> IntArray:
        import pyarrow as pa

        column = self._table.column(name)
        kind = column.type
        if pa.types.is_timestamp(kind):
            column = column.cast(pa.timestamp("ns", kind.tz), safe=False).cast(pa.int64())
            return np.asarray(column.fill_null(0).to_numpy(), dtype=np.int64)
        if (
            pa.types.is_integer(kind) and isinstance(unit_ns, int) and wraps_at is None
        ):  # what need not be cast spares loading Arrow's arithmetic
            column = column if kind == pa.int64() else column.cast(pa.int64(), safe=False)
            column = column.fill_null(0) if column.null_count else column
            counts = np.asarray(column.to_numpy(), dtype=np.int64)
            if counts.size and max(abs(int(counts.min())), abs(int(counts.max()))) * unit_ns >= 2**63:
                self._check_span(name, counts.astype(np.float64) * unit_ns)
            return counts * unit_ns
        readings, empty = self.numbers(name), self.empty(name)
        if wraps_at is not None:
            readings = self._unwrapped(name, readings, wraps_at)
        with np.errstate(over="ignore"):  # what overflows is refused below
            stamps = readings * unit_ns
        if empty is not None:
            stamps[empty] = 0.0
        self._check_span(name, stamps)
        return np.rint(stamps).astype(np.int64)

    def _unwrapped(self, name: str, counts: FloatArray, wraps_at: int) -> FloatArray:
        known = np.flatnonzero(np.isfinite(counts))
        wrong = known[(counts[known] < 0) | (counts[known] >= wraps_at)]
        if wrong.size:
            what = f"{counts[wrong[0]]:g} is none of 0 to {wraps_at - 1}; correct time_wraps_at, or leave it out"
            raise RecordingError(f"{self.path}: {self.place(int(wrong[0]))}, column {name!r}: {what}")
        out = counts.copy()
        out[known] = unwrapped(counts[known], wraps_at)
        return out

    def _check_span(self, name: str, stamps_ns: FloatArray) -> None:
        bad = np.flatnonzero(~(np.abs(stamps_ns) < 2.0**63))
        if bad.size:
            raise RecordingError(
                f"{self.path}: {self.place(int(bad[0]))}, column {name!r}: {stamps_ns[bad[0]] * 1e-9:g} s is no time "
                f"({bad.size} such rows); check time_unit"
            )


def _read_csv(path: Path, wanted: list[str], times: list[str], dialect: Dialect) -> pa.Table:
    import pyarrow as pa
    from pyarrow import csv

    names = csv_text.header(path, dialect)
    _check_names(path, names, wanted, dialect)
    types = {name: pa.float64() for name in wanted if name not in times}
    try:
        return csv.read_csv(
            path,
            csv.ReadOptions(column_names=names, skip_rows=dialect.first_data_line - 1, encoding=dialect.encoding),
            csv.ParseOptions(delimiter=dialect.delimiter),
            csv.ConvertOptions(
                column_types=types, include_columns=wanted, null_values=[""], decimal_point=dialect.decimal
            ),
        )
    except (pa.ArrowException, OSError, UnicodeDecodeError, KeyError) as error:
        fault = csv_text.find_fault(path, dialect, wanted)
        raise RecordingError(fault or f"{path}: cannot be read as CSV: {' '.join(str(error).split())}") from error


def _read_parquet(path: Path, wanted: list[str]) -> pa.Table:
    from pyarrow import parquet

    _check_ends(path)
    with _damage_explained(path), parquet.ParquetFile(path, page_checksum_verification=True, pre_buffer=False) as file:
        _check_names(path, file.schema_arrow.names, wanted)
        # on several cores it takes a fifth more of their time, and leaves the columns in the others' caches
        return file.read(columns=wanted, use_threads=False)


def parquet_rows(path: Path) -> int:
    """Return how many rows a Parquet file has; errors as of :func:`parquet_names`."""
    from pyarrow import parquet

    parquet_names(path)
    return int(parquet.read_metadata(path).num_rows)


def parquet_names(path: Path) -> list[str]:
    """Return a Parquet file's column names.

    Raises:
        RecordingError: it is empty, cut short, damaged or no Parquet.
    """
    from pyarrow import parquet

    _check_ends(path)
    with _damage_explained(path):
        return list(parquet.read_schema(path).names)


def _check_names(path: Path, names: list[str], wanted: list[str], dialect: Dialect | None = None) -> None:
    """``dialect``: of a CSV file."""
    missing = [name for name in wanted if name not in names]
    twice = [name for name in wanted if names.count(name) > 1]
    if twice:
        also = "; if its header has two lines, say header_lines = 2 in the sidecar" if dialect else ""
        raise RecordingError(f"{path}: has {names.count(twice[0])} columns {twice[0]!r}: rename them{also}")
    if not missing:
        return
    if dialect and (delimiter := csv_text.other_delimiter(path, dialect, wanted)):
        also = ' (and decimal = "," if its numbers have decimal commas)' if delimiter == ";" else ""
        shown = delimiter.replace("\t", "\\t")
        raise RecordingError(
            f'{path}: its fields are separated by "{shown}", not by "{dialect.delimiter}"; '
            f'say delimiter = "{shown}" in the sidecar{also}'
        )
    near = difflib.get_close_matches(missing[0], names, n=3, cutoff=0.5)
    guess = f" Did you mean {' or '.join(repr(name) for name in near)}?" if near else ""
    more = f" ({len(missing) - 1} more are missing too)" if len(missing) > 1 else ""
    raise RecordingError(
        f"{path}: has no column {missing[0]!r}{more}.{guess} Its columns are: {', '.join(map(repr, names))}"
    )


def is_parquet(path: Path) -> bool:
    """By its name or, where that is silent, by what is in it."""
    if path.suffix.lower() in TABLE_SUFFIXES:
        return path.suffix.lower() == ".parquet"
    try:
        with path.open("rb") as file:
            return file.read(4) == _PARQUET_MAGIC
    except OSError:
        return False  # told when it is read


def unwrapped(counts: FloatArray, wraps_at: int) -> FloatArray:
    """(N,) readings of a counter that goes on where it began anew; a step back of up to a sixteenth stays one.

    What is lost may be up to fifteen sixteenths of a turn.
    """
    back = wraps_at / 16
    steps = np.mod(np.diff(counts) + back, wraps_at) - back
    return np.concatenate((counts[:1], counts[:1] + np.cumsum(steps)))


def greatest_size(values: npt.NDArray[np.floating[Any]]) -> float:
    """The greatest size among numbers, infinite where one is none (NaN), 0 where there are none."""
    least, greatest = (float(values.min()), float(values.max())) if values.size else (0.0, 0.0)
    return max(greatest, -least) if greatest == greatest else math.inf


def _check_ends(path: Path) -> None:
    """Refuse what does not begin and end as a Parquet file."""
    try:
        with path.open("rb") as file:
            start, size = file.read(4), file.seek(0, 2)
            file.seek(max(0, size - 4))
            end = file.read(4)
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror or error}") from error
    if size == 0:
        raise RecordingError(f"{path}: is empty")
    if start != _PARQUET_MAGIC:
        raise RecordingError(f"{path}: is not a Parquet file (a CSV file must be called .csv)")
    if end != _PARQUET_MAGIC or size < 12:
        raise RecordingError(
            f"{path}: is cut short: a Parquet file's end (footer) is missing. Copy or record it again."
        )


@contextmanager
def _damage_explained(path: Path) -> Iterator[None]:
    """What fails in reading a Parquet file, as a RecordingError."""
    import pyarrow as pa

    try:
        yield
    except RecordingError:
        raise
    except (pa.ArrowException, OSError, ValueError) as error:  # ValueError: a name that is no text
        raise RecordingError(f"{path}: is damaged: {' '.join(str(error).split())}. Copy or record it again.") from error
