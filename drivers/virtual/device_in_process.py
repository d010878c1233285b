"""A simulated device as a :class:`~drivers.stimulator.serial_line.Line` in this process: no line, no clock, no waiting.

For replays, and for tests on an injected time: whoever owns it says what time it is.
"""

from __future__ import annotations

from drivers.stimulator.port import StimulatorLost
from drivers.virtual.line_faults import LineFaults
from drivers.virtual.simulated_device import SimulatedDevice
from fes.signals import NS_PER_S


class DeviceLine:
    """Writing reaches the device at once, at :attr:`t_ns`; waiting lets its time pass."""

    name = "simulated device"

    def __init__(self, device: SimulatedDevice, t_ns: int = 0) -> None:
        self.device = device
        self.faults = LineFaults()
        self.t_ns = t_ns
        self.unplugged = False

    def advance(self, t_ns: int) -> None:
        """Let time pass for the device."""
        self.t_ns = max(self.t_ns, t_ns)
        self.faults.send(self.t_ns, self.device.advance(self.t_ns))

    def clock_ns(self) -> int:
        """The device's time, for a handshake's deadline."""
        return self.t_ns

    def write(self, data: bytes) -> None:
        """To the device, now."""
        self._need_cable()
        self.faults.send(self.t_ns, self.device.receive(self.t_ns, data))

    def read(self) -> bytes:
        """What the device has sent and the line let through by now."""
        self._need_cable()
        return self.faults.due(self.t_ns)

    def wait(self, timeout_s: float) -> None:
        """Until the device or the line has something to do, at most ``timeout_s`` of their time."""
        deadline_ns = min(self.device.next_deadline_ns(), self.faults.next_deadline_ns())
        self.advance(min(max(deadline_ns, self.t_ns), self.t_ns + max(int(timeout_s * NS_PER_S), 1)))

    def fileno(self) -> int:
        """There is none."""
        return -1

    def close(self) -> None:
        """Nothing to release."""

    def _need_cable(self) -> None:
        if self.unplugged:
            raise StimulatorLost("simulated device: the cable is pulled")
