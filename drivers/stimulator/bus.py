"""Open whichever CAN bus the settings name: socketcan, pcan, kvaser, udp_multicast … need configuration only.

Besides python-can's interfaces there is ``loopback``, for a machine without any network, and python-can's bus for
serial adapters (slcan) so that it never waits.
"""

import contextlib
import errno
import os
import select
import socket
import struct
import sys
from contextlib import suppress
from typing import Any, Final

import can
from can.interfaces.slcan import slcanBus

from drivers.stimulator.can_codec import NODE_IDS
from drivers.stimulator.port import StimulatorLost
from drivers.stimulator.serial_line import Waiting, make_room
from fes.config import Bus

MULTICAST: Final = "udp_multicast"
LOOPBACK: Final = "loopback"
SLCAN: Final = "slcan"
_HINTS: Final = {
    MULTICAST: "The channel must be a multicast address (224.0.0.0 to 239.255.255.255), the option port a number, and "
    "the machine needs a route for it; with no network at all use the interface loopback.",
    LOOPBACK: "The channel must be a multicast address (224.0.0.0 to 239.255.255.255), the option port a number.",
    "socketcan": "Bring the interface up first: ip link set can0 up type can bitrate 500000; for virtual CAN modprobe "
    "vcan; ip link add vcan0 type vcan; ip link set vcan0 up. ip -br link lists them.",
    "pcan": "Install PEAK's PCANBasic library, plug the adapter in; channels are named PCAN_USBBUS1, PCAN_USBBUS2 …",
    "kvaser": "Install Kvaser's canlib, plug the adapter in; channels are numbered from 0.",
    "slcan": "The channel is the adapter's serial port; its options are bitrate and tty_baudrate.",
}
LINE_HINT: Final = "Check cable, termination (120 ohm at both ends) and the adapter; then start a new session."
VIRTUAL: Final = (MULTICAST, LOOPBACK)
_ERR_BUSOFF: Final = 0x40  # linux/can/error.h
TAKES_NONE: Final = "the adapter takes no frames"
_READ_AT_MOST: Final = 4096
_ENDS: Final = (b"\r", b"\a")  # of a line; the bell says that a command was refused
GROUP: Final = "239.74.163.2"
DEFAULT_PORT: Final = 43113
_HOST: Final = "127.0.0.1"
_FRAME: Final = struct.Struct("!IB8s")  # identifier with SocketCAN's extended flag, length, data padded with zeros
_EXTENDED: Final = 0x8000_0000
_IP_MULTICAST_ALL: Final = 49  # linux/in.h: 0 = only groups that this very socket joined


class PromptSlcanBus(slcanBus):
    """As :class:`can.interfaces.slcan.slcanBus`, but neither reading nor writing ever waits.

    As python-can has it, a write of no time-out spins until the adapter takes the bytes, each write then waits for the
    last of them to be on the line, and a read takes a system call for each byte and waits a millisecond for one more.
    All of that would be the control loop's time. Lines that are no frames are passed over, whatever they hold.

    can.CanOperationError: from ``send`` when the adapter does not take a frame whole at once, from ``recv`` when it is
    gone.
    """

    def __init__(self, channel: str, timeout: float = 0.0, **options: Any) -> None:
        super().__init__(channel, timeout=timeout, **options)
        self.channel_info = f"serial CAN adapter on {channel}"
        self._waiting = Waiting(self.serialPortOrig)
        self.serialPortOrig.write_timeout = 0  # or the first frame would set the port up anew

    def _write(self, string: str) -> None:
        data = string.encode() + self.LINE_TERMINATOR
        try:
            os.set_blocking(self._descriptor, False)
            written = os.write(self._descriptor, data)
        except BlockingIOError:
            written = 0
        except OSError as error:
            raise can.CanOperationError(f"the adapter is gone: {error.strerror}") from error
        if written != len(data):
            # what it did take is half a line, which the next opening ends
            raise can.CanOperationError(f"{TAKES_NONE}: it took {written} of {len(data)} bytes, nobody waits for it")

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        while (line := self._read(timeout)) is not None:
            timeout = 0.0
            self._queue.put_nowait(line)
            with suppress(ValueError, IndexError):  # garbled
                message, filtered = super()._recv_internal(0.0)
                if message is not None:
                    return message, filtered
        return None, False

    def _read(self, timeout: float | None) -> str | None:
        """The next line; None when none is complete within ``timeout``."""
        while not (ends := [at for at in map(self._buffer.find, _ENDS) if at >= 0]):
            if timeout == 0.0 and self._waiting.nothing():
                return None
            try:
                if not select.select([self._descriptor], [], [], timeout)[0]:
                    return None
                data = os.read(self._descriptor, _READ_AT_MOST)
            except BlockingIOError:
                continue
            except (OSError, ValueError) as error:
                raise can.CanOperationError(f"the adapter cannot be read: {error}") from error
            if not data:
                raise can.CanOperationError("the adapter is gone")
            self._buffer += data
        line = self._buffer[: min(ends) + 1]
        del self._buffer[: min(ends) + 1]
        return line.decode("latin-1")

    @property
    def _descriptor(self) -> int:
        return int(self.serialPortOrig.fileno())

    def shutdown(self) -> None:
        """Close the channel, if the adapter still takes that, and release the port."""
        with suppress(can.CanError, OSError):
            super().shutdown()
        self.serialPortOrig.close()


class LoopbackBus(can.BusABC):
    """Classical data frames over multicast on 127.0.0.1; every bus on the same group and port hears every frame.

    python-can's ``udp_multicast`` joins its group on whatever interface the default route names, so without a route it
    cannot be opened. This bus joins on the loopback interface instead: nothing leaves the machine, nothing enters. As
    with python-can's multicast, a bus hears its own frames too.

    OSError: the group is no multicast address, or the port is out of range or not ours to use.
    """

    def __init__(self, channel: str = GROUP, port: int = DEFAULT_PORT, **kwargs: Any) -> None:
        self.channel_info = f"loopback {channel} port {port}"
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            if isinstance(port, bool) or not isinstance(port, int):
                raise ValueError("the port must be a whole number")
            self._address = (channel, port)
            membership = socket.inet_aton(channel) + socket.inet_aton(_HOST)
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            self._socket.bind(self._address)
            self._socket.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, membership)
            self._socket.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton(_HOST))
            self._socket.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 0)
            if sys.platform == "linux":
                self._socket.setsockopt(socket.IPPROTO_IP, _IP_MULTICAST_ALL, 0)
            self._socket.setblocking(False)
            super().__init__(channel=channel, **kwargs)
        except (OSError, OverflowError, ValueError) as error:
            self._socket.close()
            raise OSError(errno.EINVAL, f"channel {channel!r}, port {port!r}: {error}") from error

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Put the frame out at once. can.CanOperationError: no classical data frame, or the system's buffer is full."""
        if msg.is_fd or msg.is_remote_frame or msg.is_error_frame or len(msg.data) > 8:
            raise can.CanOperationError("the loopback bus carries classical data frames only")
        identifier = msg.arbitration_id | (_EXTENDED if msg.is_extended_id else 0)
        try:
            self._socket.sendto(_FRAME.pack(identifier, len(msg.data), bytes(msg.data)), self._address)
        except OSError as error:
            raise can.CanOperationError(f"cannot send: {error.strerror}", error.errno) from error

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        try:
            if not select.select([self._socket], [], [], timeout)[0]:
                return None, False
            datagram = self._socket.recv(64)
        except OSError as error:
            raise can.CanOperationError(f"cannot receive: {error.strerror}", error.errno) from error
        if len(datagram) != _FRAME.size or datagram[4] > 8:
            raise can.CanOperationError(f"a datagram of {len(datagram)} bytes is no CAN frame")
        identifier, length, data = _FRAME.unpack(datagram)
        extended = bool(identifier & _EXTENDED)
        return can.Message(arbitration_id=identifier & ~_EXTENDED, is_extended_id=extended, data=data[:length]), False

    def fileno(self) -> int:
        """The socket, for ``select``."""
        return self._socket.fileno()

    def shutdown(self) -> None:
        """Close the socket; may be called twice."""
        super().shutdown()
        self._socket.close()


class BusError(StimulatorLost):
    """The bus of the settings cannot be opened; the message names it and what to check."""


def open_bus(settings: Bus, identifiers: frozenset[int] = NODE_IDS) -> can.BusABC:
    """The bus of ``settings``, from these settings alone: python-can's own configuration files are not read.

    Only ``identifiers`` are wanted; where the kernel can filter, nothing else arrives. Classical CAN frames only.
    A serial adapter (slcan) is never waited for: a frame that it does not take at once is lost, and the bus with it.
    Multicast does not leave this machine unless the option ``hop_limit`` says so. Frames that come while this program
    is held up wait for it, as many as the system grants room for.

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
        if own := {LOOPBACK: LoopbackBus, SLCAN: PromptSlcanBus}.get(settings.interface):
            bus: can.BusABC = own(settings.channel, **options)
        else:
            bus = can.Bus(interface=settings.interface, channel=settings.channel, ignore_config=True, **options)
    except Exception as error:  # vendors' modules raise anything: OSError, NameError, ImportError, CanError …
        fault = f"cannot be opened: {error.__cause__ or error} ({type(error).__name__})"
        hint = _HINTS.get(settings.interface, "See python-can's page on this interface for its channel and options.")
        raise BusError(f"CAN bus {settings.interface} {settings.channel!r} {fault}. {hint}") from error
    with contextlib.suppress(NotImplementedError, OSError, ValueError):  # a vendor's library may have no descriptor
        make_room(bus.fileno())
    if settings.interface in VIRTUAL:
        bus.channel_info = bus_name(settings)
    return bus


def silence_hint(bus: can.BusABC) -> str:
    """What to look at where nothing is heard on a bus."""
    if any(bus.channel_info.startswith(interface) for interface in VIRTUAL):
        return "No stimulator runs on this virtual bus: fes simulate --live starts one, and writes its session."
    return f"Is it powered and connected, is the channel right, is the bit rate the same on both sides? {LINE_HINT}"


def read_frame(bus: can.BusABC, timeout_s: float) -> can.Message | None:
    """The next frame; None when there is none within the time.

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
    """Put a frame of 11 bit identifier out, at once or never. StimulatorLost: the bus did not take it."""
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
