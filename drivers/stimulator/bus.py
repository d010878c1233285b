"""Open whichever CAN bus the settings name: socketcan, pcan, kvaser, udp_multicast … need configuration only.

Besides python-can's interfaces there is ``loopback``, for a machine without any network.
"""

from __future__ import annotations

import contextlib
from typing import Any, Final

import can

from drivers.receive_buffer import make_room
from drivers.stimulator.can_codec import NODE_IDS
from drivers.stimulator.loopback_bus import LoopbackBus
from drivers.stimulator.port import StimulatorLost
from fes.config import Bus

MULTICAST: Final = "udp_multicast"
LOOPBACK: Final = "loopback"
SLCAN: Final = "slcan"
_HINTS: Final = {
    MULTICAST: "The channel must be a multicast address (224.0.0.0 to 239.255.255.255), the option port a number, and "
    "the machine needs a route for it; with no network at all use the interface loopback.",
    LOOPBACK: "The channel must be a multicast address (224.0.0.0 to 239.255.255.255), the option port a number.",
    "socketcan": "Bring the interface up first: ip link set can0 up type can bitrate 500000; ip -br link lists them.",
    "pcan": "Install PEAK's PCANBasic library, plug the adapter in; channels are named PCAN_USBBUS1, PCAN_USBBUS2 …",
    "kvaser": "Install Kvaser's canlib, plug the adapter in; channels are numbered from 0.",
    "slcan": "The channel is the adapter's serial port; its options are bitrate and tty_baudrate.",
}

LINE_HINT: Final = "Check cable, termination (120 ohm at both ends) and the adapter; then start a new session."
_ERR_BUSOFF: Final = 0x40  # linux/can/error.h


class BusError(StimulatorLost):
    """The bus of the settings cannot be opened; the message names it and what to check."""


def open_bus(settings: Bus, identifiers: frozenset[int] = NODE_IDS) -> can.BusABC:
    """The bus of ``settings``, from these settings alone: python-can's own configuration files are not read.

    Only ``identifiers`` are wanted; where the kernel can filter, nothing else arrives. Classical CAN frames only.
    A serial adapter (slcan) is never waited for: a frame that it does not take at once is lost, and the bus with it.
    Multicast does not leave this machine unless the option ``hop_limit`` says so. Frames that come while this program
    is held up wait for it, as many as the system grants room for.

    Raises:
        BusError: unknown interface, missing vendor library, no such channel, or an option out of range.
    """
    options: dict[str, Any] = dict(settings.options)
    known = can.VALID_INTERFACES | {LOOPBACK}
    if settings.interface not in known:
        raise BusError(f"bus.interface = {settings.interface!r} is not known; one of: {', '.join(sorted(known))}")
    taken = sorted({"interface", "channel", "ignore_config", "can_filters"} & options.keys())
    if taken:
        raise BusError(f"bus.options must not hold {', '.join(taken)}; interface and channel are keys of bus itself")
    if settings.interface == MULTICAST:
        options = {"hop_limit": 0, "fd": False} | options
    if settings.interface == "socketcan":
        # in the kernel, so that foreign frames never fill the socket; elsewhere python-can would filter one frame a
        # read and leave the rest waiting: there the port itself drains and drops them
        options["can_filters"] = [{"can_id": number, "can_mask": 0x7FF, "extended": False} for number in identifiers]
    try:
        bus = _opened(settings, options)
    except Exception as error:  # vendors' modules raise anything: OSError, NameError, ImportError, CanError …
        cause = error.__cause__ or error
        hint = _HINTS.get(settings.interface, "See python-can's page on this interface for its channel and options.")
        fault = f"{cause} ({type(error).__name__})"
        raise BusError(
            f"CAN bus {settings.interface} {settings.channel!r} cannot be opened: {fault}. {hint}"
        ) from error
    with contextlib.suppress(NotImplementedError, OSError, ValueError):  # a vendor's library may have no descriptor
        make_room(bus.fileno())
    return bus


def _opened(settings: Bus, options: dict[str, Any]) -> can.BusABC:
    if settings.interface == LOOPBACK:
        return LoopbackBus(settings.channel, **options)
    if settings.interface == SLCAN:
        from drivers.stimulator.slcan_bus import PromptSlcanBus

        return PromptSlcanBus(settings.channel, **options)
    return can.Bus(interface=settings.interface, channel=settings.channel, ignore_config=True, **options)


def read_frame(bus: can.BusABC, timeout_s: float) -> can.Message | None:
    """The next frame; None when there is none within the time.

    Raises:
        StimulatorLost: the bus cannot be read, or the adapter has left it.
    """
    try:
        message = bus.recv(timeout=timeout_s)
    except (can.CanError, OSError) as error:
        raise StimulatorLost(f"{bus.channel_info}: cannot be read: {error}. {LINE_HINT}") from error
    if message is not None and is_bus_off(message):
        raise StimulatorLost(f"{bus.channel_info}: the adapter went bus-off. {LINE_HINT}")
    return message


def write_frame(bus: can.BusABC, identifier: int, data: bytes) -> None:
    """Put a frame of 11 bit identifier out, at once or never.

    Raises:
        StimulatorLost: the bus did not take it.
    """
    try:
        bus.send(can.Message(arbitration_id=identifier, data=data, is_extended_id=False), timeout=0)
    except (can.CanError, OSError) as error:
        raise StimulatorLost(f"{bus.channel_info}: did not take a command: {error}. {LINE_HINT}") from error


def is_bus_off(message: can.Message) -> bool:
    """Whether an adapter says with this frame that it has left the bus after too many errors."""
    return bool(message.is_error_frame and message.arbitration_id & _ERR_BUSOFF)


def bus_off_frame() -> can.Message:
    """What SocketCAN hands on then: an error frame of the class bus-off."""
    return can.Message(arbitration_id=_ERR_BUSOFF, is_error_frame=True, data=bytes(8))


def bus_name(settings: Bus) -> str:
    """The bus as messages name it."""
    port = settings.options.get("port")
    return f"{settings.interface} {settings.channel}" + (f" port {port}" if port is not None else "")
