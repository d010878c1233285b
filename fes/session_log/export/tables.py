"""A session log as tables, batch by batch: what every file format that it is converted to is fed with."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from enum import Enum, IntEnum
from pathlib import Path
from typing import Any, Final

import numpy as np

from fes import signals
from fes.session_log.codec import Rare, SampleParts, latency_arrays
from fes.session_log.framing import RecordType
from fes.session_log.record import Received
from fes.session_log.repair import Damage, stretches
from fes.walk_record import Note
from statemachine.phases import PhaseChange

BATCH_ROWS: Final = 20_000
ANOTHER: Final = "choose another with --out"
UNITS: Final = {
    "mps2": "m/s²",
    "radps": "rad/s",
    "mps": "m/s",
    "ns": "ns",
    "ms": "ms",
    "ma": "mA",
    "us": "µs",
    "uc": "µC",
    "hz": "Hz",
    "rad": "rad",
    "m": "m",
}
_ARRAYS = ("trajectory_m", "pitch_rad")
_TYPES: Final = {
    "int": "int",
    "int | None": "int",
    "float": "float",
    "bool": "bool",
    "bool | None": "bool",
    "bytes": "text",
    "str": "text",
}


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


@dataclass(slots=True)
class Batch:
    """Some rows of a table, as a list for each column."""

    table: Table
    columns: list[list[Any]]

    def __len__(self) -> int:
        return len(self.columns[0])


@dataclass(slots=True)
class Exported:
    """What went by: ``rows`` by table, the header, the summary, damaged places; ``begin_ns`` is its first time."""

    header: dict[str, Any] = field(default_factory=dict)
    summary: dict[str, Any] = field(default_factory=dict)
    ended: bool = False
    damages: list[Damage] = field(default_factory=list)
    rows: dict[str, int] = field(default_factory=dict)
    begin_ns: int = 0


def _table_of(kind: type, name: str, time: str = "t_ns") -> Table:
    """The table of a dataclass; enumerations become their names."""
    columns = [Column(item.name, _TYPES.get(str(item.type), "text")) for item in dataclasses.fields(kind)]
    return Table(name, tuple(column for column in columns if column.name not in _ARRAYS), time)


_IMU: Final = tuple(Column(name, "int") for name in ("t_ns", "t_sensor_ns")) + tuple(
    Column(f"{what}_{axis}_{unit}", "float") for what, unit in (("acc", "mps2"), ("gyr", "radps")) for axis in "xyz"
)
SAMPLES: Final = {sensor: Table(f"imu_{sensor}", _IMU) for sensor in signals.SENSORS}
LATENCY: Final = Table("latency", (Column("t_ns", "int"), Column("latency_ns", "int")))
PHASES: Final = Table("phases", (*_table_of(PhaseChange, "phases").columns, Column("phase", "int")))
PATHS: Final = Table(
    "stride_paths",
    (
        Column("t_ns", "int"),
        Column("foot", "text"),
        Column("number", "int"),
        *(Column(f"{axis}_m", "float") for axis in "xyz"),
        Column("pitch_rad", "float"),
    ),
)
SINGLES: Final[dict[type, Table]] = {
    signals.StrideResult: _table_of(signals.StrideResult, "strides", "t_end_ns"),
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

    Raises:
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
            _single(filling, stretch.value)
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


def _single(filling: dict[str, Batch], value: Rare) -> None:
    table = SINGLES[type(value)]
    names = [column.name for column in table.columns]
    if isinstance(value, PhaseChange):
        row = [_plain(getattr(value, name)) for name in names[:-1]] + [int(value.destination)]
    else:
        row = [_plain(getattr(value, name)) for name in names]
    _extend(filling, table, [[cell] for cell in row])
    if isinstance(value, signals.StrideResult) and len(value.trajectory_m) == len(value.pitch_rad) > 0:
        n = len(value.pitch_rad)
        t_ns = [value.t_start_ns + (value.t_end_ns - value.t_start_ns) * k // max(n - 1, 1) for k in range(n)]
        path = [*value.trajectory_m.T.tolist(), value.pitch_rad.tolist()]
        _extend(filling, PATHS, [t_ns, [value.foot] * n, [value.number] * n, *path])


def _plain(value: Any) -> Any:
    if isinstance(value, bytes):
        return value.hex()
    if isinstance(value, IntEnum):
        return value.name
    return value.value if isinstance(value, Enum) else value


def finite_or_none(value: Any) -> Any:
    """The value, also a nested one, with None for numbers that are not known (NaN, infinite)."""
    if isinstance(value, dict):
        return {key: finite_or_none(item) for key, item in value.items()}
    if isinstance(value, list):
        return [finite_or_none(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
