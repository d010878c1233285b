"""References from their files: several as one; C3D of motion capture by the library ezc3d (extra ``c3d``).

References as CSV: which of eight kinds a table is, told by its columns.

| kind | columns (units in the names: ``t_s``, ``t_ms``, ``x_mm`` …) |
|---|---|
| strides | foot, t_start, t_end, and any of stride_length, clearance, toe_clearance, heel_clearance, foot_strike … |
| events | foot, event (IC, FO), t |
| mat | foot, t_contact, and any of t_off, x, y, stride_length: a row for each footfall |
| switch | t, and a column for each switch whose name begins with left or right |
| path | t, x, y, z; or t and columns such as left_heel_x, left_heel_y, left_heel_z |
| belt | t, speed |
| orientation | t, q_w, q_x, q_y, q_z (sensor to world, z up), and perhaps sensor, moving |
| end | end_distance and end_height: where the whole walk ended, seen from its start; and perhaps foot |

A mat's stride length is the distance between successive contacts of the same foot, whatever the direction (heel to
heel); that of a walk with turns is measured along straight lines as well.
"""

import re
from collections.abc import Iterable, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from fes.evaluation.reference.table import (
    POINTS,
    MarkerPath,
    Reference,
    ReferenceEnd,
    ReferenceError,
    ReferenceEvent,
    ReferenceStride,
    Table,
    foot_of,
    read_columns,
)
from fes.signals import FloatArray

ON_SHARE, OFF_SHARE = 0.6, 0.4  # of the way from the released to the pressed level: hysteresis
BOUNCE_S = 0.05  # shorter pauses and touches are bouncing contacts
LONGEST_STRIDE_S = 4.0  # beyond: the walker left the mat and came back
LATEST_S: Final = 4e9  # seconds since 1970 are below it; as ns they still fit 64 bits
TIME: Final = ("t", "time", "seconds", "timestamp")
CONTACT: Final = ("t_contact", "t_initial_contact", "t_loading_response", "first_contact", "contact_time")
QUATERNION: Final = ("q_w", "q_x", "q_y", "q_z")
OFF: Final = ("t_off", "t_foot_off", "t_swing", "last_contact", "off_time")
EVENT_NAMES: Final = {
    "IC": ("ic", "initialcontact", "footstrike", "heelstrike", "hs", "contact", "footcontact"),
    "FO": ("fo", "footoff", "toeoff", "to", "terminalcontact", "tc", "off"),
}
_LENGTHS: Final = ("stride_length", "clearance", "toe_clearance", "heel_clearance", "height_gained")
_VALUES: Final = {name: f"{name}_m" for name in _LENGTHS} | {
    **{name: f"{name}_s" for name in ("stride_time", "stance_time", "swing_time")},
    **dict.fromkeys(("foot_strike", "foot_strike_angle"), "foot_strike_rad"),
    **dict.fromkeys(("speed", "stride_velocity"), "speed_mps"),
}
_ENDS: Final = ("end_distance", "end_height")
_MARKER: Final = re.compile(r"(left|right|l|r)_(?:foot_)?(\w+)_x")


def read_csv(path: Path, *, foot: str | None = None) -> Reference:
    """Read one CSV; ``foot`` is whose it is where it does not say.

    ReferenceError: it cannot be read, or is of no known kind.
    """
    table = read_columns(path)
    kind = kind_of(table)
    if kind is None:
        raise ReferenceError(
            f"{path}: its columns ({', '.join(table.columns)}) are those of no known kind of reference. Needed are "
            f"foot, t_start, t_end (strides); foot, event, t (events); foot, t_contact (step mat); t and left…, right… "
            f"(foot switches); t, x, y, z (a marker's path); t, speed (a belt); t, q_w, q_x, q_y, q_z (orientation); "
            f"or end_distance, end_height (a walk's end)"
        )
    if kind == "orientation":
        raise ReferenceError(f"{path}: orientations are held against a sensor alone; name no other reference")
    readers = {"strides": _strides, "events": _events, "mat": _mat, "switch": _switch, "path": _paths}
    readers |= {"belt": _belt, "end": _end}
    try:
        found = readers[kind](table, foot)
    except KeyError as error:
        raise ReferenceError(f"{path}: as {kind} it lacks a column {error.args[0]!r}") from error
    times = [event.t_s for event in found.events] + [stride.t_end_s for stride in found.strides]
    times += [float(t) for path_ in found.paths for t in (path_.t_s[0], path_.t_s[-1])] + found.belt[:, 0].tolist()
    if any(not abs(t) < LATEST_S for t in times):
        raise ReferenceError(f"{path}: holds a time beyond {LATEST_S:g} s; is the unit of its time column right?")
    return found


def kind_of(table: Table) -> str | None:
    """What a table is by its columns, as listed at the top of this module; None where they fit nothing."""
    names, timed = set(table.columns), table.first_of(*TIME) is not None
    switches = any(_switch_foot(name) for name in names)
    marker = {"x", "y", "z"} <= names or any(_MARKER.fullmatch(name) for name in names)
    kinds = (
        ("orientation", timed and set(QUATERNION) <= names),
        ("end", bool(names & set(_ENDS))),
        ("strides", {"t_start", "t_end"} <= names),
        ("events", timed and "event" in names),
        ("mat", table.first_of(*CONTACT) is not None),
        ("path", timed and marker),
        ("belt", timed and table.first_of("speed", "belt_speed") is not None and not switches),
        ("switch", timed and switches),
    )
    return next((kind for kind, fits in kinds if fits), None)


def _time(table: Table) -> FloatArray:
    name = table.first_of(*TIME)
    if name is None:
        raise KeyError("t_s")
    t_s = table.numbers(name)
    bad = np.flatnonzero(~np.isfinite(t_s))
    if len(bad):
        raise ReferenceError(f"{table.line(int(bad[0]))}: the time is empty")
    return t_s


def _increasing(table: Table) -> FloatArray:
    t_s = _time(table)
    back = np.flatnonzero(np.diff(t_s) <= 0.0)
    if len(back):
        raise ReferenceError(f"{table.line(int(back[0]) + 1)}: the time does not increase")
    if len(t_s) < 3:
        raise ReferenceError(f"{table.path}: holds fewer than three samples")
    return t_s


def _strides(table: Table, foot: str | None) -> Reference:
    values = {name: table.numbers(name) for name in table.columns if name in _VALUES}
    start, end = table.numbers("t_start"), table.numbers("t_end")
    usable = np.ones(table.rows, dtype=bool)
    for name in ("steady", "walking", "valid"):
        if name in table.columns:
            usable &= np.array(table.flags(name))
    wrong = np.flatnonzero(~(np.isfinite(start) & np.isfinite(end) & (start < end)))
    if len(wrong):
        raise ReferenceError(f"{table.line(int(wrong[0]))}: t_end must be after t_start")
    feet = table.feet(foot)
    strides, events = [], []
    for k in range(table.rows):
        known = {_VALUES[name]: float(column[k]) for name, column in values.items() if np.isfinite(column[k])}
        strides.append(ReferenceStride(feet[k], float(start[k]), float(end[k]), known, bool(usable[k])))
    soft = table.columns.get("contact", [""] * table.rows)
    for what, names in (("IC", CONTACT), ("FO", OFF)):
        if column := table.first_of(*names):
            times = table.numbers(column)
            events += [
                ReferenceEvent(float(times[k]), feet[k], what)
                for k in range(table.rows)
                if np.isfinite(times[k]) and not (what == "IC" and soft[k] == "soft")
            ]
    strides.sort(key=lambda stride: stride.t_start_s)
    return Reference((str(table.path),), tuple(sorted(events)), tuple(strides))


def _events(table: Table, foot: str | None) -> Reference:
    t_s, feet = _time(table), table.feet(foot)
    events = []
    for row, text in enumerate(table.columns["event"]):
        what = event_name(text)
        if what is None:
            raise ReferenceError(f"{table.line(row)}: {text!r} is no event known here; IC and FO are")
        events.append(ReferenceEvent(float(t_s[row]), feet[row], what))
    return Reference((str(table.path),), tuple(sorted(events)))


def event_name(text: str) -> str | None:
    """IC or FO for the names that laboratories give them; None for others."""
    plain = re.sub(r"[^a-z]", "", text.lower())
    return next((what for what, aliases in EVENT_NAMES.items() if plain in aliases), None)


def _mat(table: Table, foot: str | None) -> Reference:
    """Events and strides of K footfalls, in any order.

    ``contact_s`` (K,) is initial contact, or any one moment at which the foot stood there; ``place_m`` (K, 2) where it
    stood; ``length_m`` (K,) the stride length that ends with this footfall, if the mat says so itself.
    """
    source, feet = str(table.path), table.feet(foot)
    contact_s = table.numbers(table.first_of(*CONTACT) or "t_contact")
    off_s, length_m = (table.numbers(n) if n else None for n in (table.first_of(*OFF), table.first_of("stride_length")))
    place_m = np.column_stack([table.numbers("x"), table.numbers("y")]) if {"x", "y"} <= set(table.columns) else None
    early = off_s <= contact_s if off_s is not None else np.zeros(0, np.bool_)
    for wrong, what in ((~np.isfinite(contact_s), "has no time of contact"), (early, "leaves before it came")):
        if wrong.any():
            raise ReferenceError(f"{source}: footfall {int(np.flatnonzero(wrong)[0]) + 1} {what}")
    events, strides = [], []
    whose = np.array(feet)
    for foot in dict.fromkeys(feet):
        mine = np.flatnonzero(whose == foot)
        mine = mine[np.argsort(contact_s[mine], kind="stable")]
        events += [ReferenceEvent(float(contact_s[k]), foot, "IC") for k in mine]
        if off_s is not None:
            events += [ReferenceEvent(float(off_s[k]), foot, "FO") for k in mine if np.isfinite(off_s[k])]
        for before, after in pairwise(mine.tolist()):
            if not 0.0 < contact_s[after] - contact_s[before] <= LONGEST_STRIDE_S:
                continue
            values = {}
            if length_m is not None and np.isfinite(length_m[after]):
                values["stride_length_m"] = float(length_m[after])
            elif place_m is not None:
                values["stride_length_m"] = float(np.hypot(*(place_m[after] - place_m[before])))
            strides.append(ReferenceStride(foot, float(contact_s[before]), float(contact_s[after]), values))
    strides.sort(key=lambda stride: stride.t_start_s)
    return Reference((source,), tuple(sorted(events)), tuple(strides))


def switch_events(source: str, foot: str, t_s: FloatArray, signals: list[FloatArray]) -> list[ReferenceEvent]:
    """The foot is down while any of its switches is pressed: IC where the first closes, FO where the last opens.

    Times (N,) increase; each of the signals (N,) has two levels, or is a pressure of which the 2nd and 98th percentile
    are taken for the levels. ``source`` is the file, for messages.

    ReferenceError: none of the switches ever changes.
    """
    down = np.zeros(len(t_s), dtype=bool)
    changed = False
    for values in signals:
        low, high = np.nanpercentile(values, [2.0, 98.0]) if np.isfinite(values).any() else (0.0, 0.0)
        if high > low:
            changed = True
            down |= _pressed((values - low) / (high - low))
    if not changed:
        raise ReferenceError(f"{source}: the switches of the {foot.replace('_', ' ')} never change; is one broken?")
    at = np.flatnonzero(np.diff(down.astype(np.int8)))
    edges = at[without_bounces(t_s[at + 1])].tolist()
    return [ReferenceEvent(float(0.5 * (t_s[k] + t_s[k + 1])), foot, "IC" if down[k + 1] else "FO") for k in edges]


def without_bounces(edges_s: FloatArray) -> list[int]:
    """Which of a contact's edges at times (N,) are neither followed by their opposite at once nor such opposites."""
    kept: list[int] = []
    for k, at_s in enumerate(edges_s.tolist()):
        if kept and at_s - edges_s[kept[-1]] < BOUNCE_S:
            kept.pop()
        else:
            kept.append(k)
    return kept


def _pressed(level: FloatArray) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Schmitt trigger over a level of 0 to 1; a missing sample keeps the state."""
    state = np.where(level >= ON_SHARE, 1, np.where(level <= OFF_SHARE, 0, -1))
    known = np.flatnonzero(state >= 0)
    if not len(known):
        return np.zeros(len(level), dtype=bool)
    last = np.maximum.accumulate(np.where(state >= 0, np.arange(len(level)), known[0]))
    return np.asarray(state[last] == 1)


def _switch(table: Table, foot: str | None) -> Reference:
    t_s = _increasing(table)
    by_foot: dict[str, list[FloatArray]] = {}
    for name in table.columns:
        if whose := _switch_foot(name):
            by_foot.setdefault(whose, []).append(table.numbers(name))
    source = str(table.path)
    events = [event for whose, signals in by_foot.items() for event in switch_events(source, whose, t_s, signals)]
    return Reference((source,), tuple(sorted(events)))


def _switch_foot(name: str) -> str | None:
    return foot_of(name.split("_")[0]) if not name.endswith(("_x", "_y", "_z")) else None


def _paths(table: Table, foot: str | None) -> Reference:
    t_s, paths, notes = _increasing(table), [], []
    if {"x", "y", "z"} <= set(table.columns):
        whose = table.feet(foot)[0]
        position = np.column_stack([table.numbers(axis) for axis in "xyz"])
        paths.append(MarkerPath(whose, "sensor", t_s, position))
        notes.append(f"{table.path.name}: taken for the path of the sensor on the {whose.replace('_', ' ')}")
    for name in table.columns:
        found = _MARKER.fullmatch(name)
        if found is None:
            continue
        side, point = foot_of(found[1]), found[2]
        if side is None or point not in POINTS:
            raise ReferenceError(
                f"{table.path}: column {name!r}: a marker is one of {', '.join(POINTS)}, not {point!r}"
            )
        base = name.removesuffix("_x")
        position = np.column_stack([table.numbers(f"{base}_{axis}") for axis in "xyz"])
        paths.append(MarkerPath(side, point, t_s, position))
    return Reference((str(table.path),), paths=tuple(paths), notes=tuple(notes))


def _belt(table: Table, foot: str | None) -> Reference:
    name = table.first_of("speed", "belt_speed") or "speed"
    t_s, speed = _increasing(table), table.numbers(name)
    if not np.isfinite(speed).all() or np.abs(speed).max() > 10.0:
        raise ReferenceError(
            f"{table.path}: a belt's speed is known at all times and below 10 m/s; is it in km/h (speed_kmh)?"
        )
    return Reference((str(table.path),), belt=np.column_stack([t_s, speed]))


def orientation_columns(table: Table) -> tuple[FloatArray, FloatArray, npt.NDArray[np.bool_]]:
    """Times (N,), quaternions (N, 4) and where the body is said to move (N,), everywhere if nothing says so."""
    t_s = _increasing(table)
    quaternion = np.column_stack([table.numbers(name) for name in QUATERNION])
    moving = np.array(table.flags("moving")) if "moving" in table.columns else np.ones(table.rows, dtype=np.bool_)
    return t_s, quaternion, moving


def _end(table: Table, foot: str | None) -> Reference:
    feet = table.feet(foot)
    known = [table.numbers(name) if name in table.columns else np.full(table.rows, np.nan) for name in _ENDS]
    if len(set(feet)) < len(feet) or not np.isfinite(known).any() or np.nanmin(known[0], initial=0.0) < 0.0:
        raise ReferenceError(f"{table.path}: needs one row a foot, with end_distance (not negative) or end_height")
    ends = (ReferenceEnd(feet[k], float(known[0][k]), float(known[1][k])) for k in range(table.rows))
    return Reference((str(table.path),), ends=tuple(ends))


USUAL_LABELS: Final = {
    "heel": ("HEE", "HEEL", "FCC", "CAL", "CALC"),
    "toe": ("TOE", "D2MT", "MT2", "HALLUX"),
    "sensor": ("IMU", "SENSOR", "INSTEP"),
}
METRES: Final = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}
_TO_Z_UP: Final = {"z": (0, 1, 2), "y": (2, 0, 1), "x": (1, 2, 0)}  # a turn, so that left stays left
_TABLES = ("events", "strides", "path", "reference", "belt", "mat", "switch", "orientation", "end")
_ENDINGS = (*(f".{kind}.csv" for kind in _TABLES), ".c3d")


def read_c3d(path: Path, *, markers: Mapping[str, tuple[str, str]] | None = None, up: str = "z") -> Reference:
    """Read markers and events of a C3D file; times count from the trial's first frame number 1 on, as events do.

    ``markers`` are label → (foot, point), without it labels as in LHEE, RTOE, L_FCC, right_heel; ``up`` is the
    laboratory's vertical axis.

    ReferenceError: it cannot be read, holds nothing of the feet, or ezc3d is not installed.
    """
    if not path.is_file():
        raise ReferenceError(f"{path}: is not there. Name a C3D file.")
    try:
        import ezc3d
    except ImportError as error:
        raise ReferenceError(f"{path}: reading C3D needs ezc3d: pip install 'fes-gait[c3d]'") from error
    try:
        data: Mapping[str, Any] = ezc3d.c3d(str(path))
    except (OSError, ValueError, RuntimeError, KeyError, IndexError) as error:
        raise ReferenceError(f"{path}: is no readable C3D file: {error}") from error
    try:
        paths, unused = _markers(path, data, markers, up)
        events = _c3d_events(data)
    except (KeyError, IndexError, TypeError) as error:
        raise ReferenceError(f"{path}: lacks what a C3D file of motion capture holds: {error}") from error
    if not paths and not events:
        raise ReferenceError(
            f"{path}: holds neither events nor a marker that is known to be on a foot; its markers are "
            f"{', '.join(unused[:20]) or 'none'}. Name them: --marker LABEL=left_foot.heel"
        )
    return Reference((str(path),), tuple(sorted(events)), paths=tuple(paths))


def _markers(
    path: Path, data: Mapping[str, Any], markers: Mapping[str, tuple[str, str]] | None, up: str
) -> tuple[list[MarkerPath], list[str]]:
    group = data["parameters"]["POINT"]
    labels = [str(label).strip() for label in group["LABELS"]["value"]]
    units = group["UNITS"]["value"] if "UNITS" in group else []
    unit = str(units[0]).strip().lower() if len(units) else "mm"
    if unit not in METRES:
        raise ReferenceError(f"{path}: markers are in {unit!r}; mm, cm and m are known")
    for label in markers or {}:
        if label not in labels:
            raise ReferenceError(f"{path}: has no marker {label!r}; it has {', '.join(labels[:40])}")
    rate_hz = float(data["header"]["points"]["frame_rate"])
    points = np.asarray(data["data"]["points"], np.float64)[:3]
    if points.shape[2] < 3 or rate_hz <= 0.0:
        return [], labels
    t_s = (int(data["header"]["points"]["first_frame"]) + np.arange(points.shape[2])) / rate_hz
    found: dict[tuple[str, str], MarkerPath] = {}
    unused = []
    for k, label in enumerate(labels[: points.shape[1]]):
        named = (markers.get(label) if markers else None) or (None if markers else place_of_label(label))
        if named is None:
            unused.append(label)
            continue
        if named in found:
            raise ReferenceError(
                f"{path}: two markers are taken for the {named[0]} {named[1]}; say which: --marker LABEL=…"
            )
        found[named] = MarkerPath(*named, t_s, METRES[unit] * points[list(_TO_Z_UP[up]), k].T)
    return list(found.values()), unused


def place_of_label(label: str) -> tuple[str, str] | None:
    """(foot, point) for the labels that laboratories use, with or without a subject's name before a colon."""
    name = label.rsplit(":", 1)[-1].strip()
    for parts in (name.split("_", 1), [name[:1], name[1:]]):
        foot = foot_of(parts[0]) if len(parts) == 2 else None
        if foot is None:
            continue
        rest = parts[1].upper().removeprefix("FOOT_")
        for point, labels in USUAL_LABELS.items():
            if rest in labels:
                return foot, point
    return None


def _c3d_events(data: Mapping[str, Any]) -> list[ReferenceEvent]:
    group = data["parameters"].get("EVENT")
    if not group or "TIMES" not in group:
        return []
    times: FloatArray = np.asarray(group["TIMES"]["value"], np.float64)
    if times.size == 0:
        return []
    seconds = 60.0 * times[0] + times[1] if times.ndim == 2 else times
    contexts, labels = ([str(text) for text in group[key]["value"]] for key in ("CONTEXTS", "LABELS"))
    events = []
    for t, context, label in zip(seconds.tolist(), contexts, labels, strict=False):
        foot, what = foot_of(context), event_name(label)
        if foot is not None and what is not None:
            events.append(ReferenceEvent(float(t), foot, what))
    return events


def read_references(
    paths: Iterable[Path],
    *,
    foot: str | None = None,
    markers: Mapping[str, tuple[str, str]] | None = None,
    up: str = "z",
) -> Reference:
    """Read files, CSV or C3D, and join them.

    ``foot`` is whose a table without a column for it is; ``markers`` and ``up`` as of :func:`read_c3d`.

    ReferenceError: one cannot be used, or two say the same thing.
    """
    whole = Reference()
    for path in map(Path, paths):
        suffix = path.suffix.lower()
        if suffix == ".c3d":
            whole = whole.joined(read_c3d(path, markers=markers, up=up))
        elif suffix in (".csv", ".txt", ".tsv"):
            whole = whole.joined(read_csv(path, foot=foot))
        else:
            raise ReferenceError(f"{path}: references are .csv or .c3d files, not {suffix or 'files without a suffix'}")
    return whole


def companion_references(recording: Path) -> list[Path]:
    """The references that lie beside a recording under its name, as `fes import` writes them."""
    stem = recording.name.split(".", 1)[0]
    return [path for suffix in _ENDINGS if (path := recording.with_name(stem + suffix)).is_file()]
