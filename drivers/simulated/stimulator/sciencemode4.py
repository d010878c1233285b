"""A simulated HASOMED P24 / RehaMove3: ScienceMode4 low and mid level.

Low level: one pulse for each channel-config, executed one after another from a queue of ten; an eleventh is refused as
busy. Mid level: repeats by itself and stops 2 s after the last update or question. It refuses what is over 130 mA and,
like the real one, delivers an unbalanced pulse without a word. An open lead is only noticed at 15 mA and above.

As a process of its own: ``python -m drivers.simulated.stimulator.sciencemode4``.
"""

import struct
import sys
from collections import deque
from typing import Final

from drivers.simulated.stimulator.firmware import NEVER, NS_PER_MS
from drivers.simulated.stimulator.serial_device import CHANNELS, Repeater, SimulatedDevice, run_device
from drivers.stimulator import p24_port as codec
from drivers.stimulator.p24_port import Code, Point, Result
from drivers.stimulator.sciencemode import Packet

QUEUE_DEPTH: Final = 10
WATCHDOG_NS: Final = 2000 * NS_PER_MS
ELECTRODE_MEASURED_FROM_MA: Final = 15.0
BETWEEN_PULSES_NS: Final = NS_PER_MS
NONE, LOW, MID, MID_RUNNING = range(4)
_ERROR_NIBBLE: Final = {Result.ELECTRODE: 1, Result.PULSE_TIMEOUT: 2, Result.LOW_CURRENT: 3}


class ScienceMode4Device(SimulatedDevice):
    """See :class:`~drivers.simulated.stimulator.serial_device.SimulatedDevice`."""

    def __init__(self, t_ns: int) -> None:
        super().__init__(t_ns, codec.Decoder(codec.MAX_PACKET))

    def advance(self, t_ns: int) -> list[bytes]:
        """Queued pulses, repeated pulses, the watchdog."""
        out: list[bytes] = []
        while self._queue and self._queue_free_ns <= t_ns:
            at_ns, (number, channel, points) = self._queue_free_ns, self._queue.popleft()
            self._queue_free_ns += sum(p.width_us for p in points) * 1000 + max(BETWEEN_PULSES_NS, self.slow_ns)
            connector, within = divmod(channel, codec.CHANNELS_PER_CONNECTOR)
            data = bytes((self._deliver(at_ns, channel, points), connector << 4 | within, 0))
            out.append(codec.encode(Packet(number, Code.LOW_PULSE + 1, data)))
        end_ns = min(self._watchdog_ns, t_ns + 1)
        for channel, train in enumerate(self._trains):
            for at_ns in train.due(end_ns - 1):
                if result := self._deliver(at_ns, channel, self._patterns[channel]):
                    self._errors[channel] = result
                    train.stop()
        if self._watchdog_ns <= t_ns:
            self.note(self._watchdog_ns, "watchdog", detail="2 s without update or question")
            self._stop_mid()
            self.level = MID
        return out

    def next_deadline_ns(self) -> int:
        """The next pulse or the watchdog."""
        queue_ns = self._queue_free_ns if self._queue else NEVER
        return min(queue_ns, self._watchdog_ns, *(train.next_ns for train in self._trains))

    def power_off(self, t_ns: int) -> None:
        """Silence; the queue is lost."""
        self._queue.clear()
        self._stop_mid()
        self.note(t_ns, "off")

    def _boot(self, t_ns: int) -> None:
        self.level = NONE
        self._queue: deque[tuple[int, int, tuple[Point, ...]]] = deque()
        self._queue_free_ns: int = t_ns
        self._trains: tuple[Repeater, ...] = tuple(Repeater() for _ in range(CHANNELS))
        self._patterns: list[tuple[Point, ...]] = [()] * CHANNELS
        self._errors: list[Result] = [Result.OK] * CHANNELS
        self._watchdog_ns: int = NEVER

    def _act(self, t_ns: int, packet: Packet) -> list[bytes]:
        match packet.command:
            case Code.LOW_INIT | Code.MID_INIT:
                self._stop_mid()
                self._queue.clear()
                self.level = LOW if packet.command == Code.LOW_INIT else MID
                if self.level == MID:
                    self._errors = [Result.OK] * CHANNELS
                return self._answer(packet)
            case Code.LOW_STOP | Code.MID_STOP:
                if packet.command == Code.LOW_STOP:
                    self._queue.clear()
                else:
                    self._stop_mid()
                self.level = NONE
                return self._answer(packet)
            case Code.LOW_PULSE:
                return self._low_pulse(t_ns, packet)
            case Code.MID_UPDATE:
                return self._mid_update(t_ns, packet)
            case Code.MID_CURRENT_DATA:
                return self._current_data(t_ns, packet)
            case Code.STIM_STATUS:
                return self._answer(packet, extra=bytes((self.level, 6 if self.level else 0)))
            case _:
                return [codec.encode(Packet(packet.number, Code.UNKNOWN_COMMAND, bytes((Result.UNKNOWN_COMMAND,))))]

    def _answer(self, packet: Packet, result: int = Result.OK, extra: bytes = b"") -> list[bytes]:
        return [codec.encode(Packet(packet.number, packet.command + 1, bytes((result,)) + extra))]

    def _low_pulse(self, t_ns: int, packet: Packet) -> list[bytes]:
        head = packet.data[0] if packet.data else 0
        connector, within = head >> 4 & 1, head >> 5 & 3
        channel = within + codec.CHANNELS_PER_CONNECTOR * connector
        points = tuple(Point.decode(packet.data[at : at + 4]) for at in range(1, len(packet.data) - 3, 4))
        named = bytes((connector << 4 | within, 0))
        result = Result.OK
        if self.level != LOW:
            result = Result.NOT_INITIALISED
        elif len(packet.data) != 1 + 4 * ((head & 0x0F) + 1) or _over_limit(points):
            result = Result.PARAMETER
        elif len(self._queue) >= QUEUE_DEPTH:
            result = Result.BUSY
        if result:
            self.note(t_ns, "refused", channel, result.name.lower())
        if result or not head & 0x80:
            return self._answer(packet, result, named)
        self._queue.append((packet.number, channel, points))
        self._queue_free_ns = max(self._queue_free_ns, t_ns + self.slow_ns)
        return self.advance(t_ns)

    def _deliver(self, t_ns: int, channel: int, points: tuple[Point, ...]) -> Result:
        peak_ma = max((abs(p.steps) for p in points), default=0) * codec.CURRENT_STEP_MA
        if channel == self.electrode:  # nothing flows
            return Result.ELECTRODE if peak_ma >= ELECTRODE_MEASURED_FROM_MA else Result.OK
        balance = codec.net_charge(points)
        self.pulse(t_ns, channel, peak_ma, float(points[0].width_us), f"unbalanced {balance}" if balance else "")
        return Result.OK

    def _mid_update(self, t_ns: int, packet: Packet) -> list[bytes]:
        if self.level not in (MID, MID_RUNNING):
            return self._answer(packet, Result.NOT_INITIALISED)
        try:
            trains = _parse_update(packet.data)
        except (struct.error, IndexError):
            return self._answer(packet, Result.PARAMETER)
        if any(_over_limit(points) or not period_ns for points, period_ns in trains.values()):
            self.note(t_ns, "refused", detail="parameter")
            return self._answer(packet, Result.PARAMETER)
        for channel, train in enumerate(self._trains):
            if channel in trains and not self._errors[channel]:
                self._patterns[channel], period_ns = trains[channel]
                train.start(t_ns, period_ns)
            else:
                train.stop()
        self.level = MID_RUNNING if trains else MID
        self._watchdog_ns = t_ns + WATCHDOG_NS if trains else NEVER
        return self._answer(packet) + self.advance(t_ns)

    def _current_data(self, t_ns: int, packet: Packet) -> list[bytes]:
        if self.level not in (MID, MID_RUNNING):
            return self._answer(packet, Result.NOT_INITIALISED, bytes(6))
        if self._watchdog_ns != NEVER:
            self._watchdog_ns = t_ns + WATCHDOG_NS
        mask = sum(1 << channel for channel, train in enumerate(self._trains) if train.next_ns != NEVER)
        nibbles = [_ERROR_NIBBLE.get(error, 0) for error in self._errors]
        errors = bytes(nibbles[at] | nibbles[at + 1] << 4 for at in range(0, CHANNELS, 2))
        result = next((error for error in self._errors if error), Result.OK)
        return self._answer(packet, result, bytes((4, mask)) + errors)

    def _stop_mid(self) -> None:
        for train in self._trains:
            train.stop()
        self._watchdog_ns = NEVER


def _over_limit(points: tuple[Point, ...]) -> bool:
    return not points or any(abs(p.steps) * codec.CURRENT_STEP_MA > codec.MAX_CURRENT_MA for p in points)


def _parse_update(data: bytes) -> dict[int, tuple[tuple[Point, ...], int]]:
    """Channel → points and period in ns; raises struct.error or IndexError where the data end too early."""
    trains: dict[int, tuple[tuple[Point, ...], int]] = {}
    at = 1
    for channel in range(CHANNELS):
        if not data[0] >> channel & 1:
            continue
        head, period = struct.unpack_from(">BH", data, at)
        count = (head >> 4) + 1
        at += 3
        words = struct.unpack_from(f">{count}I", data, at)
        at += 4 * count
        unit_us = 500 if not period & 1 else 250
        points = tuple(Point.decode(word.to_bytes(4, "big")) for word in words)
        trains[channel] = (points, (period >> 1) * unit_us * 1000)
    return trains


if __name__ == "__main__":
    sys.exit(run_device("sciencemode4", ScienceMode4Device))
