"""A sidecar to start from: guessed from a file's column names and numbers, for whoever brings their own sensor."""

from __future__ import annotations

import re
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from fes.recording import csv_text
from fes.recording.csv_text import Dialect
from fes.recording.plausible import quiet_level
from fes.recording.table import Table
from fes.recording.toml_text import string_text, value_text
from fes.recording.tracks import RecordingError
from fes.recording.units import ACC_UNITS, GYR_UNITS, TIME_UNITS_NS
from fes.signals import G_MPS2, SENSORS, FloatArray

_KINDS = {
    "acc": re.compile(r"linacc|acceleration|accelerometer|accel|acc(?![a-z])|acc(?=[xyz]\b)|\ba(?=[xyz]\b)"),
    "gyr": re.compile(r"gyroscope|gyro|gyr|angular ?(velocity|rate|vel)|angvel|omega|\b[gw](?=[xyz]\b)"),
}
_OTHER = re.compile(r"mag|quat|temp|press|euler|roll|pitch|yaw|lin ?acc|free ?acc|linear ?acc")
_UNIT = re.compile(r"[(\[][^)\]]*[)\]]|\b(deg|rad|m) ?/ ?s(ec)?(\^?2|²)?|\b(mps2|radps|degps|dps)\b")
_AXIS = re.compile(r"\b([xyz])\b|([xyz])$")
_LEFT = re.compile(r"\bleft|\bl\b|\bl(?=foot|shank|shoe|f\b|s\b)|\bli\b|left")
_RIGHT = re.compile(r"\bright|\br\b|\br(?=foot|shank|shoe|f\b|s\b)|\bre\b|right")
_SHANK = re.compile(r"shank|shin|tibia|calf|lower ?leg|\b[lr]s\b")
_TIME = re.compile(r"\b(time|timestamp|t|sec|seconds|ms|millis|micros|ticks|sampletime\w*|zeit)\b|timestamp")
_PROBE_ROWS = 100_000


@dataclass
class _Group:
    """Columns whose names differ by kind and axis only: one sensor."""

    columns: dict[str, dict[str, str]] = field(default_factory=lambda: {"acc": {}, "gyr": {}})
    sensor: str = ""
    sure: bool = False

    def names(self, kind: str) -> list[str]:
        """Column names x, y, z; a placeholder where none was recognised."""
        return [self.columns[kind].get(axis, f"? {kind} {axis}") for axis in "xyz"]

    @property
    def whole(self) -> bool:
        """Are all six columns known?"""
        return all(len(axes) == 3 for axes in self.columns.values())


def sidecar_template(path: Path) -> str:
    """Return the text of a sidecar for a recording that has none; guesses that need a look are marked with “?”.

    Raises:
        RecordingError: the file itself is empty, damaged or no text.
    """
    if path.suffix.lower() not in (".csv", ".parquet"):
        return _can_template()
    dialect, names = _layout(path)
    groups = _group(names)
    time_name = next((name for name in names if _TIME.search(_plain(name)) and not _kind(_plain(name))), None)
    probe = _probe(path, dialect, groups, time_name)
    lines = [f"# {path.name} has these columns:", *(f"#   {name}" for name in names), ""]
    for setting in fields(Dialect):
        if getattr(dialect, setting.name) != setting.default:
            lines.append(f"{setting.name} = {value_text(getattr(dialect, setting.name))}")
    lines += _time_lines(time_name, probe, path)
    lines += _unit_lines(groups, probe)
    for group in groups:
        lines += ["", f"[sensors.{group.sensor}]{'' if group.sure else '  # ? one of ' + ', '.join(SENSORS)}"]
        lines += [f"{kind} = {value_text(group.names(kind))}" for kind in ("acc", "gyr")]
    if not all(group.whole for group in groups):
        lines.append("# ? put the columns' names, x, y, z, where a name starts with “?”")
    lines += [
        "",
        "# if known: belt_speed_mps, subject, description at the top; acc_range_g, gyr_range_degps per sensor",
    ]
    return "\n".join(lines) + "\n"


def _layout(path: Path) -> tuple[Dialect, list[str]]:
    if path.suffix.lower() == ".parquet":
        return Dialect(), Table.parquet_names(path)
    best = max((",", ";", "\t", "|"), key=lambda mark: len(csv_text.header(path, Dialect(mark))))
    rows = csv_text.lines(path, Dialect(best))
    names = next(rows)[1]
    first, second = next(rows, (0, []))[1], next(rows, (0, []))[1]
    dialect = Dialect(best)
    if first and not any(csv_text.NUMBER.fullmatch(cell.replace(",", ".")) for cell in first):
        stacked = len(set(names)) < len(names)
        dialect = Dialect(best, header_lines=2) if stacked else Dialect(best, skip_lines_after_header=1)
        names = csv_text.header(path, dialect)
    if best != "," and any(re.fullmatch(r"\s*[+-]?\d+,\d+\s*", cell) for cell in [*first, *second]):
        dialect = replace(dialect, decimal=",")
    return dialect, names


def _plain(name: str) -> str:
    """Lower case, words apart: ``LeftFoot_AccX`` → ``left foot acc x``."""
    spaced = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", " ", name)
    return re.sub(r"[_\-.:\s]+", " ", spaced).strip().lower()


def _kind(plain: str) -> str:
    if _OTHER.search(plain):
        return ""
    return next((kind for kind, pattern in _KINDS.items() if pattern.search(plain)), "")


def _group(names: list[str]) -> list[_Group]:
    """Sort columns into sensors by what of their names is neither kind, axis nor unit."""
    groups: dict[str, _Group] = {}
    for name in names:
        plain = re.sub(r"\s+", " ", _UNIT.sub(" ", _plain(name))).strip()
        kind = _kind(plain)
        axis = _AXIS.search(_KINDS[kind].sub(" ", plain)) if kind else None
        if not kind or axis is None:
            continue
        rest = _AXIS.sub(" ", _KINDS[kind].sub(" ", plain), count=1)
        group = groups.setdefault(" ".join(rest.split()), _Group())
        group.columns[kind].setdefault(axis.group(1) or axis.group(2), name)
    whole = {key: group for key, group in groups.items() if group.whole}
    chosen = dict(list((whole or groups).items())[: len(SENSORS)]) or {"": _Group()}
    for key, group in chosen.items():
        side = "left" if _LEFT.search(key) else "right" if _RIGHT.search(key) else ""
        sensor = f"{side or 'left'}_{'shank' if _SHANK.search(key) else 'foot'}"
        taken = {other.sensor for other in chosen.values()}
        group.sure = bool(side) and sensor not in taken
        group.sensor = sensor if sensor not in taken else next(name for name in SENSORS if name not in taken)
    return sorted(chosen.values(), key=lambda group: SENSORS.index(group.sensor))


def _probe(path: Path, dialect: Dialect, groups: list[_Group], time_name: str | None) -> dict[str, Any]:
    """Read the first sensor's numbers and the times, as far as they can be read."""
    out: dict[str, Any] = {}
    times = [time_name] if time_name else []
    try:
        values = [*groups[0].names("acc"), *groups[0].names("gyr")] if groups[0].whole else []
        table = Table(path, times + values, times, dialect)
        if time_name:
            steps = np.diff(table.times_ns(time_name, 1_000).astype(np.float64) / 1_000)
            out["step"] = float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0
        if values:
            data: FloatArray = np.column_stack([table.numbers(name)[:_PROBE_ROWS] for name in values])
            data = data[np.isfinite(data).all(axis=1)]
            quiet = quiet_level(np.ascontiguousarray(data[:, :3]), np.ascontiguousarray(data[:, 3:]), 100.0)
            out["gravity"] = quiet.acc
            out["peak"] = float(np.percentile(np.linalg.norm(data[:, 3:], axis=1), 99.0))
    except (RecordingError, ValueError, IndexError):
        return out  # the guesses stay marked; reading with the finished sidecar tells what is wrong
    return out


def _time_lines(time_name: str | None, probe: dict[str, Any], path: Path) -> list[str]:
    if time_name is None:
        return ["rate_hz = 0  # ? samples per second (not guessed); or time_column = … and time_unit = …"]
    step = probe.get("step", 0.0)
    fitting = [unit for unit, ns in TIME_UNITS_NS.items() if step > 0 and 20.0 <= 1e9 / (step * ns) <= 5000.0]
    mark = "" if len(fitting) == 1 else '  # ? "s", "ms", "us" or "ns"'
    return [f"time_column = {string_text(time_name)}", f'time_unit = "{fitting[0] if fitting else "s"}"{mark}']


def _unit_lines(groups: list[_Group], probe: dict[str, Any]) -> list[str]:
    gravity, peak = probe.get("gravity", 0.0), probe.get("peak", 0.0)
    acc = next((unit for unit, size in ACC_UNITS.items() if 0.75 <= gravity * size / G_MPS2 <= 1.33), "")
    gyr = next((unit for unit, size in GYR_UNITS.items() if 1.0 <= peak * size <= 40.0), "")
    acc_line = f'acc_unit = "{acc}"' if acc else 'acc_unit = "m/s^2"  # ? "m/s^2" or "g"'
    if not acc and gravity > 20.0:
        acc_line = f"acc_unit = {G_MPS2 / gravity:.6g}  # ? m/s² per count: at rest it reads {gravity:.5g}"
    gyr_line = f'gyr_unit = "{gyr}"' if gyr else 'gyr_unit = "deg/s"  # ? "rad/s" or "deg/s"'
    return [acc_line, gyr_line]


def _can_template() -> str:
    sensor = [f"{kind} = {value_text([f'? Message.{kind}_{axis}' for axis in 'xyz'])}" for kind in ("acc", "gyr")]
    return "\n".join(
        [
            'acc_unit = "m/s^2"  # ? "m/s^2" or "g", after the DBC\'s scaling',
            'gyr_unit = "rad/s"  # ? "rad/s" or "deg/s", after the DBC\'s scaling',
            "",
            "[can]",
            'dbc = "sensors.dbc"  # ? beside this file',
            "",
            f"[sensors.left_foot]  # ? one of {', '.join(SENSORS)}",
            *sensor,
            "",
        ]
    )
