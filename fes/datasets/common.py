"""What every import makes: a recording, its references as tables, and words about where it comes from."""

import csv
import struct
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np

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
    _need(path, found, needed)
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
    _need(path, found, needed)
    return found


def _need(path: Path, found: Mapping[str, Any], needed: Iterable[str]) -> None:
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
