"""What simulated serial stimulators have in common: bytes and time in, messages and pulses out; no I/O, no clock."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Final

from drivers.simulated.stimulator.firmware import NEVER, RecordEntry
from drivers.stimulator.sciencemode.framing import FrameDecoder, Packet
from fes.signals import NS_PER_S

CHANNELS: Final = 8
NS_PER_MS: Final = 1_000_000


class SimulatedDevice(ABC):
    """Call :meth:`receive` for bytes and :meth:`advance` at every deadline; both return the messages to send.

    Faults that are the device's own, set by :meth:`set_fault`: ``electrode`` (this channel's lead is open), ``slow``
    (each answer takes so many seconds), ``reboot`` (now), ``emergency`` (1: the switch is pressed).
    """

    OWN_FAULTS: Final = frozenset(("electrode", "slow", "reboot", "emergency"))

    def __init__(self, t_ns: int, decoder: FrameDecoder) -> None:
        self.electrode = -1
        self.slow_ns = 0
        self.pulses = [0] * CHANNELS
        self._decoder = decoder
        self._record: list[RecordEntry] = []
        self._boots = 0
        self._restart(t_ns)

    def receive(self, t_ns: int, data: bytes) -> list[bytes]:
        """Act on bytes from the host."""
        out = self.advance(t_ns)
        for packet in self._decoder.feed(data):
            out += self._act(t_ns, packet)
        return out

    @abstractmethod
    def advance(self, t_ns: int) -> list[bytes]:
        """Do all that is due by ``t_ns``."""

    @abstractmethod
    def next_deadline_ns(self) -> int:
        """When :meth:`advance` must be called again at the latest."""

    @abstractmethod
    def power_off(self, t_ns: int) -> None:
        """Silence every channel."""

    def set_fault(self, t_ns: int, name: str, value: float) -> list[bytes]:
        """Bring about one of the device's own faults.

        Raises:
            ValueError: no such fault.
        """
        if name == "electrode":
            self.electrode = int(value)
        elif name == "slow":
            self.slow_ns = int(value * NS_PER_S)
        elif name == "reboot":
            self.power_off(t_ns)
            self._restart(t_ns)
        elif name == "emergency":
            return self._emergency(t_ns, bool(value))
        else:
            raise ValueError(f"fault {name!r} is not known; one of {', '.join(sorted(self.OWN_FAULTS))}")
        return []

    def take_record(self) -> list[RecordEntry]:
        """What happened since the last call."""
        entries, self._record = self._record, []
        return entries

    @abstractmethod
    def _act(self, t_ns: int, packet: Packet) -> list[bytes]:
        """Deal with one intact packet."""

    @abstractmethod
    def _boot(self, t_ns: int) -> None:
        """All state as after switching on."""

    def _emergency(self, t_ns: int, pressed: bool) -> list[bytes]:
        """This kind of device has no emergency switch of its own."""
        return []

    def _restart(self, t_ns: int) -> None:
        self._boots += 1
        self._boot(t_ns)
        self.note(t_ns, "boot", detail=f"boot {self._boots}")

    def note(self, t_ns: int, event: str, channel: int = -1, detail: str = "") -> None:
        """Into the record: anything but a pulse."""
        self._record.append(RecordEntry(t_ns, event, channel, detail=detail))

    def pulse(self, t_ns: int, channel: int, current_ma: float, width_us: float, detail: str = "") -> None:
        """Into the record: one pulse, delivered at ``t_ns``."""
        self.pulses[channel] += 1
        count = self.pulses[channel]
        self._record.append(RecordEntry(t_ns, "pulse", channel, current_ma, width_us, 0.0, t_ns, count, t_ns, detail))


class Repeater:
    """A pulse train that the device keeps up by itself: one channel's next pulse, every ``period_ns``."""

    def __init__(self) -> None:
        self.next_ns = NEVER
        self.period_ns = 0

    def start(self, t_ns: int, period_ns: int) -> None:
        """From now on; a train already running keeps its beat."""
        self.next_ns = t_ns if self.next_ns == NEVER else min(self.next_ns, t_ns + period_ns)
        self.period_ns = period_ns

    def stop(self) -> None:
        """No more pulses."""
        self.next_ns = NEVER

    def due(self, until_ns: int) -> list[int]:
        """Times of the pulses up to and including ``until_ns``."""
        times: list[int] = []
        while self.next_ns <= until_ns:
            times.append(self.next_ns)
            self.next_ns += self.period_ns
        return times
