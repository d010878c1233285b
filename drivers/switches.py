"""Switches: one bit of a CAN frame, or an input of a serial line (CTS, DSR). A foot switch, a stop button."""

import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import can
import serial

from drivers.stimulator.bus import BusError, open_bus
from fes.config import Bus
from fes.config.session import Switch

FRAMES_AT_ONCE: Final = 64
SILENT_NS: Final = 500_000_000  # a switch on CAN says over and over what it is; silent for so long, it is lost


class SwitchFailed(RuntimeError):
    """The switch's line cannot be opened; the message names it and what to check."""


@dataclass(eq=False)
class CanSwitch:
    """A bit of a data frame with an 11-bit identifier, counted from the first byte's least significant bit.

    A switch that tells only its changes cannot be told from one that was unplugged. So it has to repeat its frame, best
    every 100 ms; after 500 ms without one nobody knows whether it is pressed. ``clock_ns`` says when a frame was read.
    """

    bus: can.BusABC
    identifier: int
    bit: int
    high: bool
    clock_ns: Callable[[], int] = time.monotonic_ns

    def __post_init__(self) -> None:
        self._heard_ns = 0
        self._pressed: bool | None = None

    def fileno(self) -> int | None:
        """Readable with frames; None where the adapter has no descriptor."""
        try:
            return self.bus.fileno()
        except NotImplementedError:
            return None

    def read(self) -> bool | None:
        """Whether it was pressed in the newest frame; None when there was none within 500 ms, or the bus is lost."""
        now_ns = self.clock_ns()
        try:
            for _ in range(FRAMES_AT_ONCE):
                message = self.bus.recv(timeout=0.0)
                if message is None:
                    break
                if message.is_extended_id or message.is_remote_frame or message.is_error_frame:
                    continue  # another's, even where the number is the same
                if message.arbitration_id == self.identifier and len(message.data) > self.bit // 8:
                    self._heard_ns = now_ns
                    self._pressed = bool(message.data[self.bit // 8] >> self.bit % 8 & 1) == self.high
        except (can.CanError, OSError):
            self._pressed = None
        if now_ns - self._heard_ns > SILENT_NS:
            self._pressed = None
        return self._pressed

    def close(self) -> None:
        """Release the bus."""
        self.bus.shutdown()


@dataclass(eq=False)
class SerialSwitch:
    """An input of a serial line; asked each time, for it cannot be waited on."""

    line: serial.SerialBase
    which: str
    high: bool

    def fileno(self) -> int | None:
        """Nothing to wait on."""
        return None

    def read(self) -> bool | None:
        """Whether it is pressed; None when the line is lost."""
        try:
            level = self.line.cts if self.which == "serial_cts" else self.line.dsr
        except (OSError, serial.SerialException):
            return None
        return bool(level) == self.high

    def close(self) -> None:
        """Release the line."""
        self.line.close()


def open_switch(settings: Switch, bus: Bus) -> CanSwitch | SerialSwitch:
    """The switch of these settings. SwitchFailed: its line or bus cannot be opened."""
    high = settings.pressed == "high"
    if settings.source == "can_bit":
        try:
            opened = open_bus(bus, frozenset({settings.identifier}))
        except BusError as error:
            raise SwitchFailed(f"switch on {settings.identifier:#x}: {error}") from error
        return CanSwitch(opened, settings.identifier, settings.bit, high=high)
    try:
        line = _open_line(settings.port)
    except (OSError, ValueError, serial.SerialException) as error:
        hint = "Is the port right, has nobody else opened it, may this user open it?"
        raise SwitchFailed(f"switch on {settings.port}: {error}. {hint}") from error
    return SerialSwitch(line, settings.source, high=high)


def _open_line(port: str) -> serial.SerialBase:
    """A line that another switch may use too, on its other input, and nobody else: opening it sets its speed."""
    if "://" in port:
        return serial.serial_for_url(port, timeout=0)
    import fcntl

    descriptor = os.open(port, os.O_RDONLY | os.O_NOCTTY | os.O_NONBLOCK)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)  # sensors and stimulators lock theirs for themselves
        line = serial.serial_for_url(port, timeout=0)
        fcntl.flock(line.fileno(), fcntl.LOCK_SH | fcntl.LOCK_NB)
    finally:
        os.close(descriptor)
    return line
