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
from typing import BinaryIO, Final

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
    """What a record holds. Numbers are never reused."""

    HEADER = 1
    SUMMARY = 2
    SAMPLES = 3
    TICK = 4
    ACT = 5
    STATUS = 6
    ALIVE = 7
    COMMAND = 8
    FRAME = 9
    PHASE = 10
    STRIDE = 11
    NOTE = 12
    LATENCY = 13
    STIM_OPENED = 14
    FOOT_SWITCH = 15
    SYSTEM_FAULT = 16
    RECEIVED = 17


_KNOWN = frozenset(int(kind) for kind in RecordType)
_KIND_BYTE = {int(kind): kind.to_bytes(1, "little") for kind in RecordType}


def framed(kind: int, payload: bytes | bytearray) -> bytes:
    """Return one whole record."""
    body = _KIND_BYTE[kind] + payload
    return _FRONT.pack(len(body), zlib.crc32(body, len(body))) + body


def unreadable(path: Path, error: OSError) -> SessionLogError:
    """Why a file cannot be read at all."""
    return SessionLogError(f"{path}: cannot be read: {error.strerror or error}. Name an existing session log.")


def wrong_start(path: Path, start: bytes) -> SessionLogError:
    """Why a file whose first bytes are not :data:`MAGIC` is no log that can be read."""
    why = f"is not a session log (it starts with {start!r}). A session log is what `fes run` or `fes replay` leaves."
    if start[:-1] == MAGIC[:-1] and len(start) == len(MAGIC):
        why = f"is a session log of format {start[-1]}, this fes reads format {MAGIC[-1]}; use the fes that wrote it"
    elif MAGIC.startswith(start):
        stopped = "the session stopped before anything was stored, so there is nothing to recover"
        why = f"holds only {len(start)} bytes; {stopped}"
    return SessionLogError(f"{path}: {why}")


class LogScan:
    """One pass over a log's whole records, up to the first that is torn or damaged.

    Iterating yields (type, payload) with the payload as a view into the file; afterwards ``lost`` says in words
    what lies behind the last good record, "" if nothing, and ``good_bytes`` how far the file is whole. Of a log that
    grows, another scan goes on ``from_byte``, where the last one found it whole.
    """

    def __init__(self, path: Path, from_byte: int = 0) -> None:
        self.path = path
        self.lost = ""
        self.good_bytes = 0
        self._begin = max(from_byte, len(MAGIC))

    def __iter__(self) -> Iterator[tuple[int, memoryview]]:
        try:
            # not mapped into memory: a file cut short while it is read would end the process
            with self.path.open("rb", buffering=0) as file:
                size = file.seek(0, 2)
                file.seek(0)
                start = file.read(len(MAGIC))
                if start != MAGIC:
                    raise wrong_start(self.path, start)
                file.seek(self._begin)
                yield from self._records(file, size)
        except OSError as error:
            raise unreadable(self.path, error) from error

    def _records(self, file: BinaryIO, size: int) -> Iterator[tuple[int, memoryview]]:
        unpack, crc32, known, head = HEAD.unpack_from, zlib.crc32, _KNOWN, HEAD_BYTES
        at, block_at, block = self._begin, self._begin, memoryview(b"")
        while at < size:
            here, fault = at - block_at, ""
            if len(block) - here < head:
                block, block_at, here = _further(file, block[here:], BLOCK_BYTES), at, 0
            if len(block) < head:
                fault = "a record's first bytes only"
            else:
                length, checksum, kind = unpack(block, here)
                end = here + 8 + length
                if end > len(block) and 0 < length <= MAX_RECORD_BYTES:
                    block, block_at, here, end = _further(file, block[here:], length), at, 0, 8 + length
                if not 0 < length <= MAX_RECORD_BYTES:
                    fault = "no record starts there"
                elif end > len(block):
                    fault = "a record cut short"
                elif crc32(block[here + 8 : end], length) != checksum:
                    fault = "a damaged record (its checksum differs)"
                elif kind not in known:
                    fault = f"a record of unknown type {kind}"
            if fault:
                self.lost = f"the last {size - at} of {size} bytes, from byte {at} on: {fault}"
                break
            payload = block[here + head : end]
            at = self.good_bytes = block_at + end
            yield kind, payload
        self.good_bytes = at


def _further(file: BinaryIO, left: memoryview, most: int) -> memoryview:
    """What is left of a block, and at least ``most`` bytes more of the file, if it has as many."""
    parts, wanted = [bytes(left)], max(most, BLOCK_BYTES)
    while wanted > 0 and (part := file.read(wanted)):
        parts.append(part)
        wanted -= len(part)
    return memoryview(b"".join(parts))
