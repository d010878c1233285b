"""Bytes from a sensor: a serial port, a pseudo-terminal, ``socket://host:port`` or ``udp://host:port``; never waits.

pyserial opens it; reading goes straight to the descriptor, so that a line whose other end is gone says so.
"""

from __future__ import annotations

import os
import select
import socket
from typing import Final
from urllib.parse import urlsplit

import serial

from drivers.imu.port import ImuLost
from drivers.receive_buffer import make_room

READ_AT_MOST: Final = 65536
READS_AT_MOST: Final = 1024  # datagrams, mostly: a flooded line must not hold the control loop
_HINT: Final = "Check cable, power and that no other program uses it (Linux: group dialout)."


class ByteLine:
    """One open line.

    Raises:
        ImuLost: it cannot be opened, or it broke; the message says what to check.
    """

    def __init__(self, sensor: str, port: str, baudrate: int) -> None:
        self.name = f"{sensor} on {port}"
        self._owner: serial.SerialBase | socket.socket
        self._closed = False
        self._datagrams = port.startswith("udp://")
        try:
            if self._datagrams:
                where = urlsplit(port)
                self._owner = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
                self._owner.bind((where.hostname or "", where.port or 0))
                make_room(self._owner.fileno())
            else:
                options: dict[str, bool] = {} if "://" in port else {"exclusive": True}
                self._owner = serial.serial_for_url(port, baudrate=baudrate, timeout=0, write_timeout=0, **options)
            self._descriptor = int(self._owner.fileno())
            os.set_blocking(self._descriptor, False)
        except Exception as error:  # SerialException, OSError, ValueError, termios.error: each call has its own
            raise ImuLost(f"{self.name} cannot be opened: {error}. {_HINT}") from error

    def read(self) -> bytes:
        """All that has arrived; under a flood the rest with the next call."""
        parts: list[bytes] = []
        readable = False
        for _ in range(READS_AT_MOST):
            try:
                data = os.read(self._descriptor, READ_AT_MOST)
            except BlockingIOError:
                break
            except (OSError, ValueError) as error:
                if parts:
                    break  # what came first is good; the next call says that it broke
                raise ImuLost(f"{self.name} cannot be read: {error}. {_HINT}") from error
            if data:
                parts.append(data)
                readable = False
                continue
            if self._datagrams:
                continue
            if readable:
                if parts:
                    break
                raise ImuLost(f"{self.name}: the other end is gone. {_HINT}")
            # a terminal without bytes reads as empty, and bytes may come just now: only what select calls readable and
            # is then empty has lost its other end
            readable = bool(select.select([self._descriptor], [], [], 0)[0])
            if not readable:
                break
        return b"".join(parts)

    def write(self, data: bytes) -> None:
        """Hand over all bytes now."""
        try:
            if os.write(self._descriptor, data) == len(data):
                return
        except OSError as error:
            raise ImuLost(f"{self.name} cannot be written: {error}. {_HINT}") from error
        raise ImuLost(f"{self.name} did not take a command. {_HINT}")

    def wait(self, timeout_s: float) -> None:
        """Until readable; only used while opening."""
        select.select([self._descriptor], [], [], max(timeout_s, 0.0))

    def fileno(self) -> int:
        """The descriptor, for ``select``."""
        return self._descriptor

    def close(self) -> None:
        """Close it; may be called twice."""
        if not self._closed:
            self._closed = True
            self._owner.close()
