"""HASOMED P24 and RehaMove3 by ScienceMode4, in low level and in mid level.

Low level: every pulse is a command of its own, and none comes without one. When the controller dies, the last pulse it
asked for is the last one delivered. The device queues up to ten pulses; at most two of a channel are ever unanswered,
so that none is delivered late.

Mid level: the device repeats the pulses by itself until it gets another command. It stops by itself no sooner than
**2 s** after the last update or question. That is as long as a whole stance: a controller that dies in mid-swing leaves
the muscle stimulated through it. So a session must accept this in its settings (``accept_watchdog_s = 2.0``); low level
has no such tail. What the host can do, it does: questions go out only as part of a command, and *off* goes out at once.

Codec of ScienceMode4 (HASOMED P24, RehaMove3): packets ↔ bytes, pulses ↔ points; no I/O.

Source: HASOMED, ScienceMode4 protocol description; agrees byte by byte with the ``science-mode-4`` package, which in
turn follows the vendor's C library. A value that a field cannot hold raises ``ValueError``; currents and widths between
two steps are rounded down, never up. The device would deliver an unbalanced pulse: the codec does not encode one.
"""

from __future__ import annotations

import math
import struct
from binascii import crc_hqx
from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import ClassVar, Final

from drivers.stimulator.port import Awaited, Pulse, PulseTrain, WordedEnum
from drivers.stimulator.sciencemode import FrameDecoder, FrameRejected, Opening, Packet, ScienceModePort, frame, stuff
from drivers.stimulator.serial_line import Line
from fes.signals import StimCommand

CURRENT_STEP_MA: Final = 0.5
MAX_CURRENT_MA: Final = 130.0
MAX_POINT_US: Final = 4095
MAX_POINTS: Final = 16
MAX_RAMP: Final = 15
PERIOD_STEP_MS: Final = 0.5
MAX_PERIOD_STEPS: Final = 2**15 - 1
INTERPHASE_US: Final = 100  # no current between the phases, as in the vendor's example pulse
CHANNELS: Final = 8
CHANNELS_PER_CONNECTOR: Final = 4
NUMBERS: Final = 64
HEADER_BYTES: Final = 10  # F0, two bytes each for length and CRC, all stuffed, and 0F
MAX_PACKET: Final = 1100  # a mid level update of eight channels with sixteen points, every byte stuffed
MAX_ACK: Final = 128  # whatever the device answers, as long as measuring is off
_CURRENT_ZERO: Final = 300


class Code(IntEnum):
    """Commands; each is answered under the next higher number."""

    LOW_INIT = 0
    LOW_PULSE = 2
    LOW_STOP = 4
    MID_INIT = 30
    MID_UPDATE = 32
    MID_STOP = 34
    MID_CURRENT_DATA = 36
    STIM_STATUS = 62
    GENERAL_ERROR = 66  # unasked, from the device
    UNKNOWN_COMMAND = 67  # unasked, from the device


class Result(WordedEnum):
    """What the device says of a command."""

    OK = 0, ""
    TRANSFER = 1, "transfer error on the line to the stimulator"
    PARAMETER = 2, "a parameter is out of the stimulator's range"
    PROTOCOL = 3, "the stimulator does not accept this command now"
    CONTROLLER_TIMEOUT = 4, "the stimulator's own controller timed out"
    NOT_INITIALISED = 7, "the stimulator is not initialised: it restarted; start a new session"
    HIGH_VOLTAGE = 8, "the stimulator's high voltage is not there"
    ELECTRODE = 10, "electrode or lead is open; the stimulator can only tell at 15 mA and above"
    UNKNOWN_COMMAND = 11, "the stimulator does not know the command"
    PULSE_TIMEOUT = 16, "the pulse took too long"
    BUSY = 21, "the stimulator is busy"
    LOW_CURRENT = 28, "less current flowed than was asked for: electrode or lead"


def result_text(result: int) -> str:
    """The result in words, "" for 0; one that the documents do not list is named by number."""
    return next((known.words for known in Result if known == result), f"stimulator error {result}")


@dataclass(frozen=True, slots=True)
class Point:
    """A piece of a pulse: how long, in µs, and how much, in steps of 0.5 mA."""

    width_us: int
    steps: int

    def encode(self) -> bytes:
        """Four bytes: 12 bit µs, 10 bit current, 10 bit reserved. ValueError: out of range."""
        if not 0 <= self.width_us <= MAX_POINT_US:
            raise ValueError(f"a point of {self.width_us} µs; 0 to {MAX_POINT_US} µs can be sent")
        if abs(self.steps) * CURRENT_STEP_MA > MAX_CURRENT_MA:
            raise ValueError(f"{self.steps * CURRENT_STEP_MA:g} mA; the stimulator's limit is {MAX_CURRENT_MA:g} mA")
        return ((self.width_us << 20) | ((self.steps + _CURRENT_ZERO) << 10)).to_bytes(4, "big")

    @classmethod
    def decode(cls, data: bytes) -> Point:
        """The inverse of :meth:`encode`, without its limits."""
        word = int.from_bytes(data, "big")
        return cls(word >> 20, ((word >> 10) & 0x3FF) - _CURRENT_ZERO)


Points = tuple[Point, ...]


def biphasic(current_ma: float, pulse_width_us: float) -> Points:
    """A rectangular pulse whose second phase takes back what the first gave; () when there is nothing to deliver.

    ValueError: not finite, negative, or over the device's limits.
    """
    for name, value in (("current_ma", current_ma), ("pulse_width_us", pulse_width_us)):
        if not math.isfinite(value) or value < 0:
            raise ValueError(f"{name} = {value!r} must be a finite number, 0 or more")
    if current_ma > MAX_CURRENT_MA:
        raise ValueError(f"current_ma = {current_ma:g}; the stimulator's limit is {MAX_CURRENT_MA:g} mA")
    if pulse_width_us > MAX_POINT_US:
        raise ValueError(f"pulse_width_us = {pulse_width_us:g}; at most {MAX_POINT_US} µs can be sent")
    steps, width_us = math.floor(current_ma / CURRENT_STEP_MA), math.floor(pulse_width_us)
    if steps == 0 or width_us == 0:
        return ()
    return Point(width_us, steps), Point(INTERPHASE_US, 0), Point(width_us, -steps)


def net_charge(points: Points) -> int:
    """Sum of current times width over the pulse, in device units (0.5 nC); 0 is balanced."""
    return sum(point.width_us * point.steps for point in points)


def _encode_points(points: Points) -> bytes:
    if not 1 <= len(points) <= MAX_POINTS:
        raise ValueError(f"a pulse has 1 to {MAX_POINTS} points, not {len(points)}")
    if net_charge(points) != 0:
        raise ValueError(f"the pulse is not charge-balanced: {net_charge(points) * 0.5e-3:g} µC would stay in the skin")
    return b"".join(point.encode() for point in points)


def low_pulse(number: int, channel: int, points: Points) -> Packet:
    """One pulse, once. Channels 0–3 are on the yellow connector, 4–7 on the green one.

    ValueError: no such channel, out of range, or not charge-balanced.
    """
    if not 0 <= channel < CHANNELS:
        raise ValueError(f"channel {channel}; this stimulator has 0 to {CHANNELS - 1}")
    data = _encode_points(points)
    connector, within = divmod(channel, CHANNELS_PER_CONNECTOR)
    return Packet(number, Code.LOW_PULSE, bytes((0x80 | within << 5 | connector << 4 | len(points) - 1,)) + data)


@dataclass(frozen=True, slots=True)
class Train:
    """What mid level repeats on one channel: a pulse every ``period_steps`` half milliseconds; ``ramp`` in pulses."""

    points: Points
    period_steps: int
    ramp: int = 0


def period_steps(frequency_hz: float) -> int:
    """The period in half milliseconds: the next longer one, so that it is never faster than asked for.

    ValueError: the device cannot be that slow, or the frequency is no positive number.
    """
    if not math.isfinite(frequency_hz) or frequency_hz <= 0:
        raise ValueError(f"frequency_hz = {frequency_hz!r} must be a finite number above 0")
    steps = math.ceil(1000.0 / PERIOD_STEP_MS / frequency_hz - 1e-9)
    if steps > MAX_PERIOD_STEPS:
        raise ValueError(f"frequency_hz = {frequency_hz:g} is slower than the stimulator's longest period")
    return steps


def mid_update(number: int, trains: Mapping[int, Train]) -> Packet:
    """The trains of all channels from now on; channels not named are off.

    ValueError: no such channel, out of range, or not charge-balanced.
    """
    mask, data = 0, b""
    for channel in sorted(trains):
        train = trains[channel]
        if not 0 <= channel < CHANNELS:
            raise ValueError(f"channel {channel}; this stimulator has 0 to {CHANNELS - 1}")
        if not 0 <= train.ramp <= MAX_RAMP or not 1 <= train.period_steps <= MAX_PERIOD_STEPS:
            raise ValueError(f"ramp {train.ramp} or period {train.period_steps} is out of the stimulator's range")
        mask |= 1 << channel
        points = _encode_points(train.points)
        data += struct.pack(">BH", (len(train.points) - 1) << 4 | train.ramp, train.period_steps << 1) + points
    return Packet(number, Code.MID_UPDATE, bytes((mask,)) + data)


def mid_current_data(number: int) -> Packet:
    """Ask for the channels' states; the device takes it for a sign of life."""
    return Packet(number, Code.MID_CURRENT_DATA, b"\x04")


def crc16(data: bytes) -> int:
    """CRC-16/XMODEM."""
    return crc_hqx(data, 0)


def encode(packet: Packet) -> bytes:
    """The frame. ValueError: number, command or length are out of range."""
    if not (0 <= packet.number < NUMBERS and 0 <= packet.command < 1024):
        raise ValueError(f"packet number {packet.number} (0–63) or command {packet.command} (0–1023) out of range")
    body = stuff((packet.number << 10 | packet.command).to_bytes(2, "big") + packet.data)
    return frame(struct.pack(">HH", len(body) + HEADER_BYTES, crc16(body)), body)


class Decoder(FrameDecoder):
    """Finds ScienceMode4 packets; ``max_length`` is for the host, a device reads up to :data:`MAX_PACKET`."""

    HEADER_FIELDS = 4
    MAX_LENGTH = MAX_ACK

    def _length(self, header: bytes) -> int:
        return int.from_bytes(header[:2], "big")

    def _packet(self, header: bytes, body: bytes) -> Packet:
        if crc16(body) != int.from_bytes(header[2:], "big"):
            raise FrameRejected("wrong CRC")
        content = self._content(body)
        prefix = int.from_bytes(content[:2], "big")
        return Packet(prefix >> 10, prefix & 0x3FF, content[2:])


ASK_EVERY_NS: Final = 250_000_000
LEVEL_NAMES: Final = ("not initialised", "low level", "mid level", "mid level, running")
LOW_LEVEL: Final = 1
WATCHDOG_S: Final = 2.0
_CHANNEL_ERRORS: Final = (Result.OK, Result.ELECTRODE, Result.PULSE_TIMEOUT, Result.LOW_CURRENT)


class _P24(ScienceModePort):
    """What both levels share; ``channels`` is 8 for the P24, 4 for the RehaMove3.

    The port owns ``line``; ``session_id`` is for the log only, the device has no sessions.
    """

    current_step_ma: ClassVar[float] = CURRENT_STEP_MA
    numbers: ClassVar[int] = NUMBERS
    identifiers: ClassVar[int] = 0x4000_0000
    initialisation: ClassVar[tuple[Code, bytes]]

    def __init__(self, line: Line, session_id: int, channels: int) -> None:
        super().__init__(line, Decoder(), encode, session_id)
        self._channels = channels
        self._asked_ns: int | None = None

    def _greet(self, opening: Opening) -> str:
        answer = self._request(opening, *self.initialisation)
        if answer is None:
            return (
                "no stimulator answered. Is it switched on, is this the right port, is it a P24 or RehaMove3? Answers "
                "that are garbled speak for a wrong baud rate."
            )
        if answer.data[:1] != b"\0":
            return f"the stimulator refused to start: {result_text(answer.data[0] if answer.data else 1)}"
        return ""

    def _points(self, command: StimCommand) -> Points:
        if not 0 <= command.channel < self._channels:
            raise ValueError(f"channel {command.channel}; this stimulator has 0 to {self._channels - 1}")
        return biphasic(command.current_ma, command.pulse_width_us)

    def _question_due(self, t_ns: int) -> bool:
        """Whether the device is to be asked for its state with this command; remembers it if so."""
        due = self._asked_ns is None or t_ns - self._asked_ns >= ASK_EVERY_NS
        self._asked_ns = t_ns if due else self._asked_ns
        return due

    def _unasked(self, t_ns: int, packet: Packet) -> bool:
        if packet.command not in (Code.GENERAL_ERROR, Code.UNKNOWN_COMMAND):
            return False
        self.report_error(t_ns, result_text(_result(packet)))
        return True

    def _count_result(self, packet: Packet, fault: str) -> tuple[int, str]:
        """The answer's result, and what is wrong with it: its turn, else what the result says."""
        result = _result(packet)
        if result:
            self._count_rejected()
        return result, fault or result_text(result)


def _result(packet: Packet) -> int:
    return packet.data[0] if packet.data else int(Result.TRANSFER)


def _level(command: StimCommand, counter: int, points: Points, frequency_hz: float) -> Pulse:
    """What of a command the device delivers: current and width in its steps."""
    current_ma, width_us = points[0].steps * CURRENT_STEP_MA, float(points[0].width_us)
    return Pulse(command.channel, counter, True, current_ma, width_us, frequency_hz)


class LowLevelStimulator(_P24):
    """Port (:mod:`drivers.stimulator.port`) for ScienceMode4 low level."""

    one_pulse_per_command: ClassVar[bool] = True
    initialisation: ClassVar[tuple[Code, bytes]] = (Code.LOW_INIT, b"\0")  # no measuring, the standard high voltage
    greetings: ClassVar[frozenset[int]] = frozenset((_P24.identifiers + Code.LOW_INIT,))

    def __init__(self, line: Line, session_id: int, channels: int = CHANNELS) -> None:
        super().__init__(line, session_id, channels)
        self._trains = tuple(PulseTrain() for _ in range(channels))

    def _packets_for(self, command: StimCommand, counter: int) -> list[Packet]:
        packets: list[Packet] = []
        if command.on:
            packets = self._pulse(command, counter)
        elif 0 <= command.channel < len(self._trains):
            self._trains[command.channel].off()
        if self._question_due(command.t_ns):
            packets.append(self._expect(Packet(self._next_number(), Code.STIM_STATUS), command.t_ns))
        return packets

    def _pulse(self, command: StimCommand, counter: int) -> list[Packet]:
        channel = command.channel
        points = self._points(command)
        if not math.isfinite(command.frequency_hz):
            raise ValueError(f"frequency_hz = {command.frequency_hz!r} must be a finite number")
        if not points or not self._trains[channel].due(command.t_ns, command.frequency_hz):
            return []
        if why := self._answers.room(channel, command.t_ns):
            self._withheld(command, counter, why)
            return []
        packet = low_pulse(self._next_number(), channel, points)
        return [self._expect(packet, command.t_ns, (_level(command, counter, points, command.frequency_hz),))]

    def _answered(self, t_ns: int, packet: Packet, awaited: Awaited, fault: str) -> None:
        result, fault = self._count_result(packet, fault)
        if packet.command == Code.STIM_STATUS + 1:
            level = packet.data[1] if len(packet.data) > 1 else 0
            if not fault and level != LOW_LEVEL:
                name = LEVEL_NAMES[level] if level < len(LEVEL_NAMES) else f"in state {level}"
                self._restarted(t_ns, f"the stimulator is {name} though we had it in low level: it restarted")
            else:
                self._alive(t_ns, fault)
            return
        for pulse in awaited.pulses:
            if not fault and len(packet.data) > 1:
                connector, within = divmod(packet.data[1], 16)
                named = within + CHANNELS_PER_CONNECTOR * connector
                fault = f"the answer names channel {named}" if named != pulse.channel else ""
            self._confirm(t_ns, pulse, fault, pulses=1)
        if result == Result.NOT_INITIALISED:
            self._restarted(t_ns, result_text(result))


def not_accepted(accept_watchdog_s: float) -> str:
    """ "" when the session accepts the device's watchdog, else what it must know."""
    if accept_watchdog_s >= WATCHDOG_S:
        return ""
    return (
        f"in mid level the stimulator goes on for up to {WATCHDOG_S:g} s after the controller has died. Use "
        f'device = "p24_low_level", or accept it with stimulator.options.accept_watchdog_s = {WATCHDOG_S:g}'
    )


class MidLevelStimulator(_P24):
    """Port (:mod:`drivers.stimulator.port`) for ScienceMode4 mid level.

    The device counts no pulses, so its :class:`StimStatus` carry none. Ramps are the plan's; the device's are not used.

    ValueError: ``accept_watchdog_s`` is less than the device's watchdog.
    """

    one_pulse_per_command: ClassVar[bool] = False
    initialisation: ClassVar[tuple[Code, bytes]] = (Code.MID_INIT, b"\x01")  # stop on all errors
    greetings: ClassVar[frozenset[int]] = frozenset((_P24.identifiers + Code.MID_INIT,))

    def __init__(self, line: Line, session_id: int, channels: int = CHANNELS, *, accept_watchdog_s: float) -> None:
        if why := not_accepted(accept_watchdog_s):
            raise ValueError(why)
        super().__init__(line, session_id, channels)
        self._trains: dict[int, Train] = {}
        self._levels: dict[int, Pulse] = {}
        self._must_stop = False

    def _packets_for(self, command: StimCommand, counter: int) -> list[Packet]:
        train: Train | None = None
        if command.on and (points := self._points(command)):
            train = Train(points, period_steps(command.frequency_hz))
        packets: list[Packet] = []
        if self._must_stop:
            self._must_stop = False
            packets.append(self._expect(Packet(self._next_number(), Code.MID_STOP), command.t_ns))
        if train != self._trains.get(command.channel):
            packets += self._update(command, counter, train)
        if self._question_due(command.t_ns):
            active = tuple(self._levels[channel] for channel in sorted(self._trains))
            packets.append(self._expect(mid_current_data(self._next_number()), command.t_ns, active))
        return packets

    def _update(self, command: StimCommand, counter: int, train: Train | None) -> list[Packet]:
        channel = command.channel
        if train is not None and (why := self._answers.room(channel, command.t_ns)):  # off always goes out
            self._withheld(command, counter, why)
            return []
        level = Pulse(channel, counter, False)
        if train is None:
            del self._trains[channel]
        else:
            self._trains[channel] = train
            level = _level(command, counter, train.points, 1000.0 / (train.period_steps * PERIOD_STEP_MS))
        self._levels[channel] = level
        return [self._expect(mid_update(self._next_number(), self._trains), command.t_ns, (level,))]

    def _answered(self, t_ns: int, packet: Packet, awaited: Awaited, fault: str) -> None:
        result, fault = self._count_result(packet, fault)
        if result == Result.NOT_INITIALISED:
            self._restarted(t_ns, fault)
        if packet.command == Code.MID_CURRENT_DATA + 1:
            self._states(t_ns, packet.data, {pulse.channel: pulse for pulse in awaited.pulses}, fault)
        elif not awaited.pulses:
            self._alive(t_ns, fault)
        for pulse in awaited.pulses if packet.command == Code.MID_UPDATE + 1 else ():
            self._confirm(t_ns, pulse, fault, pulses=0)

    def _states(self, t_ns: int, data: bytes, expected: dict[int, Pulse], fault: str) -> None:
        """The channels as the device sees them, held against what was commanded when it was asked."""
        if not fault and len(data) < 7:
            fault = f"the stimulator's channel states are cut off after {len(data)} bytes"
        self._alive(t_ns, fault)
        if fault and len(data) < 7:
            return
        for channel in range(CHANNELS):
            code = data[3 + channel // 2] >> 4 * (channel % 2) & 0x0F
            active = bool(data[2] >> channel & 1)
            what = result_text(_CHANNEL_ERRORS[code]) if code < len(_CHANNEL_ERRORS) else f"channel error {code}"
            if not what and active and channel not in expected:
                what = "the stimulator goes on though it was told to be off; it will be told to stop"
                self._must_stop = True
            elif not what and not active and channel in expected:
                what = "the stimulator stopped by itself"
            if what:
                counter = expected[channel].counter if channel in expected else 0
                self._confirm(t_ns, Pulse(channel, counter, False), what, pulses=0)
