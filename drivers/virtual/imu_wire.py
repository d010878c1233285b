"""How each kind of simulated sensor says a sample, and what it answers to the host; no I/O, no clock."""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from typing import Final, Protocol

from drivers.imu import xbus_codec as xbus
from drivers.imu import ximu3_codec
from drivers.imu.xbus_codec import Mid, Xdi
from fes.signals import G_MPS2, Vector3

CAN_RECORD: Final = struct.Struct(">IB8s")  # identifier, length, data
LSL_RECORD: Final = struct.Struct(">7d")  # stamp in s, acceleration, rate
CLIP_FLAGS: Final = xbus.CLIPPED_ACC | xbus.CLIPPED_GYR | xbus.CLIPPED_ANY


@dataclass(frozen=True, slots=True)
class Reading:
    """One sample by the device's own clock."""

    counter: int
    t_device_ns: int
    acc_mps2: Vector3
    gyr_radps: Vector3
    clipped: bool = False

    @property
    def finite(self) -> bool:
        """Whether every value is a number."""
        return all(map(math.isfinite, (*self.acc_mps2, *self.gyr_radps)))


class Wire(Protocol):
    """A kind of device. ``carries_nan``: it sends floating point, in which a value can be NaN or infinite."""

    carries_nan: bool

    def say(self, reading: Reading) -> list[bytes]:
        """The messages of one sample."""
        ...

    def hear(self, data: bytes) -> list[bytes]:
        """The answers to the host."""
        ...

    def boot(self) -> list[bytes]:
        """What it says when switched on."""
        ...


class XbusWire:
    """An MTi: configuration and measurement state, the host's choice of rate acknowledged if it is its own."""

    carries_nan = True

    def __init__(self, rate_hz: float) -> None:
        self._rate = round(rate_hz)
        self._decoder = xbus.XbusDecoder()
        self._measuring = True

    def say(self, reading: Reading) -> list[bytes]:
        """MTData2, in measurement state only."""
        if not self._measuring:
            return []
        time_fine = reading.t_device_ns // xbus.TIME_FINE_TICK_NS % 2**32
        data = xbus.block(Xdi.COUNTER, struct.pack(">H", reading.counter % 2**16))
        data += xbus.block(Xdi.TIME_FINE, struct.pack(">I", time_fine))
        data += xbus.block(Xdi.ACCELERATION, xbus.encode_reals(reading.acc_mps2, 0))
        data += xbus.block(Xdi.RATE_OF_TURN, xbus.encode_reals(reading.gyr_radps, 0))
        data += xbus.block(Xdi.STATUS_WORD, struct.pack(">I", CLIP_FLAGS if reading.clipped else 0))
        return [xbus.encode(Mid.MT_DATA2, data)]

    def hear(self, data: bytes) -> list[bytes]:
        """Acknowledge what an MTi acknowledges; error 04 for what it does not know, 03 for a rate it has not."""
        return [answer for message in self._decoder.feed(data) for answer in self._answer(message)]

    def _answer(self, message: xbus.XbusMessage) -> list[bytes]:
        if message.mid == Mid.GO_TO_CONFIG:
            self._measuring = False
            return [xbus.encode(Mid.GO_TO_CONFIG_ACK)]
        if message.mid == Mid.GO_TO_MEASUREMENT:
            self._measuring = True
            return [xbus.encode(Mid.GO_TO_MEASUREMENT_ACK)]
        if message.mid == Mid.WAKE_UP_ACK:
            return []
        if self._measuring:
            return [xbus.encode(Mid.ERROR, b"\x04")]
        if message.mid == Mid.REQ_DID:
            return [xbus.encode(Mid.DEVICE_ID, b"\x03\x70\x03\xf8")]
        if message.mid == Mid.SET_OUTPUT and len(message.data) % 4 == 0:
            pairs = struct.iter_unpack(">HH", message.data)
            given = [(xdi, 0xFFFF if rate == 0xFFFF else self._rate) for xdi, rate in pairs]
            return [xbus.encode(Mid.SET_OUTPUT_ACK, b"".join(struct.pack(">HH", *pair) for pair in given))]
        return [xbus.encode(Mid.ERROR, b"\x04")]

    def boot(self) -> list[bytes]:
        """WakeUp; without an answer it goes on measuring."""
        self._measuring = True
        return [xbus.encode(Mid.WAKE_UP)]


class _Mute:
    carries_nan = True

    def hear(self, data: bytes) -> list[bytes]:
        """Not listened to."""
        return []

    def boot(self) -> list[bytes]:
        """Nothing."""
        return []


class Ximu3Wire(_Mute):
    """An x-IMU3: inertial messages."""

    def say(self, reading: Reading) -> list[bytes]:
        """One inertial message."""
        gx, gy, gz = reading.gyr_radps
        ax, ay, az = reading.acc_mps2
        gyr = (math.degrees(gx), math.degrees(gy), math.degrees(gz))
        message = ximu3_codec.Inertial(reading.t_device_ns // 1000, gyr, (ax / G_MPS2, ay / G_MPS2, az / G_MPS2))
        return [ximu3_codec.encode(message)]


class XsensCanWire(_Mute):
    """An MTi-600 on CAN: SampleTime, GroupCounter, RateOfTurn, Acceleration, as records of ``CAN_RECORD``.

    Its values are of 16 bits, which have no NaN: a sample without numbers is not sent.
    """

    carries_nan = False

    def __init__(self, id_offset: int = 0) -> None:
        self._offset = id_offset

    def say(self, reading: Reading) -> list[bytes]:
        """Four frames."""
        if not reading.finite:
            return []
        frames = [
            (0x05, struct.pack(">I", reading.t_device_ns // xbus.TIME_FINE_TICK_NS % 2**32)),
            (0x06, struct.pack(">H", reading.counter % 2**16)),
            (0x32, _steps(reading.gyr_radps, 512)),
            (0x34, _steps(reading.acc_mps2, 256)),
        ]
        return [CAN_RECORD.pack(number + self._offset, len(data), data) for number, data in frames]


class LslWire(_Mute):
    """A stream's sample as a record of ``LSL_RECORD``."""

    def say(self, reading: Reading) -> list[bytes]:
        """One row."""
        return [LSL_RECORD.pack(reading.t_device_ns * 1e-9, *reading.acc_mps2, *reading.gyr_radps)]


def _steps(values: Vector3, per_unit: int) -> bytes:
    return struct.pack(">3h", *(min(max(round(v * per_unit), -(2**15)), 2**15 - 1) for v in values))
