"""Reading a session log, whole or torn: everything before the first bad record, and what was lost behind it."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from fes.journal.codec import RareEvent, decode, decode_json
from fes.journal.framing import LogScan, RecordType
from fes.journal.record import Received, SessionLogError, SessionRecord
from fes.journal.runs import latency_arrays, sample_arrays, samples_of
from fes.signals import Event, WireFrame

_BAD_PAYLOAD = (struct.error, ValueError, KeyError, IndexError, TypeError, OverflowError)
_SINGLE_INPUTS = frozenset(
    (
        RecordType.TICK,
        RecordType.ACT,
        RecordType.STATUS,
        RecordType.ALIVE,
        RecordType.STIM_OPENED,
        RecordType.FOOT_SWITCH,
        RecordType.SYSTEM_FAULT,
        RecordType.RECEIVED,
        RecordType.FRAME,
    )
)


def read_session(path: Path) -> SessionRecord:
    """Read all that a session left behind.

    Raises:
        SessionLogError: the file cannot be read, is no session log, or was stopped before its header was stored.
            A torn or damaged end is no error: see ``SessionRecord.complete`` and ``lost``.
    """
    scan = LogScan(Path(path))
    records = iter(scan)
    record = SessionRecord(_header(records, scan))
    singles: dict[int, list[Any]] = {
        RecordType.ACT: record.acts,
        RecordType.STATUS: record.statuses,
        RecordType.ALIVE: record.alive,
        RecordType.PHASE: record.phases,
        RecordType.STRIDE: record.strides,
        RecordType.COMMAND: record.commands,
        RecordType.FRAME: record.frames,
        RecordType.NOTE: record.notes,
        RecordType.STIM_OPENED: record.reopened,
        RecordType.FOOT_SWITCH: record.switches,
        RecordType.SYSTEM_FAULT: record.faults,
        RecordType.RECEIVED: record.received,
    }
    runs: dict[int, list[memoryview]] = {RecordType.SAMPLES: [], RecordType.LATENCY: [], RecordType.TICK: []}
    ended = False
    try:
        for kind, payload in records:
            ended = False
            if kind in runs:
                runs[kind].append(payload)
                if kind == RecordType.TICK and len(payload) != 8:
                    raise ValueError(f"a tick of {len(payload)} bytes")
            elif kind in singles:
                singles[kind].append(decode(kind, payload))
            elif kind == RecordType.SUMMARY:
                record.summary = decode_json(payload)
                ended = True
        record.samples = sample_arrays(runs[RecordType.SAMPLES])
        record.latency_t_ns, record.latency_ns = latency_arrays(runs[RecordType.LATENCY])
        record.ticks_ns = np.frombuffer(b"".join(runs[RecordType.TICK]), "<i8").astype(np.int64)
    except _BAD_PAYLOAD as error:
        raise _malformed(scan, error) from error
    record.lost = scan.lost
    record.complete = ended and not scan.lost
    return record


def iter_events(path: Path) -> Iterator[Event]:
    """Yield the events in their original order, for replay; ends where the log is torn.

    Raises:
        SessionLogError: as :func:`read_session`.
    """
    return (each for each in iter_inputs(path) if not isinstance(each, Received | WireFrame))


def iter_inputs(path: Path) -> Iterator[Event | Received | WireFrame]:
    """Yield the events in their original order, and among them what a serial line brought and what went onto the wire.

    Raises:
        SessionLogError: as :func:`read_session`.
    """
    scan = LogScan(Path(path))
    records = iter(scan)
    _header(records, scan)
    try:
        for kind, payload in records:
            if kind == RecordType.SAMPLES:
                yield from samples_of(payload)
            elif kind in _SINGLE_INPUTS:
                value = decode(kind, payload)
                if isinstance(value, RareEvent | Received | WireFrame):
                    yield value
    except _BAD_PAYLOAD as error:
        raise _malformed(scan, error) from error


def _header(records: Iterator[tuple[int, memoryview]], scan: LogScan) -> dict[str, Any]:
    kind, payload = next(records, (0, memoryview(b"")))
    if kind != RecordType.HEADER:
        raise SessionLogError(
            f"{scan.path}: has no whole header ({scan.lost or 'nothing follows the first bytes'}); "
            f"without it nothing can be recovered"
        )
    try:
        return decode_json(payload)
    except ValueError as error:
        raise _malformed(scan, error) from error


def _malformed(scan: LogScan, error: Exception) -> SessionLogError:
    """A record whose checksum is right and whose content is not: a fault of the program that wrote it."""
    return SessionLogError(
        f"{scan.path}: near byte {scan.good_bytes}: a record is malformed ({error}). `fes recover {scan.path}` makes a "
        f"new log of all that can be read."
    )
