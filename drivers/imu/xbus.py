"""An Xsens MTi on a serial line: configures it, then turns its bytes into samples.

Options: ``baudrate`` (115200), ``configure`` (true: set the outputs and their rate; false: only listen).

The codec does no I/O. From Xsens' public "MT Low Level Communication Protocol Documentation" (MT0101P): message ``FA
FF MID LEN data CS`` (``LEN`` = FF: two more bytes of length follow), all bytes after the preamble sum to 0 modulo 256,
everything most significant byte first. MTData2 (36) is a row of blocks ``XDI(2) length(1) values``; the identifier's
last hexadecimal digit tells the number format (low two bits: 0 float32, 1 Fp12.20, 2 Fp16.32 with the fraction first,
3 float64).
"""

import struct
import time
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

from drivers.imu.line import ByteLine, LineOpener, LineSensorPort
from drivers.imu.port import ImuLost, LineCounts, StampClock, flag_option
from fes.config import ImuDevice
from fes.signals import NS_PER_S, RawSample, Vector3

PREAMBLE: Final = 0xFA
BUS_ID: Final = 0xFF
EXTENDED: Final = 0xFF
MAX_LENGTH: Final = 2048
_FORMATS: Final = ("f", "i", "Ih", "d")


class Mid(IntEnum):
    """Message identifiers used here."""

    REQ_DID = 0x00
    DEVICE_ID = 0x01
    GO_TO_MEASUREMENT = 0x10
    GO_TO_MEASUREMENT_ACK = 0x11
    GO_TO_CONFIG = 0x30
    GO_TO_CONFIG_ACK = 0x31
    MT_DATA2 = 0x36
    WAKE_UP = 0x3E
    WAKE_UP_ACK = 0x3F
    ERROR = 0x42
    SET_OUTPUT = 0xC0
    SET_OUTPUT_ACK = 0xC1


class Xdi(IntEnum):
    """Data identifiers used here, without format and coordinate system."""

    COUNTER = 0x1020
    TIME_FINE = 0x1060
    ACCELERATION = 0x4020
    RATE_OF_TURN = 0x8020
    STATUS_WORD = 0xE020


TIME_FINE_TICK_NS: Final = 100_000
CLIPPED_ACC: Final = 0b111 << 8
CLIPPED_GYR: Final = 0b111 << 11
CLIPPED_ANY: Final = 1 << 19
ERRORS: Final = {
    0x03: "period not valid", 0x04: "message not valid", 0x1E: "timer overflow", 0x20: "baud rate not valid",
    0x21: "parameter not valid", 0x28: "device reports an error of its own",
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class XbusMessage:
    """One intact message."""

    mid: int
    data: bytes


class XbusRejected(ValueError):
    """Data that are no measurement: a block is cut off, or has the wrong length."""


@dataclass(frozen=True, slots=True)
class Measurement:
    """What one MTData2 holds; None for what it does not. Specific force in m/s², rate in rad/s."""

    counter: int | None = None
    time_fine: int | None = None
    acc_mps2: Vector3 | None = None
    gyr_radps: Vector3 | None = None
    status: int | None = None

    @property
    def clipped(self) -> bool:
        """The device says that an accelerometer or gyroscope is at its limit."""
        return self.status is not None and bool(self.status & (CLIPPED_ACC | CLIPPED_GYR | CLIPPED_ANY))


def encode(mid: int, data: bytes = b"") -> bytes:
    """One message. ValueError: more data than a message holds."""
    if len(data) > MAX_LENGTH:
        raise ValueError(f"{len(data)} bytes do not fit an Xbus message ({MAX_LENGTH})")
    length = bytes((len(data),)) if len(data) < EXTENDED else struct.pack(">BH", EXTENDED, len(data))
    body = bytes((BUS_ID, mid)) + length + data
    return bytes((PREAMBLE,)) + body + bytes((-sum(body) % 256,))


class XbusDecoder:
    """Bytes in, messages out, however they are cut. After noise it looks again from the byte after the false start.

    ``counts``: of wrong checksums and impossible lengths (``bad_frames``), of bytes that belonged to no message.
    """

    def __init__(self, counts: LineCounts | None = None) -> None:
        self.counts = counts or LineCounts()
        self._buffer = bytearray()

    def feed(self, data: bytes) -> list[XbusMessage]:
        """The messages complete by now."""
        buffer, counts = self._buffer, self.counts
        buffer += data
        messages: list[XbusMessage] = []
        at = 0
        while True:
            start = buffer.find(PREAMBLE, at)
            counts.bytes_skipped += (len(buffer) if start < 0 else start) - at
            at = len(buffer) if start < 0 else start
            if start < 0 or len(buffer) - at < 4:
                break
            head, length = 4, buffer[at + 3]
            if length == EXTENDED:
                if len(buffer) - at < 6:
                    break
                head, length = 6, buffer[at + 4] << 8 | buffer[at + 5]
            possible = buffer[at + 1] == BUS_ID and length <= MAX_LENGTH
            end = at + head + length + 1
            if possible and end > len(buffer):
                break
            if not possible or sum(buffer[at + 1 : end]) % 256:
                counts.bad_frames += buffer[at + 1] == BUS_ID
                counts.bytes_skipped += 1
                at += 1
                continue
            messages.append(XbusMessage(buffer[at + 2], bytes(buffer[at + head : end - 1])))
            at = end
        del buffer[:at]
        return messages


def decode_measurement(data: bytes) -> Measurement:
    """The blocks of an MTData2, unknown ones passed over. XbusRejected: one is cut off or has the wrong length."""
    found: dict[int, bytes] = {}
    formats: dict[int, int] = {}
    at = 0
    while at < len(data):
        if at + 3 > len(data) or at + 3 + data[at + 2] > len(data):
            raise XbusRejected(f"MTData2: the block at byte {at} is cut off")
        xdi = data[at] << 8 | data[at + 1]
        found[xdi & 0xFFF0] = data[at + 3 : at + 3 + data[at + 2]]
        formats[xdi & 0xFFF0] = xdi & 0x3
        at += 3 + data[at + 2]

    def whole(xdi: Xdi, size: int) -> int | None:
        raw = found.get(xdi)
        if raw is None:
            return None
        if len(raw) != size:
            raise XbusRejected(f"MTData2: {xdi.name} has {len(raw)} bytes instead of {size}")
        return int.from_bytes(raw, "big")

    def reals(xdi: Xdi, count: int) -> list[float] | None:
        raw = found.get(xdi)
        return None if raw is None else decode_reals(xdi.name, raw, formats[xdi], count)

    acc, gyr = reals(Xdi.ACCELERATION, 3), reals(Xdi.RATE_OF_TURN, 3)
    return Measurement(
        counter=whole(Xdi.COUNTER, 2),
        time_fine=whole(Xdi.TIME_FINE, 4),
        acc_mps2=None if acc is None else (acc[0], acc[1], acc[2]),
        gyr_radps=None if gyr is None else (gyr[0], gyr[1], gyr[2]),
        status=whole(Xdi.STATUS_WORD, 4),
    )


def decode_reals(name: str, raw: bytes, number_format: int, count: int) -> list[float]:
    """``count`` numbers in one of the four formats. XbusRejected: another number of bytes."""
    layout = struct.Struct(">" + _FORMATS[number_format] * count)
    if len(raw) != layout.size:
        raise XbusRejected(f"MTData2: {name} has {len(raw)} bytes instead of {layout.size}")
    parts = layout.unpack(raw)
    if number_format == 2:
        return [parts[2 * k + 1] + parts[2 * k] / 2**32 for k in range(count)]
    return [value / 2**20 for value in parts] if number_format == 1 else list(parts)


def encode_reals(values: tuple[float, ...], number_format: int) -> bytes:
    """The other way round: for a simulated device, and for tests."""
    parts: list[float] = list(values)
    if number_format == 1:
        parts = [round(value * 2**20) for value in values]
    elif number_format == 2:
        parts = [part for value in values for part in (round(value * 2**32) & 0xFFFFFFFF, round(value * 2**32) >> 32)]
    return struct.pack(">" + _FORMATS[number_format] * len(values), *parts)


def block(xdi: int, raw: bytes) -> bytes:
    """One block of an MTData2."""
    return struct.pack(">HB", xdi, len(raw)) + raw


def output_configuration(rate_hz: int) -> bytes:
    """Data of SetOutputConfiguration for counter, time, acceleration, rate of turn and status, as float32."""
    always = (Xdi.COUNTER, Xdi.TIME_FINE, Xdi.STATUS_WORD)
    pairs = [(xdi, 0xFFFF) for xdi in always] + [(Xdi.ACCELERATION, rate_hz), (Xdi.RATE_OF_TURN, rate_hz)]
    return b"".join(struct.pack(">HH", xdi, rate) for xdi, rate in pairs)


def configured_rates(data: bytes) -> dict[int, int]:
    """The device's answer (C1): data identifier without format → rate in Hz. XbusRejected: not whole pairs."""
    if len(data) % 4:
        raise XbusRejected(f"SetOutputConfiguration's answer has {len(data)} bytes, no multiple of 4")
    return {xdi & 0xFFF0: rate for xdi, rate in struct.iter_unpack(">HH", data)}


ANSWER_S: Final = 0.5
TRIES: Final = 3
SAMPLE_BYTES: Final = 54  # with counter, time, acceleration, rate of turn and status as float32


class XbusImu(LineSensorPort):
    """:class:`~drivers.imu.port.ImuPort` for one MTi.

    Raises:
        ValueError: the rate does not fit the baud rate, is not whole, or an option is not what it must be.
        ImuLost: no such line, or no MTi answers on it.
    """

    def __init__(
        self, device: ImuDevice, clock_ns: Callable[[], int] = time.monotonic_ns, opener: LineOpener = ByteLine
    ) -> None:
        self._clock_ns = clock_ns
        self._configures = flag_option(device, "configure", True)
        if self._configures and device.rate_hz != round(device.rate_hz):
            given = f"{device.sensor}: rate_hz = {device.rate_hz:g}"
            raise ValueError(f"{given} must be whole: an MTi takes no other rates")
        super().__init__(device, opener, SAMPLE_BYTES)

    def _open(self) -> None:
        self._decoder = XbusDecoder(self._counts)
        self._stamps = StampClock(32, TIME_FINE_TICK_NS)
        self._expect_samples(counter_bits=16)
        self._open_line()

    def _configure(self) -> None:
        rate = round(self._device.rate_hz)
        self._ask(Mid.GO_TO_CONFIG, b"", Mid.GO_TO_CONFIG_ACK)
        self.serials = {self._device.sensor: self._ask(Mid.REQ_DID, b"", Mid.DEVICE_ID).hex().upper()}
        answer = self._ask(Mid.SET_OUTPUT, output_configuration(rate), Mid.SET_OUTPUT_ACK)
        try:
            rates = configured_rates(answer)
        except XbusRejected as error:
            raise ImuLost(f"{self._line.name}: {error}") from error
        for xdi in (Xdi.ACCELERATION, Xdi.RATE_OF_TURN):
            if rates.get(xdi) != rate:
                raise ImuLost(
                    f"{self._line.name}: asked for {xdi.name} at {rate} Hz, it gives {rates.get(xdi)} Hz; set rate_hz "
                    "to a rate that this sensor has"
                )
        self._ask(Mid.GO_TO_MEASUREMENT, b"", Mid.GO_TO_MEASUREMENT_ACK)

    def _ask(self, mid: Mid, data: bytes, wanted: Mid) -> bytes:
        for _ in range(TRIES):
            self._line.write(encode(mid, data))
            deadline_ns = self._clock_ns() + int(ANSWER_S * NS_PER_S)
            while (left_ns := deadline_ns - self._clock_ns()) > 0:
                self._line.wait(left_ns / NS_PER_S)
                for message in self._decoder.feed(self._line.read()):
                    if message.mid == wanted:
                        return message.data
                    if message.mid == Mid.ERROR:
                        code = message.data[0] if message.data else 0
                        said = ERRORS.get(code, "unknown error")
                        raise ImuLost(f"{self._line.name}: refuses {mid.name}: {said} (0x{code:02x})")
        why = "no Xsens sensor answers. Is it one, and does options.baudrate match its own?"
        raise ImuLost(f"{self._line.name}: {why}")

    def read(self, t_ns: int) -> list[RawSample]:
        """All measurements that have arrived."""
        samples: list[RawSample] = []
        for message in self._decoder.feed(self._line.read()):
            if message.mid != Mid.MT_DATA2:
                # not even WakeUp is answered: that would send a sensor that restarted to configuration
                continue
            try:
                found = decode_measurement(message.data)
            except XbusRejected:
                found = Measurement()
            if found.time_fine is None or found.acc_mps2 is None or found.gyr_radps is None:
                self._counts.bad_frames += 1
                continue
            self._counts.clipped += found.clipped
            stamp_ns = self._stamps.time_ns(found.time_fine)
            samples.append(self._sample(t_ns, stamp_ns, found.acc_mps2, found.gyr_radps, found.counter))
        return samples
