"""A simulated sensor's end of a line that carries no bytes: a CAN bus, or an LSL outlet.

For lines of bytes see :mod:`drivers.virtual.device_lines`.
"""

from __future__ import annotations

import contextlib
import importlib
import os
from typing import Any, Final

import can

from drivers.stimulator.bus import open_bus
from drivers.virtual.imu_wire import CAN_RECORD, LSL_RECORD
from fes.config import Bus

LABELS: Final = ("acc_x", "acc_y", "acc_z", "gyr_x", "gyr_y", "gyr_z")


class CanEnd:
    """Records of ``CAN_RECORD`` as frames on a bus."""

    def __init__(self, settings: Bus) -> None:
        self.port = "bus"
        self._bus: can.BusABC | None = open_bus(settings, frozenset())

    def descriptors(self) -> list[int]:
        """Nothing is listened to."""
        return []

    def read(self) -> bytes:
        """Nothing."""
        return b""

    def write(self, data: bytes) -> None:
        """Frames that the bus does not take are lost."""
        for number, length, payload in CAN_RECORD.iter_unpack(data):
            message = can.Message(arbitration_id=number & 0x7FF, is_extended_id=False, data=payload[: min(length, 8)])
            with contextlib.suppress(can.CanError, OSError):
                if self._bus is not None:
                    self._bus.send(message, timeout=0)

    def unplug(self) -> None:
        """Leave the bus."""
        if self._bus is not None:
            self._bus.shutdown()
            self._bus = None


class LslEnd:
    """Records of ``LSL_RECORD`` as samples of an outlet."""

    def __init__(self, name: str, rate_hz: float) -> None:
        lsl = importlib.import_module("pylsl")
        info = lsl.StreamInfo(name, "IMU", len(LABELS), rate_hz, "double64", f"{name}-{os.getpid()}")
        channels = info.desc().append_child("channels")
        for label in LABELS:
            channel = channels.append_child("channel")
            channel.append_child_value("label", label)
            channel.append_child_value("unit", "m/s2" if label.startswith("acc") else "rad/s")
        self.port = name
        self._outlet: Any = lsl.StreamOutlet(info, 1)

    def descriptors(self) -> list[int]:
        """Nothing is listened to."""
        return []

    def read(self) -> bytes:
        """Nothing."""
        return b""

    def write(self, data: bytes) -> None:
        """Push them with the device's stamps."""
        for stamp_s, *values in LSL_RECORD.iter_unpack(data):
            if self._outlet is not None:
                self._outlet.push_sample(values, stamp_s)

    def unplug(self) -> None:
        """The stream ends."""
        self._outlet = None
