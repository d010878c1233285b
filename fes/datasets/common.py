"""What every import makes: a recording, its references as tables, and words about where it comes from."""

import csv
import importlib
import struct
import zlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final
from zipfile import BadZipFile

import numpy as np

from fes.extensions import ExtensionError, extension_names, load_extension
from fes.recording import Recording, RecordingError, Track, TrackQuality, write_recording
from fes.signals import FloatArray, IntArray


class ImportProblem(ValueError):
    """Files of a data set cannot be used; the message names the file, the place and what would be right."""


@dataclass(frozen=True)
class Imported:
    """One recording of a data set.

    Attributes:
        recording: in SI units, in the sensor's own axes.
        references: suffix such as ``.events.csv`` → column names with units, and rows; times in s from the
            first sample.
        notes: known defects and assumptions, in words.
    """

    recording: Recording
    references: Mapping[str, tuple[Sequence[str], Iterable[Sequence[Any]]]] = field(default_factory=dict)
    notes: tuple[str, ...] = ()


def write_imported(
    imported: Imported, folder: Path, about: Mapping[str, str], *, form: str = "parquet", overwrite: bool = False
) -> list[Path]:
    """Write the recording, its sidecar and its references into ``folder``; returns the files.

    ``about`` (source, licence, citation …) and the notes go into the sidecar's ``[extra]``.

    ImportProblem: a file is in the way or cannot be written.
    """
    recording = imported.recording
    extra = {**recording.extra, **about, **({"notes": list(imported.notes)} if imported.notes else {})}
    data = folder / f"{recording.name}.{form}"
    targets = [folder / f"{recording.name}{suffix}" for suffix in imported.references]
    for target in targets:
        if target.exists() and not overwrite:
            raise ImportProblem(f"{target}: is there already; choose another --out or say --overwrite")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_recording(replace(recording, extra=extra), data, overwrite=overwrite)
        for target, (names, rows) in zip(targets, imported.references.values(), strict=True):
            with target.open("w", encoding="utf-8", newline="") as file:
                writer = csv.writer(file, lineterminator="\n")
                writer.writerow(names)
                writer.writerows([_cell(value) for value in row] for row in rows)
    except RecordingError as error:
        raise ImportProblem(str(error).replace("pass overwrite=True", "say --overwrite")) from error
    except OSError as error:
        raise ImportProblem(f"{folder}: cannot be written: {error.strerror or error}") from error
    return [data, data.with_suffix(".toml"), *targets]


def _cell(value: object) -> object:
    if isinstance(value, (float, np.floating)):
        number = float(value)
        if number != number:
            return ""
        return f"{number:.6g}" if abs(number) < 1e-3 else f"{number:.6f}".rstrip("0").rstrip(".")
    return value


def even_track(sensor: str, rate_hz: float, acc_mps2: FloatArray, gyr_radps: FloatArray) -> Track:
    """A track (N, 3) of even rate that begins at 0."""
    t_ns = np.round(np.arange(len(acc_mps2)) * 1e9 / rate_hz).astype(np.int64)
    return stamped_track(sensor, rate_hz, t_ns, acc_mps2, gyr_radps)


def stamped_track(
    sensor: str, rate_hz: float, t_ns: IntArray, acc_mps2: FloatArray, gyr_radps: FloatArray,
    acc_range_mps2: float | None = None, gyr_range_radps: float | None = None,
) -> Track:  # fmt: skip
    """A track (N, 3) with its own stamps, and ranges where they are known."""
    acc, gyr = (np.ascontiguousarray(values, np.float64) for values in (acc_mps2, gyr_radps))
    arrival_ns, quality = np.maximum.accumulate(t_ns), TrackQuality(samples=len(t_ns))
    return Track(sensor, rate_hz, arrival_ns, t_ns, acc, gyr, acc_range_mps2, gyr_range_radps, quality)


def checked(path: Path, acc: FloatArray, gyr: FloatArray) -> None:
    """See that there are samples, all of them finite, of three axes. Raises ImportProblem: there are not."""
    for kind, values in (("accelerometer", acc), ("gyroscope", gyr)):
        if values.ndim != 2 or values.shape[1] != 3 or len(values) < 3 or values.shape != acc.shape:
            raise ImportProblem(f"{path}: its {kind} is {values.shape}, must be (samples, 3)")
        bad = np.flatnonzero(~np.isfinite(values).all(axis=1))
        if len(bad):
            raise ImportProblem(f"{path}: sample {int(bad[0])} of its {kind} is no number ({len(bad)} are not)")


def mat_file(path: Path, *needed: str) -> dict[str, Any]:
    """The variables of a MATLAB file (version 5 to 7). ImportProblem: it cannot be read or lacks one of ``needed``."""
    from scipy.io import loadmat
    from scipy.io.matlab import MatReadError

    try:
        found: dict[str, Any] = loadmat(path)
    except (OSError, ValueError, TypeError, LookupError, EOFError, OverflowError, MemoryError, NotImplementedError,
            MatReadError, struct.error, zlib.error) as error:  # fmt: skip
        raise ImportProblem(f"{path}: is no readable MATLAB file: {error}") from error
    need(path, found, needed)
    return found


def npz_file(path: Path, *needed: str) -> dict[str, FloatArray]:
    """The arrays of a NumPy archive; nothing in it is executed.

    ImportProblem: it cannot be read or lacks one of ``needed``.
    """
    try:
        with np.load(path, allow_pickle=False) as archive:
            found = {name: archive[name] for name in archive.files}
    except (OSError, ValueError, AttributeError, EOFError, BadZipFile) as error:
        raise ImportProblem(f"{path}: is no readable NumPy archive: {error}") from error
    need(path, found, needed)
    return found


def need(path: Path, found: Mapping[str, Any], needed: Iterable[str]) -> None:
    """Raise ImportProblem where one of these is not among what was found."""
    missing = [name for name in needed if name not in found]
    if missing:
        have = ", ".join(sorted(name for name in found if not name.startswith("__")))
        raise ImportProblem(f"{path}: lacks {', '.join(missing)}; it holds {have or 'nothing'}")


def _csv_numbers(path: Path, header_lines: int) -> tuple[list[list[str]], FloatArray]:
    """The cells of a CSV's header lines, and the numbers (N, K) below them; empty cells are NaN."""
    try:
        with path.open(encoding="utf-8-sig") as file:
            header = [file.readline().rstrip("\r\n").split(",") for _ in range(header_lines)]
            return header, np.genfromtxt(file, delimiter=",", ndmin=2)
    except (OSError, UnicodeDecodeError, ValueError) as error:
        raise ImportProblem(f"{path}: cannot be read: {error}") from error


def two_header_csv(path: Path) -> dict[tuple[str, str], FloatArray]:
    """Columns (N,) of a CSV whose names stand in two lines; empty cells are NaN. The index column is left out.

    ImportProblem: it is no such table.
    """
    (first, second), values = _csv_numbers(path, 2)
    if len(first) != len(second) or values.shape[1:] != (len(first),) or len(values) < 3:
        raise ImportProblem(f"{path}: is no table with two lines of column names")
    values = values[np.isfinite(values[:, 0])]  # an empty row below the names holds the index's name
    return {(a, b): values[:, k] for k, (a, b) in enumerate(zip(first, second, strict=True)) if k}


def plain_csv(path: Path) -> tuple[list[str], FloatArray]:
    """Names and numbers (N, K) of a CSV with one line of names. Raises ImportProblem: it is no such table."""
    (cells,), values = _csv_numbers(path, 1)
    names = [name.strip() for name in cells]
    if values.shape[1:] != (len(names),) or not len(values):
        raise ImportProblem(f"{path}: is no table of {len(names)} columns below a line of names")
    return names, values


# --- The data sets by name: what each is, under which licence, and the module that reads it -----------------


@dataclass(frozen=True, slots=True)
class DataSet:
    """One data set.

    ``looks_like``: names (patterns) of files, or of folders of one run, searched for in a folder. ``reader``: module
    and function, where that is not the set's own module. ``read``: the function itself, of a data set that another
    package brings: ``read(path, foot)`` → :class:`fes.datasets.Imported`.
    """

    name: str
    about: str
    source: str
    licence: str
    looks_like: tuple[str, ...]
    reader: str = ""
    read: Callable[[Path, str | None], Imported] | None = None

    def provenance(self) -> dict[str, str]:
        """For the sidecar of everything that comes from it."""
        return {"data_set": self.name, "source": self.source, "licence": self.licence}


_SETS: Final = (
    DataSet(
        "gaitmap",
        "1 healthy adult, lateral shoes 204.8 Hz; markers on heel and toe, IC and FO; stairs",
        "example data of gaitmap (MaD-Lab Erlangen)",
        "MIT",
        ("imu_sample*.csv",),
        "walks.read_gaitmap",
    ),
    DataSet(
        "stroke_treadmill",
        "stroke survivors on a treadmill, feet and shanks 100 Hz (folders of Xsens texts, or packed); belt speed",
        "Sint Maartenskliniek, MovingReality; cite 10.3390/s24020710",
        "MIT",
        ("MR*.npz", "exported[0-9]*"),
    ),
    DataSet(
        "pyshoe",
        "healthy walks, right instep 200 Hz; Vicon position at every sample",
        "PyShoe (Wagstaff, Peretroukhin, Kelly), Vicon part",
        "copy under MIT; the original's licence is not known: measure and quote, pass nothing on",
        ("*.mat",),
        "walks.read_pyshoe",
    ),
    DataSet(
        "ruler",
        "walks, one foot 200 Hz; every footprint measured by ruler",
        "mtahakoroglu/gait-driven-inertial-navigation-dataset",
        "MIT",
        ("*_LLIO.mat",),
        "walks.read_ruler",
    ),
    DataSet(
        "broad",
        "a board moved by hand (not gait), 285.7 Hz; optical orientation and position",
        "dlaidig/broad",
        "CC BY 4.0 (name the authors)",
        ("*.hdf5", "*.mat"),
        "walks.read_broad",
    ),
    DataSet(
        "xio",
        "one foot, nominally 400 Hz; a loop that ends where it starts",
        "xioTechnologies/Gait-Tracking",
        "MIT",
        ("*walk.csv",),
        "walks.read_xio",
    ),
    DataSet(
        "footswitch_treadmill",
        "healthy and hemiparetic walkers on a treadmill, one instep about 194 Hz; the four phases by footswitches",
        "midasama3124/hmm_gait_phase_classifier; cite 10.3390/s19132988",
        "BSD",
        ("[HP][0-9]*_[0-9].npz",),
        "walks.read_footswitch_treadmill",
    ),
    DataSet(
        "stroke_walks",
        "stroke survivors and healthy walkers, two minutes on the floor with turns, both feet 104 Hz; no reference",
        "RichardFel/VAE (Zenodo 8073887)",
        "MIT",
        ("S[0-9]*.npz",),
        "walks.read_stroke_walks",
    ),
)
DATA_SETS: Final = {each.name: each for each in _SETS}


def data_sets() -> dict[str, DataSet]:
    """By name, the data sets known here and those that installed packages bring; ours go first where names meet.

    ImportProblem: what a package brings is no data set.
    """
    found = dict(DATA_SETS)
    for name in extension_names("importer"):
        if name not in found:
            found[name] = _other(name)
    return found


def _other(name: str) -> DataSet:
    try:
        found = load_extension("importer", name)
    except ExtensionError as error:
        raise ImportProblem(str(error)) from error
    if not isinstance(found, DataSet) or found.read is None or found.name != name:
        raise ImportProblem(f"importer {name!r} must be a DataSet of this name with a read function")
    return found


def data_set(name: str) -> DataSet:
    """One of :func:`data_sets`. Raises ImportProblem: there is none of this name."""
    known = data_sets() if name not in DATA_SETS else DATA_SETS
    if name not in known:
        raise ImportProblem(f"{name}: is no data set known here; {', '.join(known)} are")
    return known[name]


def files_of(name: str, paths: Sequence[Path]) -> list[Path]:
    """The files to read; a folder stands for all files in it that look like the data set's.

    ImportProblem: the set is not known, or nothing of it is there.
    """
    looks_like = data_set(name).looks_like
    found = []
    for path in paths:
        if not path.exists():
            raise ImportProblem(f"{path}: is not there. Name the files of the data set, or their folder.")
        shapes = looks_like
        one = not path.is_dir() or any(path.resolve().match(shape) for shape in shapes)
        files = [path] if one else sorted({file for shape in shapes for file in path.rglob(shape)})
        if not files:
            raise ImportProblem(f"{path}: holds no file like {', '.join(shapes)}")
        found += files
    return found


def read_file(name: str, path: Path, *, foot: str | None = None) -> Imported:
    """Read one file of a data set, with what belongs to it.

    ``foot`` says whose a sensor is of which the data set does not tell.

    ImportProblem: it is none of its files.
    """
    known = data_set(name)
    if known.read is not None:
        return known.read(path, foot)
    module, _, function = (known.reader or f"{name}.read").partition(".")
    read: Callable[[Path, str | None], Imported] = getattr(importlib.import_module(f"fes.datasets.{module}"), function)
    return read(path, foot)
