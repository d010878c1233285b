"""One sensor's rows as the file has them: finite, lost samples set aside, time stamps judged; units not yet applied."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from fes.recording.csv_layout import Dialect
from fes.recording.several_files import joined_table
from fes.recording.sidecar import Sensor, SensorColumns, Sidecar
from fes.recording.table import Table, greatest_size
from fes.recording.tracks import RecordingError, TrackQuality
from fes.recording.units import (
    GAP_INTERVALS,
    MAX_BACKWARD_JUMP_NS,
    TIME_UNITS_NS,
    refuse_wild_clock,
    repaired,
    time_factor_ns,
)
from fes.recording.write import toml_value
from fes.signals import NS_PER_S, FloatArray, IntArray

LATE_ROWS, LATE_SHARE = 300, 0.05  # at most so many of the last rows may be left out, …
MIN_DURATION_S = 1.0
RATE_TOLERANCE = 0.02
PLAUSIBLE_RATES_HZ = (10.0, 20_000.0)


def stamps_from_rate(rows: int, rate_hz: float, first: int = 0) -> IntArray:
    """Return (rows,) times in ns of samples at an even rate, the ``first`` after the recording's beginning."""
    stamps: IntArray = np.rint(np.arange(first, first + rows) * (NS_PER_S / rate_hz)).astype(np.int64)
    return stamps


def late_block(stamps_ns: IntArray) -> int:
    """Where, of (N,) stamps, the last rows begin whose clock has gone back by too much; N where there are none.

    Some devices add, when they are stopped, some samples stamped anew. They are few, so the walk can do without.
    """
    first = stamps_ns.size - min(LATE_ROWS, int(LATE_SHARE * stamps_ns.size))
    steps = np.diff(stamps_ns[first - 1 :]) if first else stamps_ns[:0]
    if not (steps < -MAX_BACKWARD_JUMP_NS).any():
        return stamps_ns.size
    return first + int(np.argmax(stamps_ns[first:] < np.maximum.accumulate(stamps_ns)[first - 1 : -1]))


def judge_stamps(
    stamps_ns: IntArray, stated_hz: float | None, where: str, place: Callable[[int], str], unit: str | float
) -> tuple[float, TrackQuality]:
    """Return the rate (Hz) and the counts that (N,) stamps say; ``place`` tells where a stamp stands in the file.

    Missing samples are counted on the sorted stamps, so that two swapped samples are backward, not missing.

    Raises:
        RecordingError: too few, not advancing, too often or too far backward, an impossible rate, or another rate
            than the stated one.
    """
    if stamps_ns.size < 2:
        raise RecordingError(f"{where}: has {stamps_ns.size} sample; a recording needs at least {MIN_DURATION_S:g} s")
    steps: IntArray = np.diff(stamps_ns)
    shortest, longest = int(steps.min()), int(steps.max())
    forward = steps if shortest > 0 else steps[steps > 0]
    backward = np.flatnonzero(steps < 0) if shortest < 0 else steps[:0]
    if forward.size == 0:
        raise RecordingError(f"{where}: its time never advances; check time_column")
    if backward.size:
        refuse_wild_clock(steps, backward, where, place)
    # stamps made from a rate are often even
    usual_ns = float(np.median(forward)) if shortest < longest else float(shortest)
    _refuse_impossible_rate(NS_PER_S / usual_ns, where, unit)
    if stated_hz is not None:  # it must fit the usual interval or, where stamps bunch, the mean one
        usual_hz = NS_PER_S / usual_ns
        if abs(usual_hz / stated_hz - 1.0) > RATE_TOLERANCE:
            mean_hz = (stamps_ns.size - 1) * NS_PER_S / float(stamps_ns.max() - stamps_ns.min())
            if abs(mean_hz / stated_hz - 1.0) > RATE_TOLERANCE:
                raise RecordingError(
                    f"{where}: rate_hz = {stated_hz:g}, but its time column runs at {usual_hz:.4g} Hz (usual interval; "
                    f"{mean_hz:.4g} Hz on average). Correct rate_hz, time_unit, or leave rate_hz out."
                )
        usual_ns = NS_PER_S / stated_hz
    if 0.5 * usual_ns <= shortest and longest <= GAP_INTERVALS * usual_ns:  # the usual case: nothing to count
        return stated_hz or NS_PER_S / usual_ns, TrackQuality(stamps_ns.size)
    gaps = steps
    if backward.size:
        ordered = np.sort(stamps_ns)
        gaps = ordered[1:] - ordered[:-1]
    missing = int(np.sum(np.rint(gaps[gaps > GAP_INTERVALS * usual_ns] / usual_ns) - 1))
    irregular = int(np.count_nonzero(np.abs(steps - usual_ns) > 0.5 * usual_ns))
    doubled = int(np.count_nonzero(steps == 0))
    quality = TrackQuality(stamps_ns.size, missing, doubled, int(backward.size), irregular)
    return stated_hz or NS_PER_S / usual_ns, quality


def _refuse_impossible_rate(rate_hz: float, where: str, unit: str | float) -> None:
    lowest, highest = PLAUSIBLE_RATES_HZ
    if lowest <= rate_hz <= highest:
        return
    ns = time_factor_ns(unit, 1.0)
    fitting = [other for other, size in TIME_UNITS_NS.items() if 40.0 <= rate_hz * ns / size <= 2500.0]
    hint = f'; its numbers look like {fitting[0]}: say time_unit = "{fitting[0]}"' if fitting else ""
    raise RecordingError(
        f"{where}: with time_unit = {toml_value(unit)} it would come at {rate_hz:.4g} Hz, outside {lowest:g} to "
        f"{highest:g} Hz{hint}"
    )


LARGEST_VALUE = 1e10  # more than any sensor's counts; what lies beyond is damage, not movement


@dataclass(frozen=True)
class RawTrack:
    """One sensor as the file has it: (N,) times and (N, 3) values in the sidecar's units.

    ``stamps_ns`` holds the times of all rows that have one, those of lost samples included; ``place`` tells where a
    stamp stands in the file. ``t_arrival_ns`` is None where nothing but the stamps tells when samples came.
    ``greatest`` are the greatest sizes of a number in ``acc`` and in ``gyr``; ``repaired``: how many stamps were.
    """

    t_sensor_ns: IntArray
    t_arrival_ns: IntArray | None
    acc: FloatArray
    gyr: FloatArray
    stamps_ns: IntArray
    place: Callable[[int], str]
    greatest: tuple[float, float]
    repaired: int = 0


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
        source = path.with_name(file) if file else path
        whole = [sensor for sensor in sensors if not sidecar.sensors[sensor].gyr_file]
        if whole:
            table = Table.read(source, *_columns(sidecar_path, sidecar, whole))
            raw |= {sensor: raw_track(table, sensor, sidecar.columns_of(sensor)) for sensor in whole}
        for sensor in (sensor for sensor in sensors if sensor not in whole):
            table, columns, count = joined_table(source, sensor, sidecar.columns_of(sensor), sidecar.dialect)
            raw[sensor] = replace(raw_track(table, sensor, columns), repaired=count)
    return _in_one_turn(raw, sidecar)


def _in_one_turn(raw: dict[str, RawTrack], sidecar: Sidecar) -> dict[str, RawTrack]:
    """Counters that wrapped a different number of times before their tracks begin, brought next to the first's."""
    first_ns: int | None = None
    for sensor in sidecar.sensors:
        track, columns = raw[sensor], sidecar.columns_of(sensor)
        if columns.time_wraps_at is None or not track.t_sensor_ns.size:
            continue
        first_ns = int(track.t_sensor_ns[0]) if first_ns is None else first_ns
        turn_ns = columns.time_wraps_at * columns.unit_ns
        off_ns = round(round((first_ns - int(track.t_sensor_ns[0])) / turn_ns) * turn_ns)
        if off_ns:
            raw[sensor] = replace(track, t_sensor_ns=track.t_sensor_ns + off_ns, stamps_ns=track.stamps_ns + off_ns)
    return raw


def read_parts(path: Path, sidecar_path: Path, sidecar: Sidecar, rows: int) -> Iterator[dict[str, RawTrack]]:
    """As :func:`read_table` of a Parquet file alone, so many rows at a time; a sensor that is silent there is left out.

    Raises:
        RecordingError: as there.
    """
    sensors = list(sidecar.sensors)
    wanted, _, _ = _columns(sidecar_path, sidecar, sensors)
    for table in Table.parts(path, wanted, rows):
        found: dict[str, RawTrack] = {}
        for sensor in sensors:
            raw = raw_track(table, sensor, sidecar.columns_of(sensor), silent=True)
            if raw.t_sensor_ns.size:
                found[sensor] = raw
        del table, raw  # who clears what is yielded lets go of the file's columns too
        yield found


def _columns(sidecar_path: Path, sidecar: Sidecar, sensors: list[Sensor]) -> tuple[list[str], list[str], Dialect]:
    """Which columns to read, which of them are times, and how the text is laid out."""
    described = [sidecar.columns_of(sensor) for sensor in sensors]
    values = [name for columns in described for name in (*columns.acc, *columns.gyr)]
    times = [columns.time_column for columns in described] + [columns.arrival_column for columns in described]
    time_names = list(dict.fromkeys(name for name in times if name))
    confused = [name for name in time_names if name in values]
    if confused:
        raise RecordingError(f"{sidecar_path}: column {confused[0]!r} is named as a time and as a measurement")
    return time_names + values, time_names, sidecar.dialect


def raw_track(table: Table, sensor: str, columns: SensorColumns, *, silent: bool = False) -> RawTrack:
    """A sensor's rows of a table, by its columns as :meth:`Sidecar.columns_of` gives them.

    ``silent``: it may be that all of its cells are empty.

    Raises:
        RecordingError: as of :func:`read_table`.
    """
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
    time_name = columns.time_column
    table.check_stream((*names, time_name or names[0]), where)
    empty = None
    if time_name is None:
        stamps = stamps_from_rate(table.rows, columns.rate_hz or 1.0, table.first)
    else:
        stamps = table.times_ns(time_name, columns.unit_ns, columns.time_wraps_at)
        empty = table.empty(time_name)
        unused = empty if empty is None or dropped is None else empty & ~dropped
        untimed = [] if unused is None else np.flatnonzero(unused).tolist()
        if untimed:
            raise RecordingError(
                f"{where}: {table.place(untimed[0])} has values and no time in {time_name!r} "
                f"({len(untimed)} such rows); fill it in, or state rate_hz instead of time_column"
            )
    arrival = None
    if columns.arrival_column:
        arrival = table.times_ns(columns.arrival_column, columns.unit_ns)
    place: Callable[[int], str] = table.place
    if empty is None:
        stamped, count = repaired(stamps)
        stamps = stamped
    else:
        with_time = np.flatnonzero(~empty)
        stamped, count = repaired(stamps[with_time])
        stamps = stamps.copy()
        stamps[with_time] = stamped
        place = lambda index: table.place(int(with_time[index]))  # noqa: E731
    if kept is not None:
        if not kept.size and not silent:
            raise RecordingError(f"{where}: all of its cells are empty; leave the sensor out of the sidecar")
        stamps = stamps[kept]
        arrival = None if arrival is None else arrival[kept]
    return RawTrack(stamps, arrival, acc, gyr, stamped, place, greatest, count)


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
        if bad[:, column].all():
            raise RecordingError(
                f"{table.path}: column {names[column]!r} holds no measurement in any row. Leave its sensor out of the "
                f"sidecar, or record again."
            )
        raise RecordingError(
            f"{table.path}: {table.place(row)}, column {names[column]!r}: {data[row, column]} is no measurement "
            f"({int(bad.sum())} such values in {rows.size} rows). Where a sample is lost, leave all six cells empty."
        )
