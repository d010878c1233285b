"""A WitMotion sensor with the standard protocol on a serial line.

Options: ``baudrate`` (115200; many are shipped with 9600), ``configure`` (true: what it sends, how often and through
which low-pass is set, and stored in it, where it is not so already; false: only listens, and it must send its time).
Without its time a sample cannot be told from a late one: it is not used. Its gyroscope reads exactly 0 at rest: below
0.3 °/s for 0.5 s by the protocol's registers 6F and 6E, which are left as they are.

The codec does no I/O. From the maker's "WIT Standard Communication Protocol" (wit-motion.gitbook.io, witmotion-sdk),
and from REG.h and wit_c_sdk.c in WITMOTION/WitStandardProtocol_JY901: a frame is ``55 type data(8) sum``, the sum of
the ten bytes before it modulo 256; values of 16 bits, least significant byte first; 32768 steps are 16 g and 2000 °/s.
One sample is one time frame (50), acceleration (51) and rate (52) in this order, as in the capture of
aarushmaddula/bsli-payload-project, README.md, whose clock was never set: month and day 0. A command is ``FF AA
register value(2)``.

Not said: whether the time (in whole ms) is that of the measurement or of the sending; whether at 200 Hz every value is
new. The older six-axis models (JY61, WT61) have other commands and no time; the scale of a WT9011G4K is another.
"""

import calendar
import math
import struct
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from drivers.imu.line import ByteLine, LineOpener, LineSensorPort
from drivers.imu.port import ImuLost, LineCounts, flag_option
from fes.config import ImuDevice
from fes.signals import G_MPS2, NS_PER_S, RawSample, Vector3

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


ANSWER_S: Final = 0.5
PAUSE_S: Final = 0.2  # between commands, as the protocol asks for
TRIES: Final = 3
SAMPLE_BYTES: Final = 3 * FRAME_BYTES


class WitmotionImu(LineSensorPort):
    """:class:`~drivers.imu.port.ImuPort` for one WitMotion sensor.

    Raises:
        ValueError: a rate that it has not or that does not fit the baud rate, or an option is not what it must be.
        ImuLost: no such line, or no such sensor answers on it.
    """

    def __init__(
        self, device: ImuDevice, clock_ns: Callable[[], int] = time.monotonic_ns, opener: LineOpener = ByteLine
    ) -> None:
        self._clock_ns = clock_ns
        self._configures = flag_option(device, "configure", True)
        if device.rate_hz not in OUTPUT_RATES:
            given = f"{device.sensor}: rate_hz = {device.rate_hz:g}"
            raise ValueError(f"{given}: a WitMotion sensor has {', '.join(map(str, OUTPUT_RATES))}")
        super().__init__(device, opener, SAMPLE_BYTES)

    def _open(self) -> None:
        self._decoder = WitmotionDecoder()
        self._expect_samples()
        self._open_line()
        self._decoder.counts = self._counts  # what came before it was set up says nothing of it

    def _configure(self) -> None:
        rate_hz = round(self._device.rate_hz)
        wanted = {
            OUTPUTS: TIME_FORCE_RATE,
            OUTPUT_RATE: OUTPUT_RATES[rate_hz],
            BANDWIDTH: BANDWIDTHS[rate_hz],
        }
        if self._set_up() == wanted:
            return
        commands = (write(register, value) for register, value in wanted.items())
        for command in (UNLOCK, *commands, write(SAVE, 0)):
            self._line.write(command)
            self._pass(PAUSE_S)
        if (found := self._set_up()) != wanted:
            raise ImuLost(f"{self._line.name}: asked for registers {wanted}, it has {found}: is it of another kind?")

    def _set_up(self) -> dict[int, int]:
        """What it sends, how often and filtered how, by register."""
        outputs, rate, *_ = self._ask(OUTPUTS)
        bandwidth, gyr_range, *_ = self._ask(BANDWIDTH)
        if gyr_range != RANGE_2000_DPS:
            raise ImuLost(f"{self._line.name}: its gyroscope is not set to 2000 °/s (register 20: {gyr_range})")
        return {OUTPUTS: outputs, OUTPUT_RATE: rate, BANDWIDTH: bandwidth}

    def _ask(self, register: int) -> tuple[int, ...]:
        for attempt in range(TRIES):
            self._line.write(read(register))
            if values := self._pass(ANSWER_S, answered=True):
                if attempt:
                    self._pass(ANSWER_S)  # an answer to an earlier question must not be one to the next
                return values
        raise ImuLost(f"{self._line.name}: no WitMotion sensor answers. Is it one, and is options.baudrate its own?")

    def _pass(self, seconds: float, *, answered: bool = False) -> tuple[int, ...]:
        """Let so much time pass, or until it has ``answered``; the registers in its answer."""
        values: tuple[int, ...] = ()
        deadline_ns = self._clock_ns() + int(seconds * NS_PER_S)
        while (left_ns := deadline_ns - self._clock_ns()) > 0 and not (answered and values):
            self._line.wait(left_ns / NS_PER_S)
            for message in self._decoder.feed(self._line.read()):
                values = message.values if isinstance(message, Registers) else values
        return values

    def read(self, t_ns: int) -> list[RawSample]:
        """All samples that have arrived, by the sensor's own clock."""
        found: list[RawSample] = []
        for message in self._decoder.feed(self._line.read()):
            if isinstance(message, Sample):
                ax, ay, az = message.acc_g
                p, q, r = message.gyr_dps
                force = ax * G_MPS2, ay * G_MPS2, az * G_MPS2
                rate = math.radians(p), math.radians(q), math.radians(r)
                found.append(self._sample(t_ns, message.t_ms * 1_000_000, force, rate))
        return found
