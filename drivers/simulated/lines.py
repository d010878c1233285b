"""A simulated device on a line of bytes, in real time: its end of the line, and what can go wrong there, on command.

The line is a pseudo-terminal of its own, a TCP port, or UDP datagrams. Faults: ``garble`` / ``drop`` / ``reorder``: so
many of the next messages have a bit flipped, are lost, or change places with the one after. ``delay``: every message
comes so many seconds late. ``mute``: 1, none comes at all; 0, all again. ``backlog``: 1, none comes but each waits
in its order, as in the buffer of a sensor whose radio does not get through; 0, all that waited come at once.

A simulated device's process, seen from inside: publishes that it is ready, takes faults on stdin, ends on a signal.

Ready is one JSON line on stdout. Faults are JSON lines ``{"fault": NAME, "value": NUMBER}`` on stdin, each confirmed by
a line with the time at which it had taken effect, or answered with what is wrong. SIGTERM, SIGINT and the end of stdin
end the process. The other end of the conversation is :mod:`drivers.simulated.spawn`.
"""

import argparse
import contextlib
import gc
import heapq
import itertools
import json
import os
import select
import signal
import socket
import struct
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, ClassVar, Final, Generic, TypeVar

import can

from drivers.simulated.stimulator.firmware import NEVER
from drivers.stimulator.bus import MULTICAST, open_bus
from fes.config import Bus
from fes.signals import NS_PER_S

STDIN: Final = 0
CAN_RECORD: Final = struct.Struct(">IB8s")  # identifier, length, data
FRAMES_AT_ONCE: Final = 64
READ_ERRORS_IN_A_ROW: Final = 100


class BusBroken(RuntimeError):
    """A device's bus cannot be read any more."""


def stop_signals() -> socket.socket:
    """Readable as soon as SIGTERM or SIGINT has come, so that a wait ends with it. Call once, in the main thread."""
    signalled, wake = socket.socketpair()
    wake.setblocking(False)
    signal.set_wakeup_fd(wake.detach())
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: None)
    return signalled


def become_real_time() -> bool:
    """Ask for SCHED_FIFO, as a device's timers owe nothing to this computer's load; False where it is not allowed."""
    gc.freeze()
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(10))
    except (AttributeError, OSError):
        return False
    return True


def publish_ready(**facts: str | int | bool | dict[str, str]) -> None:
    """Publish to whoever started this process that the device runs, and how it is reached."""
    print(json.dumps({"ready": True, "pid": os.getpid(), **facts}), flush=True)


def add_bus_options(parser: argparse.ArgumentParser, interface: str = MULTICAST) -> None:
    """Options that :func:`bus_of` reads."""
    parser.add_argument("--interface", default=interface, help="python-can interface or loopback (default %(default)s)")
    parser.add_argument("--channel", default=Bus().channel, help="channel of the interface (default %(default)s)")
    parser.add_argument("--port", type=int, help="UDP port, for udp_multicast and loopback")


def bus_of(options: argparse.Namespace) -> Bus:
    """The bus that a command line names."""
    port: dict[str, str | int | float | bool] = {} if options.port is None else {"port": options.port}
    return Bus(interface=options.interface, channel=options.channel, options=port)


def fault_commands(inject: Callable[[str, float], None]) -> Callable[[dict[str, Any]], dict[str, Any]]:
    """Commands that are faults only: ``inject`` brings one about, or raises ValueError for an unknown one."""

    def execute(command: dict[str, Any]) -> dict[str, Any]:
        inject(str(command["fault"]), float(command.get("value", 1)))
        return {"done": command["fault"]}

    return execute


@dataclass(eq=False)
class CommandReader:
    """Commands as they come on stdin; ``execute`` carries one out and returns the answer, without the time."""

    execute: Callable[[dict[str, Any]], dict[str, Any]]
    now_ns: Callable[[], int] = time.monotonic_ns
    _incomplete: bytes = b""

    def read(self) -> bool:
        """Execute what has come, when stdin is readable; False at its end."""
        data = os.read(STDIN, 4096)
        *lines, self._incomplete = (self._incomplete + data).split(b"\n")
        for line in lines:
            try:
                answer = {**self.execute(json.loads(line)), "t_ns": self.now_ns()}
            except (ValueError, KeyError, TypeError, AttributeError, OverflowError) as error:
                answer = {"error": f"{line.decode(errors='replace')!r}: {error}"}
            print(json.dumps(answer), flush=True)
        return bool(data)


LINE_FAULTS: Final = frozenset(("garble", "drop", "reorder", "delay", "mute", "backlog"))
LONGEST_WAIT_S: Final = 1.0


class DeviceEnd(ABC):
    """Bytes in and out; whoever is at the other end may come and go. This base only sends."""

    port: str  # what the host opens

    def descriptors(self) -> list[int]:
        """To wait for."""
        return []

    def read(self) -> bytes:
        """What has arrived."""
        return b""

    @abstractmethod
    def write(self, data: bytes) -> None:
        """Out, or lost when nobody takes it."""

    @abstractmethod
    def unplug(self) -> None:
        """The cable is pulled, for good."""


class PtyEnd(DeviceEnd):
    """A pseudo-terminal; the host opens its other end like a serial port."""

    def __init__(self) -> None:
        import tty  # here, for only this line needs more than any computer has

        # the other end stays open here as well, so that a host that leaves is not the end of the line
        self._own, self._other = os.openpty()
        tty.setraw(self._other)
        os.set_blocking(self._own, False)
        self.port = os.ttyname(self._other)
        self._plugged = True
        self._clogged = False

    def descriptors(self) -> list[int]:
        """Our end, while there is a cable and it is read."""
        return [self._own] if self._plugged and not self._clogged else []

    def read(self) -> bytes:
        """At most 4096 bytes."""
        with contextlib.suppress(OSError):
            if self._plugged:
                return os.read(self._own, 4096)
        return b""

    def write(self, data: bytes) -> None:
        """A host that does not read loses the bytes."""
        with contextlib.suppress(OSError):
            if self._plugged and data:
                os.write(self._own, data)

    def clog(self, clogged: bool) -> None:
        """Take nothing more, with the host's buffer full at once; or throw away what is in it, and go on."""
        if not self._plugged or clogged == self._clogged:
            return
        self._clogged = clogged
        with contextlib.suppress(OSError):  # the end of each loop
            if clogged:
                os.set_blocking(self._other, False)
                while os.write(self._other, bytes(1024)):
                    pass
            while not clogged and os.read(self._own, 4096):
                pass

    def unplug(self) -> None:
        """The host's end reads as gone from now on."""
        if self._plugged:
            self._plugged = False
            os.close(self._other)
            os.close(self._own)


class TcpEnd(DeviceEnd):
    """A TCP port on this machine, for one host at a time; ``socket://127.0.0.1:PORT`` opens it."""

    def __init__(self) -> None:
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._listener.setblocking(False)
        self._host: socket.socket | None = None
        self._plugged = True
        self.port = f"socket://127.0.0.1:{self._listener.getsockname()[1]}"

    def descriptors(self) -> list[int]:
        """Listener and host."""
        return [each.fileno() for each in (self._listener, self._host) if self._plugged and each is not None]

    def read(self) -> bytes:
        """Lets a newcomer in; at most 4096 bytes."""
        if not self._plugged:
            return b""
        with contextlib.suppress(OSError):
            newcomer, _ = self._listener.accept()
            newcomer.setblocking(False)
            newcomer.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._leave()
            self._host = newcomer
        if self._host is None:
            return b""
        try:
            data = self._host.recv(4096)
        except BlockingIOError:
            return b""
        except OSError:
            data = b""
        if not data:
            self._leave()
        return data

    def write(self, data: bytes) -> None:
        """A host that does not read loses the bytes."""
        with contextlib.suppress(OSError):
            if self._host is not None and data:
                self._host.send(data)

    def unplug(self) -> None:
        """Nobody can connect any more."""
        self._leave()
        self._listener.close()
        self._plugged = False

    def _leave(self) -> None:
        if self._host is not None:
            self._host.close()
            self._host = None


class UdpEnd(DeviceEnd):
    """Datagrams to a port on this machine, which the host opens as ``udp://127.0.0.1:PORT``; it says nothing back.

    As on a real network nobody notices that the other end is gone: unplugged, there is silence.
    """

    def __init__(self) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))  # first, so that the host's port below is another one
        self._socket.setblocking(False)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.bind(("127.0.0.1", 0))
            self._host: tuple[str, int] = probe.getsockname()
        self.port = f"udp://127.0.0.1:{self._host[1]}"

    def write(self, data: bytes) -> None:
        """One datagram, lost when nobody listens."""
        with contextlib.suppress(OSError):
            if data:
                self._socket.sendto(data, self._host)

    def unplug(self) -> None:
        """Nothing is sent any more."""
        self._socket.close()


class CanEnd(DeviceEnd):
    """Records of ``CAN_RECORD`` as frames on a bus, of which ``identifiers`` are heard.

    BusError: the bus cannot be opened. BusBroken: reading failed a hundred times in a row.
    """

    def __init__(self, settings: Bus, identifiers: frozenset[int] = frozenset()) -> None:
        self.port = "bus"
        self._bus: can.BusABC | None = open_bus(settings, identifiers)
        self._listens = bool(identifiers)
        self._read_errors = 0

    def descriptors(self) -> list[int]:
        """The bus, where anything is heard."""
        return [self._bus.fileno()] if self._bus is not None and self._listens else []

    def read(self) -> bytes:
        """At most 64 frames."""
        out = b""
        for _ in range(FRAMES_AT_ONCE if self._bus is not None else 0):
            message = self._next()
            if message is None:
                break
            if not (message.is_extended_id or message.is_remote_frame or message.is_error_frame):
                out += CAN_RECORD.pack(message.arbitration_id, len(message.data), bytes(message.data))
        return out

    def _next(self) -> can.Message | None:
        assert self._bus is not None
        try:
            message = self._bus.recv(timeout=0.0)
        except (can.CanError, OSError) as error:  # a datagram that is no CAN frame, or a bus that is gone
            self._read_errors += 1
            if self._read_errors >= READ_ERRORS_IN_A_ROW:
                raise BusBroken(f"{self._bus.channel_info}: cannot be read: {error}") from error
            return None
        self._read_errors = 0
        return message

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


class FaultValues(dict[str, float]):
    """Faults by name, 0: none."""

    def use_up(self, name: str) -> bool:
        """Whether a fault that counts messages or samples meets this one."""
        meets = self[name] >= 1
        self[name] -= meets
        return meets


Message = TypeVar("Message")


class MessageFaults(Generic[Message]):
    """Messages of any kind in, those that come out at the other end; no I/O, no clock."""

    faults: ClassVar[frozenset[str]] = LINE_FAULTS - {"garble"}  # only bytes have bits

    def __init__(self) -> None:
        self._values = FaultValues(dict.fromkeys(self.faults, 0.0))
        self._waiting: list[tuple[int, int, Message]] = []
        self._held: list[Message] = []
        self._backlog: list[Message] = []
        self._order = itertools.count()

    def set(self, name: str, value: float) -> None:
        """Bring a fault about, or with 0 end it. ValueError: no such fault, or a value below 0."""
        if name not in self.faults or not value >= 0:
            known = ", ".join(sorted(self.faults))
            raise ValueError(f"fault {name!r} = {value!r} is not known; one of {known}, 0 or more")
        self._values[name] = value

    def send(self, t_ns: int, messages: Iterable[Message]) -> None:
        """The device sends these."""
        for message in messages:
            if self._values["mute"] or self._values.use_up("drop"):
                continue
            message = self._on_its_way(message)
            if not self._held and self._values.use_up("reorder"):
                self._held.append(message)
                continue
            self._push(t_ns, message)
            while self._held:
                self._push(t_ns, self._held.pop())

    def arrived(self, t_ns: int) -> list[Message]:
        """What has got through by now."""
        out: list[Message] = []
        if not self._values["backlog"] and self._backlog:
            out, self._backlog = self._backlog, []
        while self._waiting and self._waiting[0][0] <= t_ns:
            out.append(heapq.heappop(self._waiting)[2])
        return out

    def next_deadline_ns(self) -> int:
        """When :meth:`arrived` has something next."""
        if self._backlog and not self._values["backlog"]:
            return 0
        return self._waiting[0][0] if self._waiting else NEVER

    def _on_its_way(self, message: Message) -> Message:
        """The message as it gets through."""
        return message

    def _push(self, t_ns: int, message: Message) -> None:
        if self._values["backlog"]:
            self._backlog.append(message)
            return
        heapq.heappush(self._waiting, (t_ns + int(self._values["delay"] * NS_PER_S), next(self._order), message))


class LineFaults(MessageFaults[bytes]):
    """The same for messages of bytes, which may have a bit flipped as well."""

    faults = LINE_FAULTS

    def due(self, t_ns: int) -> bytes:
        """As :meth:`arrived`, in one."""
        return b"".join(self.arrived(t_ns))

    def _on_its_way(self, message: bytes) -> bytes:
        if not self._values.use_up("garble"):
            return message
        flipped = bytearray(message)
        flipped[len(flipped) // 2] ^= 0x10
        return bytes(flipped)


class Device(ABC):
    """What such a device does: time and bytes in, messages out; no I/O, no clock."""

    @abstractmethod
    def receive(self, t_ns: int, data: bytes) -> list[bytes]:
        """Act on bytes from the host."""

    @abstractmethod
    def advance(self, t_ns: int) -> list[bytes]:
        """Do all that is due by ``t_ns``."""

    @abstractmethod
    def next_deadline_ns(self) -> int:
        """When :meth:`advance` must be called again at the latest."""

    @abstractmethod
    def set_fault(self, t_ns: int, name: str, value: float) -> list[bytes]:
        """Bring about one of its own faults; ValueError for one it does not know."""


@dataclass(eq=False)
class DeviceLoop:
    """Device, its end of the line, and the line's faults: one wait per turn, until a deadline, a byte or a command.

    ``wake`` ends the loop when it is readable, so does the end of stdin if ``stdin`` is listened to. ``afterwards`` is
    called whenever the device has acted.
    """

    device: Device
    end: DeviceEnd
    wake: int
    stdin: bool = True
    afterwards: Callable[[], None] = lambda: None

    def __post_init__(self) -> None:
        self._faults = LineFaults()
        self._commands = CommandReader(fault_commands(self.inject))

    def run(self) -> None:
        """Until a signal, or the end of stdin."""
        while self._turn():
            pass

    def inject(self, name: str, value: float) -> None:
        """Bring a fault about: the line's or the device's own. ValueError: no such fault."""
        now_ns = time.monotonic_ns()
        if name == "unplug":
            self.end.unplug()
        elif name in LINE_FAULTS:
            self._faults.set(name, value)
        else:
            self._put_out(now_ns, self.device.set_fault(now_ns, name, value))

    def _turn(self) -> bool:
        now_ns = time.monotonic_ns()
        self._put_out(now_ns, self.device.advance(now_ns))
        deadline_ns = min(self.device.next_deadline_ns(), self._faults.next_deadline_ns())
        wait_s = min(max(0.0, (deadline_ns - time.monotonic_ns()) / NS_PER_S), LONGEST_WAIT_S)
        stdin = [STDIN] if self.stdin else []
        ready, _, _ = select.select([self.wake, *stdin, *self.end.descriptors()], [], [], wait_s)
        if self.wake in ready or (STDIN in ready and not self._commands.read()):
            return False
        # a command may have closed what select found
        if any(descriptor in ready for descriptor in self.end.descriptors()) and (data := self.end.read()):
            now_ns = time.monotonic_ns()
            self._put_out(now_ns, self.device.receive(now_ns, data))
        return True

    def _put_out(self, now_ns: int, messages: list[bytes]) -> None:
        self._faults.send(now_ns, messages)
        self.end.write(self._faults.due(now_ns))
        self.afterwards()
