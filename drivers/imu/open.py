"""Open whichever sensors the settings name; those on one CAN bus share a port."""

import contextlib
import importlib
from collections.abc import Callable, Sequence
from functools import partial

from drivers.imu.port import AXES, ImuLost, ImuPort
from fes.config import Bus, ImuDevice
from fes.extensions import ExtensionError, load_extension

WITHOUT_LINE = ("lsl", "capture2go_ble", "movella_dot")  # whose port is no line of this computer
ON_CAN = ("xsens_can", "dbc_can")
KINDS: dict[str, tuple[str, tuple[str, ...]]] = {  # the port, imported only where it is wanted, and its options
    "xbus": ("xbus.XbusImu", ("baudrate", "configure")),
    "xsens_can": ("can_port.CanImus", ("id_offset", "group_counter")),
    "dbc_can": (
        "can_port.CanImus",
        ("dbc", *AXES, "time", "counter", "acc_unit", "gyr_unit", "time_unit", "id_offset"),
    ),
    "ximu3": ("ximu3.Ximu3Imu", ("baudrate",)),
    "capture2go": ("capture2go_port.Capture2GoImu", ("baudrate", "sync", "sync_id")),
    "capture2go_ble": ("capture2go_port.Capture2GoRadio", ("sync", "sync_id", "find_s", "packed")),
    "witmotion": ("witmotion.WitmotionImu", ("baudrate", "configure")),
    "movella_dot": ("movella_dot.MovellaDotImu", ("find_s",)),
    "lsl": ("lsl_port.LslImu", (*AXES, "acc_unit", "gyr_unit", "timeout_s")),
}


def open_imus(sensors: Sequence[ImuDevice], bus: Bus | None = None) -> list[ImuPort]:
    """One port per line, in the order of the settings; ``bus`` is the session's CAN bus, which the port ``bus`` names.

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


def _plan(sensors: Sequence[ImuDevice], bus: Bus) -> list[Callable[[], ImuPort]]:
    plan: list[Callable[[], ImuPort]] = []
    buses: dict[str, list[ImuDevice]] = {}
    own = f"{bus.interface}:{bus.channel}"
    for device in sensors:
        if device.device not in KINDS:
            plan.append(partial(_open_other, device))
            continue
        name, known = KINDS[device.device]
        if unknown := sorted(device.options.keys() - set(known)):  # misspelt, it would leave the default without a word
            raise ValueError(
                f"{device.sensor}: device {device.device!r} has no option {', '.join(unknown)}; it has "
                f"{', '.join(known)}"
            )
        if device.device not in ON_CAN:
            plan.append(partial(_open_kind, name, device))
            continue
        # the session's bus by its other name is the same one, unless a port number tells them apart
        port = "bus" if device.port == own and "port" not in bus.options else device.port
        if port in buses:
            buses[port].append(device)
            continue
        buses[port] = [device]
        interface, colon, channel = port.partition(":")
        if port != "bus" and not colon:
            raise ValueError(f"{device.sensor}: port = {device.port!r} must be 'bus' or INTERFACE:CHANNEL")
        settings = bus if port == "bus" else Bus(interface=interface, channel=channel)
        plan.append(partial(_open_kind, name, buses[port], settings))
    return plan


def _open_kind(name: str, *settings: object) -> ImuPort:
    module, _, kind = name.partition(".")
    port: ImuPort = getattr(importlib.import_module(f"drivers.imu.{module}"), kind)(*settings)
    return port


def _open_other(device: ImuDevice) -> ImuPort:
    """A sensor of another package: its entry point makes an :class:`ImuPort` from the settings.

    Raises:
        ImuLost: it cannot be opened.
        ValueError: the package cannot be used, or made something else.
    """
    make = load_extension("sensor", device.device)
    port = make(device)
    if not isinstance(port, ImuPort):
        raise ExtensionError(f"{device.sensor}: device {device.device!r} is no ImuPort but {type(port).__name__}")
    return port
