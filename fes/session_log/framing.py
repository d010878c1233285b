"""The log's bytes: a magic, then records of ``u32 length | u32 crc32 | u8 type | payload``, little endian.

``length`` counts type and payload; the checksum covers both and starts from ``length``, so that a wrong length
shows as well. Zeros, as a file system may leave after a power cut, are no record: a length of 0 is not allowed.

What a session leaves behind, as plain values.
"""

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from enum import IntEnum
from pathlib import Path
from typing import BinaryIO, Final, Self

from fes.signals import FootSwitchEvent, StimOpened, SystemFault, WireFrame
from fes.walk_record import WalkRecord


class SessionLogError(ValueError):
    """A session log cannot be written or read; the message names the file and says what to do."""


def not_made(path: Path, error: OSError, instead: str) -> SessionLogError:
    """Why a new file or folder cannot be made; ``instead``: what to do where it is there already."""
    if isinstance(error, FileExistsError):
        return SessionLogError(f"{path}: is there already and is not overwritten; {instead}")
    return SessionLogError(f"{path}: cannot be made: {error.strerror or error}")


@dataclass(frozen=True, slots=True)
class Received:
    """Bytes that a serial stimulator's line brought, as they came; ``t_ns`` is the event that they were looked for at.

    What such a port sends next depends on them (what is still unanswered, what must be asked), so a replay needs them.
    """

    t_ns: int
    data: bytes


@dataclass(eq=False, repr=False)
class SessionRecord(WalkRecord):
    """All that a session left behind: the walk, and what came in and went out. Lists are in the order of writing."""

    frames: list[WireFrame] = field(default_factory=list)
    reopened: list[StimOpened] = field(default_factory=list)
    switches: list[FootSwitchEvent] = field(default_factory=list)
    faults: list[SystemFault] = field(default_factory=list)
    received: list[Received] = field(default_factory=list)


MAGIC: Final = b"\x89FESLOG\x01"  # the last byte is the format's version
MAX_RECORD_BYTES: Final = 1 << 26
BLOCK_BYTES: Final = 1 << 20  # read at a time

HEAD = struct.Struct("<IIB")
_FRONT = struct.Struct("<II")
HEAD_BYTES: Final = HEAD.size


class RecordType(IntEnum):
    """What a record holds; numbers are never reused.

    ``words`` are for one and for several; ``field`` is where a :class:`SessionRecord` gathers single values.
    """

    words: tuple[str, str]
    field: str

    def __new__(cls, number: int, one: str = "", several: str = "", field: str = "") -> Self:
        """A member, whose value is the number alone."""
        member = int.__new__(cls, number)
        member._value_ = number
        member.words, member.field = (one, several or f"{one}s"), field
        return member

    HEADER = 1, "header"
    SUMMARY = 2, "summary", "summaries"
    SAMPLES = 3, "run of samples", "runs of samples"
    TICK = 4, "tick"
    ACT = 5, "operator's act", "", "acts"
    STATUS = 6, "stimulator's answer", "", "statuses"
    ALIVE = 7, "stimulator's heartbeat", "", "alive"
    COMMAND = 8, "command", "", "commands"
    FRAME = 9, "frame", "", "frames"
    PHASE = 10, "phase change", "", "phases"
    STRIDE = 11, "stride", "", "strides"
    NOTE = 12, "note", "", "notes"
    LATENCY = 13, "run of latencies", "runs of latencies"
    STIM_OPENED = 14, "reopening of the stimulator", "reopenings of the stimulator", "reopened"
    FOOT_SWITCH = 15, "foot switch's event", "", "switches"
    SYSTEM_FAULT = 16, "system fault", "", "faults"
    RECEIVED = 17, "stimulator's bytes", "stimulator's bytes", "received"


_KINDS: Final = {int(kind): kind for kind in RecordType}
_KIND_BYTE = {int(kind): kind.to_bytes(1, "little") for kind in RecordType}


def framed(kind: int, payload: bytes | bytearray) -> bytes:
    """Return one whole record."""
    body = _KIND_BYTE[kind] + payload
    return _FRONT.pack(len(body), zlib.crc32(body, len(body))) + body


def unreadable(path: Path, error: OSError) -> SessionLogError:
    """Why a file cannot be read at all."""
    name = "Name the session.feslog in it." if isinstance(error, IsADirectoryError) else "Name an existing session log."
    return SessionLogError(f"{path}: cannot be read: {error.strerror or error}. {name}")


def wrong_start(path: Path, start: bytes) -> SessionLogError:
    """Why a file whose first bytes are not :data:`MAGIC` is no log that can be read."""
    why = f"is not a session log (it starts with {start!r}). A session log is what `fes run` or `fes replay` leaves."
    if start[:-1] == MAGIC[:-1] and len(start) == len(MAGIC):
        why = f"is a session log of format {start[-1]}, this fes reads format {MAGIC[-1]}; use the fes that wrote it"
    elif MAGIC.startswith(start):
        stopped = "the session stopped before anything was stored, so there is nothing to recover"
        why = f"holds only {len(start)} bytes; {stopped}"
    return SessionLogError(f"{path}: {why}")


@dataclass(frozen=True, slots=True)
class Refused:
    """Why there is no whole record at a place; ``end`` is where one would end, by its head.

    ``checked``: its checksum is right, and so is its length.
    """

    why: str
    kind: RecordType | None = None
    end: int = 0
    checked: bool = False


def record_at(file: BinaryIO, at: int, size: int) -> tuple[RecordType, bytes] | Refused:
    """Type and payload of the record that begins at byte ``at`` of ``size``, where the ``file`` stands."""
    head = file.read(HEAD_BYTES)
    if len(head) < HEAD_BYTES:
        return Refused("a record's first bytes only")
    length, checksum, number = HEAD.unpack(head)
    kind, end = _KINDS.get(number), at + 8 + length
    if not 0 < length <= MAX_RECORD_BYTES:
        return Refused("no record starts there")
    if end > size:
        return Refused("a record cut short", kind, end)
    payload = file.read(length - 1)
    if zlib.crc32(payload, zlib.crc32(head[8:], length)) != checksum:
        return Refused("a damaged record (its checksum differs)", kind, end)
    if kind is None:
        return Refused(f"a record of unknown type {number}", None, end, checked=True)
    return kind, payload


class LogScan:
    """One pass over a log's whole records, up to the first that is torn or damaged.

    Iterating yields (type, payload); afterwards ``lost`` says in words what lies behind the last good record, "" if
    nothing, and ``good_bytes`` how far the file is whole. Of a log that grows, another scan goes on ``from_byte``,
    where the last one found it whole.
    """

    def __init__(self, path: Path, from_byte: int = 0) -> None:
        self.path = path
        self.lost = ""
        self.good_bytes = 0
        self._begin = max(from_byte, len(MAGIC))

    def __iter__(self) -> Iterator[tuple[RecordType, memoryview]]:
        try:
            # not mapped into memory: a file cut short while it is read would end the process
            with self.path.open("rb", buffering=BLOCK_BYTES) as file:
                size = file.seek(0, 2)
                file.seek(0)
                start = file.read(len(MAGIC))
                if start != MAGIC:
                    raise wrong_start(self.path, start)
                at = self.good_bytes = file.seek(self._begin)
                while at < size:
                    record = record_at(file, at, size)
                    if isinstance(record, Refused):
                        self.lost = f"the last {size - at} of {size} bytes, from byte {at} on: {record.why}"
                        return
                    kind, payload = record
                    at = self.good_bytes = at + HEAD_BYTES + len(payload)
                    yield kind, memoryview(payload)
        except OSError as error:
            raise unreadable(self.path, error) from error
