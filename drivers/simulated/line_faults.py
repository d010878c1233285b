"""A simulated device on a line in real time, and what can go wrong on that line, on command.

``garble`` / ``drop`` / ``reorder``: so many of the next messages have a bit flipped, are lost, or change places with
the one after. ``delay``: every message comes so many seconds late. ``mute``: 1, none comes at all; 0, all again.
"""

from __future__ import annotations

import heapq
import select
import time
from collections.abc import Callable
from typing import Final, Protocol

from drivers.simulated.lines import DeviceEnd
from drivers.simulated.process_end import STDIN, CommandReader, fault_commands
from drivers.simulated.stimulator.firmware import NEVER
from fes.signals import NS_PER_S

LINE_FAULTS: Final = frozenset(("garble", "drop", "reorder", "delay", "mute"))
LONGEST_WAIT_S: Final = 1.0


class LineFaults:
    """Messages in, the bytes that come out at the other end; no I/O, no clock."""

    def __init__(self) -> None:
        self._values = dict.fromkeys(LINE_FAULTS, 0.0)
        self._waiting: list[tuple[int, int, bytes]] = []
        self._held = b""
        self._order = 0

    def set(self, name: str, value: float) -> None:
        """Bring a fault about, or with 0 end it.

        Raises:
            ValueError: no such fault, or a value below 0.
        """
        if name not in LINE_FAULTS or not value >= 0:
            raise ValueError(
                f"fault {name!r} = {value!r} is not known; one of {', '.join(sorted(LINE_FAULTS))}, 0 or more"
            )
        self._values[name] = value

    def send(self, t_ns: int, messages: list[bytes]) -> None:
        """The device sends these."""
        for message in messages:
            if self._values["mute"] or self._use_up("drop"):
                continue
            if self._use_up("garble"):
                flipped = bytearray(message)
                flipped[len(flipped) // 2] ^= 0x10
                message = bytes(flipped)
            if not self._held and self._use_up("reorder"):
                self._held = message
                continue
            self._push(t_ns, message)
            if self._held:
                self._push(t_ns, self._held)
                self._held = b""

    def due(self, t_ns: int) -> bytes:
        """What has got through by now."""
        out = b""
        while self._waiting and self._waiting[0][0] <= t_ns:
            out += heapq.heappop(self._waiting)[2]
        return out

    def next_deadline_ns(self) -> int:
        """When :meth:`due` has something next."""
        return self._waiting[0][0] if self._waiting else NEVER

    def _push(self, t_ns: int, message: bytes) -> None:
        self._order += 1
        heapq.heappush(self._waiting, (t_ns + int(self._values["delay"] * NS_PER_S), self._order, message))

    def _use_up(self, name: str) -> bool:
        if self._values[name] < 1:
            return False
        self._values[name] -= 1
        return True


class Device(Protocol):
    """What such a device does: time and bytes in, messages out; no I/O, no clock."""

    def receive(self, t_ns: int, data: bytes) -> list[bytes]:
        """Act on bytes from the host."""

    def advance(self, t_ns: int) -> list[bytes]:
        """Do all that is due by ``t_ns``."""

    def next_deadline_ns(self) -> int:
        """When :meth:`advance` must be called again at the latest."""

    def set_fault(self, t_ns: int, name: str, value: float) -> list[bytes]:
        """Bring about one of its own faults; ValueError for one it does not know."""


class DeviceLoop:
    """Device, its end of the line, and the line's faults: one wait per turn, until a deadline, a byte or a command.

    ``wake`` ends the loop when it is readable, so does the end of stdin if ``stdin`` is listened to. ``afterwards`` is
    called whenever the device has acted.
    """

    def __init__(
        self,
        device: Device,
        end: DeviceEnd,
        wake: int,
        *,
        stdin: bool = True,
        afterwards: Callable[[], None] = lambda: None,
    ) -> None:
        self._device = device
        self._end = end
        self._wake = wake
        self._stdin = [STDIN] if stdin else []
        self._afterwards = afterwards
        self._faults = LineFaults()
        self._commands = CommandReader(fault_commands(self.inject))

    def run(self) -> None:
        """Until a signal, or the end of stdin."""
        while self._turn():
            pass

    def inject(self, name: str, value: float) -> None:
        """Bring a fault about: the line's or the device's own.

        Raises:
            ValueError: no such fault.
        """
        now_ns = time.monotonic_ns()
        if name == "unplug":
            self._end.unplug()
        elif name in LINE_FAULTS:
            self._faults.set(name, value)
        else:
            self._put_out(now_ns, self._device.set_fault(now_ns, name, value))

    def _turn(self) -> bool:
        now_ns = time.monotonic_ns()
        self._put_out(now_ns, self._device.advance(now_ns))
        deadline_ns = min(self._device.next_deadline_ns(), self._faults.next_deadline_ns())
        wait_s = min(max(0.0, (deadline_ns - time.monotonic_ns()) / NS_PER_S), LONGEST_WAIT_S)
        line = self._end.descriptors()
        ready, _, _ = select.select([self._wake, *self._stdin, *line], [], [], wait_s)
        if self._wake in ready or (STDIN in ready and not self._commands.read()):
            return False
        # a command may have closed what select found
        if any(descriptor in ready for descriptor in self._end.descriptors()) and (data := self._end.read()):
            now_ns = time.monotonic_ns()
            self._put_out(now_ns, self._device.receive(now_ns, data))
        return True

    def _put_out(self, now_ns: int, messages: list[bytes]) -> None:
        self._faults.send(now_ns, messages)
        self._end.write(self._faults.due(now_ns))
        self._afterwards()
