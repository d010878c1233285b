"""A simulated stimulator's own account of what it delivered: one JSON object per line."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path


@dataclass(frozen=True, slots=True)
class RecordEntry:
    """One thing the node did, by its own clock (the host's monotonic one): to be held against what was commanded.

    ``event``: boot, session, on, level, off, lease_expired, on_time, fault, or refused (``detail`` says why).
    Levels are those delivered from ``t_ns`` on. ``accepted_ns`` is when the channel's newest on command was
    accepted, ``pulses`` its count since the session was opened, ``last_pulse_ns`` its newest pulse.
    """

    t_ns: int
    event: str
    channel: int = -1
    current_ma: float = 0.0
    pulse_width_us: float = 0.0
    frequency_hz: float = 0.0
    accepted_ns: int = 0
    pulses: int = 0
    last_pulse_ns: int = 0
    detail: str = ""


class RecordWriter:
    """Appends entries to a file and flushes them at once; ``None`` for the path writes nothing."""

    def __init__(self, path: Path | None) -> None:
        self._file = None if path is None else path.open("w", encoding="utf-8")

    def write(self, entries: list[RecordEntry]) -> None:
        """Append; on return the lines are with the operating system."""
        if self._file is not None and entries:
            self._file.writelines(json.dumps(asdict(entry)) + "\n" for entry in entries)
            self._file.flush()

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            self._file.close()


class RecordReader:
    """Reads a record that may still grow; each line is read once, a line without its end only when that has come."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._offset = 0
        self._incomplete = b""
        self._lines = 0

    def new_entries(self) -> list[RecordEntry]:
        """The entries since the last call; none as long as there is no file.

        Raises:
            ValueError: a line is no record entry; names file and line.
        """
        try:
            with self._path.open("rb") as file:
                file.seek(self._offset)
                data = file.read()
        except FileNotFoundError:
            return []
        self._offset += len(data)
        *lines, self._incomplete = (self._incomplete + data).split(b"\n")
        entries = []
        for line in lines:
            self._lines += 1
            try:
                entries.append(RecordEntry(**json.loads(line)))
            except (ValueError, TypeError) as error:
                raise ValueError(
                    f"{self._path}:{self._lines}: is no entry of a stimulator's record: {error}"
                ) from error
        return entries


def read_record(path: Path) -> list[RecordEntry]:
    """All complete lines of a record; a last line without its end (the node was killed) is left out.

    Raises:
        ValueError: a line is no record entry; names file and line.
    """
    return RecordReader(path).new_entries()
