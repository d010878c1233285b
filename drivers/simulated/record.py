"""What a simulated stimulator delivered: its own account, one JSON object per line; and each pulse, sent at once.

The stimulator's process sends what left its output stage, with the time it left (CLOCK_MONOTONIC), as datagrams on this
machine; a virtual patient listens and feels nothing else. Nobody listening, or not keeping up, changes nothing for the
stimulator.
"""

import json
import os
import socket
import struct
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final, NamedTuple

BUFFER_BYTES: Final = 1 << 18
_PULSE: Final = struct.Struct("<qidd")


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
                where = f"{self._path}:{self._lines}"
                raise ValueError(f"{where}: is no entry of a stimulator's record: {error}") from error
        return entries


def read_record(path: Path) -> list[RecordEntry]:
    """All complete lines, as :meth:`RecordReader.new_entries` has them; a last one without its end is left out."""
    return RecordReader(path).new_entries()


class Pulse(NamedTuple):
    """One pulse: when it left the stimulator, on which channel, how strong."""

    t_ns: int
    channel: int
    current_ma: float
    pulse_width_us: float


def pulses_of(entries: Iterable[RecordEntry]) -> list[Pulse]:
    """The pulses among these entries of a serial device's record."""
    found = (entry for entry in entries if entry.event == "pulse")
    return [Pulse(entry.t_ns, entry.channel, entry.current_ma, entry.pulse_width_us) for entry in found]


class PulseOutlet:
    """The stimulator's end; ``None`` for the path sends nothing. ``lost`` counts the pulses that nobody took."""

    def __init__(self, path: Path | None) -> None:
        self._path = path
        self._socket = None if path is None else socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.lost = 0

    def send(self, pulses: Iterable[Pulse]) -> None:
        """Send them, each by itself; never waits."""
        if self._socket is None:
            return
        for pulse in pulses:
            try:
                self._socket.sendto(_PULSE.pack(*pulse), socket.MSG_DONTWAIT, str(self._path))
            except OSError:
                self.lost += 1

    def close(self) -> None:
        """Release the socket."""
        if self._socket is not None:
            self._socket.close()


class PulseInlet:
    """The patient's end, bound to ``path``. OSError: the path is too long (107 bytes), or cannot be made."""

    def __init__(self, path: Path) -> None:
        self._path = path
        path.unlink(missing_ok=True)
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER_BYTES)
        self._socket.setblocking(False)
        before = os.umask(0o177)
        try:
            self._socket.bind(str(path))
        finally:
            os.umask(before)

    def fileno(self) -> int:
        """Readable with pulses."""
        return self._socket.fileno()

    def receive(self) -> list[Pulse]:
        """What has come; datagrams of another size are passed over."""
        pulses: list[Pulse] = []
        with suppress(OSError):  # the end of the loop
            while True:
                datagram = self._socket.recv(4096)
                if len(datagram) == _PULSE.size:
                    pulses.append(Pulse(*_PULSE.unpack(datagram)))
        return pulses

    def close(self) -> None:
        """Close and remove it."""
        self._socket.close()
        with suppress(OSError):
            self._path.unlink()
