"""An x-io x-IMU3 on a serial line, TCP or UDP.

The codec does no I/O. From x-io's public "x-IMU3 User Manual", section on the binary protocol: first byte the
message's letter with its top bit set (``'I' | 0x80``), then a 64-bit stamp in µs and six float32, gyroscope in °/s
then accelerometer in g, least significant byte first; ended by ``0A``. Within a message ``0A`` is sent as ``DB DC``
and ``DB`` as ``DB DD``. There is no checksum: a garbled message of the right length reads as other values, so they are
checked against the range.
"""

import math
import struct
from dataclasses import dataclass
from typing import Final

from drivers.imu.line import LineSensorPort
from drivers.imu.port import LineCounts
from fes.signals import G_MPS2, RawSample, Vector3

INERTIAL: Final = 0x80 | ord("I")
END: Final = 0x0A
ESCAPE: Final = 0xDB
_ESCAPED: Final = {b"\xdc": bytes((END,)), b"\xdd": bytes((ESCAPE,))}
_BODY: Final = struct.Struct("<Q6f")
_LONGEST: Final = 1024  # bytes without a terminator are noise


@dataclass(frozen=True, slots=True)
class Inertial:
    """One inertial message in the device's own units."""

    t_us: int
    gyr_dps: Vector3
    acc_g: Vector3


def encode(message: Inertial) -> bytes:
    """The message as the device sends it."""
    body = _BODY.pack(message.t_us & (2**64 - 1), *message.gyr_dps, *message.acc_g)
    escaped = body.replace(b"\xdb", b"\xdb\xdd").replace(b"\x0a", b"\xdb\xdc")
    return bytes((INERTIAL,)) + escaped + bytes((END,))


class Ximu3Decoder:
    """Bytes in, inertial messages out, however they are cut; other messages are passed over."""

    def __init__(self, counts: LineCounts | None = None) -> None:
        self.counts = counts or LineCounts()
        self._buffer = bytearray()

    def feed(self, data: bytes) -> list[Inertial]:
        """The messages complete by now."""
        self._buffer += data
        *lines, rest = self._buffer.split(bytes((END,)))
        if len(rest) > _LONGEST:
            self.counts.bytes_skipped += len(rest)
            rest = bytearray()
        self._buffer = bytearray(rest)
        return [message for line in lines if (message := self._decode(bytes(line))) is not None]

    def _decode(self, line: bytes) -> Inertial | None:
        if not line or line[0] != INERTIAL:
            if line and not line[0] & 0x80 and line[:1] != b"{":
                self.counts.bytes_skipped += len(line) + 1
            return None
        body = unescaped(line[1:])
        if body is None or len(body) != _BODY.size:
            self.counts.bad_frames += 1
            return None
        t_us, gx, gy, gz, ax, ay, az = _BODY.unpack(body)
        return Inertial(t_us, (gx, gy, gz), (ax, ay, az))


def unescaped(data: bytes) -> bytes | None:
    """Without escapes; None when one is not valid."""
    plain, *escaped = data.split(bytes((ESCAPE,)))
    if any(part[:1] not in _ESCAPED for part in escaped):
        return None
    return plain + b"".join(_ESCAPED[part[:1]] + part[1:] for part in escaped)


class Ximu3Imu(LineSensorPort):
    """:class:`~drivers.imu.port.ImuPort` for one x-IMU3."""

    def _open(self) -> None:
        self._decoder = Ximu3Decoder(self._counts)
        self._expect_samples()
        self._open_line()

    def read(self, t_ns: int) -> list[RawSample]:
        """All inertial messages that have arrived."""
        return [self._converted(t_ns, message) for message in self._decoder.feed(self._line.read())]

    def _converted(self, t_ns: int, message: Inertial) -> RawSample:
        """°/s and g → SI, counted."""
        stamp_ns = message.t_us * 1000 if message.t_us < 2**53 else 0  # a garbled stamp; 2^53 µs are 285 years
        gx, gy, gz = message.gyr_dps
        ax, ay, az = message.acc_g
        gyr = (math.radians(gx), math.radians(gy), math.radians(gz))
        return self._sample(t_ns, stamp_ns, (ax * G_MPS2, ay * G_MPS2, az * G_MPS2), gyr)
