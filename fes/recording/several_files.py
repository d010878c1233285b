"""One sensor whose accelerometer and gyroscope are files of their own: in a folder, in a zip, or beside each other.

Phones write so. Sensor Logger (github.com/tszheichoi/awesome-sensor-logger: README, UNITS, CROSSPLATFORM):
``TotalAcceleration.csv`` of Android has gravity in it, ``Accelerometer.csv`` has not, ``Gravity.csv`` is to be added;
m/s² and rad/s; an iPhone gives accelerations with the other sign unless "Standardise Units & Frames" was on, which
``Metadata.csv`` tells. phyphox: ``Accelerometer.csv`` with gravity in m/s², of the right sign on every phone (``kG`` in
its ExperimentSensorInput.swift), ``Gyroscope.csv`` in rad/s, a folder ``meta``.

The files become one table on the clock of the triad that comes faster; what follows takes it as any other file's.
"""

from __future__ import annotations

import csv
import os
import re
import shutil
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory
from typing import Final

import numpy as np

from fes.recording.csv_layout import Dialect
from fes.recording.naming import plain
from fes.recording.sidecar import SensorColumns
from fes.recording.table import Table
from fes.recording.tracks import RecordingError
from fes.recording.units import GAP_INTERVALS, refuse_wild_clock, repaired, usual_interval_ns
from fes.signals import NS_PER_S, FloatArray, IntArray

MOST_BYTES: Final = 2 << 30  # unpacked: a day at 200 Hz makes 1.6 GB in each of Sensor Logger's files
_MOST_ENTRIES: Final = 10_000  # of a folder that is looked through
_ZIP: Final = (b"PK\x03\x04", b"PK\x05\x06")
_OTHERS: Final = re.compile(r"watch|wrist|headphone|linear|(user|free) ?acc|magnet|orientation")
_KINDS: Final = {
    "total": re.compile(r"total ?acceleration"),
    "gravity": re.compile(r"gravity"),
    "acc": re.compile(r"accelerometer|acceleration|accel\b|\bacc\b"),
    "gyr": re.compile(r"gyroscope|gyro\b|\bgyr\b|rotation ?rate|angular ?velocity"),
}
_RAW: Final = re.compile(r"\buncal(ibrated)?\b")
_WANTED: Final = "one accelerometer file and one gyroscope file, such as Accelerometer.csv and Gyroscope.csv"


@dataclass(frozen=True)
class Files:
    """The files of one sensor in a folder ``inside`` another or a zip: what each is → its name."""

    inside: PurePosixPath
    names: dict[str, str] = field(default_factory=dict)

    @property
    def acc(self) -> str:
        """The accelerometer's file: with gravity before without, calibrated before raw."""
        preferred = ("total", "acc", "acc raw") if "gravity" in self.names else ("total", "acc raw", "acc")
        return next((self.names[kind] for kind in preferred if kind in self.names), "")

    @property
    def gyr(self) -> str:
        """The gyroscope's file."""
        return self.names.get("gyr", self.names.get("gyr raw", ""))

    @property
    def gravity(self) -> str:
        """The file that is to be added to an accelerometer's without gravity, "" where there is none."""
        return self.names.get("gravity", "") if self.acc == self.names.get("acc") else ""


def is_zip(path: Path) -> bool:
    """By its name or its first bytes."""
    with suppress(OSError), path.open("rb") as file:
        return path.suffix.lower() == ".zip" or file.read(4) in _ZIP
    return False


def companion_files(path: Path) -> Files | None:
    """The files of the sensor of which this file holds one triad; None where it is none of two."""
    beside = [PurePosixPath(other.name) for other in path.parent.iterdir() if other.is_file()]
    return next((files for files in _groups(beside) if path.name in files.names.values()), None)


@contextmanager
def opened(path: Path) -> Iterator[tuple[Path, Files]]:
    """Where a recording's files can be read, and which they are: of a folder or a zip, or those beside a file.

    Raises:
        RecordingError: there is no zip, it is damaged, locked, too large or unsafe, or not of one sensor.
    """
    if path.is_dir():
        files = _only(path, _listed(path))
        yield path / files.inside, files
    elif is_zip(path):
        with TemporaryDirectory() as folder:
            files = _unpacked(path, Path(folder))
            try:
                yield Path(folder), files
            except RecordingError as error:  # who reads it knows the zip, not where it was unpacked
                raise RecordingError(str(error).replace(f"{folder}{os.sep}", f"{path}/")) from error
    else:
        yield path.parent, companion_files(path) or Files(PurePosixPath())


def _groups(members: list[PurePosixPath]) -> list[Files]:
    """The sensors of which both triads are among these files."""
    found: dict[tuple[PurePosixPath, str], Files] = {}
    for member in sorted(members):
        words = plain(member.stem)
        if member.suffix.lower() not in (".csv", ".txt") or member.name.startswith(".") or _OTHERS.search(words):
            continue
        kind = next((kind for kind, pattern in _KINDS.items() if pattern.search(words)), "")
        if kind:
            rest = " ".join(_RAW.sub(" ", _KINDS[kind].sub(" ", words)).split())
            files = found.setdefault((member.parent, rest), Files(member.parent))
            files.names.setdefault(kind + (" raw" if _RAW.search(words) else ""), member.name)
    return [files for files in found.values() if files.acc and files.gyr]


def _only(path: Path, members: list[PurePosixPath]) -> Files:
    groups = _groups([member for member in members if "__MACOSX" not in member.parts])
    if not groups:
        if "[Content_Types].xml" in map(str, members):
            raise RecordingError(f"{path}: is a spreadsheet. Save its table as CSV and name that file.")
        what = "a folder" if path.is_dir() else "a zip"
        raise RecordingError(
            f"{path}: is {what} that does not hold {_WANTED}. Name a recording's file (.csv, .parquet …), or "
            "export both."
        )
    if len(groups) > 1:
        names = "; ".join(f"{files.inside / files.acc} and {files.gyr}" for files in groups)
        raise RecordingError(
            f"{path}: holds the files of {len(groups)} sensors: {names}. Put each sensor's files into a folder or zip "
            "of its own, name one, and give the other to a second sensor of its sidecar (file = …)."
        )
    return groups[0]


def _listed(folder: Path) -> list[PurePosixPath]:
    """Files of a folder and of the folders in it."""
    try:
        entries = sorted(folder.iterdir())[:_MOST_ENTRIES]
        inner = [each for entry in entries if entry.is_dir() for each in entry.iterdir()][:_MOST_ENTRIES]
    except OSError as error:
        raise RecordingError(f"{folder}: cannot be read: {error.strerror or error}") from error
    return [PurePosixPath(entry.relative_to(folder).as_posix()) for entry in (*entries, *inner) if entry.is_file()]


def _unpacked(path: Path, folder: Path) -> Files:
    """Put the files of the sensor of a zip into a folder, under their bare names."""
    try:
        with zipfile.ZipFile(path) as archive:
            members = {PurePosixPath(info.filename.replace("\\", "/")): info for info in archive.infolist()}
            unsafe = [name for name in members if ".." in name.parts or name.is_absolute() or ":" in str(name)]
            if unsafe:
                raise RecordingError(
                    f"{path}: has a member {str(unsafe[0])!r}, which leads out of its folder: no device writes that. "
                    "Export the recording again."
                )
            files = _only(path, list(members))
            names = [*files.names.values(), *(n.name for n in members if n.parent == files.inside and _is_about(n))]
            wanted = [members[files.inside / name] for name in names]
            size = sum(info.file_size for info in wanted)
            if size > MOST_BYTES:
                raise RecordingError(
                    f"{path}: would unpack to {size / 2**30:.1f} GB, more than {MOST_BYTES >> 30} GB. If that is "
                    "right, unpack it yourself and name the folder."
                )
            if any(info.flag_bits & 1 for info in wanted):
                raise RecordingError(f"{path}: is locked by a password. Unpack it and name the folder.")
            for name, info in zip(names, wanted, strict=True):
                with archive.open(info) as packed, (folder / name).open("wb") as out:
                    shutil.copyfileobj(packed, out)
    except (zipfile.BadZipFile, zlib.error, NotImplementedError, EOFError, RuntimeError) as error:
        raise RecordingError(
            f"{path}: cannot be read as a zip: {error}. Copy or export it again, or unpack it and name the folder."
        ) from error
    except OSError as error:
        raise RecordingError(f"{path}: cannot be unpacked: {error.strerror or error}") from error
    return files


def _is_about(member: PurePosixPath) -> bool:
    return member.name.lower() == "metadata.csv"


def acc_sign_of(folder: Path) -> int | None:
    """1 or -1 as Sensor Logger's ``Metadata.csv`` tells (see above), None where there is none or it does not say."""
    for path in folder.iterdir():
        if _is_about(PurePosixPath(path.name)):
            with suppress(OSError, UnicodeDecodeError, csv.Error, StopIteration):
                with path.open(encoding="utf-8-sig", newline="") as file:
                    about = next(csv.DictReader(file))
                platform = str(about.get("platform", "")).strip().lower()
                same = str(about.get("standardisation", "")).strip().lower() in ("true", "1", "yes")
                return {"ios": 1 if same else -1, "android": 1}.get(platform)
    return None


@dataclass(frozen=True)
class _Triad:
    """What one file holds: (N,) increasing stamps, (N, 3) values in its unit, and how many stamps were repaired."""

    t_ns: IntArray
    values: FloatArray
    repaired: int


def joined_table(
    source: Path, sensor: str, columns: SensorColumns, dialect: Dialect
) -> tuple[Table, SensorColumns, int]:
    """Make one table of a sensor's files, on the faster triad's clock; what is lost of either is an empty row.

    The values of the other are interpolated between neighbours that follow each other; a gap stays one.

    Returns:
        The table, the columns that it has of the sensor, and how many stamps were repaired.

    Raises:
        RecordingError: a file is missing or damaged, or their times do not overlap.
    """
    import pyarrow as pa

    with opened(source) as (folder, _):

        def triad(name: str | None, names: tuple[str, ...], time: str | None = None) -> _Triad:
            return _triad(folder / (name or ""), names, time or columns.time_column or "", columns.unit_ns, dialect)

        acc = triad(columns.acc_file or source.name, columns.acc)
        gyr = triad(columns.gyr_file, columns.gyr, columns.gyr_time_column)
        if columns.gravity_file:
            gravity = triad(columns.gravity_file, columns.acc)
            added, known = _at(acc.t_ns, gravity)
            acc = _Triad(acc.t_ns[known], acc.values[known] + added[known], acc.repaired + gravity.repaired)
    where = f"{source}: {sensor}"
    base, other = (acc, gyr) if usual_interval_ns(acc.t_ns) <= usual_interval_ns(gyr.t_ns) else (gyr, acc)
    first, last = max(acc.t_ns[0], gyr.t_ns[0]), min(acc.t_ns[-1], gyr.t_ns[-1])
    if first >= last:
        raise RecordingError(
            f"{where}: the times of {columns.acc_file or source.name} and {columns.gyr_file} do not overlap: their "
            "clocks have different origins, or they are of two recordings. Export both from one recording."
        )
    # the two do not begin and end at one instant; what one of them lacks for longer than a second is lost
    ends = ((first, base.t_ns[0]), (last, base.t_ns[-1]))
    first, last = (edge if abs(edge - end) < NS_PER_S else end for edge, end in ends)
    rows = (base.t_ns >= first) & (base.t_ns <= last)
    t_ns, own = base.t_ns[rows], base.values[rows]
    theirs, known = _at(t_ns, other)
    names = [[f"{kind} {axis}" for axis in "xyz"] for kind in ("acc", "gyr")]
    values = np.hstack((own, theirs) if base is acc else (theirs, own))
    arrays = {name: pa.array(values[:, k], mask=~known) for k, name in enumerate((*names[0], *names[1]))}
    table = Table(source, pa.table({"time": t_ns, **arrays}))
    of_table = {"acc": names[0], "gyr": names[1], "time_column": "time", "time_unit": "ns", "time_wraps_at": None}
    return table, columns.model_copy(update=of_table), acc.repaired + gyr.repaired


def _triad(path: Path, names: tuple[str, ...], time: str, unit_ns: float, dialect: Dialect) -> _Triad:
    table = Table.read(path, [time, *names], [time], dialect)
    t_ns = table.times_ns(time, unit_ns)
    values, _ = table.vectors(names)
    kept = np.ones(table.rows, np.bool_)
    for empty in map(table.empty, (time, *names)):
        kept &= True if empty is None else ~empty
    rows = np.flatnonzero(kept)
    t_ns, count = repaired(t_ns[kept], doubled=True)
    steps = np.diff(t_ns)
    if (steps < 0).any():
        refuse_wild_clock(steps, np.flatnonzero(steps < 0), str(path), lambda index: table.place(int(rows[index])))
    t_ns, order = np.unique(t_ns, return_index=True)
    if t_ns.size < 2:
        raise RecordingError(f"{path}: has {t_ns.size} sample; export the recording again")
    return _Triad(t_ns, values[kept][order], count)


def _at(t_ns: IntArray, other: _Triad) -> tuple[FloatArray, np.ndarray[tuple[int], np.dtype[np.bool_]]]:
    """Another file's values (N, 3) at these times, and where its neighbours follow each other (N,)."""
    right = np.clip(np.searchsorted(other.t_ns, t_ns), 1, other.t_ns.size - 1)
    apart_ns = other.t_ns[right] - other.t_ns[right - 1]
    inside = (t_ns >= other.t_ns[0]) & (t_ns <= other.t_ns[-1])
    hit = (t_ns == other.t_ns[right]) | (t_ns == other.t_ns[right - 1])
    known = inside & (hit | (apart_ns <= GAP_INTERVALS * usual_interval_ns(other.t_ns)))
    since_s = (other.t_ns - other.t_ns[0]) / NS_PER_S
    at_s = (t_ns - other.t_ns[0]) / NS_PER_S
    return np.column_stack([np.interp(at_s, since_s, axis) for axis in other.values.T]), known
