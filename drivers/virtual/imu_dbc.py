"""A simulated inertial sensor on CAN that speaks by any DBC, named as a session's ``dbc_can`` options name it.

A sample is sent as one group of frames, the one with the time (else the counter) first. It shares no code with the
driver's decoder, so that the two check each other.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from cantools.database.can import Database, Message, Signal

from drivers.virtual.imu_wire import CAN_RECORD, Reading
from fes.signals import G_MPS2

Options = Mapping[str, str | int | float | bool]
AXES: Final = ("acc_x", "acc_y", "acc_z", "gyr_x", "gyr_y", "gyr_z")
PER_UNIT: Final = {"m/s2": 1.0, "m/s^2": 1.0, "g": G_MPS2, "rad/s": 1.0, "deg/s": math.pi / 180.0}
LAST_ID: Final = 0x7FF
LONGEST: Final = 8  # bytes of a frame
NS_PER_UNIT: Final = {"s": 1e9, "ms": 1e6, "us": 1e3, "ns": 1.0}


class DbcWire:
    """Readings as records of ``CAN_RECORD``.

    A value beyond what its signal can carry is sent as the signal's end. A signal of integers has no NaN: a sample with
    one is not sent. Signals that no option names are sent as 0.

    Raises:
        ValueError: the DBC cannot be read, or an option does not fit it; the message names the option.
    """

    def __init__(self, options: Options) -> None:
        database = _database(str(options.get("dbc", "")))
        wanted = [*(name for name in ("time", "counter") if options.get(name)), *AXES]
        self._signals: dict[str, Signal] = {}
        self._messages: dict[str, Message] = {}
        for what in wanted:
            message_name, _, signal_name = str(options.get(what, "")).partition(".")
            try:
                message = database.get_message_by_name(message_name)
                self._signals[what] = message.get_signal_by_name(signal_name)
            except KeyError:
                raise ValueError(f"options.{what} = {options.get(what)!r} is not in {options.get('dbc')}") from None
            self._messages.setdefault(message_name, message)
        if wanted == list(AXES):
            raise ValueError("options need time or counter as MESSAGE.SIGNAL")
        self._where = {what: str(options[what]).partition(".")[0] for what in wanted}
        offset = options.get("id_offset", 0)
        if isinstance(offset, bool) or not isinstance(offset, int):
            raise ValueError(f"options.id_offset = {offset!r} must be a whole number")
        self._offset = offset
        self.carries_nan = all(self._signals[axis].is_float for axis in AXES)
        acc, gyr = (options.get("acc_unit", "m/s2"), options.get("gyr_unit", "rad/s"))
        self._units = dict(zip(AXES, [_unit(acc, PER_UNIT)] * 3 + [_unit(gyr, PER_UNIT)] * 3, strict=True))
        self._ns_per_time = _unit(options.get("time_unit", "s"), NS_PER_UNIT)
        if not all(0 <= message.frame_id + self._offset <= LAST_ID for message in self._messages.values()):
            raise ValueError(f"options.id_offset = {self._offset} leaves the identifiers 0 to 0x{LAST_ID:x}")
        for name, message in self._messages.items():
            if message.length > LONGEST:
                raise ValueError(f"message {name} has {message.length} bytes; classical CAN carries {LONGEST}")
        try:
            self.say(Reading(0, 0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)))
        except Exception as error:  # multiplexed …: cantools' own errors, bitstruct's
            raise ValueError(f"{options.get('dbc')}: its messages cannot be sent: {error}") from error

    def say(self, reading: Reading) -> list[bytes]:
        """The frames of one sample."""
        if not (self.carries_nan or reading.finite):
            return []
        values = dict(zip(AXES, (*reading.acc_mps2, *reading.gyr_radps), strict=True))
        frames: dict[str, dict[str, int | float]] = {
            name: {signal.name: 0 for signal in message.signals} for name, message in self._messages.items()
        }
        for what, signal in self._signals.items():
            if what in values:
                number = _raw(signal, values[what] / self._units[what])
            elif what == "time":
                number = round(reading.t_device_ns / (float(signal.scale) * self._ns_per_time)) % (1 << signal.length)
            else:
                number = reading.counter % (1 << signal.length)
            frames[self._where[what]][signal.name] = number
        records = []
        for name, message in self._messages.items():
            data = message.encode(frames[name], scaling=False, strict=False)
            records.append(CAN_RECORD.pack(message.frame_id + self._offset, len(data), data))
        return records

    def hear(self, data: bytes) -> list[bytes]:
        """Not listened to."""
        return []

    def boot(self) -> list[bytes]:
        """Nothing."""
        return []


def _database(path: str) -> Database:
    database = Database(strict=True)
    try:
        database.add_dbc_file(str(Path(path)))
    except Exception as error:  # cantools raises OSError, its own parse errors, UnicodeDecodeError …
        raise ValueError(f"options.dbc = {path!r} cannot be read as a DBC: {error}") from error
    return database


def _unit(name: object, factors: Mapping[str, float]) -> float:
    if name not in factors:
        raise ValueError(f"unit {name!r} is not one of {', '.join(factors)}")
    return factors[str(name)]


def _raw(signal: Signal, value: float) -> int | float:
    raw = (value - float(signal.offset)) / float(signal.scale)
    if signal.is_float:
        return raw
    least, most = (-(1 << signal.length - 1), (1 << signal.length - 1) - 1)
    if not signal.is_signed:
        least, most = 0, (1 << signal.length) - 1
    return round(min(max(raw, least), most))
