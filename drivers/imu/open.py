"""Open whichever sensors the settings name; those on one CAN bus share a port."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence

from drivers.imu.port import AXES, ImuLost, ImuPort, SensorDevice, flag_option
from fes.config import Bus

ON_CAN = ("xsens_can", "dbc_can")
OPTIONS = {
    "xbus": ("baudrate", "configure"),
    "xsens_can": ("id_offset", "group_counter"),
    "dbc_can": ("dbc", *AXES, "time", "counter", "acc_unit", "gyr_unit", "time_unit", "id_offset"),
    "ximu3": ("baudrate", "library"),
    "lsl": (*AXES, "acc_unit", "gyr_unit", "timeout_s"),
}  # that each kind of device has


def open_imus(sensors: Sequence[SensorDevice], bus: Bus | None = None) -> list[ImuPort]:
    """One port per line, in the order of the settings.

    Args:
        sensors: the settings of all sensors.
        bus: the session's CAN bus, which the port ``bus`` names; ``interface:channel`` names another one.

    Raises:
        ImuLost: one cannot be opened; those already open are closed again.
        ValueError: settings that cannot work; the message names the sensor and the option.
    """
    ports: list[ImuPort] = []
    try:
        for open_one in _plan(sensors, bus or Bus()):
            ports.append(open_one())
    except (ImuLost, ValueError):
        for port in ports:
            with contextlib.suppress(ImuLost):
                port.close()
        raise
    return ports


def _plan(sensors: Sequence[SensorDevice], bus: Bus) -> list[Callable[[], ImuPort]]:
    plan: list[Callable[[], ImuPort]] = []
    buses: dict[str, list[SensorDevice]] = {}
    own = f"{bus.interface}:{bus.channel}"
    for device in sensors:
        _has_its_options(device)
        if device.device not in ON_CAN:
            plan.append(_serial(device))
            continue
        # the session's bus by its other name is the same one, unless a port number tells them apart
        port = "bus" if device.port == own and "port" not in bus.options else device.port
        if port in buses:
            buses[port].append(device)
        else:
            buses[port] = [device]
            plan.append(_can(buses[port], bus if port == "bus" else _other_bus(device)))
    return plan


def _has_its_options(device: SensorDevice) -> None:
    """A misspelt option would leave the sensor at its default, such as a unit, without a word."""
    known = OPTIONS.get(device.device, ())
    if unknown := sorted(device.options.keys() - set(known)):
        raise ValueError(
            f"{device.sensor}: device {device.device!r} has no option {', '.join(unknown)}; it has {', '.join(known)}"
        )


def _other_bus(device: SensorDevice) -> Bus:
    interface, colon, channel = device.port.partition(":")
    if not colon:
        raise ValueError(f"{device.sensor}: port = {device.port!r} must be 'bus' or INTERFACE:CHANNEL")
    return Bus(interface=interface, channel=channel)


def _can(group: list[SensorDevice], settings: Bus) -> Callable[[], ImuPort]:
    def open_one() -> ImuPort:
        from drivers.imu.can_port import CanImus

        return CanImus(group, settings)

    return open_one


def _serial(device: SensorDevice) -> Callable[[], ImuPort]:
    def open_one() -> ImuPort:
        if device.device == "xbus":
            from drivers.imu.xbus_port import XbusImu

            return XbusImu(device)
        if device.device == "ximu3":
            from drivers.imu.ximu3_port import Ximu3Imu, Ximu3LibraryImu

            return Ximu3LibraryImu(device) if flag_option(device, "library", False) else Ximu3Imu(device)
        if device.device == "lsl":
            from drivers.imu.lsl_port import LslImu

            return LslImu(device)
        raise ValueError(f"{device.sensor}: device = {device.device!r} is not known")

    return open_one
