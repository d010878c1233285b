"""A session log as tables, batch by batch: what every file format that it is converted to is fed with.

Tables → a folder of CSV or Parquet files, one a table, and what the log's header and summary say as JSON.
"""

import csv
import json
import math
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from enum import Enum, IntEnum
from pathlib import Path
from typing import Any, Final, get_type_hints

import numpy as np

from fes import signals
from fes.session_log.codec import Rare, SampleParts, latency_arrays
from fes.session_log.framing import Received, RecordType, SessionLogError, not_made
from fes.session_log.repair import Damage, stretches
from fes.walk_record import MARK, Note, finite_or_none
from statemachine.phases import PhaseChange

BATCH_ROWS: Final = 20_000
ANOTHER: Final = "choose another with --out"
UNITS: Final = {name: name for name in ("ns", "ms", "rad", "m")} | {"ma": "mA", "us": "µs", "uc": "µC", "hz": "Hz"}
UNITS.update({"mps2": "m/s²", "radps": "rad/s", "mps": "m/s"})
_ARRAYS = ("trajectory_m", "pitch_rad", "roll_rad")
_KINDS: Final[dict[Any, str]] = {int: "int", int | None: "int", float: "float", bool: "bool", bool | None: "bool"}


@dataclass(frozen=True, slots=True)
class Column:
    """A column: ``kind`` is int, float, bool or text; ``unit`` "" where there is none."""

    name: str
    kind: str

    @property
    def unit(self) -> str:
        """The unit that the name ends with."""
        return UNITS.get(self.name.rsplit("_", 1)[-1], "") if "_" in self.name else ""


@dataclass(frozen=True, slots=True)
class Table:
    """A table's name, columns and the column with the time that its rows belong to (ns)."""

    name: str
    columns: tuple[Column, ...]
    time: str = "t_ns"

    @property
    def names(self) -> list[str]:
        """Of the columns."""
        return [column.name for column in self.columns]


@dataclass(slots=True)
class Batch:
    """Some rows of a table, as a list for each column."""

    table: Table
    columns: list[list[Any]]

    def __len__(self) -> int:
        return len(self.columns[0])


@dataclass(slots=True)
class Exported:
    """What went by: ``rows`` by table, the header, the summary, damaged places; ``begin_ns`` is its first time.

    ``marks`` are those so far: when (ns), and what.
    """

    header: dict[str, Any] = field(default_factory=dict)
    summary: dict[str, Any] = field(default_factory=dict)
    ended: bool = False
    damages: list[Damage] = field(default_factory=list)
    rows: dict[str, int] = field(default_factory=dict)
    begin_ns: int = 0
    marks: list[tuple[int, str]] = field(default_factory=list)


def library_missing(what: str, extra: str) -> SessionLogError:
    """Why a format cannot be written here."""
    install = f"pip install 'fes-gait[{extra}]', or convert to csv or parquet"
    return SessionLogError(f"{what} needs a library that is not installed: {install}")


def _table_of(kind: type, name: str, time: str = "t_ns") -> Table:
    """The table of a dataclass; enumerations become their names."""
    columns = [Column(column, _KINDS.get(of, "text")) for column, of in get_type_hints(kind).items()]
    return Table(name, tuple(column for column in columns if column.name not in _ARRAYS), time)


_IMU: Final = tuple(Column(name, "int") for name in ("t_ns", "t_sensor_ns")) + tuple(
    Column(f"{what}_{axis}_{unit}", "float") for what, unit in (("acc", "mps2"), ("gyr", "radps")) for axis in "xyz"
)
SAMPLES: Final = {sensor: Table(f"imu_{sensor}", _IMU) for sensor in signals.SENSORS}
MARKS: Final = Table("marks", (Column("t_ns", "int"), Column("text", "text")))
LATENCY: Final = Table("latency", (Column("t_ns", "int"), Column("latency_ns", "int")))
PHASES: Final = Table("phases", (*_table_of(PhaseChange, "phases").columns, Column("phase", "int")))
_STRIDE: Final = _table_of(signals.StrideResult, "strides", "t_end_ns")
STRIDES: Final = replace(_STRIDE, columns=(*_STRIDE.columns, Column("mark", "text")))
_PATH: Final = (Column("t_ns", "int"), Column("foot", "text"), Column("number", "int"))
_PLACE: Final = ("x_m", "y_m", "z_m", "pitch_rad", "roll_rad")
PATHS: Final = Table("stride_paths", _PATH + tuple(Column(name, "float") for name in _PLACE))
SINGLES: Final[dict[type, Table]] = {
    signals.StrideResult: STRIDES,
    signals.StimCommand: _table_of(signals.StimCommand, "commands"),
    signals.WireFrame: _table_of(signals.WireFrame, "frames"),
    Received: _table_of(Received, "received"),
    signals.StimStatus: _table_of(signals.StimStatus, "statuses"),
    signals.StimAlive: _table_of(signals.StimAlive, "heartbeats"),
    signals.StimOpened: _table_of(signals.StimOpened, "reopened"),
    signals.OperatorAct: _table_of(signals.OperatorAct, "operator"),
    signals.FootSwitchEvent: _table_of(signals.FootSwitchEvent, "foot_switches"),
    signals.SystemFault: _table_of(signals.SystemFault, "system_faults"),
    Note: _table_of(Note, "notes"),
    signals.Tick: _table_of(signals.Tick, "ticks"),
    PhaseChange: PHASES,
}


def batches(path: Path, exported: Exported, rows: int = BATCH_ROWS) -> Iterator[Batch]:
    """Yield a log's tables in batches of about ``rows``, in the order of the file; memory does not grow with it.

    Damaged places are left out and noted in ``exported``, which is complete when the iteration ends. Its header and
    ``begin_ns`` are there before the first batch.

    SessionLogError: the file cannot be read or is no session log.
    """
    filling: dict[str, Batch] = {}
    runs: list[memoryview] = []
    gathered, timed = 0, False
    for stretch in stretches(Path(path)):
        if isinstance(stretch, Damage):
            exported.damages.append(stretch)
            continue
        exported.ended = stretch.kind == RecordType.SUMMARY
        if stretch.kind == RecordType.SAMPLES:
            runs.append(stretch.payload)
        elif stretch.kind == RecordType.LATENCY:
            t_ns, latency_ns = latency_arrays([stretch.payload])
            _extend(filling, LATENCY, [t_ns.tolist(), latency_ns.tolist()])
        elif isinstance(stretch.value, dict):
            setattr(exported, "header" if stretch.kind == RecordType.HEADER else "summary", stretch.value)
        elif stretch.value is not None:
            _single(filling, stretch.value, exported.marks)
        if not exported.rows and stretch.begin_ns is not None:
            exported.begin_ns = min(exported.begin_ns, stretch.begin_ns) if timed else stretch.begin_ns
            timed = True
        gathered += stretch.count
        if gathered >= rows:
            yield from _all(filling, runs, exported)
            gathered = 0
    yield from _all(filling, runs, exported)


def _all(filling: dict[str, Batch], runs: list[memoryview], exported: Exported) -> Iterator[Batch]:
    samples = SampleParts()
    samples.add(runs)
    for sensor, arrays in samples.arrays().items():
        values = np.hstack([arrays.acc_mps2, arrays.gyr_radps]).T.tolist()
        _extend(filling, SAMPLES[sensor], [arrays.t_ns.tolist(), arrays.t_sensor_ns.tolist(), *values])
    for batch in filling.values():
        exported.rows[batch.table.name] = exported.rows.get(batch.table.name, 0) + len(batch)
        yield batch
    filling.clear()
    runs.clear()


def _extend(filling: dict[str, Batch], table: Table, columns: list[list[Any]]) -> None:
    batch = filling.setdefault(table.name, Batch(table, [[] for _ in table.columns]))
    for column, values in zip(batch.columns, columns, strict=True):
        column.extend(values)


def _single(filling: dict[str, Batch], value: Rare, marks: list[tuple[int, str]]) -> None:
    """``marks``: those so far; a mark joins them, a stride carries the last one before it began."""
    table = SINGLES[type(value)]
    if isinstance(value, Note) and value.source == MARK:
        table = MARKS
        marks.append((value.t_ns, value.text))
    more: dict[str, object] = {}
    if isinstance(value, PhaseChange):
        more["phase"] = int(value.destination)
    elif isinstance(value, signals.StrideResult):
        more["mark"] = next((text for t_ns, text in reversed(marks) if t_ns <= value.t_start_ns), "")
    row = [more[name] if name in more else _plain(getattr(value, name)) for name in table.names]
    _extend(filling, table, [[cell] for cell in row])
    if isinstance(value, signals.StrideResult) and len(value.trajectory_m) == len(value.pitch_rad) > 0:
        n = len(value.pitch_rad)
        t_ns = [value.t_start_ns + (value.t_end_ns - value.t_start_ns) * k // max(n - 1, 1) for k in range(n)]
        roll = value.roll_rad.tolist() or [math.nan] * n  # a shank's
        path = [*value.trajectory_m.T.tolist(), value.pitch_rad.tolist(), roll]
        _extend(filling, PATHS, [t_ns, [value.foot] * n, [value.number] * n, *path])


def _plain(value: Any) -> Any:
    if isinstance(value, Enum):
        return value.name if isinstance(value, IntEnum) else value.value
    return value.hex() if isinstance(value, bytes) else value


ABOUT: Final = "session.json"


def to_csv(log: Path, folder: Path) -> Exported:
    """Write ``folder/TABLE.csv`` for every table that has rows; column names end with their units.

    What is not known is an empty cell, yes and no are true and false.

    SessionLogError: ``folder`` exists, cannot be written, or the log cannot be read.
    """

    def begin(table: Table, exported: Exported, files: ExitStack) -> Callable[[Batch], object]:
        file = files.enter_context((folder / f"{table.name}.csv").open("x", encoding="utf-8", newline=""))
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(table.names)

        def write(batch: Batch) -> None:
            for row in zip(*batch.columns, strict=True):
                writer.writerow([str(cell).lower() if isinstance(cell, bool) else finite_or_none(cell) for cell in row])

        return write

    return _written(log, folder, begin)


def to_parquet(log: Path, folder: Path) -> Exported:
    """Write ``folder/TABLE.parquet`` for every table that has rows; each field's metadata says its unit.

    SessionLogError: ``folder`` exists, cannot be written, or the log cannot be read.
    """
    import pyarrow as pa
    from pyarrow import parquet

    kinds = {"int": pa.int64(), "float": pa.float64(), "bool": pa.bool_(), "text": pa.string()}

    def begin(table: Table, exported: Exported, files: ExitStack) -> Callable[[Batch], object]:
        about = json.dumps(finite_or_none(exported.header), ensure_ascii=False)
        fields = [pa.field(each.name, kinds[each.kind], metadata={"unit": each.unit}) for each in table.columns]
        schema = pa.schema(fields, metadata={"table": table.name, "session_header": about})
        place = folder / f"{table.name}.parquet"
        writer = files.enter_context(parquet.ParquetWriter(place, schema, compression="zstd"))

        def write(batch: Batch) -> None:
            arrays = [pa.array(values, each.type) for values, each in zip(batch.columns, schema, strict=True)]
            writer.write_table(pa.Table.from_arrays(arrays, schema=schema))

        return write

    return _written(log, folder, begin)


def _written(
    log: Path, folder: Path, begin: Callable[[Table, Exported, ExitStack], Callable[[Batch], object]]
) -> Exported:
    """``begin`` opens a table's file and gives what writes a batch into it."""
    exported, writers = Exported(), dict[str, Callable[[Batch], object]]()
    with _new_folder(folder), ExitStack() as files:
        for batch in batches(log, exported):
            name = batch.table.name
            if name not in writers:
                writers[name] = begin(batch.table, exported, files)
            writers[name](batch)
        about = finite_or_none({"header": exported.header, "summary": exported.summary, "rows": exported.rows})
        (folder / ABOUT).write_text(json.dumps(about, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    return exported


@contextmanager
def _new_folder(folder: Path) -> Iterator[None]:
    """A folder that was not there before; OSErrors inside become SessionLogErrors that name it."""
    try:
        folder.mkdir(parents=True)
    except OSError as error:
        raise not_made(folder, error, ANOTHER) from error
    try:
        yield
    except SessionLogError:
        if not any(folder.iterdir()):
            folder.rmdir()
        raise
    except OSError as error:
        raise SessionLogError(
            f"{folder}: cannot be written: {error.strerror or error}. What is in it is not complete: make "
            f"room and convert again into another folder"
        ) from error
