"""Simulated stimulators in this process: no wire, no clock, no waiting; whoever owns one says what time it is.

The controller's side is the real port with its codec, counters and answers; the other side is the simulated firmware.
Between them bytes and frames pass at once.
"""

from collections import deque
from dataclasses import dataclass, field
from itertools import count

import can

from drivers.simulated.lines import Device, LineFaults
from drivers.simulated.record import Pulse
from drivers.simulated.stimulator.firmware import NodeFaults, StimulatorNode
from drivers.stimulator.can_codec import Frame
from drivers.stimulator.can_port import CanStimulator, Handshake
from drivers.stimulator.port import StimulatorLost
from fes.limits import MAX_VALIDITY_MS
from fes.signals import NS_PER_S, StimAlive, StimCommand, StimStatus, WireFrame
from fes.simulation.forward.settings import DeliveredPulse


@dataclass(eq=False)
class DeviceLine:
    """A device on a line of bytes as a :class:`~drivers.stimulator.serial_line.Line`.

    Writing reaches the device at once, at :attr:`t_ns`; waiting lets its time pass.
    """

    device: Device
    t_ns: int = 0
    faults: LineFaults = field(default_factory=LineFaults)
    unplugged: bool = False
    name: str = "simulated device"

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


class NodeBus(can.BusABC):
    """A bus with one simulated stimulator on it and no wire; time passes by :meth:`advance`, and while one waits."""

    def __init__(self, boot_id: int, t_ns: int, faults: NodeFaults | None = None) -> None:
        super().__init__(channel="in process")
        self.channel_info = "simulated stimulator in this process"
        self.node = StimulatorNode(boot_id, t_ns, faults)
        self.pulses: list[Pulse] = []
        self.t_ns = t_ns
        self._frames: deque[Frame] = deque()

    def advance(self, t_ns: int) -> None:
        """Let the node live on to ``t_ns``, from deadline to deadline, so that each pulse is seen by itself."""
        while (deadline_ns := self.node.next_deadline_ns()) <= t_ns:
            self.t_ns = max(self.t_ns, deadline_ns)
            self._frames.extend(self.node.advance(self.t_ns))
            self.pulses += self.node.take_pulses()
        self.t_ns = max(self.t_ns, t_ns)

    def clock_ns(self) -> int:
        """The node's time, for a handshake's deadline."""
        return self.t_ns

    def wait(self, timeout_s: float) -> None:
        """Until the node has something to do, at most ``timeout_s`` of its time; not at all when a frame has come."""
        if not self._frames:
            end_ns = self.t_ns + max(int(timeout_s * NS_PER_S), 1)
            self.advance(min(max(self.node.next_deadline_ns(), self.t_ns), end_ns))

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """To the node, now; a pulse that it makes at once counts too."""
        self._frames.extend(self.node.receive(self.t_ns, msg.arbitration_id, bytes(msg.data)))
        self.pulses += self.node.take_pulses()

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        if timeout:
            self.wait(timeout)
        if not self._frames:
            return None, False
        identifier, data = self._frames.popleft()
        return can.Message(arbitration_id=identifier, data=data, is_extended_id=False), False

    def shutdown(self) -> None:
        """Nothing to release; it may be opened again."""
        super().shutdown()


class InProcessStimulator(CanStimulator):
    """:class:`CanStimulator` to a node in this process; :meth:`send` and :meth:`poll` advance it.

    Every pulse that the node makes is kept until :meth:`take_pulses`: what a virtual patient feels.
    """

    def __init__(
        self,
        session_id: int,
        boot_id: int = 1,
        t_ns: int = 0,
        faults: NodeFaults | None = None,
        *,
        validity_ms: int = MAX_VALIDITY_MS,
    ) -> None:
        self.bus = NodeBus(boot_id, t_ns, faults)
        super().__init__(self.bus, session_id, validity_ms=validity_ms)

    def start(self, t_ns: int) -> Handshake:
        """Open the session at ``t_ns``."""
        self.bus.advance(t_ns)
        ticks = count()
        return self.open(t_ns, timeout_s=1e-6, clock_ns=lambda: next(ticks))

    def send(self, command: StimCommand) -> WireFrame:
        """As :meth:`CanStimulator.send`, at the command's time."""
        self.bus.advance(command.t_ns)
        return super().send(command)

    def poll(self, t_ns: int) -> list[StimStatus | StimAlive]:
        """As :meth:`CanStimulator.poll`, at ``t_ns``."""
        self.bus.advance(t_ns)
        return super().poll(t_ns)

    def take_pulses(self) -> list[DeliveredPulse]:
        """The pulses since the last call, by time."""
        pulses, self.bus.pulses = self.bus.pulses, []
        return [DeliveredPulse(*pulse) for pulse in sorted(pulses)]
