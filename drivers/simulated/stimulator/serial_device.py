"""What simulated stimulators have in common: the process that runs one, and the serial ones the device itself.

The device is bytes and time in, messages and pulses out; no I/O, no clock. Its process prints one JSON line when it is
ready, with the port that the host opens, and takes faults on stdin (:mod:`drivers.simulated.lines`). It ends on
SIGTERM, SIGINT, or when stdin closes (``--until-stdin-closes``). What it delivered is in its record, pulse by pulse, by
CLOCK_MONOTONIC.
"""

import argparse
import sys
import time
from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from drivers.simulated.lines import (
    BusBroken,
    Device,
    DeviceEnd,
    DeviceLoop,
    PtyEnd,
    TcpEnd,
    become_real_time,
    publish_ready,
    stop_signals,
)
from drivers.simulated.record import Pulse, PulseOutlet, RecordEntry, RecordWriter, pulses_of
from drivers.simulated.stimulator.firmware import NEVER, parse_fault_values
from drivers.stimulator.bus import BusError
from drivers.stimulator.sciencemode import FrameDecoder, Packet
from fes.signals import NS_PER_S

CHANNELS: Final = 8


class StimulatingDevice(Device):
    """What :func:`run_stimulator` runs."""

    @abstractmethod
    def power_off(self, t_ns: int) -> None:
        """Silence every channel."""

    @abstractmethod
    def take_record_and_pulses(self) -> tuple[list[RecordEntry], list[Pulse]]:
        """What happened since the last call, and the pulses."""


class SimulatedDevice(StimulatingDevice):
    """Call :meth:`receive` for bytes and :meth:`advance` at every deadline; both return the messages to send.

    Faults that are the device's own, set by :meth:`set_fault`: ``electrode`` (this channel's lead is open), ``slow``
    (each answer takes so many seconds), ``reboot`` (now), ``emergency`` (1: the switch is pressed).
    """

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
    def _act(self, t_ns: int, packet: Packet) -> list[bytes]:
        """Deal with one intact packet."""

    @abstractmethod
    def _boot(self, t_ns: int) -> None:
        """All state as after switching on."""

    def _emergency(self, t_ns: int, pressed: bool) -> list[bytes]:
        """This kind of device has no emergency switch of its own."""
        return []

    def set_fault(self, t_ns: int, name: str, value: float) -> list[bytes]:
        """Bring about one of the device's own faults. ValueError: no such fault."""
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
            raise ValueError(f"fault {name!r} is not known; one of electrode, emergency, reboot, slow")
        return []

    def take_record(self) -> list[RecordEntry]:
        """What happened since the last call."""
        entries, self._record = self._record, []
        return entries

    def take_record_and_pulses(self) -> tuple[list[RecordEntry], list[Pulse]]:
        """See the base."""
        entries = self.take_record()
        return entries, pulses_of(entries)

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


@dataclass(slots=True)
class Repeater:
    """A pulse train that the device keeps up by itself: one channel's next pulse, every ``period_ns``."""

    next_ns: int = NEVER
    period_ns: int = 0

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


def stimulator_parser(name: str, faults: str) -> argparse.ArgumentParser:
    """The options of every simulated stimulator; ``faults`` are those that it may be started with."""
    parser = argparse.ArgumentParser(prog=name, description=f"A simulated stimulator ({name}) in its own process.")
    parser.add_argument("--record", type=Path, help="write what was delivered to this file, JSON lines")
    parser.add_argument("--pulses", type=Path, help="send each pulse to the socket of this name")
    parser.add_argument("--faults", default="", help=faults)
    parser.add_argument("--until-stdin-closes", action="store_true", help="listen to stdin, and end with it")
    return parser


def run_stimulator(
    parser: argparse.ArgumentParser,
    options: argparse.Namespace,
    opened: Callable[[], DeviceEnd],
    make: Callable[[int], StimulatingDevice],
    faults: Sequence[tuple[str, float]] = (),
    **facts: int,
) -> int:
    """Run the device that is made, on the line that is opened, until a signal or the end of stdin; then all is off.

    ``facts``: what it is to say of itself when it is ready. Exit status 2: the settings are wrong, 1: its bus broke.
    """
    stop = stop_signals()
    try:
        record = RecordWriter(options.record)
        end = opened()
    except (BusError, OSError) as error:
        print(f"{parser.prog}: {error}", file=sys.stderr)
        return 2
    real_time = become_real_time()
    pulses = PulseOutlet(options.pulses)
    device = make(time.monotonic_ns())

    def keep() -> None:
        entries, delivered = device.take_record_and_pulses()
        pulses.send(delivered)
        record.write(entries)

    loop = DeviceLoop(device, end, stop.fileno(), stdin=options.until_stdin_closes, afterwards=keep)
    try:
        for fault, value in faults:
            loop.inject(fault, value)
    except ValueError as error:
        parser.error(f"--faults: {error}")
    publish_ready(port=end.port, real_time=real_time, **facts)
    try:
        loop.run()
    except BusBroken as error:
        print(f"{parser.prog}: {error}", file=sys.stderr)
        return 1
    finally:
        device.power_off(time.monotonic_ns())
        keep()
        record.close()
        pulses.close()
        end.unplug()
    return 0


def run_device(name: str, make: Callable[[int], SimulatedDevice], arguments: Sequence[str] | None = None) -> int:
    """Run a device on a line of bytes; exit status as of :func:`run_stimulator`."""
    parser = stimulator_parser(name, "electrode=CH,slow=S,garble=N,drop=N,reorder=N,delay=S,mute=1 …")
    parser.add_argument("--line", choices=("pty", "tcp"), default="pty", help="what the host opens")
    options = parser.parse_args(arguments)
    try:
        faults = parse_fault_values(options.faults)
    except ValueError as error:
        parser.error(f"--faults: {error}")
    return run_stimulator(parser, options, PtyEnd if options.line == "pty" else TcpEnd, make, faults)
