"""Inertial sensors on one CAN bus behind python-can."""

from collections.abc import Sequence
from typing import Final

import can

from drivers.imu.can_codec import DbcSensor
from drivers.imu.port import ImuLost, ImuPort, LineCounts
from drivers.stimulator.bus import BusError, bus_name, is_bus_off, open_bus
from fes.config import Bus, ImuDevice
from fes.signals import RawSample

READ_AT_MOST: Final = 1024  # frames: a flooded bus must not hold the control loop


class CanImus(ImuPort):
    """:class:`~drivers.imu.port.ImuPort` for all sensors of one bus.

    Raises:
        ValueError: two sensors use the same identifier.
        ImuLost: the bus cannot be opened.
    """

    def __init__(self, devices: Sequence[ImuDevice], bus: Bus) -> None:
        self._settings = bus
        self._parts = [DbcSensor(device) for device in devices]
        self.sensors: tuple[str, ...] = tuple(part.sensor for part in self._parts)
        self.counts: dict[str, LineCounts] = {part.sensor: part.counts for part in self._parts}
        self._of: dict[int, DbcSensor] = {}
        for part in self._parts:
            for identifier in part.identifiers:
                if identifier in self._of:
                    both = f"{part.sensor} and {self._of[identifier].sensor} both use the identifier 0x{identifier:x}"
                    raise ValueError(f"{both}; give one of the sensors other identifiers and set options.id_offset")
                self._of[identifier] = part
        self._open()

    def _open(self) -> None:
        try:
            self._bus = open_bus(self._settings, frozenset(self._of))
        except BusError as error:
            raise ImuLost(str(error)) from error

    def fileno(self) -> int | None:
        """The bus' descriptor, None where the interface has none."""
        try:
            number = self._bus.fileno()
        except NotImplementedError:
            return None
        return number if number >= 0 else None

    def read(self, t_ns: int) -> list[RawSample]:
        """All samples completed by the frames that have arrived."""
        samples: list[RawSample] = []
        for _ in range(READ_AT_MOST):
            try:
                message = self._bus.recv(timeout=0.0)
            except (can.CanError, OSError) as error:
                raise ImuLost(f"{bus_name(self._settings)}: cannot be read: {error}") from error
            if message is None:
                break
            if is_bus_off(message):
                raise ImuLost(f"{bus_name(self._settings)}: the adapter went bus-off. Check cable and termination.")
            part = self._of.get(message.arbitration_id)
            if part is None or message.is_extended_id or message.is_remote_frame or message.is_error_frame:
                continue
            sample = part.receive(t_ns, message.arbitration_id, bytes(message.data))
            if sample is not None:
                samples.append(sample)
        return samples

    def close(self) -> None:
        """Shut the bus down; may be called twice."""
        self._bus.shutdown()
