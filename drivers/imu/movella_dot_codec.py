"""Movella DOT over Bluetooth LE: values of its characteristics ↔ samples and settings, no I/O.

From "Movella DOT BLE Service Specification", XD0506P revision C, July 2023, whose revision of 2020 is in
adamkewley/xdc, and "Xsens DOT User Manual", XD0502P, 4.2.5 (the stamp). Everything is least significant byte first. Of
all payloads only *rate quantities* (20 with, 21 without magnetometer) and *custom mode 5* (26, with a quaternion) carry
the measured acceleration; the others have free acceleration, from which gravity was taken, or increments. Here it is
21: stamp in µs (32 bits, from when it was switched on), acceleration in m/s² and rate in °/s as float32; what stands
behind its 28 bytes is 0. In real time it has 60 Hz at most; 120 Hz are for its own storage.

Not said: how it can be asked for its time; whether it keeps what it cannot send, and how much; how exact its clock is;
which status goes with this payload (clipping is not told in it).
"""

import math
import struct
from dataclasses import dataclass
from typing import Final

from fes.signals import Vector3

INFO, DEVICE_CONTROL, MEASUREMENT, MEDIUM_PAYLOAD = 0x1001, 0x1002, 0x2001, 0x2003  # characteristics
RATES_HZ: Final = (60, 30)  # the lower ones are of no use here
START, STOP = b"\1\1\x15", b"\1\0\x15"  # values of MEASUREMENT: of what, whether it runs, payload 21
_INFO: Final = struct.Struct("<6s3B7xIQ6s")  # address, firmware, its date, radio's firmware, serial number, model
_CONTROL: Final = struct.Struct("<B23xH6x")  # which fields count, output rate
_OUTPUT_RATE: Final = 1 << 4
_PAYLOAD: Final = struct.Struct("<I3f3f")


@dataclass(frozen=True, slots=True)
class Sample:
    """One sample; its stamp wraps."""

    t_us: int
    acc_mps2: Vector3
    gyr_radps: Vector3


def uuid(characteristic: int) -> str:
    """In full."""
    return f"1517{characteristic:04x}-4947-11e9-8646-d663bd873d93"


def is_measuring(value: bytes) -> bool:
    """Of what is read there."""
    return value[1:2] == b"\1"


def output_rate(rate_hz: int) -> bytes:
    """The value that sets the output rate and nothing else."""
    return _CONTROL.pack(_OUTPUT_RATE, rate_hz)


def set_rate_hz(value: bytes) -> int:
    """Of what is read there. struct.error: it is no such value."""
    return int(_CONTROL.unpack(value)[1])


def identity(value: bytes) -> tuple[str, str]:
    """Serial number, as it is printed, and firmware. struct.error: it is no such value."""
    _, major, minor, revision, _, serial, _ = _INFO.unpack(value)
    return f"{serial:X}", f"{major}.{minor}.{revision}"


def sample(payload: bytes) -> Sample:
    """One notification. struct.error: it is too short for rate quantities."""
    t_us, ax, ay, az, p, q, r = _PAYLOAD.unpack_from(payload)
    return Sample(t_us, (ax, ay, az), (math.radians(p), math.radians(q), math.radians(r)))
