"""An x-io x-IMU3 on a serial line, TCP or UDP, by our own decoder or (option ``library = true``) by x-io's library.

Both carry 500 Hz without loss. Ours is the default: the library (1.9.1, measured on a pseudo-terminal) goes on saying
"connected" after the line is gone, so only silence tells, and once in four runs it aborted the interpreter at its exit,
its reading thread being in a callback. The library serves serial and TCP here; UDP is ours.

The codec does no I/O. From x-io's public "x-IMU3 User Manual", section on the binary protocol: first byte the
message's letter with its top bit set (``'I' | 0x80``), then a 64-bit stamp in µs and six float32, gyroscope in °/s
then accelerometer in g, least significant byte first; ended by ``0A``. Within a message ``0A`` is sent as ``DB DC``
and ``DB`` as ``DB DD``. There is no checksum: a garbled message of the right length reads as other values, so they are
checked against the range.
"""

import contextlib
import importlib
import math
import os
import struct
import time
from collections import deque
from dataclasses import dataclass
from typing import Any, Final
from urllib.parse import urlsplit

from drivers.imu.line import LineSensorPort
from drivers.imu.port import ImuLost, LineCounts, OneSensorPort, whole_option
from fes.config import ImuDevice
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


class _Ximu3Port(OneSensorPort):
    def _converted(self, t_ns: int, message: Inertial) -> RawSample:
        """°/s and g → SI, counted."""
        stamp_ns = message.t_us * 1000 if message.t_us < 2**53 else 0  # a garbled stamp; 2^53 µs are 285 years
        gx, gy, gz = message.gyr_dps
        ax, ay, az = message.acc_g
        gyr = (math.radians(gx), math.radians(gy), math.radians(gz))
        return self._sample(t_ns, stamp_ns, (ax * G_MPS2, ay * G_MPS2, az * G_MPS2), gyr)


class Ximu3Imu(LineSensorPort, _Ximu3Port):
    """:class:`~drivers.imu.port.ImuPort` for one x-IMU3, by our own decoder."""

    def _open(self) -> None:
        self._decoder = Ximu3Decoder(self._counts)
        self._expect_samples()
        self._open_line()

    def read(self, t_ns: int) -> list[RawSample]:
        """All inertial messages that have arrived."""
        return [self._converted(t_ns, message) for message in self._decoder.feed(self._line.read())]


class Ximu3LibraryImu(_Ximu3Port):
    """The same by x-io's library: its thread fills a queue and an eventfd tells ``select``.

    ``silent_s``: as the library does not report a lost line, one that says nothing for so long is lost.
    """

    def __init__(self, device: ImuDevice, silent_s: float = 1.0) -> None:
        try:
            self._library: Any = importlib.import_module("ximu3")
        except ImportError as error:
            why = "options.library needs the package ximu3: pip install 'fes-gait[ximu3]'"
            raise ImuLost(f"{device.sensor}: {why}") from error
        self._silent_ns = int(silent_s * 1e9)
        super().__init__(device)

    def _open(self) -> None:
        device = self._device
        baudrate = whole_option(device, "baudrate", 115200, 1)
        self._queue: deque[Inertial] = deque(maxlen=100_000)
        self._errors: deque[int] = deque(maxlen=100_000)
        self._expect_samples()
        self._heard_ns = -1
        self._event = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._open_event = True
        where = urlsplit(device.port)
        try:
            if where.scheme == "socket":
                config = self._library.TcpConnectionConfig(where.hostname or "", where.port or 0)
            elif where.scheme:
                raise ImuLost(f"{device.sensor}: options.library has no {where.scheme}:// here; leave it out")
            else:
                config = self._library.SerialConnectionConfig(device.port, baudrate, False)
            self._connection = self._library.Connection(config)
            self._connection.add_inertial_callback(self._heard)
            self._connection.add_receive_error_callback(self._errors.append)
            self._connection.open()
        except Exception as error:  # the library raises RuntimeError and what its binding makes of it
            self._close_event()
            raise ImuLost(f"{device.sensor} on {device.port} cannot be opened: {error}") from error

    def _heard(self, message: Any) -> None:
        gyr = (message.gyroscope_x, message.gyroscope_y, message.gyroscope_z)
        acc = (message.accelerometer_x, message.accelerometer_y, message.accelerometer_z)
        self._queue.append(Inertial(message.timestamp, gyr, acc))
        if self._open_event:
            with contextlib.suppress(OSError):
                os.eventfd_write(self._event, 1)

    def fileno(self) -> int:
        """An eventfd that the library's thread raises."""
        return self._event

    def read(self, t_ns: int) -> list[RawSample]:
        """All that the library's thread has queued."""
        with contextlib.suppress(BlockingIOError):
            os.eventfd_read(self._event)
        samples: list[RawSample] = []
        while self._errors:
            self._errors.popleft()
            self._counts.bad_frames += 1
        while self._queue:
            samples.append(self._converted(t_ns, self._queue.popleft()))
        if samples or self._heard_ns < 0:
            self._heard_ns = t_ns
        elif t_ns - self._heard_ns > self._silent_ns:
            raise ImuLost(f"{self._device.sensor} on {self._device.port}: silent. Check cable and power.")
        return samples

    def close(self) -> None:
        """End the library's thread."""
        if self._open_event:
            self._connection.close()
            self._close_event()
            time.sleep(0)  # lets the library's thread see it

    def _close_event(self) -> None:
        self._open_event = False
        os.close(self._event)
