"""PyShoe's Vicon walks: a MATLAB file each, right instep, 200 Hz, z axis down, marker position at every sample.

Files are named by trial, or ``processed_data.mat`` in a folder of that name. Single positions jump: where the marker
would be faster than 8 m/s they are left empty.
"""

from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from fes.datasets.common import Imported, ImportProblem, checked, even_track, mat_file
from fes.recording import Recording

RATE_HZ: Final = 200.0
FASTEST_MPS: Final = 8.0
GYR_RANGE_RADPS: Final = 9.7


def read(path: Path, foot: str | None = None) -> Imported:
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
