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
    """What a package is: the document's SensorHeader, without what it reserves."""

    CMD_GET_DEVICE_INFO = 0x0070
    DATA_DEVICE_INFO = 0x0071
    CMD_SLEEP = 0x0110
    ACK_SLEEP = 0x0111
    CMD_DEEP_SLEEP = 0x0112
    ACK_DEEP_SLEEP = 0x0113
    CMD_SET_MEASUREMENT_MODE = 0x0120
    CMD_GET_MEASUREMENT_MODE = 0x0121
    DATA_MEASUREMENT_MODE = 0x0122
    CMD_SET_MEASUREMENT_BURST_MODE = 0x0123
    CMD_GET_MEASUREMENT_BURST_MODE = 0x0124
    DATA_MEASUREMENT_BURST_MODE = 0x0125
    CMD_SET_RECORDING_CONFIG = 0x0140
    CMD_GET_RECORDING_CONFIG = 0x0141
    DATA_RECORDING_CONFIG = 0x0142
    CMD_START_STREAMING = 0x0150
    ACK_START_STREAMING = 0x0151
    CMD_STOP_STREAMING = 0x0152
    ACK_STOP_STREAMING = 0x0153
    CMD_START_RECORDING = 0x0154
    ACK_START_RECORDING = 0x0155
    CMD_STOP_RECORDING = 0x0156
    ACK_STOP_RECORDING = 0x0157
    CMD_STOP_STREAMING_AND_CLEAR_BUFFER = 0x0158
    ACK_STOP_STREAMING_AND_CLEAR_BUFFER = 0x0159
    CMD_START_REAL_TIME_STREAMING = 0x0160
    CMD_GET_REAL_TIME_STREAMING_MODE = 0x0161
    DATA_REAL_TIME_STREAMING_MODE = 0x0162
    CMD_STOP_REAL_TIME_STREAMING = 0x0163
    ACK_STOP_REAL_TIME_STREAMING = 0x0164
    CMD_SET_ABSOLUTE_TIME = 0x0170
    DATA_ABSOLUTE_TIME = 0x0171
    DATA_CLOCK_ROUNDTRIP = 0x0172
    CMD_SET_LED_CONFIG = 0x0180
    CMD_GET_LED_CONFIG = 0x0181
    DATA_LED_CONFIG = 0x0182
    CMD_SET_LED_MODE = 0x0183
    CMD_GET_LED_MODE = 0x0184
    DATA_LED_MODE = 0x0185
    CMD_SET_SYNC_OUTPUT_MODE = 0x0186
    DATA_SYNC_OUTPUT_MODE = 0x0187
    CMD_GET_STATUS = 0x0200
    DATA_STATUS = 0x0201
    DATA_FULL_PACKED_200HZ = 0x0221
    DATA_FULL_PACKED_100HZ = 0x0222
    DATA_FULL_PACKED_50HZ = 0x0223
    DATA_FULL_PACKED_25HZ = 0x0224
    DATA_FULL_PACKED_10HZ = 0x0225
    DATA_FULL_PACKED_1HZ = 0x0226
    DATA_FULL_6D_PACKED_200HZ = 0x0231
    DATA_FULL_6D_PACKED_100HZ = 0x0232
    DATA_FULL_6D_PACKED_50HZ = 0x0233
    DATA_FULL_6D_PACKED_25HZ = 0x0234
    DATA_FULL_6D_PACKED_10HZ = 0x0235
    DATA_FULL_6D_PACKED_1HZ = 0x0236
    DATA_FULL_FIXED_200HZ = 0x0241
    DATA_FULL_FIXED_100HZ = 0x0242
    DATA_FULL_FIXED_50HZ = 0x0243
    DATA_FULL_FIXED_25HZ = 0x0244
    DATA_FULL_FIXED_10HZ = 0x0245
    DATA_FULL_FIXED_1HZ = 0x0246
    DATA_FULL_FIXED_RT = 0x0247
    DATA_FULL_6D_FIXED_200HZ = 0x0251
    DATA_FULL_6D_FIXED_100HZ = 0x0252
    DATA_FULL_6D_FIXED_50HZ = 0x0253
    DATA_FULL_6D_FIXED_25HZ = 0x0254
    DATA_FULL_6D_FIXED_10HZ = 0x0255
    DATA_FULL_6D_FIXED_1HZ = 0x0256
    DATA_FULL_FLOAT_200HZ = 0x0261
    DATA_QUAT_PACKED_200HZ = 0x0271
    DATA_QUAT_PACKED_100HZ = 0x0272
    DATA_QUAT_PACKED_50HZ = 0x0273
    DATA_QUAT_PACKED_25HZ = 0x0274
    DATA_QUAT_PACKED_10HZ = 0x0275
    DATA_QUAT_PACKED_1HZ = 0x0276
    DATA_QUAT_FIXED_200HZ = 0x0281
    DATA_QUAT_FIXED_100HZ = 0x0282
    DATA_QUAT_FIXED_50HZ = 0x0283
    DATA_QUAT_FIXED_25HZ = 0x0284
    DATA_QUAT_FIXED_10HZ = 0x0285
    DATA_QUAT_FIXED_1HZ = 0x0286
    DATA_QUAT_FIXED_RT = 0x0287
    DATA_QUAT_FLOAT_200HZ = 0x0291
    DATA_QUAT_FLOAT_100HZ = 0x0292
    DATA_QUAT_FLOAT_50HZ = 0x0293
    DATA_QUAT_FLOAT_25HZ = 0x0294
    DATA_QUAT_FLOAT_10HZ = 0x0295
    DATA_QUAT_FLOAT_1HZ = 0x0296
    DATA_RAW_BURST = 0x0300
    DATA_ACCZ_BURST = 0x0301
    DATA_SYNC_TRIGGER = 0x0400
    CMD_FS_LIST_FILES = 0x0500
    DATA_FS_FILE_COUNT = 0x0501
    DATA_FS_FILE = 0x0502
    CMD_FS_GET_BYTES = 0x0503
    DATA_FS_BYTES = 0x0504
    CMD_FS_STOP_GET_BYTES = 0x0505
    ACK_FS_STOP_GET_BYTES = 0x0506
    CMD_FS_GET_SIZE = 0x0507
    DATA_FS_SIZE = 0x0508
    CMD_FS_DELETE_FILE = 0x0509
    ACK_FS_DELETE_FILE = 0x050A
    CMD_FS_FORMAT_FILESYSTEM = 0x050D
    ACK_FS_FORMAT_FILESYSTEM = 0x050E
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


REAL_TIME_FULL: Final = 2  # CmdStartRealTimeStreaming.mode: DataFullFixedRt
CHARGING: Final = 0x80  # of DataStatus.battery, beside its percentage
SAMPLING_MODES: Final = {200: 1, 100: 2, 50: 3, 25: 4, 10: 5, 1: 6}  # by rate in Hz
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
_BURST = "enabled:? startTimestamp:q endTimestamp:q endTimestampIsRelative:? accZOnly:?"
_RECORDING = "endTimestamp:q endTimestampIsRelative:? filename:65s"
_REAL_TIME = "mode:B rateLimit:B"
_LED = "brightnessPercentage:B alternativeColors:? notifyColor:I"
_LED_MODE = "notifyStartTimestamp:q notifyEndTimestamp:q endTimestampIsRelative:?"
_PULSE = "startTimestamp:q endTimestamp:q endTimestampIsRelative:?"
_ORIENTED = "quat:Q delta:h errorFlags:B"
_FLOAT = "quat:4f delta:f restDetected:? magDistDetected:? errorFlags:B"
_LAYOUTS: Final[dict[str, str]] = {  # by the beginning of a header's name: NAME:FORMAT of each field, as struct has it
    "DATA_DEVICE_INFO": "protocolVersion:H serial:6s hardwareRevision:8s firmwareRevision:8s firmwareVersion:12s "
    "firmwareDate:11s",
    "CMD_SET_MEASUREMENT_MODE": _MODE,
    "DATA_MEASUREMENT_MODE": _MODE,
    "CMD_SET_MEASUREMENT_BURST_MODE": _BURST,
    "DATA_MEASUREMENT_BURST_MODE": _BURST,
    "CMD_SET_RECORDING_CONFIG": _RECORDING,
    "DATA_RECORDING_CONFIG": _RECORDING,
    "CMD_START_REAL_TIME_STREAMING": _REAL_TIME,
    "DATA_REAL_TIME_STREAMING_MODE": _REAL_TIME,
    "CMD_SET_ABSOLUTE_TIME": "newTimestamp:q",
    "DATA_ABSOLUTE_TIME": "newTimestamp:q",
    "DATA_CLOCK_ROUNDTRIP": "hostSendTimestamp:q sensorReceiveTimestamp:q sensorSendTimestamp:q hostReceiveTimestamp:q",
    "CMD_SET_LED_CONFIG": _LED,
    "DATA_LED_CONFIG": _LED,
    "CMD_SET_LED_MODE": _LED_MODE,
    "DATA_LED_MODE": _LED_MODE,
    "CMD_SET_SYNC_OUTPUT_MODE": _PULSE,
    "DATA_SYNC_OUTPUT_MODE": _PULSE,
    "DATA_STATUS": "timestamp:q sensorState:B connectionState:B gyrBias:3h synchronized:? battery:B "
    "freeStoragePercentage:B",
    "DATA_FULL_PACKED": f"timestamp:q gyr:24h acc:24h mag:24h {_ORIENTED}",
    "DATA_FULL_6D_PACKED": f"timestamp:q gyr:24h acc:24h {_ORIENTED}",
    "DATA_FULL_FIXED": f"timestamp:q gyr:3h acc:3h mag:3h {_ORIENTED}",
    "DATA_FULL_6D_FIXED": f"timestamp:q gyr:3h acc:3h {_ORIENTED}",
    "DATA_FULL_FLOAT": f"timestamp:q gyr:3f acc:3f mag:3f {_FLOAT} :5x",
    "DATA_QUAT_PACKED": "timestamp:q quat:20Q delta:20h errorFlags:20B",
    "DATA_QUAT_FIXED": f"timestamp:q {_ORIENTED}",
    "DATA_QUAT_FLOAT": f"timestamp:q {_FLOAT}",
    "DATA_RAW_BURST": "timestamp:q gyr:48h acc:48h mag:3h errorFlags:B",
    "DATA_ACCZ_BURST": "timestamp:q accZ:64h errorFlags:B",
    "DATA_SYNC_TRIGGER": "timestamp:q value:B",
    "DATA_FS_FILE_COUNT": "fileCount:H",
    "DATA_FS_FILE": "index:H filename:65s size:I",
    "CMD_FS_GET_BYTES": "filename:65s startPos:I endPos:I",
    "DATA_FS_BYTES": "offset:I",  # then the file's bytes, as many as there are: field ``payload``
    "CMD_FS_GET_SIZE": "filename:65s",
    "DATA_FS_SIZE": "filename:65s fileSize:I",
    "CMD_FS_DELETE_FILE": "filename:65s",
    "ACK_FS_DELETE_FILE": "filename:65s",
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
SIZES: Final[dict[int, range]] = {  # of payloads in bytes, by header
    header: range(layout.struct.size, 1 + (MAX_PAYLOAD if header is Header.DATA_FS_BYTES else layout.struct.size))
    for header, layout in LAYOUTS.items()
}


def encode(header: int, payload: bytes = b"") -> bytes:
    """One package. ValueError: more payload than a package holds."""
    if len(payload) > MAX_PAYLOAD:
        raise ValueError(f"{len(payload)} bytes do not fit a Capture2Go package ({MAX_PAYLOAD})")
    body = struct.pack("<H", header) + payload
    return struct.pack("<BIB", START, zlib.crc32(body), len(payload)) + body


def pack(header: Header, fields: Mapping[str, Value] | None = None) -> bytes:
    """One package from its fields; those that are not named are 0. ValueError, struct.error: one that does not fit."""
    layout, given = LAYOUTS[header], dict(fields or {})
    rest = given.pop("payload", b"") if header is Header.DATA_FS_BYTES else b""
    if not isinstance(rest, bytes):
        raise ValueError(f"{header.name}: payload must be bytes")
    values: list[Value] = []
    for (name, count), blank in zip(layout.fields, _blank(layout), strict=True):
        value = given.pop(name, blank)
        values += value if count and isinstance(value, tuple) else [value]
    if given:
        raise ValueError(f"{header.name} has no field {', '.join(sorted(given))}")
    return encode(header, layout.struct.pack(*values) + rest)


def _blank(layout: _Layout) -> list[Value]:
    return list(_grouped(layout, layout.struct.unpack(bytes(layout.struct.size))))


def _grouped(layout: _Layout, flat: tuple[Any, ...]) -> list[Any]:
    values = []
    at = 0
    for _, count in layout.fields:
        values.append(flat[at : at + count] if count else flat[at])
        at += count or 1
    return values


def unpack(package: Package) -> dict[str, Any]:
    """The fields of a package, in the document's units; text as bytes up to its first zero.

    Raises:
        Capture2GoRejected: an unknown header, or a payload of another size.
    """
    layout, payload = _layout_of(package), package.payload
    fields = dict(zip((name for name, _ in layout.fields), _unpacked(layout, payload), strict=True))
    if package.header == Header.DATA_FS_BYTES:
        fields["payload"] = payload[layout.struct.size :]
    return {name: value.split(b"\0")[0] if isinstance(value, bytes) and name != "payload" else value
            for name, value in fields.items()}  # fmt: skip


def _unpacked(layout: _Layout, payload: bytes) -> list[Any]:
    return _grouped(layout, layout.struct.unpack_from(payload))


def _layout_of(package: Package) -> _Layout:
    try:
        layout = LAYOUTS[Header(package.header)]
    except ValueError:
        raise Capture2GoRejected(f"header {package.header:#06x} is not in the protocol") from None
    if len(package.payload) not in SIZES[package.header]:
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

    Raises:
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
    up to 244 bytes, the samples of 60 ms. What the makers reserve for themselves is passed over as such bytes.
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
            possible = size in SIZES.get(header, ())
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
