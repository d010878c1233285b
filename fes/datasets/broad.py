"""BROAD: a board moved by hand, 285.7 Hz, with optical orientation and position; HDF5 or MATLAB files. Not gait.

The board is written as the sensor ``right_foot``, for a recording has no other names: good for orientation only. The
optical quaternion (w, x, y, z, sensor → east-north-up) goes into ``.orientation.csv``, empty where it was not seen.
"""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from typing import Any, Final

import numpy as np

from fes.datasets.common import Imported, ImportProblem, checked, even_track, mat_file
from fes.datasets.hdf5 import OldHdf5
from fes.recording import Recording
from fes.signals import FloatArray

NEEDED: Final = ("imu_acc", "imu_gyr", "opt_quat", "opt_pos", "movement")


def read(path: Path, foot: str | None = None) -> Imported:
    """Read one trial.

    Raises:
        ImportProblem: it is no such file.
    """
    arrays, rate_hz = _mat(path) if path.suffix.lower() == ".mat" else _hdf5(path)
    acc, gyr, quaternion, place = (np.asarray(arrays[name], np.float64) for name in NEEDED[:4])
    moving = np.asarray(arrays["movement"]).ravel().astype(int)
    checked(path, acc, gyr)
    if quaternion.shape != (len(acc), 4) or place.shape != (len(acc), 3) or len(moving) != len(acc):
        raise ImportProblem(f"{path}: optical data and samples differ in length")
    sensor = f"{foot or 'right'}_foot"
    names = ["t_s", "q_w", "q_x", "q_y", "q_z", "x_m", "y_m", "z_m", "moving"]
    stamps = np.arange(len(acc)) / rate_hz
    rows = np.column_stack([stamps, quaternion, place, moving]).tolist()
    notes = (
        f"a board moved by hand, not a foot: written as {sensor}; phases and strides of it mean nothing",
        "the magnetometer is left out; orientation counts only while the board moves (column moving)",
    )
    track = even_track(sensor, rate_hz, acc, gyr)
    recording = Recording(f"broad_{path.stem}", None, {sensor: track}, extra={"not_gait": True})
    return Imported(recording, {".orientation.csv": (names, rows)}, notes)


def _hdf5(path: Path) -> tuple[dict[str, Any], float]:
    try:
        file = OldHdf5(path)
        arrays: dict[str, Any] = dict(file.arrays())
        rate_hz = file.attributes()["sampling_rate"]
    except (OSError, ValueError, KeyError, IndexError, RecursionError, MemoryError, struct.error, zlib.error) as error:
        raise ImportProblem(f"{path}: is no HDF5 file as BROAD has them: {error}") from error
    missing = [name for name in NEEDED if name not in arrays]
    if missing:
        raise ImportProblem(f"{path}: lacks {', '.join(missing)}; it holds {', '.join(sorted(arrays))}")
    return arrays, _rate(path, rate_hz)


def _mat(path: Path) -> tuple[dict[str, FloatArray], float]:
    data = mat_file(path, *NEEDED, "sampling_rate")
    return {name: data[name] for name in NEEDED}, _rate(path, float(np.asarray(data["sampling_rate"]).ravel()[0]))


def _rate(path: Path, rate_hz: float) -> float:
    if not 1.0 <= rate_hz <= 10_000.0:
        raise ImportProblem(f"{path}: its sampling_rate is {rate_hz:g} Hz, which no such sensor has")
    return rate_hz
