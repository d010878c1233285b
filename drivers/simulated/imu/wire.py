"""How each kind of simulated sensor encodes a sample, and what it answers to the host; no I/O, no clock.

What is on CAN shares no code with the driver's decoder, so that the two check each other.
"""

import math
import struct
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from cantools.database.can import Database, Message, Signal

from drivers.imu import xbus, ximu3
from drivers.imu.xbus import Mid, Xdi
from drivers.simulated.lines import CAN_RECORD
from fes.signals import G_MPS2, Vector3

LSL_RECORD: Final = struct.Struct(">7d")  # stamp in s, acceleration, rate
CLIP_FLAGS: Final = xbus.CLIPPED_ACC | xbus.CLIPPED_GYR | xbus.CLIPPED_ANY
AXES: Final = ("acc_x", "acc_y", "acc_z", "gyr_x", "gyr_y", "gyr_z")
PER_UNIT: Final = {"m/s2": 1.0, "m/s^2": 1.0, "g": G_MPS2, "rad/s": 1.0, "deg/s": math.pi / 180.0}
NS_PER_UNIT: Final = {"s": 1e9, "ms": 1e6, "us": 1e3, "ns": 1.0}
LAST_ID: Final = 0x7FF
LONGEST: Final = 8  # bytes of a frame


@dataclass(frozen=True, slots=True)
class Reading:
    """One sample by the device's own clock; ``t_true_ns`` is when it was taken, which no device knows."""

    counter: int
    t_device_ns: int
    acc_mps2: Vector3
    gyr_radps: Vector3
    clipped: bool = False
    t_true_ns: int = 0

    @property
    def finite(self) -> bool:
        """Whether every value is a number."""
        return all(map(math.isfinite, (*self.acc_mps2, *self.gyr_radps)))


SERIAL: Final = "037003F8"  # of a simulated MTi, unless it is given another


class Wire(ABC):
    """A kind of device.

    ``carries_nan``: it sends floating point, in which a value can be NaN or infinite. ``faults``: those that only this
    kind can have.
    """

    carries_nan = True
    faults: frozenset[str] = frozenset()

    @abstractmethod
    def encode(self, reading: Reading) -> list[bytes]:
        """The messages of one sample."""

    def answer(self, data: bytes, t_device_ns: int) -> list[bytes]:
        """The answers to the host at this time of the device's clock: most kinds do not listen."""
        return []

    def boot(self) -> list[bytes]:
        """What it sends when switched on."""
        return []

    def set_fault(self, name: str, value: float) -> None:
        """Bring one of its own ``faults`` about, or with 0 end it. ValueError: it has none of that name."""
        raise ValueError(f"fault {name!r} is not one of this sensor's")


class XbusWire(Wire):
    """An MTi: configuration and measurement state, the host's choice of rate acknowledged if it is its own."""

    def __init__(self, rate_hz: float, serial: str = SERIAL) -> None:
        self._rate, self._serial = round(rate_hz), bytes.fromhex(serial)
        self._decoder = xbus.XbusDecoder()
        self._measuring = True

    def encode(self, reading: Reading) -> list[bytes]:
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

    def answer(self, data: bytes, t_device_ns: int) -> list[bytes]:
        """Acknowledge what an MTi acknowledges; error 04 for what it does not know, 03 for a rate it has not."""
        return [answer for message in self._decoder.feed(data) for answer in self._answers(message)]

    def _answers(self, message: xbus.XbusMessage) -> list[bytes]:
        if message.mid in (Mid.GO_TO_CONFIG, Mid.GO_TO_MEASUREMENT):
            self._measuring = message.mid == Mid.GO_TO_MEASUREMENT
            return [xbus.encode(Mid.GO_TO_MEASUREMENT_ACK if self._measuring else Mid.GO_TO_CONFIG_ACK)]
        if message.mid == Mid.WAKE_UP_ACK:
            return []
        if self._measuring:
            return [xbus.encode(Mid.ERROR, b"\x04")]
        if message.mid == Mid.REQ_DID:
            return [xbus.encode(Mid.DEVICE_ID, self._serial)]
        if message.mid == Mid.SET_OUTPUT and len(message.data) % 4 == 0:
            pairs = struct.iter_unpack(">HH", message.data)
            given = [(xdi, 0xFFFF if rate == 0xFFFF else self._rate) for xdi, rate in pairs]
            return [xbus.encode(Mid.SET_OUTPUT_ACK, b"".join(struct.pack(">HH", *pair) for pair in given))]
        return [xbus.encode(Mid.ERROR, b"\x04")]

    def boot(self) -> list[bytes]:
        """WakeUp; without an answer it goes on measuring."""
        self._measuring = True
        return [xbus.encode(Mid.WAKE_UP)]


class Ximu3Wire(Wire):
    """An x-IMU3: inertial messages."""

    def encode(self, reading: Reading) -> list[bytes]:
        """One inertial message."""
        gx, gy, gz = reading.gyr_radps
        ax, ay, az = reading.acc_mps2
        gyr = (math.degrees(gx), math.degrees(gy), math.degrees(gz))
        message = ximu3.Inertial(reading.t_device_ns // 1000, gyr, (ax / G_MPS2, ay / G_MPS2, az / G_MPS2))
        return [ximu3.encode(message)]


@dataclass(frozen=True)
class XsensCanWire(Wire):
    """An MTi-600 on CAN: SampleTime, GroupCounter, RateOfTurn, Acceleration, as records of ``CAN_RECORD``.

    Its values are of 16 bits, which have no NaN: a sample without numbers is not sent.
    """

    carries_nan = False

    id_offset: int = 0

    def encode(self, reading: Reading) -> list[bytes]:
        """Four frames."""
        if not reading.finite:
            return []
        frames = [
            (0x05, struct.pack(">I", reading.t_device_ns // xbus.TIME_FINE_TICK_NS % 2**32)),
            (0x06, struct.pack(">H", reading.counter % 2**16)),
            (0x32, _steps(reading.gyr_radps, 512)),
            (0x34, _steps(reading.acc_mps2, 256)),
        ]
        return [CAN_RECORD.pack(number + self.id_offset, len(data), data) for number, data in frames]


class LslWire(Wire):
    """A stream's sample as a record of ``LSL_RECORD``."""

    def encode(self, reading: Reading) -> list[bytes]:
        """One row."""
        return [LSL_RECORD.pack(reading.t_device_ns * 1e-9, *reading.acc_mps2, *reading.gyr_radps)]


def _steps(values: Vector3, per_unit: int) -> bytes:
    return struct.pack(">3h", *(min(max(round(v * per_unit), -(2**15)), 2**15 - 1) for v in values))


class DbcWire(Wire):
    """A sensor on CAN that speaks by any DBC, named as ``dbc_can`` options name it: records of ``CAN_RECORD``.

    A sample is one group of frames, the one with the time (else the counter) first. A value beyond what its signal can
    carry is sent as the signal's end. A signal of integers has no NaN: a sample with one is not sent. Signals that no
    option names are sent as 0.

    ValueError: the DBC cannot be read, or an option does not fit it; the message names the option.
    """

    def __init__(self, options: Mapping[str, str | int | float | bool]) -> None:
        path = str(options.get("dbc", ""))
        database = Database(strict=True)
        try:
            database.add_dbc_file(str(Path(path)))
        except Exception as error:  # cantools raises OSError, its own parse errors, UnicodeDecodeError …
            raise ValueError(f"options.dbc = {path!r} cannot be read as a DBC: {error}") from error
        self._signals: dict[str, tuple[Message, Signal]] = {}
        for what in (*(name for name in ("time", "counter") if options.get(name)), *AXES):
            message_name, _, signal_name = str(options.get(what, "")).partition(".")
            try:
                message = database.get_message_by_name(message_name)
                self._signals[what] = message, message.get_signal_by_name(signal_name)
            except KeyError:
                raise ValueError(f"options.{what} = {options.get(what)!r} is not in {options.get('dbc')}") from None
        if list(self._signals) == list(AXES):
            raise ValueError("options need time or counter as MESSAGE.SIGNAL")
        self._messages = {message.name: message for message, _ in self._signals.values()}
        offset = options.get("id_offset", 0)
        if isinstance(offset, bool) or not isinstance(offset, int):
            raise ValueError(f"options.id_offset = {offset!r} must be a whole number")
        self._offset = offset
        self.carries_nan = all(self._signals[axis][1].is_float for axis in AXES)
        acc = _unit(options.get("acc_unit", "m/s2"), PER_UNIT)
        gyr = _unit(options.get("gyr_unit", "rad/s"), PER_UNIT)
        self._units = dict(zip(AXES, [acc] * 3 + [gyr] * 3, strict=True))
        self._ns_per_time = _unit(options.get("time_unit", "s"), NS_PER_UNIT)
        if not all(0 <= message.frame_id + self._offset <= LAST_ID for message in self._messages.values()):
            raise ValueError(f"options.id_offset = {self._offset} leaves the identifiers 0 to 0x{LAST_ID:x}")
        for name, message in self._messages.items():
            if message.length > LONGEST:
                raise ValueError(f"message {name} has {message.length} bytes; classical CAN carries {LONGEST}")
        try:
            self.encode(Reading(0, 0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)))
        except Exception as error:  # multiplexed …: cantools' own errors, bitstruct's
            raise ValueError(f"{options.get('dbc')}: its messages cannot be sent: {error}") from error

    def encode(self, reading: Reading) -> list[bytes]:
        """The frames of one sample."""
        if not (self.carries_nan or reading.finite):
            return []
        values = dict(zip(AXES, (*reading.acc_mps2, *reading.gyr_radps), strict=True))
        frames: dict[str, dict[str, int | float]] = {
            name: {signal.name: 0 for signal in message.signals} for name, message in self._messages.items()
        }
        for what, (message, signal) in self._signals.items():
            if what in values:
                number = _raw(signal, values[what] / self._units[what])
            elif what == "time":
                number = round(reading.t_device_ns / (float(signal.scale) * self._ns_per_time)) % (1 << signal.length)
            else:
                number = reading.counter % (1 << signal.length)
            frames[message.name][signal.name] = number
        records = []
        for name, message in self._messages.items():
            data = message.encode(frames[name], scaling=False, strict=False)
            records.append(CAN_RECORD.pack(message.frame_id + self._offset, len(data), data))
        return records


def _unit(name: object, factors: Mapping[str, float]) -> float:
    if name not in factors:
        raise ValueError(f"unit {name!r} is not one of {', '.join(factors)}")
    return factors[str(name)]


def _raw(signal: Signal, value: float) -> int | float:
    raw = (value - float(signal.offset)) / float(signal.scale)
    if signal.is_float:
        return raw
    least = -(1 << signal.length - 1) if signal.is_signed else 0
    most = least + (1 << signal.length) - 1
    return round(min(max(raw, least), most))
