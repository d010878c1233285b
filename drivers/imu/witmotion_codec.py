"""WitMotion's standard protocol, serial: bytes ↔ commands, samples and registers, no I/O.

From the maker's "WIT Standard Communication Protocol" (wit-motion.gitbook.io, witmotion-sdk), and from REG.h and
wit_c_sdk.c in WITMOTION/WitStandardProtocol_JY901: a frame is ``55 type data(8) sum``, the sum of the ten bytes before
it modulo 256; values of 16 bits, least significant byte first; 32768 steps are 16 g and 2000 °/s. One sample is one
time frame (50), acceleration (51) and rate (52) in this order, as in the capture of aarushmaddula/bsli-payload-project,
README.md, whose clock was never set: month and day 0. A command is ``FF AA register value(2)``.

Not said: whether the time (in whole ms) is that of the measurement or of the sending; whether at 200 Hz every value is
new. The older six-axis models (JY61, WT61) have other commands and no time; the scale of a WT9011G4K is another.
"""

import calendar
import struct
from dataclasses import dataclass
from typing import Final

from drivers.imu.port import LineCounts
from fes.signals import Vector3

START: Final = 0x55
FRAME_BYTES: Final = 11
TIME, ACCELERATION, RATE, REGISTERS = 0x50, 0x51, 0x52, 0x5F
TYPES: Final = frozenset((*range(TIME, 0x5B), REGISTERS))
ACC_G: Final = 16.0 / 32768.0  # per step
GYR_DPS: Final = 2000.0 / 32768.0

SAVE, OUTPUTS, OUTPUT_RATE, BANDWIDTH, READ, KEY = 0x00, 0x02, 0x03, 0x1F, 0x27, 0x69  # registers
TIME_FORCE_RATE: Final = 0b111  # of OUTPUTS
OUTPUT_RATES: Final = {50: 0x08, 100: 0x09, 200: 0x0B}  # by rate in Hz; the lower ones are of no use here
BANDWIDTHS: Final = {50: 4, 100: 3, 200: 2}  # 20, 42, 98 Hz: the widest below half of the rate
RANGE_2000_DPS: Final = 3  # of the register behind BANDWIDTH
_UNLOCKS: Final = 0xB588


@dataclass(frozen=True, slots=True)
class Sample:
    """One sample in the device's own units; ``t_ms`` since 1970 by its clock, which may never have been set."""

    t_ms: int
    acc_g: Vector3
    gyr_dps: Vector3


@dataclass(frozen=True, slots=True)
class Registers:
    """Four in a row: what was asked for with :func:`read`, though it does not say where they begin."""

    values: tuple[int, ...]


def write(register: int, value: int) -> bytes:
    """The command that sets a register, taken for 10 s after :data:`UNLOCK`."""
    return struct.pack("<BBBH", 0xFF, 0xAA, register, value)


def read(register: int) -> bytes:
    """The command that asks for this register and the three behind it."""
    return write(READ, register)


UNLOCK: Final = write(KEY, _UNLOCKS)


class WitmotionDecoder:
    """Bytes in, samples and registers out, however they are cut; frames of no use here are passed over.

    ``counts``: of wrong checksums, samples with a part or a date missing (``bad_frames``), of bytes of no frame.
    """

    def __init__(self, counts: LineCounts | None = None) -> None:
        self.counts = counts or LineCounts()
        self._buffer = bytearray()
        self._parts: dict[int, bytes] = {}

    def feed(self, data: bytes) -> list[Sample | Registers]:
        """What is complete by now."""
        buffer, counts = self._buffer, self.counts
        buffer += data
        found: list[Sample | Registers] = []
        at = 0
        while len(buffer) - at >= FRAME_BYTES:
            frame = bytes(buffer[at : at + FRAME_BYTES])
            possible = frame[0] == START and frame[1] in TYPES
            if not possible or sum(frame[:-1]) % 256 != frame[-1]:
                counts.bad_frames += possible
                counts.bytes_skipped += 1
                at += 1
                self._parts = {}  # what was lost may have been a part of another sample
                continue
            at += FRAME_BYTES
            if (message := self._taken(frame[1], frame[2:-1])) is not None:
                found.append(message)
        del buffer[:at]
        return found

    def _taken(self, kind: int, data: bytes) -> Sample | Registers | None:
        if kind == REGISTERS:
            return Registers(struct.unpack("<4H", data))
        if kind == TIME:
            self._parts = {}
        self._parts[kind] = data
        if kind != RATE:
            return None
        time, force, self._parts = self._parts.get(TIME), self._parts.get(ACCELERATION), {}
        try:
            if time is None or force is None:
                raise ValueError("a part is missing")
            return Sample(_time_ms(time), _scaled(force, ACC_G), _scaled(data, GYR_DPS))
        except ValueError:
            self.counts.bad_frames += 1
            return None


def _time_ms(data: bytes) -> int:
    """Of its calendar clock; ValueError: a 13th month."""
    year, month, day, hour, minute, second, ms = struct.unpack("<6BH", data)
    return calendar.timegm((2000 + year, month or 1, day or 1, hour, minute, second)) * 1000 + int(ms)


def _scaled(data: bytes, unit: float) -> Vector3:
    x, y, z = struct.unpack_from("<3h", data)
    return x * unit, y * unit, z * unit
