"""Single records' payloads ↔ values; what comes often is packed, what is rare is JSON.

Runs: many samples or latencies in one record, so that an hour at 2 × 500 Hz stays small and reads fast.

A run's payload is ``u8 layout | i64 base_t_ns | entry …``. Times are offsets from the base, the sensor's time an
offset from the sample's own. Values are float32 where that keeps every bit of them, else float64; a run takes the
narrowest layout its first sample fits and ends at the first sample that does not fit. It also ends after a quarter of a
second: a replay logs minutes between two deliveries, and a tear costs the record it goes through.
"""

import dataclasses
import json
import struct
from collections.abc import Iterable, Iterator, Sequence
from itertools import groupby
from operator import itemgetter
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from fes.session_log.framing import Received, RecordType
from fes.signals import (
    NS_PER_S,
    SENSORS,
    FootSwitchEvent,
    ImuSample,
    IntArray,
    OperatorAct,
    OperatorAction,
    StimAlive,
    StimCommand,
    StimOpened,
    StimStatus,
    StrideResult,
    SystemFault,
    Tick,
    WireFrame,
)
from fes.walk_record import Note, SampleArrays
from statemachine.phases import Phase, PhaseChange, Transition

WIDE_TIME: Final = 1  # bit 0 of the layout
DOUBLE: Final = 2  # bit 1
LONGEST_RUN_NS: Final = NS_PER_S // 4

_START = struct.Struct("<Bq")
_LARGEST_LATENCY: Final = 0xFFFF_FFFF
_LARGEST_LAG: Final = 0x7FFF_FFFF
_SIX_DOUBLES = struct.Struct("<6d")
_SIX_SINGLES = struct.Struct("<6f")
_pack_singles, _unpack_singles = _SIX_SINGLES.pack, _SIX_SINGLES.unpack
_TIMES = (struct.Struct("<BIi"), struct.Struct("<Bqq"))  # an entry is one of these, then one of those
_ENTRIES = tuple(struct.Struct(f"<B{times}6{number}") for number in "fd" for times in ("Ii", "qq"))
_DTYPES = tuple(
    np.dtype([("sensor", "u1"), ("offset", offset), ("lag", lag), ("values", number, (6,))])
    for number in ("<f4", "<f8")
    for offset, lag in (("<u4", "<i4"), ("<i8", "<i8"))
)
_PAIRS = (struct.Struct("<II"), struct.Struct("<qq"))
_PAIR_DTYPES = tuple(np.dtype([("offset", number), ("latency", number)]) for number in ("<u4", "<i8"))
_NUMBER_OF = {sensor: number for number, sensor in enumerate(SENSORS)}


class _Run:
    """An open run; its length is that of its payload."""

    def __init__(self) -> None:
        self._payload = bytearray()
        self._layout = 0
        self._base_ns = 0

    def __len__(self) -> int:
        return len(self._payload)

    def close(self) -> bytes:
        """Return the run's payload and start anew."""
        payload = bytes(self._payload)
        self._payload.clear()
        return payload


class SampleRun(_Run):
    """The open run of samples."""

    def add(self, sample: ImuSample) -> bool:
        """Append a sample; False, with nothing changed, if this run cannot hold it or is long enough.

        Raises:
            KeyError: the sensor is none of SENSORS.
            struct.error: a time beyond 64 bits.
        """
        values = (*sample.acc_mps2, *sample.gyr_radps)
        t_ns = sample.t_ns
        lag = t_ns - sample.t_sensor_ns
        if not self._payload:
            wide = 0 if -_LARGEST_LAG <= lag <= _LARGEST_LAG else WIDE_TIME
            self._layout = wide | (0 if singles(values) else DOUBLE)
            self._base_ns = t_ns
            self._payload += _START.pack(self._layout, t_ns)
        offset = t_ns - self._base_ns
        if offset > LONGEST_RUN_NS:
            return False
        layout = self._layout
        if layout & WIDE_TIME == 0 and not (offset >= 0 and -_LARGEST_LAG <= lag <= _LARGEST_LAG):
            return False
        packed = _SIX_DOUBLES.pack(*values) if layout & DOUBLE else singles(values)
        if not packed:
            return False
        self._payload += _TIMES[layout & WIDE_TIME].pack(_NUMBER_OF[sample.sensor], offset, lag) + packed
        return True


def singles(values: tuple[float, ...]) -> bytes:
    """Return six values as float32, b"" if one changes by it; NaN counts as changing, its bits might."""
    try:
        packed = _pack_singles(*values)
    except OverflowError:
        return b""
    return packed if _unpack_singles(packed) == values else b""


def samples_of(payload: memoryview) -> Iterator[ImuSample]:
    """Yield a run's samples.

    Raises:
        struct.error: the payload is no run.
        IndexError: an unknown layout or sensor.
    """
    layout, base_ns = _START.unpack_from(payload)
    for sensor, offset, lag, ax, ay, az, gx, gy, gz in _ENTRIES[layout].iter_unpack(payload[_START.size :]):
        t_ns = base_ns + offset
        yield ImuSample(t_ns, SENSORS[sensor], t_ns - lag, (ax, ay, az), (gx, gy, gz))


class Growing:
    """An array to which rows are added; it grows in place, so that its rows are never there twice."""

    def __init__(self, kind: type, *width: int) -> None:
        self._array: npt.NDArray[Any] = np.empty((0, *width), kind)
        self._filled = 0

    def add(self, rows: Sequence[object] | npt.NDArray[Any]) -> None:
        """Append rows (N, …), of any kind of number that the array's takes."""
        end = self._filled + len(rows)
        if end > len(self._array):
            self._resize(max(end, len(self._array) + len(self._array) // 4))
        self._array[self._filled : end] = rows
        self._filled = end

    def whole(self) -> npt.NDArray[Any]:
        """All rows; nothing may be added afterwards."""
        self._resize(self._filled)
        return self._array

    def _resize(self, rows: int) -> None:
        self._array.resize((rows, *self._array.shape[1:]), refcheck=False)


class SampleParts:
    """Sensors' samples gathered from many runs, some at a time: what has been read need not be kept."""

    def __init__(self) -> None:
        self._columns: dict[int, tuple[Growing, Growing, Growing, Growing]] = {}

    def add(self, payloads: Iterable[memoryview]) -> None:
        """Take runs in, in order. struct.error, IndexError, ValueError: a payload is no run."""
        starts = [(*_START.unpack_from(payload), payload) for payload in payloads]
        for layout, alike in groupby(starts, key=itemgetter(0)):
            base_ns, rows = _joined(alike, _DTYPES[layout])
            t_ns = base_ns + rows["offset"]
            for number in np.flatnonzero(np.bincount(rows["sensor"])).tolist():
                if number >= len(SENSORS):
                    raise ValueError(f"sensor number {number}")
                if number not in self._columns:
                    times = Growing(np.int64), Growing(np.int64)
                    self._columns[number] = (*times, Growing(np.float64, 3), Growing(np.float64, 3))
                mine = np.flatnonzero(rows["sensor"] == number)
                own_ns, values = t_ns[mine], rows["values"][mine]
                own = (own_ns, own_ns - rows["lag"][mine], values[:, :3], values[:, 3:])
                for column, more in zip(self._columns[number], own, strict=True):
                    column.add(more)

    def arrays(self) -> dict[str, SampleArrays]:
        """Each sensor's samples, in order; nothing may be added afterwards."""
        return {SENSORS[k]: SampleArrays(*(own.whole() for own in self._columns[k])) for k in sorted(self._columns)}


def _joined(alike: Iterable[tuple[int, int, memoryview]], dtype: np.dtype[Any]) -> tuple[IntArray, Any]:
    """Entries of runs of one layout as one array (N,), and the base of each entry's run (N,)."""
    runs = [(base_ns, payload[_START.size :]) for _, base_ns, payload in alike]
    if any(len(entries) % dtype.itemsize for _, entries in runs):
        raise ValueError("a run with a fraction of an entry")
    counts = [len(entries) // dtype.itemsize for _, entries in runs]
    base_ns = np.repeat(np.array([base_ns for base_ns, _ in runs], np.int64), counts)
    return base_ns, np.frombuffer(b"".join([entries for _, entries in runs]), dtype)


class LatencyRun(_Run):
    """The open run of (time, latency) pairs."""

    def add(self, t_ns: int, latency_ns: int) -> bool:
        """Append a pair; False, with nothing changed, if this run cannot hold it or is long enough.

        struct.error: a time beyond 64 bits.
        """
        if not self._payload:
            self._layout = 0 if 0 <= latency_ns <= _LARGEST_LATENCY else 1
            self._base_ns = t_ns
            self._payload += _START.pack(self._layout, t_ns)
        offset = t_ns - self._base_ns
        if offset > LONGEST_RUN_NS:
            return False
        if not self._layout and not (offset >= 0 and 0 <= latency_ns <= _LARGEST_LATENCY):
            return False
        self._payload += _PAIRS[self._layout].pack(offset, latency_ns)
        return True


def latency_arrays(payloads: Iterable[memoryview]) -> tuple[IntArray, IntArray]:
    """Return (t_ns, latency_ns) of many latency runs. struct.error, IndexError, ValueError: a payload is no run."""
    times, latencies = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    starts = [(*_START.unpack_from(payload), payload) for payload in payloads]
    for wide, alike in groupby(starts, key=itemgetter(0)):
        base_ns, pairs = _joined(alike, _PAIR_DTYPES[wide])
        times.append(base_ns + pairs["offset"])
        latencies.append(pairs["latency"].astype(np.int64))
    return np.concatenate(times), np.concatenate(latencies)


_TICK = struct.Struct("<q")
_ACT = struct.Struct("<qd")
_ALIVE = struct.Struct("<qqq")
_OPENED = struct.Struct("<qI")
_SWITCH = struct.Struct("<qBB")
_SILENT = 2  # beside not pressed and pressed
# from the narrowest form to the one that takes everything; the flags' upper bits say which
_STATUS = tuple(map(struct.Struct, ("<BqBBHffff", "<BqBBHdddd", "<Bqqqqdddd")))
_COMMAND = tuple(map(struct.Struct, ("<BqBHfff", "<BqBHddd", "<Bqqqddd")))
_FRAME = struct.Struct("<qI")
_PHASE = struct.Struct("<qBBBB")
_STRIDE = struct.Struct("<III")
_STRIDE_ARRAYS = ("trajectory_m", "pitch_rad", "roll_rad")

RareEvent = Tick | OperatorAct | StimStatus | StimAlive | StimOpened | FootSwitchEvent | SystemFault
Rare = RareEvent | StimCommand | WireFrame | PhaseChange | StrideResult | Note | Received


def encode(value: Rare) -> tuple[RecordType, bytes]:
    """Return the record type and payload of a value.

    struct.error, TypeError, ValueError: a field holds what the log cannot.
    """
    match value:
        case Tick():
            return RecordType.TICK, _TICK.pack(value.t_ns)
        case StimCommand():
            numbers = (value.current_ma, value.pulse_width_us, value.frequency_hz)
            packed = _pack(_COMMAND, value.on, value.t_ns, value.channel, value.validity_ms, *numbers)
            return RecordType.COMMAND, packed + value.refused.encode()
        case WireFrame():
            return RecordType.FRAME, _FRAME.pack(value.t_ns, value.identifier) + value.data
        case StimStatus():
            numbers = (value.current_ma, value.pulse_width_us, value.frequency_hz)
            counts = (value.channel, value.counter, value.pulses)
            packed = _pack(_STATUS, value.on, value.t_ns, *counts, *numbers, value.charge_uc)
            return RecordType.STATUS, packed + value.fault.encode()
        case StimAlive():
            return RecordType.ALIVE, _ALIVE.pack(value.t_ns, value.boot_id, value.rejected) + value.fault.encode()
        case PhaseChange():
            foot = SENSORS.index(value.foot)
            return RecordType.PHASE, _PHASE.pack(value.t_ns, foot, value.transition, value.source, value.destination)
        case OperatorAct():
            text = f"{value.action}\n{value.why}" if value.why else str(value.action)
            return RecordType.ACT, _ACT.pack(value.t_ns, value.value) + text.encode()
        case Note():
            return RecordType.NOTE, encode_json(dataclasses.asdict(value))
        case StrideResult():
            return RecordType.STRIDE, _encode_stride(value)
        case StimOpened():
            return RecordType.STIM_OPENED, _OPENED.pack(value.t_ns, value.session_id)
        case FootSwitchEvent():
            pressed = _SILENT if value.pressed is None else value.pressed
            return RecordType.FOOT_SWITCH, _SWITCH.pack(value.t_ns, SENSORS.index(value.foot), pressed)
        case Received():
            return RecordType.RECEIVED, _TICK.pack(value.t_ns) + value.data
        case SystemFault():
            return RecordType.SYSTEM_FAULT, _TICK.pack(value.t_ns) + value.text.encode()


def decode(kind: int, payload: memoryview) -> Rare:
    """Return the value of a single record; the inverse of :func:`encode`.

    struct.error, ValueError, KeyError, IndexError, TypeError: the payload is not of this type.
    """
    match kind:
        case RecordType.TICK:
            return Tick(*_TICK.unpack(payload))
        case RecordType.COMMAND:
            return _command(*_unpack(_COMMAND, payload))
        case RecordType.FRAME:
            t_ns, identifier = _FRAME.unpack_from(payload)
            return WireFrame(t_ns, identifier, bytes(payload[_FRAME.size :]))
        case RecordType.STATUS:
            return _status(*_unpack(_STATUS, payload))
        case RecordType.ALIVE:
            t_ns, boot_id, rejected = _ALIVE.unpack_from(payload)
            return StimAlive(t_ns, boot_id, rejected, str(payload[_ALIVE.size :], "utf-8"))
        case RecordType.PHASE:
            t_ns, foot, transition, source, destination = _PHASE.unpack(payload)
            return PhaseChange(t_ns, SENSORS[foot], Transition(transition), Phase(source), Phase(destination))
        case RecordType.ACT:
            t_ns, value = _ACT.unpack_from(payload)
            action, _, why = str(payload[_ACT.size :], "utf-8").partition("\n")
            return OperatorAct(t_ns, OperatorAction(action), value, why)
        case RecordType.NOTE:
            return Note(**decode_json(payload))
        case RecordType.STRIDE:
            return _decode_stride(payload)
        case RecordType.STIM_OPENED:
            return StimOpened(*_OPENED.unpack(payload))
        case RecordType.FOOT_SWITCH:
            t_ns, foot, pressed = _SWITCH.unpack(payload)
            return FootSwitchEvent(t_ns, SENSORS[foot], None if pressed == _SILENT else bool(pressed))
        case RecordType.SYSTEM_FAULT:
            (t_ns,) = _TICK.unpack_from(payload)
            return SystemFault(t_ns, str(payload[_TICK.size :], "utf-8"))
        case RecordType.RECEIVED:
            (t_ns,) = _TICK.unpack_from(payload)
            return Received(t_ns, bytes(payload[_TICK.size :]))
        case _:
            raise ValueError(f"record type {kind} is no single value")


def decode_many(kind: int, payloads: Sequence[memoryview]) -> list[Any]:
    """Return the values of many single records of one type, as :func:`decode` each; frequent ones three times as fast.

    struct.error, ValueError, KeyError, IndexError, TypeError: as :func:`decode`.
    """
    if kind not in (RecordType.COMMAND, RecordType.STATUS):
        return [decode(kind, each) for each in payloads]
    # the narrowest form, without a refusal or fault
    form, made = (_COMMAND[0], _command) if kind == RecordType.COMMAND else (_STATUS[0], _status)
    usual = ((each, len(each) == form.size and each[0] <= 1) for each in payloads)
    return [made(*form.unpack(each)) if narrow else decode(kind, each) for each, narrow in usual]


def _command(
    on: int, t_ns: int, channel: int, validity_ms: int, current_ma: float, width_us: float, hz: float, refused: str = ""
) -> StimCommand:
    return StimCommand(t_ns, channel, on == 1, current_ma, width_us, hz, validity_ms, refused)


def _status(
    on: int, t_ns: int, channel: int, counter: int, pulses: int, current_ma: float, width_us: float, hz: float,
    charge_uc: float, fault: str = "",
) -> StimStatus:  # fmt: skip
    return StimStatus(t_ns, channel, counter, on == 1, current_ma, width_us, hz, pulses, charge_uc, fault)


def _pack(forms: tuple[struct.Struct, ...], on: bool, *fields: float) -> bytes:
    """Pack in the first form that every field survives, else in the last."""
    for number, form in enumerate(forms[:-1]):
        try:
            packed = form.pack(on | number << 1, *fields)
        except (struct.error, OverflowError):
            continue
        if form.unpack(packed)[1:] == fields:
            return packed
    return forms[-1].pack(on | len(forms) - 1 << 1, *fields)


def _unpack(forms: tuple[struct.Struct, ...], payload: memoryview) -> tuple[Any, ...]:
    """Return on (0 or 1), the fields and the text behind them."""
    form = forms[payload[0] >> 1]
    flags, *fields = form.unpack_from(payload)
    return (flags & 1, *fields, str(payload[form.size :], "utf-8"))


def encode_json(values: dict[str, Any]) -> bytes:
    """Return UTF-8 JSON; NaN and infinities are kept, numpy's numbers become plain ones.

    TypeError, ValueError: a value is not plain data.
    """
    return json.dumps(values, ensure_ascii=False, separators=(",", ":"), default=_plain).encode()


def decode_json(payload: memoryview) -> dict[str, Any]:
    """Return the mapping in a JSON payload. ValueError: it is not JSON or not a mapping."""
    try:
        values = json.loads(bytes(payload))
    except RecursionError as error:
        raise ValueError("nested too deeply") from error
    if not isinstance(values, dict):
        raise ValueError("not a mapping")
    return values


def _plain(value: object) -> Any:
    if isinstance(value, (np.generic, np.ndarray)):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} is not plain data")


def _encode_stride(stride: StrideResult) -> bytes:
    names = [field.name for field in dataclasses.fields(stride) if field.name not in _STRIDE_ARRAYS]
    text = encode_json({name: getattr(stride, name) for name in names})
    trajectory = np.ascontiguousarray(stride.trajectory_m, "<f4").reshape(-1, 3)
    pitch = np.ascontiguousarray(stride.pitch_rad, "<f4").reshape(-1)
    roll = np.ascontiguousarray(stride.roll_rad, "<f4").reshape(-1)
    arrays = trajectory.tobytes() + pitch.tobytes() + roll.tobytes()
    return _STRIDE.pack(len(text), len(trajectory), len(pitch)) + text + arrays


def _decode_stride(payload: memoryview) -> StrideResult:
    text_bytes, rows, angles = _STRIDE.unpack_from(payload)
    start = _STRIDE.size + text_bytes
    numbers = np.frombuffer(payload[start:], "<f4").astype(np.float64)
    trajectory, pitch, roll = np.split(numbers, (3 * rows, 3 * rows + angles))
    if len(pitch) < angles or len(roll) not in (0, angles):
        raise ValueError("a stride of another length than it says")
    fields = decode_json(payload[_STRIDE.size : start])
    return StrideResult(**fields, trajectory_m=trajectory.reshape(-1, 3), pitch_rad=pitch, roll_rad=roll)
