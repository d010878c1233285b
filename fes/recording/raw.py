"""One sensor's rows as the file has them: complete, finite, lost samples set aside; units not yet applied."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import numpy.typing as npt

from fes.recording.csv_text import Dialect
from fes.recording.sidecar import Sensor, Sidecar
from fes.recording.table import Table, greatest_size
from fes.recording.timebase import stamps_from_rate
from fes.recording.tracks import RecordingError
from fes.recording.units import TIME_UNITS_NS
from fes.signals import FloatArray, IntArray

LARGEST_VALUE = 1e10  # more than any sensor's counts; what lies beyond is damage, not movement


@dataclass(frozen=True)
class RawTrack:
    """One sensor as the file has it: (N,) times and (N, 3) values in the sidecar's units.

    ``stamps_ns`` holds the times of all rows that have one, those of lost samples included; ``place`` tells where a
    stamp stands in the file. ``t_arrival_ns`` is None where nothing but the stamps tells when samples came.
    ``greatest`` are the greatest sizes of a number in ``acc`` and in ``gyr``.
    """

    t_sensor_ns: IntArray
    t_arrival_ns: IntArray | None
    acc: FloatArray
    gyr: FloatArray
    stamps_ns: IntArray
    place: Callable[[int], str]
    greatest: tuple[float, float]


def read_table(path: Path, sidecar_path: Path, sidecar: Sidecar) -> dict[str, RawTrack]:
    """Return sensor → what a CSV or Parquet file, or the file that the sidecar names for it, has of it.

    Raises:
        RecordingError: the file is damaged, lacks a column or a cell, or holds what is no number.
    """
    if sidecar.can is not None:
        raise RecordingError(f"{sidecar_path}: [can] is for CAN logs; leave it out, {path.name} is none")
    raw: dict[str, RawTrack] = {}
    for file in dict.fromkeys(columns.file for columns in sidecar.sensors.values()):
        sensors = [sensor for sensor, columns in sidecar.sensors.items() if columns.file == file]
        raw |= _of_one_file(path.with_name(file) if file else path, sidecar_path, sidecar, sensors)
    return raw


def read_parts(path: Path, sidecar_path: Path, sidecar: Sidecar, rows: int) -> Iterator[dict[str, RawTrack]]:
    """As :func:`read_table` of a Parquet file alone, so many rows at a time; a sensor that is silent there is left out.

    Raises:
        RecordingError: as there.
    """
    sensors = list(sidecar.sensors)
    wanted, _, dialect = _columns(sidecar_path, sidecar, sensors)
    for table in Table.parts(path, wanted, rows, dialect):
        found: dict[str, RawTrack] = {}
        for sensor in sensors:
            raw = _raw_track(table, sidecar, sensor, silent=True)
            if raw.t_sensor_ns.size:
                found[sensor] = raw
        del table, raw  # who clears what is yielded lets go of the file's columns too
        yield found


def _of_one_file(path: Path, sidecar_path: Path, sidecar: Sidecar, sensors: list[Sensor]) -> dict[str, RawTrack]:
    table = Table(path, *_columns(sidecar_path, sidecar, sensors))
    return {sensor: _raw_track(table, sidecar, sensor) for sensor in sensors}


def _columns(sidecar_path: Path, sidecar: Sidecar, sensors: list[Sensor]) -> tuple[list[str], list[str], Dialect]:
    """Which columns to read, which of them are times, and how the text is laid out."""
    described = [sidecar.sensors[sensor] for sensor in sensors]
    values = [name for columns in described for name in (*columns.acc, *columns.gyr)]
    times = [sidecar.time_of(sensor) for sensor in sensors]
    times += [columns.arrival_column for columns in described]
    time_names = list(dict.fromkeys(name for name in times if name))
    confused = [name for name in time_names if name in values]
    if confused:
        raise RecordingError(f"{sidecar_path}: column {confused[0]!r} is named as a time and as a measurement")
    dialect = Dialect(**{field.name: getattr(sidecar, field.name) for field in fields(Dialect)})
    return time_names + values, time_names, dialect


def _raw_track(table: Table, sidecar: Sidecar, sensor: Sensor, *, silent: bool = False) -> RawTrack:
    """``silent``: it may be that all of its cells are empty."""
    columns = sidecar.sensors[sensor]
    names = (*columns.acc, *columns.gyr)
    where = f"{table.path}: {sensor}"
    (acc, acc_size), (gyr, gyr_size) = table.vectors(columns.acc), table.vectors(columns.gyr)
    data, greatest = [acc, gyr], (acc_size, gyr_size)
    dropped = _dropped_rows(table, names, where)
    kept = None if dropped is None else np.flatnonzero(~dropped)
    if kept is not None:
        acc, gyr = acc[kept], gyr[kept]
        greatest = greatest_size(acc), greatest_size(gyr)
    if max(greatest) >= LARGEST_VALUE:
        _check_finite(table, data, names, dropped)
    time_name = sidecar.time_of(sensor)
    empty = None
    if time_name is None:
        rate_hz = sidecar.rate_of(sensor)
        stamps = stamps_from_rate(table.rows, rate_hz or 1.0, table.first)
    else:
        stamps = table.times_ns(time_name, TIME_UNITS_NS[sidecar.time_unit_of(sensor)])
        empty = table.empty(time_name)
        untimed = _rows_of(empty, but=dropped)
        if untimed.size:
            raise RecordingError(
                f"{where}: {table.place(int(untimed[0]))} has values and no time in {time_name!r} "
                f"({untimed.size} such rows); fill it in, or state rate_hz instead of time_column"
            )
    arrival = None
    if columns.arrival_column:
        arrival = table.times_ns(columns.arrival_column, TIME_UNITS_NS[sidecar.time_unit_of(sensor)])
    stamped = stamps
    place: Callable[[int], str] = table.place
    if empty is not None:
        with_time = np.flatnonzero(~empty)
        stamped, place = stamps[with_time], lambda index: table.place(int(with_time[index]))
    if kept is not None:
        if not kept.size and not silent:
            raise RecordingError(f"{where}: all of its cells are empty; leave the sensor out of the sidecar")
        stamps = stamps[kept]
        arrival = None if arrival is None else arrival[kept]
    return RawTrack(stamps, arrival, acc, gyr, stamped, place, greatest)


def _rows_of(mask: npt.NDArray[np.bool_] | None, *, but: npt.NDArray[np.bool_] | None) -> IntArray:
    """The rows that one mask marks and the other does not; None marks none."""
    if mask is None:
        return np.zeros(0, np.int64)
    return np.flatnonzero(mask if but is None else mask & ~but)


def _dropped_rows(table: Table, names: tuple[str, ...], where: str) -> npt.NDArray[np.bool_] | None:
    """Rows in which all of a sensor's cells are empty, None if no cell is; a row with some empty is refused."""
    masks = [table.empty(name) for name in names]
    found = [mask for mask in masks if mask is not None]
    if not found:
        return None
    empty = np.logical_or.reduce(found)
    dropped = np.logical_and.reduce(found) if len(found) == len(names) else np.zeros(table.rows, bool)
    partly = np.flatnonzero(empty != dropped)
    if partly.size:
        row = int(partly[0])
        name = next(name for name, mask in zip(names, masks, strict=True) if mask is not None and mask[row])
        raise RecordingError(
            f"{where}: {table.place(row)}: column {name!r} is empty and others of the sensor are not "
            f"({partly.size} such rows). Where a sample is lost, leave all six cells empty."
        )
    return np.asarray(dropped)


def _check_finite(
    table: Table, acc_and_gyr: list[FloatArray], names: tuple[str, ...], dropped: npt.NDArray[np.bool_] | None
) -> None:
    data = np.hstack(acc_and_gyr)
    bad = ~(np.abs(data) < LARGEST_VALUE)
    if dropped is not None:
        bad[dropped] = False
    rows = np.flatnonzero(bad.any(axis=1))
    if rows.size:
        row = int(rows[0])
        column = int(np.argmax(bad[row]))
        raise RecordingError(
            f"{table.path}: {table.place(row)}, column {names[column]!r}: {data[row, column]} is no measurement "
            f"({int(bad.sum())} such values in {rows.size} rows). Where a sample is lost, leave all six cells empty."
        )
