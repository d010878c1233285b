"""Arrays and data frames → a recording, through the checks of a file; rows of NaN are lost samples, as empty cells are.

A frame is what has ``columns`` and ``index``; no library of frames is imported. gaitmap gives one frame, a dict of
frames ``left_sensor`` and ``right_sensor``, or one with the sensor as the columns' first level; ``acc_x`` … ``gyr_z``
are in m/s² and deg/s, the index counts samples or seconds (``gaitmap.example_data``). mobgap gives a dict of frames in
the same units, whose index is date and time (``mobgap.data.base.BaseGaitDataset``).
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fes.config import FootGeometry
from fes.recording import naming
from fes.recording.raw import PLAUSIBLE_RATES_HZ, RATE_TOLERANCE, RawTrack, raw_track
from fes.recording.read import tracks_of
from fes.recording.sidecar import Sidecar
from fes.recording.table import Table
from fes.recording.tracks import UNLABELLED_FEET, Recording, RecordingError
from fes.recording.units import ACC_UNITS, GRAVITY_GONE, GYR_UNITS, TIME_UNITS_NS, canonical
from fes.signals import NS_PER_S, SENSORS, FloatArray, IntArray

Arrays = npt.ArrayLike | Mapping[str, npt.ArrayLike]
Frames = Any  # a frame, or a mapping from each sensor to its frame


@dataclass(frozen=True)
class _Given:
    """One sensor's (N, 3) values, stamps (N,) where there are any, and the units that its columns' names state."""

    acc: FloatArray
    gyr: FloatArray
    t_ns: IntArray | None = None
    stated: tuple[str, str] | None = None  # None of arrays


def is_frames(given: object) -> bool:
    """Is it a data frame, or a mapping of them?"""
    if isinstance(given, Mapping):
        return bool(given) and all(is_frames(each) for each in given.values())
    return hasattr(given, "columns") and hasattr(given, "index")


def recording_from_arrays(
    acc: Arrays | Frames,
    gyr: Arrays | None = None,
    rate_hz: float | None = None,
    sensor: str = "left_foot",
    *,
    t_s: npt.ArrayLike | None = None,
    acc_unit: str | None = None,
    gyr_unit: str | None = None,
    name: str = "arrays",
    belt_speed_mps: float | None = None,
    geometry: Mapping[str, FootGeometry] | None = None,
) -> Recording:
    """Return a recording of one sensor, or of several; a row of NaN is a lost sample.

    Args:
        acc: (N, 3) specific force in the sensor's axes, gravity included; or a mapping from each sensor to its array.
            Or a data frame with columns such as ``acc_x`` … ``gyr_z``, or a mapping of frames, without ``gyr``.
        gyr: (N, 3) angular rate in the same axes, likewise.
        rate_hz: samples a second, of all sensors; not needed where there are times.
        sensor: which it is, where nothing names it: one of ``fes.signals.SENSORS``, or ``foot_a`` and ``foot_b`` for
            feet that calibration is to tell apart.
        t_s: (N,) times of arrays, s. Of frames it is a column called time, or the index.
        acc_unit: ``m/s^2``, ``g`` or ``mg``. Default: of arrays m/s², of frames what names and numbers tell.
        gyr_unit: ``rad/s``, ``deg/s`` or ``mdeg/s``. Default: of arrays rad/s, of frames as above.
        name: what tables and reports call it.
        belt_speed_mps: of the treadmill, if it was one.
        geometry: where toe and heel are, by foot.

    Raises:
        RecordingError: a shape, a unit or a time does not fit, a value is infinite or stands alone in a row of NaN, it
            is too short, or no such sensor.
    """
    lowest, highest = PLAUSIBLE_RATES_HZ
    if rate_hz is not None and not lowest <= rate_hz <= highest:
        raise RecordingError(f"{name}: rate_hz = {rate_hz:g} is outside {lowest:g} to {highest:g} Hz")
    asked = tuple(None if unit is None else str(canonical(unit)) for unit in (acc_unit, gyr_unit))
    for unit, known, argument in zip(asked, (ACC_UNITS, GYR_UNITS), ("acc_unit", "gyr_unit"), strict=True):
        if unit is not None and unit not in known:
            raise RecordingError(f"{name}: {argument} = {unit!r}: must be one of {', '.join(known)}")
    if gyr is None:
        given = dict(_from_frames(name, acc, sensor, rate_hz))
    else:
        given = _from_arrays(name, (acc, gyr), sensor, t_s)
    if not given:
        raise RecordingError(f"{name}: holds no sensor of a foot or shank; call one left_foot, right_foot or the like")
    if unknown := [each for each in given if each not in SENSORS + UNLABELLED_FEET]:
        raise RecordingError(f"{name}: no sensor is called {unknown[0]!r}; one of {', '.join(SENSORS)}")
    if rate_hz is None and any(each.t_ns is None for each in given.values()):
        raise RecordingError(f"{name}: nothing says when the samples are: give rate_hz, or times")
    sizes = {each: len(one.acc) for each, one in given.items() if one.t_ns is None}
    if len(set(sizes.values())) > 1:
        said = ", ".join(f"{each}: {size}" for each, size in sizes.items())
        raise RecordingError(f"{name}: sensors that were sampled together have as many samples ({said}); or give times")
    sensors = {
        each: {
            **_names(each),
            **_units(f"{name}: {each}", one, asked),
            **({} if one.t_ns is None else {"time_column": "time"}),
        }
        for each, one in given.items()
    }
    sidecar = Sidecar.model_validate({"time_unit": "ns", "rate_hz": rate_hz, "sensors": sensors})
    path = Path(name)
    raw: dict[str, RawTrack] = {
        each: raw_track(_table(path, each, given[each]), each, sidecar.columns_of(each)) for each in sidecar.sensors
    }
    return Recording(name, None, tracks_of(path, sidecar, raw), belt_speed_mps, geometry=dict(geometry or {}))


def _from_arrays(
    name: str, acc_and_gyr: tuple[Arrays, Arrays], sensor: str, t_s: npt.ArrayLike | None
) -> dict[str, _Given]:
    forces, rates = (each if isinstance(each, Mapping) else {sensor: each} for each in acc_and_gyr)
    if forces.keys() != rates.keys():
        raise RecordingError(f"{name}: acc is of {', '.join(forces)}, gyr of {', '.join(rates)}: give both of each")
    given = {}
    for each in forces:
        where = f"{name}: {each}"
        force, rate = _numbers(where, "acc", forces[each], (-1, 3)), _numbers(where, "gyr", rates[each], (-1, 3))
        if force.shape != rate.shape:
            raise RecordingError(f"{where}: acc has {len(force)} samples, gyr {len(rate)}")
        times = None if t_s is None else _times_ns(where, "t_s", _numbers(where, "t_s", t_s, (len(force),)), 1.0, "s")
        given[each] = _Given(force, rate, times)
    return given


def _from_frames(name: str, frames: Frames, sensor: str, rate_hz: float | None) -> Iterator[tuple[str, _Given]]:
    """Each sensor of a frame, or of a mapping of frames."""
    if not is_frames(frames):
        raise RecordingError(f"{name}: gyr is missing: give the gyroscope's array too, or a data frame that holds both")
    if not isinstance(frames, Mapping):
        levels = [column for column in frames.columns if isinstance(column, tuple) and len(column) == 2]
        if levels and len(levels) == len(frames.columns):
            frames = {first: frames[first] for first in dict.fromkeys(first for first, _ in levels)}
    seen: dict[str, str] = {}
    for called, frame in frames.items() if isinstance(frames, Mapping) else [("", frames)]:
        words = naming.plain(str(called))
        if called and naming.worn_elsewhere(words):
            continue
        columns = {str(column): frame[column] for column in frame.columns}
        groups = naming.group_columns(list(columns))
        where = f"{name}: {called or 'the frame'}"
        if not groups[0].whole:
            shown = ", ".join(map(repr, list(columns)[:12]))
            what = "has no columns such as acc_x … acc_z, gyr_x … gyr_z"
            raise RecordingError(f"{where}: {what}, but {shown or 'none'}; rename them")
        times = _frame_times(where, frame, columns, rate_hz)
        for group in groups:
            side = naming.side_of(words)
            place = f"{side}_{naming.part_of(words) or 'foot'}" if side else called if called in UNLABELLED_FEET else ""
            if not (place := place or group.sensor or ("" if called or len(groups) > 1 else sensor)):
                raise RecordingError(f"{where}: nothing says which sensor it is: call it one of {', '.join(SENSORS)}")
            if place in seen:
                raise RecordingError(f"{where}: is {place}, and so is {seen[place]!r}; leave one out")
            seen[place] = str(called)
            names = group.names("acc"), group.names("gyr")
            values = [np.column_stack([_numbers(where, n, columns[n], (-1,)) for n in own]) for own in names]
            stated = tuple(naming.stated_unit(kind, own[0]) for kind, own in zip(("acc", "gyr"), names, strict=True))
            yield place, _Given(values[0], values[1], times, (stated[0], stated[1]))


def _frame_times(where: str, frame: Frames, columns: Mapping[str, Any], rate_hz: float | None) -> IntArray | None:
    """Times (N,) of a column that is called so, or of the index; None where the index only counts the rows."""
    called = next(iter(naming.time_columns(list(columns))), "")
    values = np.asarray(getattr(columns[called] if called else frame.index, "values", frame.index))
    what = f"column {called!r}" if called else "the index"
    if values.dtype.kind in "Mm":
        counts = values.astype(f"{values.dtype.kind}8[ns]").astype(np.int64)
        if (counts == np.iinfo(np.int64).min).any():
            raise RecordingError(f"{where}: {what} has rows without a time; leave them out")
        return counts
    if values.dtype.kind not in "iuf":
        raise RecordingError(f"{where}: {what} is no time: give one of dates, of seconds or of sample numbers")
    steps = np.diff(values.astype(np.float64))
    usual = float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0
    if not usual:
        raise RecordingError(f"{where}: {what} never advances; sort the rows by time")
    unit = naming.stated_unit("time", called or str(getattr(frame.index, "name", "") or ""))
    if not unit and usual == 1.0:  # it counts samples; what it leaves out was lost
        if rate_hz is None:
            raise RecordingError(f"{where}: {what} counts samples: give rate_hz too")
        return _times_ns(where, what, values, 1.0 / rate_hz, "")
    fitting = [unit] if unit else [each for each, ns in TIME_UNITS_NS.items() if _fits(usual * ns, rate_hz)]
    if len(fitting) != 1:
        raise RecordingError(f"{where}: {what} rises by {usual:g}, which is no usual rate: give it in seconds")
    return _times_ns(where, what, values, 1.0, fitting[0])


def _fits(step_ns: float, rate_hz: float | None) -> bool:
    low, high = naming.RATES_HZ if rate_hz is None else ((1 - RATE_TOLERANCE) * rate_hz, (1 + RATE_TOLERANCE) * rate_hz)
    return step_ns > 0 and low <= NS_PER_S / step_ns <= high


def _times_ns(where: str, what: str, values: npt.NDArray[Any], size: float, unit: str) -> IntArray:
    ns = TIME_UNITS_NS.get(unit, NS_PER_S)
    with np.errstate(invalid="ignore", over="ignore"):
        finite = np.abs(values.astype(np.float64)) * size * ns < 2.0**62
    if not finite.all():
        row = int(np.argmin(finite))
        raise RecordingError(f"{where}: {what} is no time in row {row + 1}: {values[row]}; leave such rows out")
    exact = values.dtype.kind in "iu" and size == 1.0
    times: IntArray = values.astype(np.int64) * ns if exact else np.rint(values * (size * ns)).astype(np.int64)
    return times


def _units(where: str, given: _Given, asked: tuple[str | None, ...]) -> dict[str, str]:
    """The units as they were asked for, stated by names, or told by the numbers."""
    if given.stated is None:
        return {"acc_unit": asked[0] or "m/s^2", "gyr_unit": asked[1] or "rad/s"}
    data = np.hstack((given.acc, given.gyr))
    data = data[np.isfinite(data).all(axis=1)]
    acc, gyr = (one or other for one, other in zip(asked, given.stated, strict=True))
    if len(data) and not (acc and gyr):
        numbers = naming.characterise(data)
        acc = acc or naming.acc_unit_of(numbers)
        gyr = gyr or naming.gyr_unit_of(numbers, acc)
        if not acc and numbers.subtracted:
            raise RecordingError(f"{where}: {GRAVITY_GONE}")
    for unit, argument, known in ((acc, "acc_unit", ACC_UNITS), (gyr, "gyr_unit", GYR_UNITS)):
        if not unit:
            raise RecordingError(
                f"{where}: neither names nor numbers tell the unit: fes.recording(frame, {argument}=…), one of "
                f"{', '.join(known)}"
            )
    return {"acc_unit": acc, "gyr_unit": gyr}


def _names(sensor: str) -> dict[str, list[str]]:
    return {kind: [f"{sensor} {kind} {axis}" for axis in "xyz"] for kind in ("acc", "gyr")}


def _table(path: Path, sensor: str, given: _Given) -> Table:
    import pyarrow as pa

    values = np.hstack((given.acc, given.gyr))
    names = [name for own in _names(sensor).values() for name in own]
    columns = {name: pa.array(axis, mask=np.isnan(axis)) for name, axis in zip(names, values.T, strict=True)}
    return Table(path, pa.table(columns if given.t_ns is None else {**columns, "time": given.t_ns}))


def _numbers(where: str, argument: str, values: npt.ArrayLike, shape: tuple[int, ...]) -> FloatArray:
    """Numbers of a shape; -1 is any size."""
    try:
        numbers = np.array(values, np.float64)
    except (TypeError, ValueError) as error:
        raise RecordingError(f"{where}: {argument} is no array of numbers: {error}") from error
    if len(numbers.shape) != len(shape) or any(
        -1 != due != size for due, size in zip(shape, numbers.shape, strict=True)
    ):
        due = "(N, 3): a row a sample, x y z" if shape == (-1, 3) else f"({shape[0] if shape[0] >= 0 else 'N'},)"
        raise RecordingError(f"{where}: {argument} has shape {numbers.shape}, must be {due}")
    return numbers
