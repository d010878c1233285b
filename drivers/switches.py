"""Switches: one bit of a CAN frame, or an input of a serial line (CTS, DSR). A foot switch, a stop button."""

from __future__ import annotations

from typing import Final

import can
import serial

from drivers.stimulator.bus import BusError, open_bus
from fes.config import Bus
from fes.config.devices import Switch

FRAMES_AT_ONCE: Final = 64


class SwitchFailed(RuntimeError):
    """The switch's line cannot be opened; the message names it and what to check."""


class CanSwitch:
    """A bit of a CAN frame, counted from the first byte's least significant bit; None before the first frame."""

    def __init__(self, bus: can.BusABC, identifier: int, bit: int, *, high: bool) -> None:
        self._bus = bus
        self._identifier = identifier
        self._byte, self._mask = bit // 8, 1 << bit % 8
        self._high = high
        self._pressed: bool | None = None

    def fileno(self) -> int | None:
        """Readable with frames; None where the adapter has no descriptor."""
        try:
            return self._bus.fileno()
        except NotImplementedError:
            return None

    def read(self) -> bool | None:
        """Whether it was pressed in the newest frame; None as long as there was none, and when the bus is lost."""
        try:
            for _ in range(FRAMES_AT_ONCE):
                message = self._bus.recv(timeout=0.0)
                if message is None:
                    break
                if message.arbitration_id == self._identifier and len(message.data) > self._byte:
                    self._pressed = bool(message.data[self._byte] & self._mask) == self._high
        except (can.CanError, OSError):
            self._pressed = None
        return self._pressed

    def close(self) -> None:
        """Release the bus."""
        self._bus.shutdown()


class SerialSwitch:
    """An input of a serial line; asked each time, for it cannot be waited on."""

    def __init__(self, line: serial.SerialBase, which: str, *, high: bool) -> None:
        self._line = line
        self._which = which
        self._high = high

    def fileno(self) -> int | None:
        """Nothing to wait on."""
        return None

    def read(self) -> bool | None:
        """Whether it is pressed; None when the line is lost."""
        try:
            level = self._line.cts if self._which == "serial_cts" else self._line.dsr
        except (OSError, serial.SerialException):
            return None
        return bool(level) == self._high

    def close(self) -> None:
        """Release the line."""
        self._line.close()


def open_switch(settings: Switch, bus: Bus) -> CanSwitch | SerialSwitch:
    """The switch of these settings.

    Raises:
        SwitchFailed: its line or bus cannot be opened.
    """
    high = settings.pressed == "high"
    if settings.source == "can_bit":
        try:
            opened = open_bus(bus, frozenset({settings.identifier}))
        except BusError as error:
            raise SwitchFailed(f"switch on {settings.identifier:#x}: {error}") from error
        return CanSwitch(opened, settings.identifier, settings.bit, high=high)
    try:
        line = serial.serial_for_url(settings.port, timeout=0)
    except (OSError, ValueError, serial.SerialException) as error:
        raise SwitchFailed(f"switch on {settings.port}: {error}. Is the port right, may this user open it?") from error
    return SerialSwitch(line, settings.source, high=high)
