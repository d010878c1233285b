"""Reading a session log, whole or torn: everything before the first bad record, and what was lost behind it."""

import gc
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from fes.session_log.codec import (
    Growing,
    RareEvent,
    SampleParts,
    decode,
    decode_json,
    decode_many,
    latency_arrays,
    samples_of,
)
from fes.session_log.framing import LogScan, Received, RecordType, SessionLogError, SessionRecord
from fes.signals import Event, WireFrame

TOGETHER = 10_000  # records that are decoded in one go

_BAD_PAYLOAD = (struct.error, ValueError, KeyError, IndexError, TypeError, OverflowError)
_RUNS = (RecordType.SAMPLES, RecordType.LATENCY, RecordType.TICK)
_NO_INPUTS = frozenset((*_RUNS[:2], RecordType.HEADER, RecordType.SUMMARY, RecordType.COMMAND, RecordType.PHASE))
_NO_INPUTS |= {RecordType.STRIDE, RecordType.NOTE}


def read_session(path: Path, leave_out: frozenset[RecordType] = frozenset()) -> SessionRecord:
    """Read all that a session left behind; types of single records to ``leave_out`` stay empty.

    SessionLogError: the file cannot be read, is no session log, or was stopped before its header was stored. A torn or
    damaged end is no error: see ``SessionRecord.complete`` and ``lost``.
    """
    scan = LogScan(Path(path))
    records = iter(scan)
    record = SessionRecord(_header(records, scan))
    gathered = _Gathered(record, leave_out)
    ended = False
    collected = gc.isenabled()
    gc.disable()  # it would go through all values again and again while they grow, for nothing
    try:
        for kind, payload in records:
            ended = kind == RecordType.SUMMARY
            if ended:
                record.summary = decode_json(payload)
            else:
                gathered.add(kind, payload)
        gathered.end()
    except _BAD_PAYLOAD as error:
        raise _malformed(scan, error) from error
    finally:
        if collected:
            gc.enable()
    record.lost = scan.lost
    record.complete = ended and not scan.lost
    return record


class _Gathered:
    """A log's records on their way into a :class:`SessionRecord`, many of a type at a time."""

    def __init__(self, record: SessionRecord, leave_out: frozenset[RecordType]) -> None:
        self._record = record
        self._singles: dict[int, list[Any]] = {kind: getattr(record, kind.field) for kind in RecordType if kind.field}
        kinds = {*self._singles, *_RUNS} - leave_out
        self._waiting: dict[int, list[memoryview]] = {kind: [] for kind in kinds}
        self._count = 0
        self._samples = SampleParts()
        self._latency_t_ns, self._latency_ns, self._ticks_ns = Growing(np.int64), Growing(np.int64), Growing(np.int64)

    def add(self, kind: int, payload: memoryview) -> None:
        """Take one record in."""
        waiting = self._waiting.get(kind)
        if waiting is not None:
            waiting.append(payload)
            self._count += 1
            if self._count == TOGETHER:
                self._decode_waiting()

    def end(self) -> None:
        """All is there."""
        self._decode_waiting()
        self._record.samples = self._samples.arrays()
        self._record.latency_t_ns, self._record.latency_ns = self._latency_t_ns.whole(), self._latency_ns.whole()
        self._record.ticks_ns = self._ticks_ns.whole()

    def _decode_waiting(self) -> None:
        self._count = 0
        for kind, waiting in self._waiting.items():
            if kind == RecordType.SAMPLES:
                self._samples.add(waiting)
            elif kind == RecordType.LATENCY:
                for column, more in zip((self._latency_t_ns, self._latency_ns), latency_arrays(waiting), strict=True):
                    column.add(more)
            elif kind == RecordType.TICK:
                if odd := [len(payload) for payload in waiting if len(payload) != 8]:
                    raise ValueError(f"a tick of {odd[0]} bytes")
                self._ticks_ns.add(np.frombuffer(b"".join(waiting), "<i8"))
            else:
                self._singles[kind] += decode_many(kind, waiting)
            waiting.clear()


def iter_events(path: Path) -> Iterator[Event]:
    """Yield the events in their original order, for replay; ends where the log is torn.

    SessionLogError: as :func:`read_session`.
    """
    return (each for each in iter_inputs(path) if not isinstance(each, Received | WireFrame))


def iter_inputs(path: Path) -> Iterator[Event | Received | WireFrame]:
    """Yield the events in their original order, and among them what a serial line brought and what went onto the wire.

    SessionLogError: as :func:`read_session`.
    """
    scan = LogScan(Path(path))
    records = iter(scan)
    _header(records, scan)
    try:
        for kind, payload in records:
            if kind == RecordType.SAMPLES:
                yield from samples_of(payload)
            elif kind not in _NO_INPUTS:
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
