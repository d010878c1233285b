"""Xsens Xbus: bytes ↔ messages ↔ measurements, no I/O.

From Xsens' public "MT Low Level Communication Protocol Documentation" (MT0101P): message ``FA FF MID LEN data CS``
(``LEN`` = FF: two more bytes of length follow), all bytes after the preamble sum to 0 modulo 256, everything most
significant byte first. MTData2 (36) is a row of blocks ``XDI(2) length(1) values``; the identifier's last hexadecimal
digit tells the number format (low two bits: 0 float32, 1 Fp12.20, 2 Fp16.32 with the fraction first, 3 float64).
"""

import struct
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

from drivers.imu.port import LineCounts
from fes.signals import Vector3

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
