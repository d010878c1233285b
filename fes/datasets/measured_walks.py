"""Walks of one foot at 200 Hz, z axis down, a MATLAB file each, of which every stride's length was measured.

PyShoe: right instep, the marker's position by Vicon at every sample. Files are named by trial, or
``processed_data.mat`` in a folder of that name. Single positions jump: where the marker would be faster than 8 m/s they
are left empty.

Ruler: ``SensorConnectData_N_LLIO.mat`` and the table of footprints beside it, with the sample at which the foot stood
on each print. Which foot is not documented.
"""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import numpy as np

from fes.datasets.common import Imported, ImportProblem, checked, even_track, mat_file, plain_csv
from fes.recording import Recording

RATE_HZ: Final = 200.0
FASTEST_MPS: Final = 8.0
GYR_RANGE_RADPS: Final = 9.7


def read_pyshoe(path: Path, foot: str | None = None) -> Imported:
    """Read one walk. Raises ImportProblem: it is no such file."""
    data = mat_file(path, "imu", "gt")
    imu, place = np.asarray(data["imu"], np.float64), np.asarray(data["gt"], np.float64)
    if imu.ndim != 2 or imu.shape[1] != 6 or place.shape != (len(imu), 3):
        raise ImportProblem(f"{path}: imu is {imu.shape} and gt {place.shape}, must be (N, 6) and (N, 3)")
    checked(path, imu[:, :3], imu[:, 3:])
    sensor = f"{foot or 'right'}_foot"
    speed = np.linalg.norm(np.diff(place, axis=0), axis=1) * RATE_HZ
    jumps = np.flatnonzero(speed > FASTEST_MPS)
    place = place.copy()
    place[np.union1d(jumps, jumps + 1)] = np.nan
    names = ["t_s", *(f"{foot or 'right'}_sensor_{axis}_m" for axis in "xyz")]
    rows = np.column_stack([np.arange(len(place)) / RATE_HZ, place]).tolist()
    notes = (
        "z of the sensor points down",
        "taken as even at 200 Hz; the stamps in the file are those of arrival",
        f"{len(jumps)} jumps of the Vicon reference above 8 m/s were left empty",
        "the gyroscope clips near 9.7 rad/s; the marker is near the sensor, not at it",
    )
    trial = path.parent.name if path.stem == "processed_data" else path.stem
    track = replace(even_track(sensor, RATE_HZ, imu[:, :3], imu[:, 3:]), gyr_range_radps=GYR_RANGE_RADPS)
    return Imported(Recording(f"pyshoe_{trial}", None, {sensor: track}), {".path.csv": (names, rows)}, notes)


def read_ruler(path: Path, foot: str | None = None) -> Imported:
    """Read one walk. Raises ImportProblem: it is no such file."""
    imu = np.asarray(mat_file(path, "imu_data")["imu_data"], np.float64)
    if imu.ndim != 2 or imu.shape[1] != 6:
        raise ImportProblem(f"{path}: imu_data is {imu.shape}, must be (N, 6)")
    checked(path, imu[:, :3], imu[:, 3:])
    sensor = f"{foot or 'right'}_foot"
    name = path.stem.removesuffix("_LLIO")
    table = path.with_name(f"{name}_strideIndex_timestamp_gcpX_gcpY.csv")
    references: dict[str, Any] = {}
    if table.is_file():
        references[".strides.csv"] = _strides(table, sensor, len(imu))
    notes = (
        "z of the sensor points down; the sign of the mediolateral rate differs between walks",
        f"which foot is not documented: taken for the {sensor.replace('_', ' ')}",
        "in turns the foot swivels, and what the sensor travels is not the way between footprints",
    )
    number = name.removeprefix("SensorConnectData_")
    track = even_track(sensor, RATE_HZ, imu[:, :3], imu[:, 3:])
    return Imported(Recording(f"ruler_{number}", None, {sensor: track}), references, notes)


def _strides(path: Path, sensor: str, samples: int) -> tuple[list[str], list[tuple[Any, ...]]]:
    names, values = plain_csv(path)
    try:
        index, x, y = (values[:, names.index(name)] for name in ("strideIndex", "gcpX", "gcpY"))
    except ValueError as error:
        raise ImportProblem(f"{path}: lacks strideIndex, gcpX or gcpY; it has {', '.join(names)}") from error
    if not np.isfinite(values).all() or (np.diff(index) <= 0).any() or index[0] < 0 or index[-1] >= samples + 1:
        raise ImportProblem(f"{path}: its strideIndex must increase and lie within the recording's {samples} samples")
    place = np.column_stack([x, y])
    rows = [
        (sensor, index[a] / RATE_HZ, index[b] / RATE_HZ, float(np.hypot(*(place[b] - place[a]))))
        for a, b in pairwise(range(len(index)))
    ]
    return ["foot", "t_start_s", "t_end_s", "stride_length_m"], rows
