"""A simulated device on a line, in real time: one wait per turn, until its next deadline, a byte or an order."""

from __future__ import annotations

import select
import time
from collections.abc import Callable
from typing import Final, Protocol

from drivers.virtual.device_lines import DeviceEnd
from drivers.virtual.line_faults import LINE_FAULTS, LineFaults
from drivers.virtual.process_end import STDIN, Orders, fault_orders
from fes.signals import NS_PER_S

LONGEST_WAIT_S: Final = 1.0


class Device(Protocol):
    """What such a device does: time and bytes in, messages out; no I/O, no clock."""

    def receive(self, t_ns: int, data: bytes) -> list[bytes]:
        """Act on bytes from the host."""
        ...

    def advance(self, t_ns: int) -> list[bytes]:
        """Do all that is due by ``t_ns``."""
        ...

    def next_deadline_ns(self) -> int:
        """When :meth:`advance` must be called again at the latest."""
        ...

    def set_fault(self, t_ns: int, name: str, value: float) -> list[bytes]:
        """Bring about one of its own faults; ValueError for one it does not know."""
        ...


class DeviceLoop:
    """Device, its end of the line, and the line's faults.

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
        self._orders = Orders(fault_orders(self.fault))

    def run(self) -> None:
        """Until a signal, or the end of stdin."""
        while self._turn():
            pass

    def fault(self, name: str, value: float) -> None:
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
        if self._wake in ready or (STDIN in ready and not self._orders.read()):
            return False
        # an order may have closed what select found
        if any(descriptor in ready for descriptor in self._end.descriptors()) and (data := self._end.read()):
            now_ns = time.monotonic_ns()
            self._put_out(now_ns, self._device.receive(now_ns, data))
        return True

    def _put_out(self, now_ns: int, messages: list[bytes]) -> None:
        self._faults.send(now_ns, messages)
        self._end.write(self._faults.due(now_ns))
        self._afterwards()
