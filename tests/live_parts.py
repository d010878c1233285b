"""Parts of a live session for tests: a stimulator and sensors over real socket pairs, a clock that is set."""

from __future__ import annotations

import os
import socket
import struct
from dataclasses import dataclass, field

from fes.live.source import EMPTY_READS
from fes.live.supervision import SessionOpened
from fes.signals import StimAlive, StimCommand, StimStatus, Vector3, WireFrame

MS = 1_000_000
SENSOR = struct.Struct("<q6d")


class Lost(RuntimeError):
    """A line is gone."""


@dataclass
class SetClock:
    """Advances by a little whenever it is read, or a loop that waits for it would wait for ever."""

    now_ns: int = 1_000 * MS
    step_ns: int = 50_000

    def __call__(self) -> int:
        self.now_ns += self.step_ns
        return self.now_ns


@dataclass(frozen=True)
class Raw:
    sensor: str
    t_host_ns: int
    t_device_ns: int
    acc_mps2: Vector3
    gyr_radps: Vector3


class SocketImu:
    """A sensor at the other end of a socket pair: send it with :meth:`give`, unplug it with :meth:`unplug`."""

    def __init__(self, sensor: str = "right_foot") -> None:
        self.sensors = (sensor,)
        self.serials: dict[str, str] = {}
        self.notices: list[str] = []
        self._ours, self.theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._ours.setblocking(False)
        self.closed = False
        self.away = False

    def fileno(self) -> int | None:
        return self._ours.fileno()

    def give(self, t_device_ns: int, acc: Vector3 = (0.0, 0.0, 9.81), gyr: Vector3 = (0.0, 0.0, 0.0)) -> None:
        self.theirs.send(SENSOR.pack(t_device_ns, *acc, *gyr))

    def unplug(self) -> None:
        self.theirs.send(b"")
        self.away = True

    def reopen(self) -> None:
        if self.away:
            raise Lost("still away")
        self._ours.close()
        self._ours, self.theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._ours.setblocking(False)

    def read(self, t_ns: int) -> list[Raw]:
        found = []
        while True:
            try:
                data = self._ours.recv(256)
            except BlockingIOError:
                return found
            if not data:
                raise Lost("unplugged")
            t_device_ns, *v = SENSOR.unpack(data)
            found.append(Raw(self.sensors[0], t_ns, t_device_ns, (v[0], v[1], v[2]), (v[3], v[4], v[5])))

    def close(self) -> None:
        self.closed = True
        self._ours.close()


class EverReadable:
    """A line that has :meth:`samples` whenever it is read; none at first, for what has queued up is let go."""

    def __init__(self, *sensors: str) -> None:
        self.sensors = sensors
        self.serials: dict[str, str] = {}
        self.notices: list[str] = []
        self._ready, self._more = os.pipe()
        os.write(self._more, b"x")
        self._unheard = EMPTY_READS

    def fileno(self) -> int:
        return self._ready

    def read(self, t_ns: int) -> list[Raw]:
        os.write(self._more, os.read(self._ready, 1))  # readable anew
        if self._unheard:
            self._unheard -= 1
            return []
        return self.samples(t_ns)

    def samples(self, t_ns: int) -> list[Raw]:
        """What is read next; the test moves its clock on."""
        raise NotImplementedError

    def reopen(self) -> None:
        raise Lost

    def close(self) -> None:
        os.close(self._ready)
        os.close(self._more)


class SameClock:
    """The device runs on the host's clock."""

    resets = 0

    def map(self, t_host_ns: int, t_device_ns: int) -> int:
        return t_device_ns


@dataclass
class FakeStimulator:
    """Remembers commands; answers every one; raises once told to."""

    sent: list[StimCommand] = field(default_factory=list)
    answers: list[StimStatus | StimAlive] = field(default_factory=list)
    broken: str = ""
    closed: bool = False
    heard: bytes = b""

    def send(self, command: StimCommand) -> WireFrame:
        if self.broken:
            raise Lost(self.broken)
        self.sent.append(command)
        return WireFrame(command.t_ns, 0x120, bytes([command.channel, command.on]))

    def poll(self, t_ns: int) -> list[StimStatus | StimAlive]:
        if self.broken:
            raise Lost(self.broken)
        answers, self.answers = self.answers, []
        return answers

    def open(self, t_ns: int) -> SessionOpened:
        """Again, once it is no longer broken."""
        if self.broken:
            raise Lost(self.broken)
        return SessionOpened(4711, 0.5, (WireFrame(t_ns, 0x100, b"hello"),), ())

    def close(self) -> None:
        self.closed = True
