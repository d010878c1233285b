"""A simulated HASOMED RehaStim2: ScienceMode2 with its handshake, its watchdog and its emergency switch.

It announces itself every 500 ms until it is answered. 1.2 s without a valid packet, or the emergency switch, stop
everything and reset its modes. A main interval of 0 gives one pulse for each start; any other repeats the list.

As a process of its own: ``python -m drivers.simulated.stimulator.sciencemode2``.
"""

import struct
import sys
from typing import Final

from drivers.simulated.stimulator.firmware import NEVER, NS_PER_MS
from drivers.simulated.stimulator.serial_device import CHANNELS, Repeater, SimulatedDevice, run_device
from drivers.stimulator import rehastim2_port as codec
from drivers.stimulator.rehastim2_port import Code
from drivers.stimulator.sciencemode import Packet

WATCHDOG_NS: Final = 1200 * NS_PER_MS
INIT_EVERY_NS: Final = 500 * NS_PER_MS
ANSWER_AFTER_NS: Final = 12 * NS_PER_MS  # 10 to 24 ms from command to pulse
VERSION: Final = 1
TRANSFER, PARAMETER, WRONG_MODE = -1, -2, -3
EMERGENCY, ELECTRODE = -1, -2
_LIST_INIT: Final = struct.Struct(">BBBBHB")


class ScienceMode2Device(SimulatedDevice):
    """See :class:`~drivers.simulated.stimulator.serial_device.SimulatedDevice`."""

    def __init__(self, t_ns: int) -> None:
        self._pressed = False
        super().__init__(t_ns, codec.Decoder())

    def advance(self, t_ns: int) -> list[bytes]:
        """Pulses, answers, the announcement, the watchdog."""
        out: list[bytes] = []
        while self._due and self._due[0][0] <= t_ns:
            at_ns, number, pulses = self._due.pop(0)
            out += self._deliver(at_ns, pulses)
            out.append(_message(number, Code.LIST_START + 1, 0))
        for at_ns in self._repeater.due(min(t_ns, self._watchdog_ns - 1)):
            out += self._deliver(at_ns, self._pulses)
        if self._watchdog_ns <= t_ns:
            self.note(self._watchdog_ns, "watchdog", detail="1.2 s without a packet")
            self._reset(self._watchdog_ns)
        while self._next_init_ns <= t_ns:
            out.append(codec.encode(Packet(self._init_number, Code.INIT, bytes((VERSION,)))))
            self._next_init_ns += INIT_EVERY_NS
        return out

    def next_deadline_ns(self) -> int:
        """The next of all these."""
        due_ns = self._due[0][0] if self._due else NEVER
        return min(due_ns, self._repeater.next_ns, self._watchdog_ns, self._next_init_ns)

    def power_off(self, t_ns: int) -> None:
        """Silence."""
        self._reset(t_ns)
        self.note(t_ns, "off")

    def _boot(self, t_ns: int) -> None:
        self._init_number = 0
        self._reset(t_ns)

    def _reset(self, t_ns: int) -> None:
        """No session: modes are gone, and it announces itself again."""
        self.connected = False
        self.channels: tuple[int, ...] = ()
        self._interval = codec.ONE_SHOT
        self._due: list[tuple[int, int, tuple[tuple[int, int], ...]]] = []
        self._pulses: tuple[tuple[int, int], ...] = ()
        self._repeater = Repeater()
        self._watchdog_ns = NEVER
        self._next_init_ns = t_ns
        self._init_number = (self._init_number + 1) % codec.NUMBERS

    def _act(self, t_ns: int, packet: Packet) -> list[bytes]:
        if not self.connected:
            if packet.command == Code.INIT_ACK and packet.number == self._init_number:
                self.connected = True
                self._next_init_ns = NEVER
                self._watchdog_ns = t_ns + WATCHDOG_NS
                self.note(t_ns, "session")
            return []
        self._watchdog_ns = t_ns + WATCHDOG_NS
        result = 0
        match packet.command:
            case Code.WATCHDOG | Code.INIT_ACK:
                return []
            case Code.GET_MODE:
                mode = 2 if self._pulses else 1 if self.channels else 0
                return [codec.encode(Packet(packet.number, Code.GET_MODE + 1, bytes((0, mode))))]
            case Code.LIST_INIT:
                result = self._list_init(packet.data)
            case Code.LIST_START:
                return self._list_start(t_ns, packet)
            case Code.LIST_STOP:
                self._stop_list()
            case Code.SINGLE_PULSE:
                result = self._single(t_ns, packet.data)
            case _:
                result = TRANSFER
        return [_message(packet.number, packet.command + 1, result)]

    def _stop_list(self) -> None:
        self.channels, self._pulses, self._due = (), (), []
        self._repeater.stop()

    def _list_init(self, data: bytes) -> int:
        if len(data) != _LIST_INIT.size:
            return PARAMETER
        if self.channels:
            return WRONG_MODE
        _, mask, _, _, interval, _ = _LIST_INIT.unpack(data)
        self.channels = tuple(channel for channel in range(CHANNELS) if mask >> channel & 1)
        self._interval = interval
        return 0

    def _list_start(self, t_ns: int, packet: Packet) -> list[bytes]:
        result = 0
        if not self.channels or self._pressed:
            result = WRONG_MODE
        elif len(packet.data) != 4 * len(self.channels):
            result = PARAMETER
        else:
            pulses = tuple((width, current) for _, width, current in struct.iter_unpack(">BHB", packet.data))
            if any(not 0 <= width <= codec.MAX_WIDTH_US or current > codec.MAX_CURRENT_MA for width, current in pulses):
                result = PARAMETER
        if result:
            self.note(t_ns, "refused", detail=str(result))
            return [_message(packet.number, Code.LIST_START + 1, result)]
        if self._interval == codec.ONE_SHOT:
            after_ns = max(ANSWER_AFTER_NS, self.slow_ns)
            begin_ns = max(t_ns, self._due[-1][0] if self._due else 0) + after_ns
            self._due.append((begin_ns, packet.number, pulses))
            return []
        self._pulses = pulses
        self._repeater.start(t_ns, (self._interval * 500 + 1000) * 1000)
        return [_message(packet.number, Code.LIST_START + 1, 0)]

    def _single(self, t_ns: int, data: bytes) -> int:
        if len(data) != 4:
            return PARAMETER
        if self.channels or self._pressed:
            return WRONG_MODE
        channel, width_us, current_ma = struct.unpack(">BHB", data)
        if channel >= CHANNELS or width_us > codec.MAX_WIDTH_US or current_ma > codec.MAX_CURRENT_MA:
            return PARAMETER
        self.pulse(t_ns, channel, float(current_ma), float(max(width_us, codec.MIN_WIDTH_US)))
        return 0

    def _deliver(self, t_ns: int, pulses: tuple[tuple[int, int], ...]) -> list[bytes]:
        out: list[bytes] = []
        for channel, (width_us, current_ma) in zip(self.channels, pulses, strict=True):
            if current_ma and channel == self.electrode:
                out.append(_message(0, Code.STIMULATION_ERROR, ELECTRODE))
            elif current_ma:
                self.pulse(t_ns, channel, float(current_ma), float(max(width_us, codec.MIN_WIDTH_US)))
        return out

    def _emergency(self, t_ns: int, pressed: bool) -> list[bytes]:
        self._pressed = pressed
        if not pressed:
            return []
        self.note(t_ns, "emergency")
        self._stop_list()
        return [_message(0, Code.STIMULATION_ERROR, EMERGENCY)] if self.connected else []


def _message(number: int, command: int, result: int) -> bytes:
    return codec.encode(Packet(number, command, result.to_bytes(1, "big", signed=True)))


if __name__ == "__main__":
    sys.exit(run_device("sciencemode2", ScienceMode2Device))
