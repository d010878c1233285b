"""A sidecar to start from: what a file's text, names and numbers tell, for whoever brings their own sensor.

What nothing tells is not guessed: it stands as “?”, and reading refuses it until someone has answered.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path

import numpy as np

from fes.recording import naming as hints
from fes.recording.can_log import CAN_SUFFIXES, dbc_signals
from fes.recording.containers import container_of, container_table
from fes.recording.csv_layout import Dialect, Layout, csv_layout, settings_of
from fes.recording.naming import Group, counter_columns, group_columns, stated_unit, time_columns
from fes.recording.raw import RATE_TOLERANCE
from fes.recording.several_files import acc_sign_of, companion_files, is_zip, opened
from fes.recording.table import Table, is_parquet, parquet_names, unwrapped
from fes.recording.tracks import RecordingError
from fes.recording.units import ACC_UNITS, GRAVITY_GONE, GYR_UNITS, time_factor_ns
from fes.recording.write import toml_value
from fes.signals import G_MPS2, NS_PER_S, SENSORS, FloatArray

_PROBE_ROWS = 100_000
_WHICH = f"? which sensor: {', '.join(SENSORS)}"


def sidecar_template(path: Path) -> str:
    """Return the text of a sidecar for a recording that has none; what is to be answered is marked with “?”.

    Raises:
        RecordingError: the file itself is empty, damaged or no text, or lacks what no answer could replace.
    """
    if path.suffix.lower() in CAN_SUFFIXES:
        return _can_template(path)
    if path.is_dir() or is_zip(path):
        return _several_template(path)
    if container_of(path):
        table, units = container_table(path)
        layout = Layout(Dialect(), table.column_names, units, [], set(table.column_names))
    elif is_parquet(path):
        names = parquet_names(path)
        layout = Layout(Dialect(), names, {}, [], set(names))
    else:
        layout = csv_layout(path)
    groups = group_columns(layout.names)
    if not groups[0].whole and companion_files(path):
        return _several_template(path)
    why = _place(path, layout, groups)
    times = [name for name in (*time_columns(layout.names), *counter_columns(layout.names)) if name in layout.filled]
    numbers = _characterised(path, layout, groups[0])
    if not any(group.names("gyr")[0] in layout.names for group in groups) and groups[0].names("acc")[0] in layout.names:
        raise RecordingError(
            f"{path}: has an accelerometer and no gyroscope (no column of turning rates). Strides need both: export "
            "the gyroscope of the same sensor too"
        )
    if numbers and numbers.subtracted and not hints.acc_unit_of(numbers):
        raise RecordingError(f"{path}: {GRAVITY_GONE}")
    lines = [f"# {path.name} has these columns:", *(f"#   {name}" for name in layout.names if name), ""]
    lines += [f"{key} = {toml_value(value)}" for key, value in settings_of(layout.dialect).items()]
    own = _own_times(groups, times := list(dict.fromkeys(times)))
    own_lines = [_time_lines(path, layout, names) for names in own]
    wraps = [line for line in chain(*own_lines) if line.startswith("time_wraps_at")]  # one counter's is the others' too
    lines += wraps[:1] if own else _time_lines(path, layout, times)
    lines += [_acc_line(layout, groups[0], numbers), _gyr_line(layout, groups[0], numbers)]
    for number, group in enumerate(groups, start=1):
        key = group.sensor or (f'"? {number}"' if len(groups) > 1 else '"?"')
        lines += ["", f"[sensors.{key}]{why.get(number, '') if group.sensor else f'  # {_WHICH}'}"]
        lines += [f"{kind} = {toml_value(group.names(kind))}" for kind in ("acc", "gyr")]
        lines += [line for line in own_lines[number - 1] if line not in wraps] if own else []
    if not all(group.whole for group in groups):
        lines.append("# ? put the columns' names, x, y, z, where a name starts with “?”")
    lines += _other_foot(path, layout, groups)
    known = "at the top: belt_speed_mps, subject, description; for each sensor: acc_range_g, gyr_range_dps"
    return "\n".join([*lines, "", f"# if known, {known}", ""])


def _place(path: Path, layout: Layout, groups: list[Group]) -> dict[int, str]:
    """Name a lone sensor by what the file tells; return group number → the comment that says what source."""
    why = {}
    for number, group in enumerate(groups, start=1):
        if group.sensor.endswith("foot") and "foot" not in group.called and "shoe" not in group.called:
            why[number] = "  # taken for the foot: no name says shank"
    if len(groups) == 1 and not groups[0].sensor:
        side, part, source = hints.place_of(path, layout.above)
        if side:
            groups[0].sensor = f"{side}_{part or 'foot'}"
            why[1] = f"  # by {source}" + ("" if part else "; taken for the foot: no name says shank")
    return why


def _characterised(path: Path, layout: Layout, group: Group) -> hints.Numbers | None:
    """What the first sensor's numbers look like; None where they cannot be read, which stays to be answered."""
    if not group.whole:
        return None
    values = [*group.names("acc"), *group.names("gyr")]
    try:
        return _characterised_data(_numbers(path, values, layout)[:_PROBE_ROWS])
    except (RecordingError, ValueError, IndexError):
        return None


def _characterised_data(data: FloatArray) -> hints.Numbers | None:
    data = data[np.isfinite(data).all(axis=1)]
    return hints.characterise(data) if len(data) else None


def _several_template(path: Path) -> str:
    """Of a sensor whose accelerometer and gyroscope are files of their own."""
    with opened(path) as (folder, files):
        acc_path, gyr_path = folder / files.acc, folder / files.gyr
        layout, of_gyr = csv_layout(acc_path), csv_layout(gyr_path)
        group = Group({"acc": hints.axis_columns(layout.names), "gyr": hints.axis_columns(of_gyr.names)})
        times, gyr_times = ([n for n in time_columns(each.names) if n in each.filled] for each in (layout, of_gyr))
        lines = _time_lines(acc_path, layout, times)
        own = group.names("acc"), group.names("gyr")
        numbers = None
        if group.whole:
            data = _numbers(acc_path, own[0], layout)
            others = [(gyr_path, own[1], of_gyr)]
            others += [(folder / files.gravity, own[0], layout)] if files.gravity else []
            gyr, *gravity = (_spread(_numbers(*each), len(data)) for each in others)
            numbers = _characterised_data(np.hstack((sum(gravity, data), gyr))[:_PROBE_ROWS])
        sensor_logger = "seconds_elapsed" in layout.names
        sign = acc_sign_of(folder) if sensor_logger and files.acc != files.names.get("total") else 1
        without = sensor_logger and files.acc == files.names.get("acc") and not files.gravity
    if numbers and (numbers.subtracted or without) and not hints.acc_unit_of(numbers):
        how = "In Sensor Logger switch on Gravity (or Total Acceleration) beside Accelerometer and Gyroscope"
        raise RecordingError(f"{path}: {files.acc}: {GRAVITY_GONE}{f'. {how}' if sensor_logger else ''}")
    units = dict.fromkeys(own[1], "rad/s") if sensor_logger else of_gyr.units
    why = _place(path, layout, [group])
    named = {"acc_file": files.acc, "gravity_file": files.gravity, "gyr_file": files.gyr}
    about = [f"# {path.name}: accelerometer and gyroscope are files of their own, which become one on one clock."]
    return "\n".join([
        *about, "", *(f"{key} = {toml_value(value)}" for key, value in settings_of(layout.dialect).items()), *lines,
        _acc_line(layout, group, numbers), _gyr_line(replace(of_gyr, units=units), group, numbers), "",
        f"[sensors.{group.sensor}]{why.get(1, '')}" if group.sensor else f'[sensors."?"]  # {_WHICH}',
        *(f"{key} = {toml_value(name)}" for key, name in named.items() if name),
        *(f"{kind} = {toml_value(names)}" for kind, names in zip(("acc", "gyr"), own, strict=True)),
        *([] if times[:1] == gyr_times[:1] else [f"gyr_time_column = {toml_value((gyr_times or ['?'])[0])}"]),
        *_sign_lines(sign), "",
    ])  # fmt: skip


def _sign_lines(sign: int | None) -> list[str]:
    if sign is None:
        return ['acc_sign = "?"  # ? -1 of an iPhone, 1 of Android: Metadata.csv, which tells, is not there']
    return [] if sign == 1 else ["acc_sign = -1  # an iPhone's, by Metadata.csv: the axis that points up reads -1 g"]


def _numbers(path: Path, names: list[str], layout: Layout) -> FloatArray:
    table = Table.read(path, names, [], layout.dialect)
    return np.column_stack([table.numbers(name) for name in names])


def _spread(data: FloatArray, rows: int) -> FloatArray:
    """As many rows over the same time, roughly: enough to tell units by."""
    chosen = np.linspace(0, len(data) - 1, rows).round().astype(np.int64)
    return data[chosen]


def _own_times(groups: list[Group], times: list[str]) -> list[list[str]]:
    """Each sensor's own time columns, where every one of several has some; else none."""
    own = []
    for group in groups:
        streams = {name.rpartition(".")[0] for name in group.names("acc")}
        alike = [name for name in times if _same_sensor(name, group)]  # of one side: foot's and shank's
        own.append([name for name in alike if name.rpartition(".")[0] in streams] or alike)
    return own if len(groups) > 1 and all(own) else []


def _same_sensor(name: str, group: Group) -> bool:
    words = hints.plain(name)
    side = hints.side_of(words)
    return bool(side and group.sensor.startswith(side)) or bool(group.called and f" {group.called} " in f" {words} ")


@dataclass(frozen=True)
class _Clock:
    """A column that tells time: (N,) ``readings``, as if it never began anew, and the ``step`` that is usual."""

    name: str
    readings: FloatArray
    step: float
    wraps_at: int | None
    packet: int = 1  # readings that share a stamp

    @property
    def missing(self) -> int:
        """Samples that lie in its gaps."""
        steps = np.diff(self.readings)
        return int(np.sum(np.rint(steps[steps > 1.5 * self.step] / self.step) - 1))

    @property
    def counts(self) -> bool:
        """Most samples are one whole step after the one before."""
        steps = np.diff(self.readings)
        whole = self.step >= 1.0 and self.step % 1.0 == 0.0
        return whole and 2 * int(np.count_nonzero(steps == self.step)) > steps.size


def _clock(path: Path, layout: Layout, name: str) -> _Clock | None:
    """None where the column cannot be read or stands still."""
    try:
        table = Table.read(path, [name], [name], layout.dialect)
        try:
            readings = table.numbers(name)
        except RecordingError:  # date and time
            readings = table.times_ns(name, 1) / 1e3
    except (RecordingError, ValueError, IndexError):
        return None
    readings = readings[np.isfinite(readings)]
    turn = hints.wraps_at_of(readings)
    readings = unwrapped(readings, turn) if turn else readings
    steps = np.diff(readings)
    if not (steps > 0).any():
        return None
    lengths = np.diff(np.flatnonzero(np.concatenate(([True], steps != 0))))
    packet = int(np.median(lengths)) if lengths.size and (steps >= 0).all() else 1
    usual = np.median(steps[steps > 0])
    step = steps[np.abs(steps - usual) < 0.5 * usual].mean()  # stamps may be rounded: 8, 8, 7 ms at 128 Hz
    return _Clock(name, readings, float(step if packet == 1 else usual / packet), turn, packet)


def _time_lines(path: Path, layout: Layout, names: list[str]) -> list[str]:
    """What tells time among these columns: a clock, or a counter of samples where that shows more missing ones."""
    stated = hints.stated_rate(layout.above)
    by_rate = [f"rate_hz = {stated[0]:g}  # by {stated[1]}"] if stated else []
    found = [clock for name in names if (clock := _clock(path, layout, name)) is not None]
    called = set(hints.counter_columns(names))
    counter = next((one for one in found if one.name in called and one.counts), None)
    clocks = ((one, unit, told) for one in found if one is not counter for unit, told in _unit_of(layout, one))
    clock, unit, told = next(clocks, (None, "", ""))
    rate_hz = NS_PER_S / (clock.step * time_factor_ns(unit, None)) if clock else 0.0
    if counter and (clock is None or counter.missing > clock.missing):
        if clock and not stated:
            by_rate = [f"rate_hz = {_rate_by(counter, clock, unit):.5g}  # by {clock.name}"]
        return _counter_lines(counter, by_rate)
    if clock is not None and clock.packet > 1:
        told = f"they arrive in packets of {clock.packet}, which share a stamp of {clock.name}"
        return by_rate or [f"rate_hz = {_rounded(rate_hz):g}  # {told}"]
    if clock is None:
        wanted = "? samples per second, as the sensor was set; or time_column = … and time_unit = … instead"
        return by_rate or [f"rate_hz = 0  # {wanted}"]
    agree = stated is not None and abs(rate_hz / stated[0] - 1.0) <= RATE_TOLERANCE
    lines = [f"time_column = {toml_value(clock.name)}", f"time_unit = {toml_value(unit)}  # {told}: {rate_hz:.5g} Hz"]
    lines += _wrap_lines(clock)
    if stated and not agree:
        lines.append(f"# rate_hz = {stated[0]:g} stands in {stated[1]}, and the times say {rate_hz:.5g}")
    return lines + (by_rate if agree else [])


def _rounded(rate_hz: float) -> float:
    """A rate by stamps of arrival, to the nearest that a sensor is set to where that is within 1 %."""
    usual = min((25, 50, 52, 60, 64, 100, 104, 120, 128, 200, 208, 256, 400, 500), key=lambda each: abs(each - rate_hz))
    return float(usual) if abs(usual - rate_hz) <= 0.01 * usual else round(rate_hz, 1)


def _unit_of(layout: Layout, clock: _Clock) -> list[tuple[str | float, str]]:
    """The unit that a clock's name gives or, alone, makes a rate that a sensor can have, and what told it."""
    named = stated_unit("time", clock.name, layout.units.get(clock.name, ""))
    if named and _fits(clock.step, named):
        return [(named, "the file says so")]
    fitting = [one for one in hints.units_of_time(clock.name) if _fits(clock.step, one)]
    return [(fitting[0], f"steps of {clock.step:g}")] if len(fitting) == 1 and clock.step != 1.0 else []


def _fits(step: float, unit: str | float) -> bool:
    return step > 0 and hints.RATES_HZ[0] <= NS_PER_S / (step * time_factor_ns(unit, None)) <= hints.RATES_HZ[1]


def _rate_by(counter: _Clock, clock: _Clock, unit: str | float) -> float:
    """The rate at which the clock says that samples come of which none is missing in between."""
    size = min(counter.readings.size, clock.readings.size)
    next_one = np.diff(counter.readings[:size]) == counter.step
    return NS_PER_S / float(np.diff(clock.readings[:size])[next_one].mean() * time_factor_ns(unit, None))


def _counter_lines(counter: _Clock, by_rate: list[str]) -> list[str]:
    name, missing = toml_value(counter.name), f"{counter.missing or 'none'} of them missing"
    lines = [f"time_column = {name}  # it counts samples, {missing}", *_wrap_lines(counter)]
    asked = by_rate or ["rate_hz = 0  # ? samples per second, as the sensor was set"]
    if counter.step == 1.0:
        return [*lines, 'time_unit = "samples"', *asked]
    steps = f"it goes up by {counter.step:g} a sample"
    if not by_rate:
        return [*lines, f'time_unit = "?"  # ? seconds per count; {steps}']
    rate_hz = float(by_rate[0].split()[2])
    return [*lines, f"time_unit = {1.0 / (rate_hz * counter.step):.9g}  # seconds per count; {steps}", *by_rate]


def _wrap_lines(clock: _Clock) -> list[str]:
    return [f"time_wraps_at = {clock.wraps_at}  # there it begins anew"] if clock.wraps_at else []


def _named_unit(kind: str, group: Group, units: Mapping[str, str]) -> str:
    """The unit that all names of a kind, or what stands under them, agree on; "" where they do not."""
    stated = {stated_unit(kind, name, units.get(name, "")) for name in group.names(kind)}
    return stated.pop() if len(stated) == 1 else ""


def _acc_line(layout: Layout, group: Group, numbers: hints.Numbers | None) -> str:
    named = _named_unit("acc", group, layout.units)
    if numbers is None:
        return f'acc_unit = "{named}"' if named else 'acc_unit = "?"  # ? "m/s^2", "g" or "mg"'
    gravity, found = numbers.gravity, hints.acc_unit_of(numbers)
    rest = f"at rest it reads {gravity:.4g}"
    if named and found and named != found:
        return f'acc_unit = "?"  # ? its name says {named}, but {rest}, as {found} would'
    if found:
        return f'acc_unit = "{found}"  # {rest}, gravity is {G_MPS2 / ACC_UNITS[found]:.4g} {found}'
    if gravity > 20.0 and not named:
        return f'acc_unit = "?"  # ? m/s² per count, for {rest}: {G_MPS2 / gravity:.6g} would make that gravity'
    return f'acc_unit = "?"  # ? {f"its name says {named}, but " if named else ""}{rest}, and gravity is due there'


def _gyr_line(layout: Layout, group: Group, numbers: hints.Numbers | None) -> str:
    named = _named_unit("gyr", group, layout.units)
    if numbers is None:
        return f'gyr_unit = "{named}"' if named else 'gyr_unit = "?"  # ? "rad/s" or "deg/s"'
    found = hints.gyr_unit_of(numbers, hints.acc_unit_of(numbers))
    peaks = f"peaks of {numbers.peak:.4g}"
    if named and found and named != found:
        return f'gyr_unit = "?"  # ? its name says {named}, but {peaks} (99th percentile) look like {found}'
    if named:
        return f'gyr_unit = "{named}"  # the file says so; {peaks} (99th percentile)'
    if found:
        degrees = np.degrees(numbers.peak * GYR_UNITS[found])
        return f'gyr_unit = "{found}"  # {peaks} (99th percentile): {degrees:.0f} deg/s, as legs walk'
    return f'gyr_unit = "?"  # ? "rad/s" or "deg/s": {peaks} (99th percentile) do not tell'


def _other_foot(path: Path, layout: Layout, groups: list[Group]) -> list[str]:
    """A lone sensor's other side from the file beside it, as lines to uncomment."""
    if len(groups) != 1 or not groups[0].sensor or is_parquet(path) or container_of(path):
        return []
    other = hints.other_side(path)
    try:
        if other is None or csv_layout(other).names != layout.names:
            return []
    except RecordingError:
        return []
    side, part = groups[0].sensor.split("_")
    return [
        "",
        "# If this file holds the other side of the same walk, delete the “# ” of these lines:",
        f"# [sensors.{'right' if side == 'left' else 'left'}_{part}]",
        f"# file = {toml_value(other.name)}",
        *(f"# {kind} = {toml_value(groups[0].names(kind))}" for kind in ("acc", "gyr")),
    ]


def _can_template(path: Path) -> str:
    """By the only DBC that lies beside the log, else with all of it to be answered."""
    beside = sorted(other for other in path.parent.iterdir() if other.suffix.lower() == ".dbc")
    groups, units, dbc = [Group()], dict[str, str](), 'sensors.dbc"  # ? beside this file'
    if len(beside) == 1:
        units = dbc_signals(beside[0])
        groups, dbc = group_columns(list(units)), f'{beside[0].name}"  # the only one beside this file'
    lines = []
    for kind, allowed in (("acc", "m/s^2"), ("gyr", "rad/s")):
        named = _named_unit(kind, groups[0], units)
        other = "g" if kind == "acc" else "deg/s"
        asked = f'"{allowed}"  # ? "{allowed}" or "{other}", after the DBC\'s scaling'
        lines.append(f'{kind}_unit = "{named}"  # the DBC says so' if named else f"{kind}_unit = {asked}")
    lines += ["", "[can]", f'dbc = "{dbc}']
    for number, group in enumerate(groups, start=1):
        key = group.sensor or (f'"? {number}"' if len(groups) > 1 else '"?"')
        lines += ["", f"[sensors.{key}]" + ("" if group.sensor else f"  # {_WHICH}")]
        known = {kind: group.names(kind) for kind in ("acc", "gyr")}
        lines += [f"{kind} = {toml_value([n.replace('? ', '? Message.') for n in known[kind]])}" for kind in known]
    return "\n".join([*lines, ""])
