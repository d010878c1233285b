"""Tables → one MCAP file that Foxglove and PlotJuggler open: JSON messages with their schemas, in zstd chunks.

A topic for each table, ``/imu/left_foot``, ``/phases`` …; one message a row. Log time is ns since 1970 where the header
says when the session was begun, else since its first moment.
"""

import json
from datetime import datetime
from pathlib import Path
from typing import Any, BinaryIO, Final

from fes import __version__
from fes.session_log.export.tables import ANOTHER, Exported, Table, batches, library_missing
from fes.session_log.framing import SessionLogError, not_made
from fes.walk_record import finite_or_none

EXTRA: Final = "mcap"
_LARGEST_TIME: Final = (1 << 63) - 1
_JSON_TYPES: Final = {"int": ["integer", "null"], "float": ["number", "null"], "bool": ["boolean", "null"]}


def to_mcap(log: Path, target: Path) -> Exported:
    """Write the MCAP file ``target``.

    SessionLogError: ``target`` exists or cannot be written, the log cannot be read, or the library is not there.
    """
    try:
        from mcap.writer import Writer
    except ImportError as error:
        raise library_missing("MCAP", EXTRA) from error
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
