"""Codec of ScienceMode4 (HASOMED P24, RehaMove3): packets ↔ bytes, pulses ↔ points; no I/O.

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
from typing import Final

from drivers.stimulator.port import WordedEnum
from drivers.stimulator.sciencemode.framing import FrameDecoder, FrameRejected, Packet, frame, stuff

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

    Raises:
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

    Raises:
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

    Raises:
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

    Raises:
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
