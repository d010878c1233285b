"""References from their files: several as one; C3D of motion capture by the library ezc3d (extra ``c3d``)."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from fes.evaluation.reference.csv_file import event_name, read_csv
from fes.evaluation.reference.table import MarkerPath, Reference, ReferenceError, ReferenceEvent, foot_of
from fes.signals import FloatArray

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

    Raises:
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
        events = _events(data)
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


def _events(data: Mapping[str, Any]) -> list[ReferenceEvent]:
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

    Raises:
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
