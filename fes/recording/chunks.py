"""A long recording chunk by chunk, so that memory does not grow with it; several sensors at once."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import parent_process
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from fes.recording.read import follow_recording
from fes.recording.tracks import PER_SAMPLE, Recording, Track
from fes.signals import NS_PER_S, IntArray

Made = TypeVar("Made")
_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3  # of mallopt(3)
_LARGEST_BYTES = 32 << 20  # the C library takes no more; larger arrays go back as before
_KEPT_BYTES = 256 << 20


def keep_freed_memory() -> bool:
    """Keep up to a quarter of a gigabyte that is free; False where the C library has no such setting (not glibc).

    The C library gives large arrays back to the system at once and asks for them anew, page by page, zeroed: on a
    recording of ten minutes that is a tenth of the analysis. For processes that analyse; nothing else changes.
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError, TypeError):  # TypeError: Windows has no library of that name
        return False
    return bool(mallopt(_MMAP_THRESHOLD, _LARGEST_BYTES) and mallopt(_TRIM_THRESHOLD, _KEPT_BYTES))


def at_once(work: Callable[[str], Made], sensors: Iterable[str]) -> dict[str, Made]:
    """What ``work`` makes of each sensor, by their names and in their order; the first that fails raises its error.

    In threads: compiled code and numpy hold no lock of Python's meanwhile.
    """
    names = list(sensors)
    if len(names) < 2 or parent_process() is not None:  # one of several processes, which share the processors already
        return {name: work(name) for name in names}
    with ThreadPoolExecutor() as threads:
        return dict(zip(names, threads.map(work, names), strict=True))


WHOLE_S = 1800.0  # a recording that is no longer is one chunk, …
CHUNK_S = 900.0  # … of a longer one each is so long at most
AROUND_S = 30.0  # on either side of a chunk, for what needs neighbours: strides, rests, filters without lag
ALWAYS_NS, NEVER_NS = -(2**63), 2**63 - 1


@dataclass(frozen=True)
class Chunk:
    """A chunk of a recording: what is newer than ``begin_ns``, up to ``end_ns`` on the sensors' clock, and what lies
    around it."""

    recording: Recording
    begin_ns: int = ALWAYS_NS
    end_ns: int = NEVER_NS

    def own(self, track: Track) -> slice:
        """Which of a track's samples are this chunk's own; every sample is that of one chunk."""
        if self.whole:
            return slice(None)
        newest = np.maximum.accumulate(track.t_sensor_ns)
        begin, end = np.searchsorted(newest, (self.begin_ns, self.end_ns), side="right").tolist()
        return slice(begin, end)

    def owns(self, t_ns: IntArray) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        """Which of these instants (N,) are."""
        return (t_ns > self.begin_ns) & (t_ns <= self.end_ns)

    @property
    def whole(self) -> bool:
        """It is the whole recording."""
        return self.begin_ns == ALWAYS_NS and self.end_ns == NEVER_NS


def recording_chunks(path: Path, *, chunk_s: float = CHUNK_S, whole_s: float = WHOLE_S) -> Iterator[Chunk]:
    """Read a recording of more than ``whole_s`` in chunks of equal length, of ``chunk_s`` at most.

    Errors are those of ``read_recording``.

    Parquet whose sensors share one time column is read from the file chunk by chunk, anything else at once. The rate is
    that stated, or else that of the first chunk.
    """
    return cut_into_chunks(follow_recording(path, chunk_s, whole_s))


def cut_into_chunks(parts: Iterable[Recording], *, around_s: float = AROUND_S) -> Iterator[Chunk]:
    """Chunks from parts of a recording that follow each other; each chunk ends ``around_s`` before its part."""
    around_ns = round(around_s * NS_PER_S)
    ahead, tail, begin_ns = iter(parts), None, ALWAYS_NS
    part = next(ahead, None)
    while part is not None:
        following = next(ahead, None)
        recording = part if tail is None else _after(tail, part)
        end_ns = NEVER_NS
        if following is not None:
            newest_ns = max(int(track.t_sensor_ns.max()) for track in recording.tracks.values())
            end_ns = max(newest_ns - around_ns, begin_ns)
        tail = _newer(recording, end_ns - around_ns) if following is not None else None
        chunk = Chunk(recording, begin_ns, end_ns)
        del part, recording  # whoever takes the chunk decides how long it stays
        yield chunk
        del chunk
        begin_ns, part, following = end_ns, following, None


def _newer(recording: Recording, than_ns: int) -> Recording:
    """What is newer than this."""
    kept = {}
    for name, track in recording.tracks.items():
        begin = int(np.searchsorted(np.maximum.accumulate(track.t_sensor_ns), than_ns, side="right"))
        kept[name] = track.part(slice(begin, None))
    return replace(recording, tracks=kept)


def _after(one: Recording, other: Recording) -> Recording:
    """Both as one."""
    tracks = dict(one.tracks)
    for name, track in other.tracks.items():
        before = one.tracks.get(name, track.part(slice(0)))
        both: dict[str, Any] = {
            field: np.concatenate((getattr(before, field), getattr(track, field))) for field in PER_SAMPLE
        }
        tracks[name] = replace(track, **both)
    return replace(other, tracks={name: track for name, track in tracks.items() if track.t_ns.size})
