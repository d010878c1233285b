"""Finding every whole record of a damaged session log, in one pass that holds one record at a time.

Behind damage the next record is looked for byte by byte: it is one where length, type and checksum fit and whose
content can be decoded. By chance 32 bits of checksum fit once in 4 · 10⁹ places.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, BinaryIO, Final

import numpy as np

from fes.journal.codec import Rare, decode, decode_json
from fes.journal.framing import HEAD_BYTES, MAGIC, MAX_RECORD_BYTES, RecordType
from fes.journal.record import Note, SessionLogError
from fes.journal.runs import latency_arrays, samples_of
from fes.signals import StrideResult

LONGEST_RESYNC_BYTES: Final = 1 << 20  # of a record looked for behind damage; what is written stays far below
ZEROS: Final = "zeros, as a file system leaves them after a power cut"

_HEAD = struct.Struct("<IIB")
_BLOCK_BYTES: Final = 1 << 20
_CHECKED_PER_BYTE: Final = 64  # bytes summed for each byte searched, so that no file makes the search quadratic
_BAD_CONTENT = (struct.error, ValueError, KeyError, IndexError, TypeError, RecursionError)
_TYPES: Final[dict[str, tuple[type, ...]]] = {
    "int": (int,),
    "int | None": (int, type(None)),
    "float": (float, int),
    "str": (str,),
    "bool": (bool,),
}
_KNOWN = np.isin(np.arange(256), [int(kind) for kind in RecordType])


@dataclass(frozen=True, slots=True)
class Whole:
    """A record whose checksum and content are right, at byte ``at`` of the file.

    ``value`` is what it holds: a mapping for header and summary, None for runs (see ``payload``). ``count`` is how many
    values it holds (a run: its samples or latencies); ``begin_ns`` and ``end_ns`` the time it tells of, if any.
    """

    at: int
    size: int
    kind: RecordType
    payload: memoryview
    value: Rare | dict[str, Any] | None
    count: int = 1
    begin_ns: int | None = None
    end_ns: int | None = None


@dataclass(frozen=True, slots=True)
class Damage:
    """Bytes that are no whole record; ``kind`` is what they were, where their first bytes still tell."""

    at: int
    size: int
    why: str
    kind: RecordType | None = None


@dataclass(frozen=True, slots=True)
class _Refused:
    """Why there is no whole record at a place; ``end`` is where one would end, by its head."""

    why: str
    kind: RecordType | None = None
    end: int = 0
    checked: bool = False  # the checksum was right


def pieces(path: Path) -> Iterator[Whole | Damage]:
    """Yield what a session log consists of, without a byte left out, in the order of the file.

    Raises:
        SessionLogError: the file cannot be read or is no session log of this format.
    """
    try:
        with Path(path).open("rb", buffering=_BLOCK_BYTES) as file:
            size = file.seek(0, 2)
            yield from _magic(Path(path), file, size)
            at = len(MAGIC)
            while at < size:
                found = _record(file, at, size)
                piece = _damage(file, at, size, found) if isinstance(found, _Refused) else found
                yield piece
                at += piece.size
    except OSError as error:
        raise SessionLogError(
            f"{path}: cannot be read: {error.strerror or error}. Name an existing session log."
        ) from error


def _magic(path: Path, file: BinaryIO, size: int) -> Iterator[Damage]:
    """Nothing if the file begins as it should, the damage if a header follows all the same."""
    file.seek(0)
    start = file.read(len(MAGIC))
    if start == MAGIC:
        return
    if len(start) < len(MAGIC):
        raise SessionLogError(
            f"{path}: holds only {len(start)} bytes; the session stopped before anything was stored, so there is "
            f"nothing to recover"
        )
    if start[:-1] == MAGIC[:-1]:
        raise SessionLogError(
            f"{path}: is a session log of format {start[-1]}, this fes reads format {MAGIC[-1]}; "
            f"use the fes that wrote it"
        )
    first = _record(file, len(MAGIC), size)
    if isinstance(first, _Refused) or first.kind != RecordType.HEADER:
        raise SessionLogError(
            f"{path}: is not a session log (it starts with {start!r}). A session log is what `fes run` or `fes replay` "
            f"leaves."
        )
    yield Damage(0, len(MAGIC), "the format's mark is damaged")


def _record(file: BinaryIO, at: int, size: int) -> Whole | _Refused:
    file.seek(at)
    head = file.read(HEAD_BYTES)
    if len(head) < HEAD_BYTES:
        return _Refused("a record's first bytes only")
    length, checksum, number = _HEAD.unpack(head)
    kind = RecordType(number) if _KNOWN[number] else None
    if not 0 < length <= MAX_RECORD_BYTES:
        return _Refused("no record starts there")
    end = at + 8 + length
    if end > size:
        return _Refused("a record cut short", kind, end)
    payload = file.read(length - 1)
    if zlib.crc32(payload, zlib.crc32(head[8:], length)) != checksum:
        return _Refused("a damaged record (its checksum differs)", kind, end)
    if kind is None:
        return _Refused(f"a record of unknown type {number}", None, end, checked=True)
    try:
        return _content(at, 8 + length, kind, memoryview(payload))
    except _BAD_CONTENT as error:
        return _Refused(f"a malformed record ({error})", kind, end, checked=True)


def _content(at: int, size: int, kind: RecordType, payload: memoryview) -> Whole:
    """Decode a record whole, so that nobody who reads it later meets what it cannot read."""
    if kind in (RecordType.HEADER, RecordType.SUMMARY):
        return Whole(at, size, kind, payload, decode_json(payload))
    if kind == RecordType.SAMPLES:
        times = [sample.t_ns for sample in samples_of(payload)]
        return Whole(at, size, kind, payload, None, len(times), min(times, default=None), max(times, default=None))
    if kind == RecordType.LATENCY:
        times = latency_arrays([payload])[0].tolist()
        return Whole(at, size, kind, payload, None, len(times), min(times, default=None), max(times, default=None))
    value = decode(kind, payload)
    if isinstance(value, StrideResult | Note):
        _check_types(value)
    t_ns = value.t_end_ns if isinstance(value, StrideResult) else value.t_ns
    return Whole(at, size, kind, payload, value, 1, t_ns, t_ns)


def _check_types(value: StrideResult | Note) -> None:
    """Refuse JSON whose values are of another type than the fields: what reads them counts on it."""
    for item in fields(value):
        kinds = _TYPES.get(str(item.type))
        held = getattr(value, item.name)
        if kinds and (not isinstance(held, kinds) or (isinstance(held, bool) and bool not in kinds)):
            raise ValueError(f"{item.name} is {held!r}")
        if isinstance(held, int) and abs(held) >= 1 << 63:
            raise ValueError(f"{item.name} is beyond 64 bits")


def _damage(file: BinaryIO, at: int, size: int, refused: _Refused) -> Damage:
    if refused.checked:  # its length is right as well
        return Damage(at, refused.end - at, refused.why, refused.kind)
    found = _next_record(file, at + 1, size)
    if _all_zero(file, at, found):
        return Damage(at, found - at, ZEROS)
    # the head is believed where the next record begins where it says, or where it was the last one
    believed = refused.end == found or (refused.end > size and found == size)
    return Damage(at, found - at, refused.why, refused.kind if believed else None)


def _next_record(file: BinaryIO, start: int, size: int) -> int:
    """Where the next whole record begins; ``size`` if there is none."""
    allowed = _CHECKED_PER_BYTE * _BLOCK_BYTES
    for begin in range(start, size, _BLOCK_BYTES):
        file.seek(begin)
        block = np.frombuffer(file.read(_BLOCK_BYTES + HEAD_BYTES - 1), np.uint8)
        if len(block) < HEAD_BYTES:
            break
        n = len(block) - HEAD_BYTES + 1
        low, middle, high, top = (block[i : i + n].astype(np.uint32) for i in range(4))
        length = low | middle << 8 | high << 16 | top << 24
        likely = _KNOWN[block[8 : 8 + n]] & (length > 0) & (length <= LONGEST_RESYNC_BYTES)
        likely &= begin + np.arange(n) + 8 + length <= size
        for place in np.flatnonzero(likely).tolist():
            if length[place] > allowed:
                continue
            allowed -= int(length[place])
            if isinstance(_record(file, begin + place, size), Whole):
                return begin + place
        allowed += _CHECKED_PER_BYTE * n
    return size


def _all_zero(file: BinaryIO, begin: int, end: int) -> bool:
    file.seek(begin)
    left = end - begin
    while left:
        block = file.read(min(left, _BLOCK_BYTES))
        if not block or block.count(0) != len(block):
            return False
        left -= len(block)
    return True
