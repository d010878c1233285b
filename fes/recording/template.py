"""A sidecar to start from: what a file's text, names and numbers tell, for whoever brings their own sensor.

What nothing tells is not guessed: it stands as “?”, and reading refuses it until someone has answered.
"""

from pathlib import Path

import numpy as np

from fes.recording import naming as hints
from fes.recording.csv_layout import Dialect, Layout, csv_layout, settings_of
from fes.recording.naming import Group, group_columns, stated_unit, time_columns
from fes.recording.raw import RATE_TOLERANCE
from fes.recording.table import Table
from fes.recording.tracks import RecordingError
from fes.recording.units import ACC_UNITS, GYR_UNITS, TIME_UNITS_NS
from fes.recording.write import toml_value
from fes.signals import G_MPS2, NS_PER_S, SENSORS

_PROBE_ROWS = 100_000
_WHICH = f"? which sensor: {', '.join(SENSORS)}"


def sidecar_template(path: Path) -> str:
    """Return the text of a sidecar for a recording that has none; what is to be answered is marked with “?”.

    Raises:
        RecordingError: the file itself is empty, damaged or no text.
    """
    if path.suffix.lower() not in (".csv", ".parquet"):
        return _can_template()
    if path.suffix.lower() == ".parquet":
        names = Table.parquet_names(path)
        layout = Layout(Dialect(), names, {}, [], set(names))
    else:
        layout = csv_layout(path)
    groups = group_columns(layout.names)
    why = _place(path, layout, groups)
    times = [name for name in time_columns(layout.names) if name in layout.filled]
    steps = {name: _usual_step(path, layout, name) for name in times}
    numbers = _characterised(path, layout, groups[0])
    lines = [f"# {path.name} has these columns:", *(f"#   {name}" for name in layout.names if name), ""]
    lines += [f"{key} = {toml_value(value)}" for key, value in settings_of(layout.dialect).items()]
    lines += _time_lines(layout, steps)
    lines += [_acc_line(layout, groups[0], numbers), _gyr_line(layout, groups[0], numbers)]
    for number, group in enumerate(groups, start=1):
        key = group.sensor or (f'"? {number}"' if len(groups) > 1 else '"?"')
        lines += ["", f"[sensors.{key}]{why.get(number, '') if group.sensor else f'  # {_WHICH}'}"]
        lines += [f"{kind} = {toml_value(group.names(kind))}" for kind in ("acc", "gyr")]
    if not all(group.whole for group in groups):
        lines.append("# ? put the columns' names, x, y, z, where a name starts with “?”")
    lines += _other_foot(path, layout, groups)
    known = "at the top: belt_speed_mps, subject, description; for each sensor: acc_range_g, gyr_range_degps"
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
        table = Table(path, values, [], layout.dialect)
        data = np.column_stack([table.numbers(name)[:_PROBE_ROWS] for name in values])
        data = data[np.isfinite(data).all(axis=1)]
        return hints.characterise(data) if len(data) else None
    except (RecordingError, ValueError, IndexError):
        return None


def _usual_step(path: Path, layout: Layout, name: str) -> float:
    """A time column's usual step, in its own unit; 0 where it has none or cannot be read."""
    try:
        stamps = Table(path, [name], [name], layout.dialect).times_ns(name, 1_000).astype(np.float64) / 1_000
    except (RecordingError, ValueError, IndexError):
        return 0.0
    steps = np.diff(stamps)
    return float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0


def _time_lines(layout: Layout, steps: dict[str, float]) -> list[str]:
    stated = hints.stated_rate(layout.above)
    by_rate = [f"rate_hz = {stated[0]:g}  # by {stated[1]}"] if stated else []
    for name, step in steps.items():
        unit = stated_unit("time", name, layout.units.get(name, ""))
        if unit and not _fits(step, unit):
            unit = ""
        fitting = [unit] if unit else [one for one in TIME_UNITS_NS if _fits(step, one)]
        counter = step == 1.0 and not unit
        if len(fitting) != 1 or counter:
            continue
        rate = NS_PER_S / (step * TIME_UNITS_NS[fitting[0]])
        agree = stated is not None and abs(rate / stated[0] - 1.0) <= RATE_TOLERANCE
        source = "the file says so" if unit else f"steps of {step:g}"
        unit_line = f"time_unit = {toml_value(fitting[0])}  # {source}: {rate:.5g} Hz"
        lines = [f"time_column = {toml_value(name)}", unit_line]
        if stated and not agree:
            lines.append(f"# rate_hz = {stated[0]:g} stands in {stated[1]}, and the times say {rate:.5g}")
        return lines + (by_rate if agree else [])
    wanted = "? samples per second, as the sensor was set; or time_column = … and time_unit = … instead"
    return by_rate or [f"rate_hz = 0  # {wanted}"]


def _fits(step: float, unit: str) -> bool:
    return step > 0 and hints.RATES_HZ[0] <= NS_PER_S / (step * TIME_UNITS_NS[unit]) <= hints.RATES_HZ[1]


def _acc_line(layout: Layout, group: Group, numbers: hints.Numbers | None) -> str:
    stated = {stated_unit("acc", name, layout.units.get(name, "")) for name in group.names("acc")}
    named = stated.pop() if len(stated) == 1 else ""
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
    stated = {stated_unit("gyr", name, layout.units.get(name, "")) for name in group.names("gyr")}
    named = stated.pop() if len(stated) == 1 else ""
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
    if len(groups) != 1 or not groups[0].sensor or path.suffix.lower() != ".csv":
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


def _can_template() -> str:
    acc, gyr = (toml_value([f"? Message.{kind}_{axis}" for axis in "xyz"]) for kind in ("acc", "gyr"))
    return f"""\
acc_unit = "m/s^2"  # ? "m/s^2" or "g", after the DBC's scaling
gyr_unit = "rad/s"  # ? "rad/s" or "deg/s", after the DBC's scaling

[can]
dbc = "sensors.dbc"  # ? beside this file

[sensors."?"]  # {_WHICH}
acc = {acc}
gyr = {gyr}
"""
