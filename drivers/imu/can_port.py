"""Inertial sensors on one CAN bus behind python-can, described by a DBC.

A sample is a group of frames (time, counter, rate, acceleration); the frame that begins the group is the one with the
time, else the counter, so that a lost frame costs its own sample and never mixes two. For the Xsens MTi-600 the layout
is ``xsens_mti.dbc``, from Xsens' public "MTi CAN protocol" document: SampleTime 005 (u32, 10 kHz), GroupCounter 006,
StatusWord 011, Quaternion 021, RateOfTurn 032 (2⁻⁹ rad/s), Acceleration 034 (2⁻⁸ m/s²), most significant byte first.

Options of ``dbc_can``: ``dbc`` (file), ``acc_x`` … ``acc_z``, ``gyr_x`` … ``gyr_z`` (each ``Message.Signal``),
``time`` and ``time_unit`` (s, ms, us, ns), ``counter``, ``acc_unit`` (m/s2, g), ``gyr_unit`` (rad/s, deg/s). Either
``time`` or ``counter`` is needed. Both kinds: ``id_offset`` is added to every identifier of the DBC.
"""

import math
from collections.abc import Sequence
from importlib import resources
from pathlib import Path
from typing import Final

import can
from cantools.database.can import Database, Message, Signal

from drivers.imu import port
from drivers.imu.port import AXES, ImuLost, ImuPort, LineCounts, flag_option, text_option
from drivers.stimulator.bus import BusError, bus_name, is_bus_off, open_bus
from fes.config import Bus, ImuDevice
from fes.signals import G_MPS2, NS_PER_S, RawSample

ACC_UNITS: Final = {"m/s2": 1.0, "m/s^2": 1.0, "g": G_MPS2}
GYR_UNITS: Final = {"rad/s": 1.0, "deg/s": math.radians(1.0)}
TIME_UNITS: Final = {"s": 1e9, "ms": 1e6, "us": 1e3, "ns": 1.0}
LAST_ID: Final = 0x7FF
LONGEST: Final = 8  # bytes of a frame
XSENS: Final = {
    "acc_x": "Acceleration.AccX", "acc_y": "Acceleration.AccY", "acc_z": "Acceleration.AccZ",
    "gyr_x": "RateOfTurn.GyrX", "gyr_y": "RateOfTurn.GyrY", "gyr_z": "RateOfTurn.GyrZ", "time": "SampleTime.Time",
}  # fmt: skip


class DbcSensor:
    """One sensor's part of a bus. ValueError: the options or the DBC do not fit; the message names what would."""

    def __init__(self, device: ImuDevice) -> None:
        self.sensor = device.sensor
        self.counts = port.LineCounts()
        self._ranges = port.Ranges(device)
        database, names = self._layout(device)
        offset = port.whole_option(device, "id_offset", 0, -LAST_ID)
        self._signals = {what: _found(database, device.sensor, what, name) for what, name in names.items()}
        self._messages = {message.frame_id + offset: message for message, _ in self._signals.values()}
        if not all(0 <= number <= LAST_ID for number in self._messages):
            raise ValueError(f"{device.sensor}: options.id_offset = {offset} leaves the identifiers 0 to 0x7ff")
        self.identifiers = frozenset(self._messages)
        first = self._signals["time" if "time" in names else "counter"][0]
        self._first = first.frame_id + offset
        self._factors = [_unit(device, "acc_unit", "m/s2", ACC_UNITS)] * 3
        self._factors += [_unit(device, "gyr_unit", "rad/s", GYR_UNITS)] * 3
        time_factor = _unit(device, "time_unit", "s", TIME_UNITS)
        self._period_ns = NS_PER_S / device.rate_hz
        counter_bits = int(self._signals["counter"][1].length) if "counter" in names else 0
        self._counters = port.Unwrapper(max(counter_bits, 1))
        self._losses = port.LossCounter(self.counts, device.rate_hz, counter_bits)
        self._stamps: port.StampClock | None = None
        if "time" in names:
            signal = self._signals["time"][1]
            self._stamps = port.StampClock(int(signal.length), float(signal.scale) * time_factor)
        self._group: dict[int, dict[str, float]] = {}

    @staticmethod
    def _layout(device: ImuDevice) -> tuple[Database, dict[str, str]]:
        database = Database(strict=True)
        if device.device == "xsens_can":
            text = resources.files(__package__).joinpath("xsens_mti.dbc").read_text(encoding="ascii")
            database.add_dbc_string(text)
            counter = {"counter": "GroupCounter.Counter"} if flag_option(device, "group_counter", False) else {}
            return database, XSENS | counter
        path = Path(text_option(device, "dbc", ""))
        try:
            database.add_dbc_file(str(path))
        except Exception as error:  # cantools raises OSError, its own parse errors, UnicodeDecodeError …
            where = f"{device.sensor}: options.dbc = {str(path)!r}"
            raise ValueError(f"{where} cannot be read as a DBC: {error}") from error
        names = {what: text_option(device, what, "") for what in (*AXES, "time", "counter")}
        if missing := [what for what in AXES if not names[what]]:
            raise ValueError(f"{device.sensor}: options need {', '.join(missing)} as MESSAGE.SIGNAL of {path.name}")
        if not names["time"] and not names["counter"]:
            raise ValueError(f"{device.sensor}: options need time or counter as MESSAGE.SIGNAL of {path.name}")
        return database, {what: name for what, name in names.items() if name}

    def receive(self, t_ns: int, identifier: int, data: bytes) -> RawSample | None:
        """Take one frame of :attr:`identifiers`; the sample that it completes."""
        message = self._messages[identifier]
        try:
            values = message.decode_simple(data, decode_choices=False, scaling=True)
        except Exception:  # too short: cantools' own error, or bitstruct's
            self.counts.bad_frames += 1
            return None
        if identifier == self._first:
            self.counts.bad_frames += bool(self._group)  # the group before never became complete
            self._group = {}
        elif self._first not in self._group:
            self.counts.bad_frames += 1
            return None
        self._group[identifier] = {name: value for name, value in values.items() if isinstance(value, (int, float))}
        if len(self._group) < len(self._messages):
            return None
        named = {message.name: self._group[number] for number, message in self._messages.items()}
        self._group = {}
        return self._sample(t_ns, named)

    def _sample(self, t_ns: int, named: dict[str, dict[str, float]]) -> RawSample:
        def value(what: str) -> float:
            message, signal = self._signals[what]
            return named[message.name][signal.name]

        def count(what: str) -> int:
            # as sent: what its scale and offset make of it runs over elsewhere
            signal = self._signals[what][1]
            return round((value(what) - float(signal.offset)) / float(signal.scale)) % (1 << int(signal.length))

        counter = count("counter") if "counter" in self._signals else None
        beat_ns = round(self._counters.unwrap(counter or 0) * self._period_ns)
        stamp_ns = beat_ns if self._stamps is None else self._stamps.time_ns(count("time"))
        self._losses.note(stamp_ns, counter)
        v = [value(axis) * factor for axis, factor in zip(AXES, self._factors, strict=True)]
        sample = RawSample(self.sensor, t_ns, stamp_ns, (v[0], v[1], v[2]), (v[3], v[4], v[5]))
        return self._ranges.judged(sample, self.counts)


def _found(database: Database, sensor: str, what: str, name: str) -> tuple[Message, Signal]:
    where = f"{sensor}: options.{what} = {name!r}"
    message_name, _, signal_name = name.partition(".")
    try:
        message: Message = database.get_message_by_name(message_name)
        signal: Signal = message.get_signal_by_name(signal_name)
    except KeyError:
        known = ", ".join(f"{m.name}.{s.name}" for m in database.messages for s in m.signals)
        raise ValueError(f"{where} is not in the DBC; it has: {known}") from None
    if message.is_extended_frame:
        raise ValueError(f"{where} is in a message of 29 bit identifier; sensors here have 11 bits")
    if message.length > LONGEST:
        raise ValueError(f"{where} is in a message of {message.length} bytes; classical CAN carries {LONGEST}")
    if message.is_multiplexed() and signal.multiplexer_ids:
        raise ValueError(f"{where} is not in each of its messages (multiplexed); a sample needs all of its values")
    if what in ("time", "counter") and (signal.is_float or signal.scale <= 0):
        raise ValueError(f"{where} must be an integer that counts up: a float loses its steps as it grows")
    return message, signal


def _unit(device: ImuDevice, name: str, default: str, units: dict[str, float]) -> float:
    unit = text_option(device, name, default)
    if unit not in units:
        raise ValueError(f"{device.sensor}: options.{name} = {unit!r} is not one of {', '.join(units)}")
    return units[unit]


READ_AT_MOST: Final = 1024  # frames: a flooded bus must not hold the control loop


class CanImus(ImuPort):
    """:class:`~drivers.imu.port.ImuPort` for all sensors of one bus.

    Raises:
        ValueError: two sensors use the same identifier.
        ImuLost: the bus cannot be opened.
    """

    def __init__(self, devices: Sequence[ImuDevice], bus: Bus) -> None:
        self._settings = bus
        self._parts = [DbcSensor(device) for device in devices]
        self.sensors: tuple[str, ...] = tuple(part.sensor for part in self._parts)
        self.counts: dict[str, LineCounts] = {part.sensor: part.counts for part in self._parts}
        self._of: dict[int, DbcSensor] = {}
        for part in self._parts:
            for identifier in part.identifiers:
                if identifier in self._of:
                    both = f"{part.sensor} and {self._of[identifier].sensor} both use the identifier 0x{identifier:x}"
                    raise ValueError(f"{both}; give one of the sensors other identifiers and set options.id_offset")
                self._of[identifier] = part
        self._open()

    def _open(self) -> None:
        try:
            self._bus = open_bus(self._settings, frozenset(self._of))
        except BusError as error:
            raise ImuLost(str(error)) from error

    def fileno(self) -> int | None:
        """The bus' descriptor, None where the interface has none."""
        try:
            number = self._bus.fileno()
        except NotImplementedError:
            return None
        return number if number >= 0 else None

    def read(self, t_ns: int) -> list[RawSample]:
        """All samples completed by the frames that have arrived."""
        samples: list[RawSample] = []
        for _ in range(READ_AT_MOST):
            try:
                message = self._bus.recv(timeout=0.0)
            except (can.CanError, OSError) as error:
                raise ImuLost(f"{bus_name(self._settings)}: cannot be read: {error}") from error
            if message is None:
                break
            if is_bus_off(message):
                raise ImuLost(f"{bus_name(self._settings)}: the adapter went bus-off. Check cable and termination.")
            part = self._of.get(message.arbitration_id)
            if part is None or message.is_extended_id or message.is_remote_frame or message.is_error_frame:
                continue
            sample = part.receive(t_ns, message.arbitration_id, bytes(message.data))
            if sample is not None:
                samples.append(sample)
        return samples

    def close(self) -> None:
        """Shut the bus down; may be called twice."""
        self._bus.shutdown()
