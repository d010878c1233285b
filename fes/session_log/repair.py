"""A damaged session log → a new one with every whole record, and what was lost.

The file is read in one pass that holds one record at a time. Behind damage the next record is looked for byte by byte:
it is one where length, type and checksum fit and whose content can be decoded. By chance 32 bits of checksum fit once
in 4 · 10⁹ places.
"""

import os
import struct
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, BinaryIO, Final, get_type_hints

import numpy as np

from fes.session_log.codec import Rare, decode, decode_json, encode, encode_json, latency_arrays, samples_of
from fes.session_log.framing import (
    BLOCK_BYTES,
    HEAD_BYTES,
    MAGIC,
    RecordType,
    Refused,
    SessionLogError,
    framed,
    record_at,
    unreadable,
    wrong_start,
)
from fes.session_log.writer import create
from fes.signals import StrideResult
from fes.walk_record import Note

LONGEST_RESYNC_BYTES: Final = 1 << 20  # of a record looked for behind damage; what is written stays far below
ZEROS: Final = "zeros, as a file system leaves them after a power cut"

_CHECKED_PER_BYTE: Final = 64  # bytes summed for each byte searched, so that no file makes the search quadratic
_BAD_CONTENT = (struct.error, ValueError, KeyError, IndexError, TypeError, RecursionError)
_TYPES: Final[dict[Any, tuple[type, ...]]] = {
    int: (int,),
    int | None: (int, type(None)),
    float: (float, int),
    str: (str,),
    bool: (bool,),
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


def stretches(path: Path) -> Iterator[Whole | Damage]:
    """Yield what a session log consists of, without a byte left out, in the order of the file.

    SessionLogError: the file cannot be read or is no session log of this format.
    """
    try:
        with Path(path).open("rb", buffering=BLOCK_BYTES) as file:
            size = file.seek(0, 2)
            file.seek(0)
            start = file.read(len(MAGIC))
            if start != MAGIC:  # damage, if a header follows all the same
                other = len(start) < len(MAGIC) or start[:-1] == MAGIC[:-1]
                first = None if other else _record(file, len(MAGIC), size)
                if not isinstance(first, Whole) or first.kind != RecordType.HEADER:
                    raise wrong_start(Path(path), start)
                yield Damage(0, len(MAGIC), "the format's mark is damaged")
            at = len(MAGIC)
            while at < size:
                record = _record(file, at, size)
                stretch = _damage(file, at, size, record) if isinstance(record, Refused) else record
                yield stretch
                at += stretch.size
    except OSError as error:
        raise unreadable(path, error) from error


def _record(file: BinaryIO, at: int, size: int) -> Whole | Refused:
    file.seek(at)
    record = record_at(file, at, size)
    if isinstance(record, Refused):
        return record
    kind, payload = record
    bytes_long = HEAD_BYTES + len(payload)
    try:
        return _content(at, bytes_long, kind, memoryview(payload))
    except _BAD_CONTENT as error:
        return Refused(f"a malformed record ({error})", kind, at + bytes_long, checked=True)


def _content(at: int, size: int, kind: RecordType, payload: memoryview) -> Whole:
    """Decode a record whole, so that nobody who reads it later meets what it cannot read."""
    if kind in (RecordType.HEADER, RecordType.SUMMARY):
        return Whole(at, size, kind, payload, decode_json(payload))
    if kind in (RecordType.SAMPLES, RecordType.LATENCY):
        samples = kind == RecordType.SAMPLES
        times = [each.t_ns for each in samples_of(payload)] if samples else latency_arrays([payload])[0].tolist()
        return Whole(at, size, kind, payload, None, len(times), min(times, default=None), max(times, default=None))
    value = decode(kind, payload)
    if isinstance(value, StrideResult | Note):
        _check_types(value)
    t_ns = value.t_end_ns if isinstance(value, StrideResult) else value.t_ns
    return Whole(at, size, kind, payload, value, 1, t_ns, t_ns)


def _check_types(value: StrideResult | Note) -> None:
    """Refuse JSON whose values are of another type than the fields: what reads them counts on it."""
    for name, of in get_type_hints(type(value)).items():
        kinds = _TYPES.get(of)
        held = getattr(value, name)
        if kinds and (not isinstance(held, kinds) or (isinstance(held, bool) and bool not in kinds)):
            raise ValueError(f"{name} is {held!r}")
        if isinstance(held, int) and abs(held) >= 1 << 63:
            raise ValueError(f"{name} is beyond 64 bits")


def _damage(file: BinaryIO, at: int, size: int, refused: Refused) -> Damage:
    if refused.checked:  # its length is right as well
        return Damage(at, refused.end - at, refused.why, refused.kind)
    end = _next_record(file, at + 1, size)
    if all(block.count(0) == len(block) for block in _blocks(file, at, end)):
        return Damage(at, end - at, ZEROS)
    # the head is believed where the next record begins where it says, or where it was the last one
    believed = refused.end == end or (refused.end > size and end == size)
    return Damage(at, end - at, refused.why, refused.kind if believed else None)


def _next_record(file: BinaryIO, start: int, size: int) -> int:
    """Where the next whole record begins; ``size`` if there is none."""
    allowed = _CHECKED_PER_BYTE * BLOCK_BYTES
    for begin in range(start, size, BLOCK_BYTES):
        file.seek(begin)
        block = np.frombuffer(file.read(BLOCK_BYTES + HEAD_BYTES - 1), np.uint8)
        if len(block) < HEAD_BYTES:
            break
        n = len(block) - HEAD_BYTES + 1
        low, middle, high, top = (block[i : i + n].astype(np.uint32) for i in range(4))
        length = low | middle << 8 | high << 16 | top << 24
        possible = _KNOWN[block[8 : 8 + n]] & (length > 0) & (length <= LONGEST_RESYNC_BYTES)
        possible &= begin + np.arange(n) + 8 + length <= size
        for place in np.flatnonzero(possible).tolist():
            if length[place] > allowed:
                continue
            allowed -= int(length[place])
            if isinstance(_record(file, begin + place, size), Whole):
                return begin + place
        allowed += _CHECKED_PER_BYTE * n
    return size


def _blocks(file: BinaryIO, begin: int, end: int) -> Iterator[bytes]:
    """The file from ``begin`` to ``end``; OSError where it ends before."""
    file.seek(begin)
    while begin < end:
        block = file.read(min(end - begin, BLOCK_BYTES))
        if not block:
            raise OSError(None, f"the damaged log became shorter while it was read (byte {begin})")
        yield block
        begin += len(block)


@dataclass(frozen=True, slots=True)
class Gap(Damage):
    """A place where something is missing.

    ``before_ns`` and ``after_ns`` are the times of the nearest records of its kind on its two sides (of the samples
    where the kind is not known); None: there is none.
    """

    before_ns: int | None = None
    after_ns: int | None = None

    @property
    def harmless(self) -> bool:
        """Nothing of the session is in it."""
        return self.at == 0

    def describe(self, begin_ns: int) -> str:
        """One sentence; times are s since ``begin_ns``."""
        what = f"{self.size} byte{'s' * (self.size != 1)} from byte {self.at} on: {self.why}"
        if self.kind is not None:
            what += f", by its head a {self.kind.words[0]}"
        if self.harmless:
            return what
        before = f"{1e-9 * (self.before_ns - begin_ns):.3f} s" if self.before_ns is not None else "the beginning"
        if self.after_ns is None:
            return f"{what}; after {before}"
        after_s = 1e-9 * (self.after_ns - begin_ns)
        spent = "" if self.before_ns is None else f" ({1e-6 * max(self.after_ns - self.before_ns, 0):.0f} ms)"
        return f"{what}; between {before} and {after_s:.3f} s{spent}"


@dataclass(slots=True)
class Survey:
    """What a log holds and lacks: ``kept`` and ``gaps``; ``ended`` if its last record is the session's summary.

    ``begin_ns`` is the earliest time known; ``summary`` the session's last, if one is whole.
    """

    path: Path
    size: int = 0
    kept: Counter[RecordType] = field(default_factory=Counter)
    gaps: list[Gap] = field(default_factory=list)
    header: dict[str, Any] | None = None
    summary: dict[str, Any] = field(default_factory=dict)
    ended: bool = False
    begin_ns: int | None = None

    @property
    def whole(self) -> bool:
        """Nothing is damaged and the end is there."""
        return self.ended and not self.gaps

    @property
    def lost_bytes(self) -> int:
        """Bytes that belonged, or may have belonged, to the session."""
        return sum(gap.size for gap in self.gaps if self._lost(gap))

    def _lost(self, gap: Gap) -> bool:
        behind_the_end = self.ended and gap is self.gaps[-1] and gap.why == ZEROS and gap.at + gap.size == self.size
        return not (gap.harmless or behind_the_end)

    @property
    def lost_kinds(self) -> Counter[str]:
        """How many records of which kind are known to be lost; ``unknown`` counts places, not records."""
        counted: Counter[str] = Counter()
        for gap in self.gaps:
            if self._lost(gap):
                counted["unknown" if gap.kind is None else gap.kind.name.lower()] += 1
        return counted

    @property
    def lost_ns(self) -> int:
        """Time inside the session that damaged places cover; what is missing at the end is not known."""
        lost = [gap for gap in self.gaps if self._lost(gap)]
        spans = [(g.before_ns, g.after_ns) for g in lost if g.before_ns is not None and g.after_ns is not None]
        total, until = 0, spans[0][0] if spans else 0
        for before, after in sorted(spans):
            total += max(after - max(before, until), 0)
            until = max(until, after)
        return total

    def sentences(self) -> list[str]:
        """What was lost, a sentence for each place, and of the end."""
        end = "the session's end was never written: it lacks what happened in the last quarter of a second"
        return [gap.describe(self.begin_ns or 0) for gap in self.gaps] + [end] * (not self.ended)

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON and for the recovered log's summary."""
        return {
            "bytes": self.size,
            "lost_bytes": self.lost_bytes,
            "lost_ms": round(1e-6 * self.lost_ns, 3),
            "lost_records": dict(self.lost_kinds),
            "end_missing": not self.ended,
            "kept_records": {kind.name.lower(): count for kind, count in sorted(self.kept.items())},
            "gaps": [
                {"byte": gap.at, "bytes": gap.size, "why": gap.why}
                | {"kind": None if gap.kind is None else gap.kind.name.lower()}
                | {"after_t_ns": gap.before_ns, "before_t_ns": gap.after_ns}
                for gap in self.gaps
            ],
        }


def survey(path: Path) -> Survey:
    """Read a log through and say what it holds and lacks; nothing is written.

    SessionLogError: the file cannot be read or is no session log.
    """
    log = Survey(Path(path))
    last_ns: dict[RecordType, int] = {}
    waiting: dict[RecordType, list[int]] = {}  # gaps that the next record of a kind will end
    for stretch in stretches(log.path):
        log.size = stretch.at + stretch.size
        if isinstance(stretch, Damage):
            stream = RecordType.SAMPLES if stretch.kind is None else stretch.kind
            waiting.setdefault(stream, []).append(len(log.gaps))
            log.gaps.append(Gap(stretch.at, stretch.size, stretch.why, stretch.kind, last_ns.get(stream)))
            continue
        log.kept[stretch.kind] += stretch.count
        log.ended = stretch.kind == RecordType.SUMMARY
        if stretch.kind == RecordType.HEADER and isinstance(stretch.value, dict) and stretch.at == len(MAGIC):
            log.header = stretch.value
        elif log.ended and isinstance(stretch.value, dict):
            log.summary = stretch.value
        if stretch.begin_ns is not None and stretch.end_ns is not None:
            log.begin_ns = stretch.begin_ns if log.begin_ns is None else min(log.begin_ns, stretch.begin_ns)
            for number in waiting.pop(stretch.kind, ()):
                log.gaps[number] = replace(log.gaps[number], after_ns=stretch.begin_ns)
            last_ns[stretch.kind] = stretch.end_ns
    return log


def recover(damaged: Survey, target: Path, header: dict[str, Any] | None = None) -> None:
    """Write a new log: every whole record as it is, a note where something is missing, a summary that says so.

    Args:
        damaged: what :func:`survey` returned of the damaged log, which is only read.
        target: must not exist.
        header: to use where the log's own is damaged.

    Raises:
        SessionLogError: there is no header, ``target`` exists or cannot be written; nothing is left of it then.
    """
    if damaged.header is None and header is None:
        raise SessionLogError(
            f"{damaged.path}: its header, with the settings, is damaged; {sum(damaged.kept.values())} values behind it "
            f"are whole. Name another log of the same settings to take the header from: --header-from LOG"
        )
    descriptor = create(target)
    try:
        with os.fdopen(descriptor, "wb") as out, damaged.path.open("rb") as source:
            out.write(MAGIC)
            if damaged.header is None and header is not None:
                out.write(framed(RecordType.HEADER, encode_json({**header, "header_from_another_log": True})))
            at = len(MAGIC)
            for gap in damaged.gaps:
                out.writelines(_blocks(source, at, gap.at))
                at = max(gap.at + gap.size, at)
                if not gap.harmless:
                    text = f"lost here: {gap.describe(damaged.begin_ns or 0)}"
                    t_ns = next((t for t in (gap.before_ns, gap.after_ns, damaged.begin_ns) if t is not None), 0)
                    out.write(framed(*encode(Note(t_ns, "warning", "recover", text))))
            out.writelines(_blocks(source, at, damaged.size))
            out.write(framed(RecordType.SUMMARY, encode_json(summary_of(damaged))))
            out.flush()
            os.fsync(out.fileno())
    except OSError as error:
        target.unlink(missing_ok=True)
        raise SessionLogError(
            f"{target}: cannot be written: {error.strerror or error}. The damaged log is as it was; make room, or "
            f"choose another place with --out"
        ) from error


def summary_of(damaged: Survey) -> dict[str, Any]:
    """The recovered log's summary: the session's own if it is whole, and what was lost."""
    ended = {"ended": f"recovered, {damaged.lost_bytes} bytes lost"} if damaged.lost_bytes or not damaged.ended else {}
    return {**damaged.summary, **ended, "recovered": {"from": damaged.path.name, **damaged.to_dict()}}
