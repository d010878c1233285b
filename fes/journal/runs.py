"""Runs: many samples or latencies in one record, so that an hour at 2 × 500 Hz stays small and reads fast.

A run's payload is ``u8 layout | i64 base_t_ns | entry …``. Times are offsets from the base, the sensor's time an
offset from the sample's own. Values are float32 where that keeps every bit of them, else float64; a run takes the
narrowest layout its first sample fits and ends at the first sample that does not fit. It also ends after a quarter of a
second: a replay logs minutes between two deliveries, and a tear costs the record it goes through.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import Any, Final

import numpy as np

from fes.journal.record import SampleArrays
from fes.signals import NS_PER_S, SENSORS, ImuSample, IntArray

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
_NUMBER_OF = {sensor: number for number, sensor in enumerate(SENSORS)}


class SampleRun:
    """The open run of samples; empty when ``size`` is 0."""

    def __init__(self) -> None:
        self._payload = bytearray()
        self._layout = 0
        self._base_ns = 0
        self._pack = _TIMES[0].pack

    def __len__(self) -> int:
        return len(self._payload)

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
            self._open(t_ns, lag, values)
        offset = t_ns - self._base_ns
        if offset > LONGEST_RUN_NS:
            return False
        layout = self._layout
        if layout & WIDE_TIME == 0 and not (offset >= 0 and -_LARGEST_LAG <= lag <= _LARGEST_LAG):
            return False
        packed = _doubles(values) if layout & DOUBLE else singles(values)
        if not packed:
            return False
        self._payload += self._pack(_NUMBER_OF[sample.sensor], offset, lag) + packed
        return True

    def _open(self, t_ns: int, lag: int, values: tuple[float, ...]) -> None:
        wide = 0 if -_LARGEST_LAG <= lag <= _LARGEST_LAG else WIDE_TIME
        self._layout = wide | (0 if singles(values) else DOUBLE)
        self._base_ns = t_ns
        self._pack = _TIMES[wide].pack
        self._payload += _START.pack(self._layout, t_ns)

    def take(self) -> bytes:
        """Return the run's payload and start anew."""
        payload = bytes(self._payload)
        self._payload.clear()
        return payload


def singles(values: tuple[float, ...]) -> bytes:
    """Return six values as float32, b"" if one changes by it; NaN counts as changing, its bits might."""
    try:
        packed = _pack_singles(*values)
    except OverflowError:
        return b""
    return packed if _unpack_singles(packed) == values else b""


def _doubles(values: tuple[float, ...]) -> bytes:
    return _SIX_DOUBLES.pack(*values)


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


def sample_arrays(payloads: list[memoryview]) -> dict[str, SampleArrays]:
    """Return each sensor's samples of many runs, in order.

    Raises:
        struct.error, IndexError, ValueError: a payload is no run.
    """
    starts = [_START.unpack_from(payload) for payload in payloads]
    for payload, (layout, _) in zip(payloads, starts, strict=True):
        if (len(payload) - _START.size) % _DTYPES[layout].itemsize:
            raise ValueError("a run of samples with a fraction of one")
    parts: list[tuple[Any, IntArray, IntArray]] = []
    for layout, dtype in enumerate(_DTYPES):
        chosen = [number for number, start in enumerate(starts) if start[0] == layout]
        rows = np.frombuffer(b"".join([payloads[number][_START.size :] for number in chosen]), dtype)
        counts = [(len(payloads[number]) - _START.size) // dtype.itemsize for number in chosen]
        base_ns = np.repeat(np.array([starts[number][1] for number in chosen], np.int64), counts)
        parts.append((rows, base_ns, np.repeat(np.array(chosen, np.int64), counts)))
    run = np.concatenate([part[2] for part in parts])
    order = np.argsort(run, kind="stable")
    sensor = np.concatenate([rows["sensor"] for rows, _, _ in parts])[order]
    t_ns = np.concatenate([base_ns + rows["offset"].astype(np.int64) for rows, base_ns, _ in parts])[order]
    lag = np.concatenate([rows["lag"].astype(np.int64) for rows, _, _ in parts])[order]
    values = np.concatenate([rows["values"].astype(np.float64) for rows, _, _ in parts])[order]
    if sensor.size and sensor.max() >= len(SENSORS):
        raise ValueError(f"sensor number {sensor.max()}")
    out = {}
    for number, name in enumerate(SENSORS):
        mine = np.flatnonzero(sensor == number)
        if mine.size:
            acc, gyr = np.ascontiguousarray(values[mine, :3]), np.ascontiguousarray(values[mine, 3:])
            out[name] = SampleArrays(t_ns[mine], t_ns[mine] - lag[mine], acc, gyr)
    return out


class LatencyRun:
    """The open run of (time, latency) pairs."""

    def __init__(self) -> None:
        self._payload = bytearray()
        self._wide = 0
        self._base_ns = 0

    def __len__(self) -> int:
        return len(self._payload)

    def add(self, t_ns: int, latency_ns: int) -> bool:
        """Append a pair; False, with nothing changed, if this run cannot hold it or is long enough.

        Raises:
            struct.error: a time beyond 64 bits.
        """
        if not self._payload:
            self._wide = 0 if 0 <= latency_ns <= _LARGEST_LATENCY else 1
            self._base_ns = t_ns
            self._payload += _START.pack(self._wide, t_ns)
        offset = t_ns - self._base_ns
        if offset > LONGEST_RUN_NS:
            return False
        if not self._wide and not (offset >= 0 and 0 <= latency_ns <= _LARGEST_LATENCY):
            return False
        self._payload += _PAIRS[self._wide].pack(offset, latency_ns)
        return True

    def take(self) -> bytes:
        """Return the run's payload and start anew."""
        payload = bytes(self._payload)
        self._payload.clear()
        return payload


def latency_arrays(payloads: list[memoryview]) -> tuple[IntArray, IntArray]:
    """Return (t_ns, latency_ns) of many latency runs.

    Raises:
        struct.error, IndexError, ValueError: a payload is no run.
    """
    times, latencies = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    for payload in payloads:
        wide, base_ns = _START.unpack_from(payload)
        pairs = np.frombuffer(payload[_START.size :], ("<u4", "<i8")[wide]).astype(np.int64).reshape(-1, 2)
        times.append(base_ns + pairs[:, 0])
        latencies.append(pairs[:, 1])
    return np.concatenate(times), np.concatenate(latencies)
