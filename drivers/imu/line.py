"""Bytes from a sensor: a serial port, a pseudo-terminal, ``socket://host:port`` or ``udp://host:port``; never waits.

pyserial opens it; reading goes straight to the descriptor, so that a line whose other end is gone says so.
"""

import os
import socket
from collections.abc import Callable
from typing import Final
from urllib.parse import urlsplit

import serial

from drivers.imu.port import ImuLost, OneSensorPort, whole_option
from drivers.stimulator.serial_line import Line, SerialLine, make_room
from fes.config import ImuDevice

READ_AT_MOST: Final = 65536
BAUDRATE: Final = 115200  # where the settings name none
READS_AT_MOST: Final = 1024  # datagrams, mostly: a flooded line must not hold the control loop
_HINT: Final = "Check cable, power and that no other program uses it (Linux: group dialout)."


class ByteLine(SerialLine):
    """One open line. ImuLost: it cannot be opened, or it broke; the message says what to check."""

    def __init__(self, sensor: str, port: str, baudrate: int) -> None:
        name = f"{sensor} on {port}"
        self._datagrams = port.startswith("udp://")
        owner: serial.SerialBase | socket.socket
        try:
            if self._datagrams:
                where = urlsplit(port)
                owner = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
                owner.bind((where.hostname or "", where.port or 0))
                make_room(owner.fileno())
            else:
                options: dict[str, bool] = {} if "://" in port else {"exclusive": True}
                owner = serial.serial_for_url(port, baudrate=baudrate, timeout=0, write_timeout=0, **options)
            super().__init__(name, owner.fileno(), owner, ImuLost, _HINT, READ_AT_MOST)
        except Exception as error:  # SerialException, OSError, ValueError, termios.error: each call has its own
            raise ImuLost(f"{name} cannot be opened: {error}. {_HINT}") from error

    def read(self) -> bytes:
        """All that has arrived; under a flood the rest with the next call."""
        parts: list[bytes] = []
        for _ in range(READS_AT_MOST):
            try:
                data = self._read_once() if self._datagrams else super().read() or None
            except ImuLost:
                if parts:
                    break  # what came first is good; the next call says that it broke
                raise
            if data is None:
                break
            parts.append(data)
        return b"".join(parts)

    def write(self, data: bytes) -> None:
        """Hand over all bytes now."""
        try:
            if os.write(self._descriptor, data) == len(data):
                return
        except OSError as error:
            raise ImuLost(f"{self.name} cannot be written: {error}. {_HINT}") from error
        raise ImuLost(f"{self.name} did not take a command. {_HINT}")


LineOpener = Callable[[str, str, int], Line]
"""Opens the line of a sensor: its name, its port, its baud rate."""


class LineSensorPort(OneSensorPort):
    """Base of a port whose one sensor is behind a :class:`ByteLine`, or behind what another ``opener`` opens."""

    _line: Line
    _configures = False

    def __init__(self, device: ImuDevice, opener: LineOpener = ByteLine, sample_bytes: int = 0) -> None:
        """``sample_bytes``: of a sample on the line. ValueError: the line is too slow for the rate."""
        self._opener = opener
        self._baudrate = whole_option(device, "baudrate", BAUDRATE, 1)
        if (needs := device.rate_hz * sample_bytes * 10) > self._baudrate:
            raise ValueError(
                f"{device.sensor}: {device.rate_hz:g} Hz need {needs:.0f} baud, options.baudrate is {self._baudrate}; "
                "set the sensor and this option to a higher one"
            )
        super().__init__(device)

    def _open_line(self) -> None:
        self._line = self._opener(self._device.sensor, self._device.port, self._baudrate)
        try:
            if self._configures:
                self._configure()
        except ImuLost:
            self._line.close()
            raise

    def _configure(self) -> None:
        """Set the sensor up, before its first sample. ImuLost: it does not answer, or refuses."""

    def fileno(self) -> int:
        """The line's descriptor."""
        return self._line.fileno()

    def close(self) -> None:
        """Release the line."""
        self._line.close()
