"""A session log as tables, batch by batch, and these as CSV, Parquet, MCAP; the log as C3D.

MCAP, for Foxglove and PlotJuggler: a topic for each table, ``/imu/left_foot``, ``/phases`` …; a JSON message a row,
with schemas, in zstd chunks. Log time is ns since 1970 where the header says when the session was begun, else since its
first moment.

C3D, which motion laboratories open (Mokka, Visual3D, Nexus), by the library ezc3d:

- *Analog*: each sensor's acceleration and rotation rate, its phase (0 stance, 1 pre-swing, 2 swing, 3 loading
  response), and each channel's commanded current, at the fastest sensor's rate.
- *Points*: each foot sensor's trajectory from the start of its stride (x forward, z up), invalid outside strides.
- *Events*: foot off and foot strike of each foot, as the phase machine saw them.

C3D has one rate for all and no missing analog values: sensors are interpolated onto the common times, and a channel
``….Present`` is 0 where a gap was filled with zeros.
"""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from datetime import datetime
from enum import Enum, IntEnum
from pathlib import Path
from typing import Any, BinaryIO, Final, get_type_hints

import numpy as np

from fes import __version__, signals
from fes.session_log import read_session
from fes.session_log.codec import Rare, SampleParts, latency_arrays
from fes.session_log.framing import Received, RecordType, SessionLogError, SessionRecord, not_made
from fes.session_log.repair import Damage, stretches
from fes.signals import BoolArray, FloatArray, IntArray, StimCommand, StrideResult
from fes.walk_record import MARK, Note, SampleArrays, finite_or_none
from statemachine.phases import Phase, PhaseChange

BATCH_ROWS: Final = 20_000
ANOTHER: Final = "choose another with --out"
UNITS: Final = {name: name for name in ("ns", "ms", "rad", "m")} | {"ma": "mA", "us": "µs", "uc": "µC", "hz": "Hz"}
UNITS.update({"mps2": "m/s²", "radps": "rad/s", "mps": "m/s"})
_ARRAYS = ("trajectory_m", "pitch_rad", "roll_rad", "left_over")
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


_LARGEST_TIME: Final = (1 << 63) - 1
_JSON_TYPES: Final = {"int": ["integer", "null"], "float": ["number", "null"], "bool": ["boolean", "null"]}


def to_mcap(log: Path, target: Path) -> Exported:
    """Write the MCAP file ``target``.

    SessionLogError: ``target`` exists or cannot be written, the log cannot be read, or the library is not there.
    """
    try:
        from mcap.writer import Writer
    except ImportError as error:
        raise library_missing("MCAP", "mcap") from error
    exported = Exported()
    try:
        file: BinaryIO = target.open("xb")
    except OSError as error:
        raise not_made(target, error, ANOTHER) from error
    try:
        with file:
            writer: Any = Writer(file)
            writer.start("", f"fes {__version__}")
            _messages(writer, log, exported)
            writer.finish()
    except OSError as error:
        target.unlink(missing_ok=True)
        raise SessionLogError(
            f"{target}: cannot be written: {error.strerror or error}; make room, or use --out"
        ) from error
    except SessionLogError:
        target.unlink(missing_ok=True)
        raise
    return exported


def topic(table: Table) -> str:
    """``/imu/left_foot`` for ``imu_left_foot``, ``/phases`` for ``phases``."""
    return f"/imu/{table.name.removeprefix('imu_')}" if table.name.startswith("imu_") else f"/{table.name}"


def epoch_offset_ns(header: dict[str, Any], first_ns: int) -> tuple[int, bool]:
    """What to add to the session's times to get ns since 1970, and True; or ns since its first moment, and False.

    A live header says its monotonic time at ``created``; a replay's first sample counts as ``created``.
    """
    try:
        created = datetime.fromisoformat(header["created"])
        since_1970_ns = int(created.timestamp()) * 1_000_000_000
    except (KeyError, TypeError, ValueError, OverflowError):
        return -first_ns, False
    at_ns = header.get("created_t_ns")
    return since_1970_ns - (at_ns if isinstance(at_ns, int) else first_ns), True


def _messages(writer: Any, log: Path, exported: Exported) -> None:
    channels: dict[str, int] = {}
    offset_ns: int | None = None
    for batch in batches(log, exported):
        if offset_ns is None:
            offset_ns, absolute = epoch_offset_ns(exported.header, exported.begin_ns)
            since = "1970 (the host's clock when the session began)" if absolute else "the first moment"
            clock = {"log_time": f"ns since {since}", "t_ns": f"log_time - ({offset_ns})"}
            writer.add_metadata("fes_session", {"header": json.dumps(finite_or_none(exported.header)), **clock})
        name = batch.table.name
        if name not in channels:
            schema = json.dumps(_schema(batch.table)).encode()
            schema_id = writer.register_schema(f"fes.{name}", "jsonschema", schema)
            channels[name] = writer.register_channel(topic(batch.table), "json", schema_id)
        for cells in zip(*batch.columns, strict=True):
            values = dict(zip(batch.table.names, map(finite_or_none, cells), strict=True))
            log_time = min(max(values[batch.table.time] + offset_ns, 0), _LARGEST_TIME)
            data = json.dumps(values, separators=(",", ":"), ensure_ascii=False).encode()
            writer.add_message(channels[name], log_time, data, log_time)
    end = {"summary": json.dumps(finite_or_none(exported.summary)), "rows": json.dumps(exported.rows)}
    writer.add_metadata("fes_summary", end)


def _schema(table: Table) -> dict[str, Any]:
    units = {column.name: {"description": f"unit: {column.unit}"} if column.unit else {} for column in table.columns}
    properties = {
        each.name: {"type": _JSON_TYPES.get(each.kind, "string"), **units[each.name]} for each in table.columns
    }
    return {"title": f"fes.{table.name}", "type": "object", "properties": properties}


MAX_FRAMES: Final = 65_535  # the format counts frames in 16 bits
LONGEST_GAP: Final = 2.5  # usual intervals; beyond it samples are missing
_EVENTS: Final = {Phase.SWING: "Foot Off", Phase.LOADING_RESPONSE: "Foot Strike", Phase.STANCE: "Foot Strike"}
_AXES: Final = "XYZ"
Channel = tuple[str, str, FloatArray]  # label, unit, values
FootEvent = tuple[float, str, str]  # s, foot, what


def to_c3d(log: Path, target: Path) -> Exported:
    """Write the C3D file ``target``.

    SessionLogError: ``target`` exists or cannot be written, the log cannot be read, holds no samples or is too long for
    the format, or the library is not there.
    """
    try:
        import ezc3d
    except ImportError as error:
        raise library_missing("C3D", "c3d") from error
    if target.exists():
        raise not_made(target, FileExistsError(), ANOTHER)
    record = read_session(log)
    sensors = {sensor: arrays for sensor, arrays in record.samples.items() if len(arrays.t_ns) >= 2}
    if not sensors:
        raise SessionLogError(f"{log}: holds no sensor's samples, so there is nothing to write as C3D")
    file: Any = ezc3d.c3d()
    exported = _fill(file, log, record, sensors)
    try:
        with target.open("xb"):
            pass
        file.write(str(target))
    except (OSError, RuntimeError) as error:
        target.unlink(missing_ok=True)
        raise SessionLogError(f"{target}: cannot be written: {error}; make room, or use --out") from error
    return exported


def _fill(file: Any, log: Path, record: SessionRecord, sensors: dict[str, SampleArrays]) -> Exported:
    times = {sensor: _sampled_at_s(arrays) for sensor, arrays in sensors.items()}
    begin_s = min(float(at[0]) for at in times.values())
    seconds = max(float(at[-1]) for at in times.values()) - begin_s
    rate_hz = 1.0 / min(float(np.median(np.diff(at))) for at in times.values())
    rate_hz = float(round(rate_hz)) if abs(rate_hz - round(rate_hz)) < 0.01 * rate_hz else rate_hz
    frames = math.floor(seconds * rate_hz) + 1
    per_frame = math.ceil(frames / MAX_FRAMES)
    frames = frames // per_frame
    if frames < 2 or per_frame > MAX_FRAMES:
        raise SessionLogError(f"{log}: {seconds:.3g} s at {rate_hz:.4g} Hz cannot be held by a C3D file")
    grid_s = begin_s + np.arange(frames * per_frame) / rate_hz
    channels: list[Channel] = []
    for sensor, arrays in sensors.items():
        present = _present(times[sensor], grid_s)
        for what, unit, values in (("Acc", "m/s^2", arrays.acc_mps2), ("Gyr", "rad/s", arrays.gyr_radps)):
            for axis, letter in enumerate(_AXES):
                column = np.interp(grid_s, times[sensor], np.nan_to_num(values[:, axis], posinf=0.0, neginf=0.0))
                channels.append((f"{sensor}.{what}{letter}", unit, np.where(present, column, 0.0)))
        channels.append((f"{sensor}.Present", "", present.astype(np.float64)))
    for foot in sorted({change.foot for change in record.phases}):
        changes = [change for change in record.phases if change.foot == foot]
        phases = np.array([float(change.destination) for change in changes])
        held, _ = _held(changes, phases, grid_s, before=float(changes[0].source))
        channels.append((f"{foot}.Phase", "", held))
    for number in sorted({command.channel for command in record.commands}):
        own = [command for command in record.commands if command.channel == number]
        channels.append((f"stimulation.{number}", "mA", _currents(own, grid_s)))
    frame_s = grid_s[::per_frame]
    feet = sorted({stride.foot for stride in record.strides if len(stride.pitch_rad)})
    points = np.full((4, len(feet), frames), np.nan)
    points[3] = 1.0
    for k, foot in enumerate(feet):
        points[:3, k] = _trajectories([one for one in record.strides if one.foot == foot], frame_s)
    events = sorted(
        (1e-9 * one.t_ns - begin_s, one.foot, _EVENTS[one.destination])
        for one in record.phases
        if one.destination in _EVENTS and (one.destination != Phase.STANCE or one.source == Phase.SWING)
    )
    _parameters(file, rate_hz, per_frame, feet, channels, events)
    file["data"]["points"] = points
    file["data"]["analogs"] = np.asarray([values for _, _, values in channels])[np.newaxis]
    counts = {"analog channels": len(channels), "analog samples": len(grid_s)}
    counts |= {"points": len(feet), "events": len(events)}
    return Exported(record.header, record.summary, record.complete, rows=counts, begin_ns=round(1e9 * begin_s))


def _sampled_at_s(arrays: SampleArrays) -> FloatArray:
    """(N,) when the samples were taken, on the host's clock, increasing: the sensor's own clock, drift taken out.

    Where the sensor's clock cannot be followed (set anew, stamps doubled), the times of arrival.
    """
    arrived, stamped = 1e-9 * arrays.t_ns, 1e-9 * arrays.t_sensor_ns
    if np.all(np.diff(stamped) > 0.0):
        drift, offset = np.polyfit(stamped - stamped[0], arrived - stamped, 1)
        at: FloatArray = stamped + offset + drift * (stamped - stamped[0])
        if np.max(np.abs(arrived - at)) < 0.25:
            return at
    increasing: FloatArray = np.maximum.accumulate(arrived) + 1e-9 * np.arange(len(arrived))
    return increasing


def _present(t_s: FloatArray, grid_s: FloatArray) -> BoolArray:
    """(M,) whether a sample was there: between two that are no more than a few intervals apart."""
    after = np.clip(np.searchsorted(t_s, grid_s), 1, len(t_s) - 1)
    short = (t_s[after] - t_s[after - 1]) <= LONGEST_GAP * float(np.median(np.diff(t_s)))
    inside: BoolArray = short & (grid_s >= t_s[0] - 1e-6) & (grid_s <= t_s[-1] + 1e-6)
    return inside


def _held(
    decided: Sequence[PhaseChange | StimCommand], values: FloatArray, grid_s: FloatArray, *, before: float
) -> tuple[FloatArray, IntArray]:
    """The last value at each time of the grid, and which one that is (-1: none yet)."""
    which = np.searchsorted(np.array([1e-9 * one.t_ns for one in decided]), grid_s, side="right") - 1
    return np.where(which >= 0, values[which], before), which


def _currents(commands: Sequence[StimCommand], grid_s: FloatArray) -> FloatArray:
    """(M,) mA: what the newest command asks for while it is valid."""
    asked_ma = np.array([one.current_ma * one.on for one in commands])
    current_ma, which = _held(commands, asked_ma, grid_s, before=0.0)
    until_s = np.array([1e-9 * one.t_ns + 1e-3 * one.validity_ms for one in commands])
    return np.where((which >= 0) & (grid_s <= until_s[which]), current_ma, 0.0)


def _trajectories(strides: Sequence[StrideResult], frame_s: FloatArray) -> FloatArray:
    """(3, F) mm from each stride's start, NaN where there is none."""
    trajectories = np.full((3, len(frame_s)), np.nan)
    for stride in strides:
        k = len(stride.pitch_rad)
        if k < 2 or len(stride.trajectory_m) != k:
            continue
        t_s = np.linspace(1e-9 * stride.t_start_ns, 1e-9 * stride.t_end_ns, k)
        first, last = np.searchsorted(frame_s, [t_s[0], t_s[-1]])
        for axis in range(3):
            trajectories[axis, first:last] = 1e3 * np.interp(frame_s[first:last], t_s, stride.trajectory_m[:, axis])
    return trajectories


def _parameters(
    file: Any, rate_hz: float, per_frame: int, feet: list[str], channels: list[Channel], events: list[FootEvent]
) -> None:
    points: dict[str, list[Any]] = {"RATE": [rate_hz / per_frame], "LABELS": [f"{foot}.sensor" for foot in feet]}
    points |= {"DESCRIPTIONS": ["sensor, from the start of each stride" for _ in feet], "UNITS": ["mm"]}
    analog: dict[str, list[Any]] = {"RATE": [rate_hz], "LABELS": [label for label, _, _ in channels]}
    analog["UNITS"] = [unit for _, unit, _ in channels]
    for group, values in (("POINT", points), ("ANALOG", analog)):
        for name, value in values.items():
            file["parameters"][group][name]["value"] = value
    file.add_parameter("EVENT", "USED", [len(events)])
    if events:
        minutes = [math.floor(t_s / 60.0) for t_s, _, _ in events]
        seconds = [t_s - 60.0 * whole for whole, (t_s, _, _) in zip(minutes, events, strict=True)]
        file.add_parameter("EVENT", "CONTEXTS", [foot.split("_")[0].capitalize() for _, foot, _ in events])
        file.add_parameter("EVENT", "LABELS", [label for _, _, label in events])
        file.add_parameter("EVENT", "TIMES", np.array([minutes, seconds], np.float64))
