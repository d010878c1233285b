"""HASOMED RehaStim2: a list of channels, one shot for each command, so that no pulse comes without one.

The device's own watchdog (1.2 s) would let a repeated list run through a whole stance; with a main interval of 0 it
repeats nothing. It needs 10 to 24 ms for a list, so all channels of a control step share one: it goes out with the last
channel's command of that step, and holds what is due of those with the very same time. A step whose last command does
not come delivers nothing.

Codec of ScienceMode2 (HASOMED RehaStim2): packets ↔ bytes; no I/O.

Source: HASOMED, ScienceMode2 RehaStim2, Description and Protocol (2012); the field order of the channel list agrees
with the public implementations. The device makes its pulses biphasic and balanced by itself. Currents are whole mA,
widths whole µs; what lies between is rounded down, never up.
"""

import math
import struct
from collections.abc import Sequence
from enum import IntEnum
from functools import reduce
from typing import ClassVar, Final

from drivers.stimulator.e2e import crc8_table
from drivers.stimulator.port import Awaited, Pulse, PulseTrain
from drivers.stimulator.sciencemode import FrameDecoder, FrameRejected, Opening, Packet, ScienceModePort, frame, stuff
from drivers.stimulator.serial_line import Line
from fes.signals import StimCommand

MAX_CURRENT_MA: Final = 130
MIN_WIDTH_US: Final = 20
MAX_WIDTH_US: Final = 500
CHANNELS: Final = 8
NUMBERS: Final = 256
MIN_INTERVAL_MS: Final = 8.0
ONE_SHOT: Final = 0  # as the main interval: one pulse of each channel for each start, none by itself
MAX_PACKET: Final = 128
SINGLE: Final = 0
NO_PULSE: Final = (MIN_WIDTH_US, 0)
_INTER_PULSE: Final = 1  # (2 ms − 1.5 ms) / 0.5 ms; for doublets and triplets only
_OVERHEAD: Final = 6  # F0, CRC and length stuffed, 0F
_CRC: Final = crc8_table(0x07)


class Code(IntEnum):
    """Commands; those of stimulation are answered under the next higher number."""

    INIT = 1  # from the device, every 500 ms until answered
    INIT_ACK = 2
    WATCHDOG = 4  # not answered
    GET_MODE = 10
    LIST_INIT = 30
    LIST_START = 32
    LIST_STOP = 34
    SINGLE_PULSE = 36
    STIMULATION_ERROR = 38  # unasked, from the device


RESULT_TEXT: Final[dict[int, str]] = {
    0: "",
    -1: "transfer error on the line to the stimulator",
    -2: "a parameter is out of the stimulator's range",
    -3: "the stimulator is in the wrong mode: it restarted or stopped by itself",
    -5: "the stimulator speaks another protocol version",
    -8: "the stimulator is busy",
}
ERROR_TEXT: Final[dict[int, str]] = {
    -1: "emergency switch pressed or not connected",
    -2: "electrode error",
    -3: "stimulation module error",
}


def signed(data: bytes) -> int:
    """The first byte as a signed number, 0 when there is none."""
    return int.from_bytes(data[:1], "big", signed=True)


def result_text(result: int) -> str:
    """The answer's result in words, "" for 0."""
    return RESULT_TEXT.get(result, f"stimulator error {result}")


def error_text(error: int) -> str:
    """An unasked stimulation error in words."""
    return ERROR_TEXT.get(error, f"stimulation error {error}")


def pulse(current_ma: float, pulse_width_us: float) -> tuple[int, int]:
    """Width in µs and current in mA as they are sent; :data:`NO_PULSE` when there is nothing to deliver.

    ValueError: not finite, negative, or over the device's limits.
    """
    current, width = ("current_ma", current_ma, MAX_CURRENT_MA), ("pulse_width_us", pulse_width_us, MAX_WIDTH_US)
    for name, value, most in (current, width):
        if not math.isfinite(value) or not 0 <= value <= most:
            raise ValueError(f"{name} = {value!r}; this stimulator takes 0 to {most}")
    width_us, whole_ma = math.floor(pulse_width_us), math.floor(current_ma)
    if width_us < MIN_WIDTH_US or whole_ma == 0:  # the device would make a narrower pulse 20 µs wide
        return NO_PULSE
    return width_us, whole_ma


def list_init(number: int, channels: Sequence[int], interval: int = ONE_SHOT) -> Packet:
    """The list's channels; ``interval``: 0.5 ms above 1 ms each, 0: one-shot. ValueError: no or unknown channels."""
    if not channels or not all(0 <= channel < CHANNELS for channel in channels):
        raise ValueError(f"channels {list(channels)}; this stimulator has 0 to {CHANNELS - 1}")
    mask = sum(1 << channel for channel in set(channels))
    return Packet(number, Code.LIST_INIT, struct.pack(">BBBBHB", 0, mask, 0, _INTER_PULSE, interval, 0))


def list_start(number: int, pulses: Sequence[tuple[int, int]]) -> Packet:
    """One pulse for each channel of the list, lowest first: (width in µs, current in mA) as :func:`pulse` gives them.

    ValueError: no pulses, or one out of range.
    """
    if not pulses:
        raise ValueError("a list has at least one channel")
    for width_us, current_ma in pulses:
        if not (MIN_WIDTH_US <= width_us <= MAX_WIDTH_US and 0 <= current_ma <= MAX_CURRENT_MA):
            raise ValueError(f"a pulse of {width_us} µs and {current_ma} mA is out of the stimulator's range")
    return Packet(number, Code.LIST_START, b"".join(struct.pack(">BHB", SINGLE, *one) for one in pulses))


def crc8(data: bytes) -> int:
    """CRC-8, polynomial 07, initial value 0."""
    return reduce(lambda crc, byte: _CRC[crc ^ byte], data, 0)


def encode(packet: Packet) -> bytes:
    """The frame. ValueError: number, command or length are out of range."""
    if not (0 <= packet.number < NUMBERS and 0 <= packet.command < 256):
        raise ValueError(f"packet number {packet.number} or command {packet.command} is no byte")
    body = stuff(bytes((packet.number, packet.command)) + packet.data)
    if len(body) + _OVERHEAD > MAX_PACKET:
        raise ValueError(f"a packet with {len(packet.data)} bytes of data is too long")
    return frame(bytes((crc8(body), len(body))), body)


class Decoder(FrameDecoder):
    """Finds ScienceMode2 packets."""

    HEADER_FIELDS = 2
    MAX_LENGTH = MAX_PACKET

    def _length(self, header: bytes) -> int:
        return header[1] + _OVERHEAD

    def _packet(self, header: bytes, body: bytes) -> Packet:
        if crc8(body) != header[0]:
            raise FrameRejected("wrong CRC")
        content = self._content(body)
        return Packet(content[0], content[1], content[2:])


KEEP_ALIVE_NS: Final = 250_000_000


class RehaStim2(ScienceModePort):
    """Port (:mod:`drivers.stimulator.port`) for ScienceMode2, which owns ``line``; ``session_id`` is for the log only.

    ``channels`` are those of the session, in the order in which each control step commands them; ValueError: none, or
    unknown ones.
    """

    one_pulse_per_command: ClassVar[bool] = True
    current_step_ma: ClassVar[float] = 1.0
    numbers: ClassVar[int] = NUMBERS
    identifiers: ClassVar[int] = 0x2000_0000
    greetings: ClassVar[frozenset[int]] = frozenset((identifiers + Code.INIT_ACK, identifiers + Code.LIST_INIT))

    def __init__(self, line: Line, session_id: int, channels: Sequence[int]) -> None:
        list_init(0, channels)
        super().__init__(line, Decoder(), encode, session_id)
        self._channels = tuple(sorted(set(channels)))
        self._last = channels[-1]
        self._trains = {channel: PulseTrain(int(MIN_INTERVAL_MS * 1e6)) for channel in self._channels}
        self._due: dict[int, Pulse] = {}
        self._step_ns: int | None = None

    def _greet(self, opening: Opening) -> str:
        asked = -1
        for packet in self._packets_until(opening, opening.deadline_ns):
            if packet.command == Code.INIT:
                asked = self._next_number()
                self._write(opening, Packet(packet.number, Code.INIT_ACK, b"\0"))
                self._write(opening, list_init(asked, self._channels))
            elif (packet.number, packet.command) == (asked, Code.LIST_INIT + 1):
                result = signed(packet.data)
                return f"the stimulator refused the channel list: {result_text(result)}" if result else ""
            elif packet.command == Code.STIMULATION_ERROR:
                return error_text(signed(packet.data))
        if asked >= 0:
            return "the stimulator did not answer to the channel list"
        return (
            "no RehaStim2 was heard; it announces itself every 0.5 s. Is it switched on and in ScienceMode, is this "
            "the right port, has it been left alone for 1.2 s? Bytes that are no frames speak for a wrong baud rate."
        )

    def _packets_for(self, command: StimCommand, counter: int) -> list[Packet]:
        self._note_due(command, counter)
        if command.channel == self._last and self._due:
            due = [self._due.get(channel) for channel in self._channels]
            pulses = [(int(one.pulse_width_us), int(one.current_ma)) if one else NO_PULSE for one in due]
            confirmed = tuple(self._due.values())
            self._due.clear()
            return [self._expect(list_start(self._next_number(), pulses), command.t_ns, confirmed)]
        if self._sent_ns is None or command.t_ns - self._sent_ns >= KEEP_ALIVE_NS:
            # asked for its mode rather than sent a watchdog message: its answer shows that it lives, too
            return [self._expect(Packet(self._next_number(), Code.GET_MODE), command.t_ns)]
        return []

    def _note_due(self, command: StimCommand, counter: int) -> None:
        """Whether this command is a pulse of the list that this step's last command will send."""
        wanted = NO_PULSE
        if command.on:
            if command.channel not in self._trains:
                raise ValueError(f"channel {command.channel} is not in the stimulator's list {list(self._channels)}")
            wanted = pulse(command.current_ma, command.pulse_width_us)
            if not math.isfinite(command.frequency_hz):
                raise ValueError(f"frequency_hz = {command.frequency_hz!r} must be a finite number")
        if self._step_ns != command.t_ns:
            self._due.clear()
            self._step_ns = command.t_ns
        self._due.pop(command.channel, None)
        if not command.on:
            if command.channel in self._trains:
                self._trains[command.channel].off()
        elif wanted != NO_PULSE and self._trains[command.channel].due(command.t_ns, command.frequency_hz):
            if why := self._answers.room(command.channel, command.t_ns):
                self._withheld(command, counter, why)
            else:
                levels = (float(wanted[1]), float(wanted[0]), command.frequency_hz)
                self._due[command.channel] = Pulse(command.channel, counter, True, *levels)

    def _unasked(self, t_ns: int, packet: Packet) -> bool:
        if packet.command == Code.INIT:
            self._restarted(t_ns, "the stimulator restarted, or its watchdog ended our session")
        elif packet.command == Code.STIMULATION_ERROR:
            self.report_error(t_ns, error_text(signed(packet.data)))
        else:
            return False
        return True

    def _answered(self, t_ns: int, packet: Packet, awaited: Awaited, fault: str) -> None:
        result = signed(packet.data) if packet.data else -1
        if result:
            self._count_rejected()
        fault = fault or result_text(result)
        if packet.command == Code.GET_MODE + 1:
            if not fault and packet.data[1:2] == b"\0":
                self._restarted(t_ns, "the stimulator has forgotten its channel list: it restarted, or was stopped")
            else:
                self._alive(t_ns, fault)
        for pulse in awaited.pulses:
            self._confirm(t_ns, pulse, fault, pulses=1)
