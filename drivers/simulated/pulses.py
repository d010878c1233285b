"""Each pulse that a simulated stimulator delivers, sent at once to whoever listens: datagrams on this machine.

The stimulator's process sends what left its output stage, with the time it left (CLOCK_MONOTONIC); a virtual patient
listens and feels nothing else. Nobody listening, or not keeping up, changes nothing for the stimulator.
"""

from __future__ import annotations

import os
import socket
import struct
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Final, NamedTuple

from drivers.simulated.record import RecordEntry
from drivers.simulated.stimulator.firmware import OutputChannel

BUFFER_BYTES: Final = 1 << 18
_PULSE: Final = struct.Struct("<qidd")


class Pulse(NamedTuple):
    """One pulse: when it left the stimulator, on which channel, how strong."""

    t_ns: int
    channel: int
    current_ma: float
    pulse_width_us: float


class PulseOutlet:
    """The stimulator's end; ``None`` for the path sends nothing. ``lost`` counts the pulses that nobody took."""

    def __init__(self, path: Path | None) -> None:
        self._path = None if path is None else str(path)
        self._socket: socket.socket | None = None
        self.lost = 0
        if path is not None:
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
            self._socket.setblocking(False)

    def send_made(self, channels: Iterable[OutputChannel]) -> None:
        """Send what these output stages have made since the last call."""
        for number, channel in enumerate(channels):
            while channel.made:
                t_ns, current_ma, pulse_width_us = channel.made.popleft()
                self.send(Pulse(t_ns, number, current_ma, pulse_width_us))

    def send_record(self, entries: Iterable[RecordEntry]) -> None:
        """Send the pulses among these entries of a serial device's record."""
        for entry in entries:
            if entry.event == "pulse":
                self.send(Pulse(entry.t_ns, entry.channel, entry.current_ma, entry.pulse_width_us))

    def send(self, pulse: Pulse) -> None:
        """Send one; never waits."""
        if self._socket is None or self._path is None:
            return
        try:
            self._socket.sendto(_PULSE.pack(*pulse), self._path)
        except OSError:
            self.lost += 1

    def close(self) -> None:
        """Release the socket."""
        if self._socket is not None:
            self._socket.close()


class PulseInlet:
    """The patient's end, bound to ``path``.

    Raises:
        OSError: the path is too long (107 bytes), or cannot be made.
    """

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
        while True:
            try:
                datagram = self._socket.recv(4096)
            except OSError:
                return pulses
            if len(datagram) == _PULSE.size:
                pulses.append(Pulse(*_PULSE.unpack(datagram)))

    def close(self) -> None:
        """Close and remove it."""
        self._socket.close()
        with suppress(OSError):
            self._path.unlink()
