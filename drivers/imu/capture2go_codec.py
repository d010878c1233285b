"""SensorStim Capture2Go: bytes ↔ packages ↔ fields and samples, no I/O.

From the makers' public "Capture2Go Communication Protocol" (MIT, capture2go_sdk 1.0.1): package ``02 crc32(4) size(1)
header(2) payload``, least significant byte first, at most 236 bytes of payload; the checksum is CRC-32 as in zlib, over
header and payload. Fields have the document's own names. Over Bluetooth LE the first byte of a notification says how
many whole real-time packages follow it (FF none, FE one, FD two …); the rest goes on in the stream of the send buffer.

Every measured value has one full range, ±2000 °/s and ±16 · 9.81 m/s²: there is no command that sets another.
"""

import math
import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum, IntFlag
from typing import Any, Final

from drivers.imu.port import LineCounts
from fes.signals import NS_PER_S, Vector3

START: Final = 0x02
HEAD_BYTES: Final = 8
MAX_PAYLOAD: Final = 236
MOST_REAL_TIME: Final = 3  # packages in a notification, as the makers' reader takes them
ACC_RANGE_G: Final = 16.0
GYR_RANGE_DPS: Final = 2000.0
ACC_MPS2: Final = 16.0 / 32768.0 * 9.81  # per step
GYR_RADPS: Final = 2000.0 * math.pi / 180.0 / 32768.0
_HEAD: Final = struct.Struct("<BIBH")

Value = int | float | bool | bytes | tuple[int, ...] | tuple[float, ...]


class Header(IntEnum):
    """What a package is: of the document's SensorHeader what a session asks for and can get."""

    CMD_GET_DEVICE_INFO = 0x0070
    DATA_DEVICE_INFO = 0x0071
    CMD_SET_MEASUREMENT_MODE = 0x0120
    DATA_MEASUREMENT_MODE = 0x0122
    CMD_START_STREAMING = 0x0150
    ACK_START_STREAMING = 0x0151
    CMD_STOP_STREAMING = 0x0152
    ACK_STOP_STREAMING = 0x0153
    CMD_STOP_STREAMING_AND_CLEAR_BUFFER = 0x0158
    ACK_STOP_STREAMING_AND_CLEAR_BUFFER = 0x0159
    CMD_SET_ABSOLUTE_TIME = 0x0170
    DATA_ABSOLUTE_TIME = 0x0171
    CMD_GET_STATUS = 0x0200
    DATA_STATUS = 0x0201
    DATA_FULL_PACKED_200HZ = 0x0221
    DATA_FULL_PACKED_100HZ = 0x0222
    DATA_FULL_PACKED_50HZ = 0x0223
    DATA_FULL_PACKED_25HZ = 0x0224
    DATA_FULL_6D_PACKED_200HZ = 0x0231
    DATA_FULL_6D_PACKED_100HZ = 0x0232
    DATA_FULL_6D_PACKED_50HZ = 0x0233
    DATA_FULL_6D_PACKED_25HZ = 0x0234
    DATA_FULL_FIXED_200HZ = 0x0241
    DATA_FULL_FIXED_100HZ = 0x0242
    DATA_FULL_FIXED_50HZ = 0x0243
    DATA_FULL_FIXED_25HZ = 0x0244
    DATA_FULL_FIXED_RT = 0x0247
    DATA_FULL_6D_FIXED_200HZ = 0x0251
    DATA_FULL_6D_FIXED_100HZ = 0x0252
    DATA_FULL_6D_FIXED_50HZ = 0x0253
    DATA_FULL_6D_FIXED_25HZ = 0x0254
    DATA_FULL_FLOAT_200HZ = 0x0261
    ERROR = 0xFFFF


class Flags(IntFlag):
    """A sample's errorFlags. Clipping is meant of the sensor's own samples at 1666 Hz, before its processing."""

    TIME_GAP = 0x01
    GYR_CLIPPING = 0x02
    ACC_CLIPPING = 0x04
    MAG_CLIPPING = 0x08
    PROCESSING_ISSUE = 0x10


class SensorState(IntEnum):
    """DataStatus.sensorState."""

    OFF = 0
    IDLE = 1
    STREAMING = 2
    RECORDING = 3


class SyncMode(IntEnum):
    """CmdSetMeasurementMode.syncMode."""

    NONE = 0
    SENDER = 1
    RECEIVER = 2


CHARGING: Final = 0x80  # of DataStatus.battery, beside its percentage
SAMPLING_MODES: Final = {200: 1, 100: 2, 50: 3, 25: 4}  # by rate in Hz
ERRORS: Final = {
    0x00: "no error", 0xF0: "file not found", 0xF1: "file deletion failed", 0xF2: "file system error",
    0xF3: "file already exists", 0xF4: "file is too short", 0xF5: "file name is not valid", 0xF6: "file system is full",
    0xF7: "file system is busy", 0xF9: "recording configuration is not set", 0xFA: "calibration cannot be stored",
    0xFB: "wrong state", 0xFC: "package cannot be parsed", 0xFD: "unknown command", 0xFE: "send buffer is full",
    0xFF: "unknown error",
}  # fmt: skip

_MODE = "timestamp:q fullFloat200HzEnabled:? fullFixedMode:B fullPackedMode:B quatFloatMode:B quatFixedMode:B"
_MODE += " quatPackedMode:B statusMode:B calibDataMode:B processExtensionMode:H syncMode:B syncId:Q"
_MODE += " disableBiasEstimation:? disableMagDistRejection:? disableMagData:?"
_ORIENTED = "quat:Q delta:h errorFlags:B"
_FLOAT = "quat:4f delta:f restDetected:? magDistDetected:? errorFlags:B"
_LAYOUTS: Final[dict[str, str]] = {  # by the beginning of a header's name: NAME:FORMAT of each field, as struct has it
    "DATA_DEVICE_INFO": "protocolVersion:H serial:6s hardwareRevision:8s firmwareRevision:8s firmwareVersion:12s "
    "firmwareDate:11s",
    "CMD_SET_MEASUREMENT_MODE": _MODE,
    "DATA_MEASUREMENT_MODE": _MODE,
    "CMD_SET_ABSOLUTE_TIME": "newTimestamp:q",
    "DATA_ABSOLUTE_TIME": "newTimestamp:q",
    "DATA_STATUS": "timestamp:q sensorState:B connectionState:B gyrBias:3h synchronized:? battery:B "
    "freeStoragePercentage:B",
    "DATA_FULL_PACKED": f"timestamp:q gyr:24h acc:24h mag:24h {_ORIENTED}",
    "DATA_FULL_6D_PACKED": f"timestamp:q gyr:24h acc:24h {_ORIENTED}",
    "DATA_FULL_FIXED": f"timestamp:q gyr:3h acc:3h mag:3h {_ORIENTED}",
    "DATA_FULL_6D_FIXED": f"timestamp:q gyr:3h acc:3h {_ORIENTED}",
    "DATA_FULL_FLOAT": f"timestamp:q gyr:3f acc:3f mag:3f {_FLOAT} :5x",
    "ERROR": "errorCode:B command:H",
}


class Capture2GoRejected(ValueError):
    """A package whose header is not known, or whose payload has not the size that goes with its header."""


@dataclass(frozen=True, slots=True)
class Package:
    """One intact package."""

    header: int
    payload: bytes = b""


@dataclass(frozen=True, slots=True)
class Sample:
    """One inertial sample by the sensor's clock: ``t_ns``, specific force in m/s², rate in rad/s."""

    t_ns: int
    acc_mps2: Vector3
    gyr_radps: Vector3
    flags: Flags


class _Layout:
    """The fields of one kind of package."""

    def __init__(self, text: str) -> None:
        parts = [part.split(":") for part in text.split()]
        self.struct = struct.Struct("<" + "".join(code for _, code in parts))
        self.fields: list[tuple[str, int]] = []  # name, and how many values; 0: one value by itself
        for name, code in parts:
            if name:
                self.fields.append((name, int(code[:-1]) if code[:-1] and code[-1] != "s" else 0))


def _layout_text(header: Header) -> str:
    name = header.name.rpartition("_")[0] if header.name.endswith(("HZ", "_RT")) else header.name
    return _LAYOUTS.get(name, "")


LAYOUTS: Final = {header: _Layout(_layout_text(header)) for header in Header}
SIZES: Final[dict[int, int]] = {header: layout.struct.size for header, layout in LAYOUTS.items()}  # of payloads, bytes


def encode(header: int, payload: bytes = b"") -> bytes:
    """One package. ValueError: more payload than a package holds."""
    if len(payload) > MAX_PAYLOAD:
        raise ValueError(f"{len(payload)} bytes do not fit a Capture2Go package ({MAX_PAYLOAD})")
    body = struct.pack("<H", header) + payload
    return struct.pack("<BIB", START, zlib.crc32(body), len(payload)) + body


def pack(header: Header, fields: Mapping[str, Value] | None = None) -> bytes:
    """One package from its fields; those that are not named are 0. ValueError, struct.error: one that does not fit."""
    layout, given = LAYOUTS[header], dict(fields or {})
    values: list[Value] = []
    blanks = _unpacked(layout, bytes(layout.struct.size))
    for (name, count), blank in zip(layout.fields, blanks, strict=True):
        value = given.pop(name, blank)
        values += value if count and isinstance(value, tuple) else [value]
    if given:
        raise ValueError(f"{header.name} has no field {', '.join(sorted(given))}")
    return encode(header, layout.struct.pack(*values))


def unpack(package: Package) -> dict[str, Any]:
    """The fields of a package, in the document's units; text as bytes up to its first zero.

    Capture2GoRejected: an unknown header, or a payload of another size.
    """
    layout = _layout_of(package)
    fields = dict(zip((name for name, _ in layout.fields), _unpacked(layout, package.payload), strict=True))
    return {name: value.split(b"\0")[0] if isinstance(value, bytes) else value for name, value in fields.items()}


def _unpacked(layout: _Layout, payload: bytes) -> list[Any]:
    flat = layout.struct.unpack(payload)
    values: list[Any] = []
    at = 0
    for _, count in layout.fields:
        values.append(flat[at : at + count] if count else flat[at])
        at += count or 1
    return values


def _layout_of(package: Package) -> _Layout:
    try:
        layout = LAYOUTS[Header(package.header)]
    except ValueError:
        raise Capture2GoRejected(f"header {package.header:#06x} is none of the protocol that is used here") from None
    if len(package.payload) != layout.struct.size:
        said = f"{Header(package.header).name} with {len(package.payload)} bytes of payload"
        raise Capture2GoRejected(f"{said} instead of {layout.struct.size}")
    return layout


def nominal_rate_hz(header: int) -> int:
    """That of the samples in a package of this kind; 0 where its header names none."""
    name = Header(header).name
    return int(name.rpartition("_")[2].removesuffix("HZ")) if name.endswith("HZ") else 0


def samples(package: Package) -> list[Sample]:
    """The inertial samples in a package, oldest first: none in one of another kind, eight in a packed one.

    A packed one has the stamp of its first sample, and one set of flags for all.

    Capture2GoRejected: as :func:`unpack`.
    """
    layout = _layout_of(package)
    if not Header.DATA_FULL_PACKED_200HZ <= package.header <= Header.DATA_FULL_FLOAT_200HZ:
        return []
    by_name = dict(zip((name for name, _ in layout.fields), _unpacked(layout, package.payload), strict=True))
    t_ns, gyr, acc, flags = (by_name[name] for name in ("timestamp", "gyr", "acc", "errorFlags"))
    real = package.header == Header.DATA_FULL_FLOAT_200HZ
    gyr_unit, acc_unit = (1.0, 1.0) if real else (GYR_RADPS, ACC_MPS2)
    period_ns = NS_PER_S // nominal_rate_hz(package.header) if len(gyr) > 3 else 0
    return [
        Sample(t_ns + k * period_ns, _scaled(acc, 3 * k, acc_unit), _scaled(gyr, 3 * k, gyr_unit), Flags(flags))
        for k in range(len(gyr) // 3)
    ]


def _scaled(values: tuple[int, ...] | tuple[float, ...], at: int, unit: float) -> Vector3:
    return values[at] * unit, values[at + 1] * unit, values[at + 2] * unit


class Capture2GoDecoder:
    """Bytes in, packages out, however they are cut. After noise it looks again from the byte after the false start.

    Only a header of the protocol with the size that goes with it is waited for: a stray start byte would else hold back
    up to 244 bytes, the samples of 60 ms. Kinds of package that no session asks for are passed over as such bytes.
    ``counts``: of wrong checksums (``bad_frames``), of bytes that belonged to no package.
    """

    def __init__(self, counts: LineCounts | None = None) -> None:
        self.counts = counts or LineCounts()
        self._buffer = bytearray()

    def feed(self, data: bytes) -> list[Package]:
        """The packages complete by now."""
        buffer, counts = self._buffer, self.counts
        buffer += data
        packages: list[Package] = []
        at = 0
        while True:
            start = buffer.find(START, at)
            counts.bytes_skipped += (len(buffer) if start < 0 else start) - at
            at = len(buffer) if start < 0 else start
            if len(buffer) - at < HEAD_BYTES:
                break
            _, crc, size, header = _HEAD.unpack_from(buffer, at)
            end = at + HEAD_BYTES + size
            possible = size == SIZES.get(header)
            if possible and end > len(buffer):
                break
            if not possible or zlib.crc32(memoryview(buffer)[at + 6 : end]) != crc:
                counts.bad_frames += possible
                counts.bytes_skipped += 1
                at += 1
                continue
            packages.append(Package(header, bytes(buffer[at + HEAD_BYTES : end])))
            at = end
        del buffer[:at]
        return packages


class NotificationDecoder:
    """Bluetooth LE notifications in, packages out: real-time ones first, then those that the send buffer completes."""

    def __init__(self, counts: LineCounts | None = None) -> None:
        self.counts = counts or LineCounts()
        self._buffered = Capture2GoDecoder(self.counts)

    def feed(self, notification: bytes) -> list[Package]:
        """The packages complete by now; a notification that is not what its first byte says is passed over whole."""
        if not notification:
            return []
        packages: list[Package] = []
        at = 1
        for _ in range(0xFF - notification[0]):
            end = at + HEAD_BYTES + notification[at + 5] if len(notification) >= at + HEAD_BYTES else 0
            found = Capture2GoDecoder().feed(notification[at:end]) if at < end <= len(notification) else []
            if len(found) != 1 or HEAD_BYTES + len(found[0].payload) != end - at or len(packages) == MOST_REAL_TIME:
                self.counts.bad_frames += 1
                self.counts.bytes_skipped += len(notification)
                return []
            packages += found
            at = end
        return packages + self._buffered.feed(notification[at:])
