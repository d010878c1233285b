"""gaitmap's example data: ``imu_sample.csv`` with markers and events beside it, and walks on stairs without truth.

Gyroscope in deg/s; the markers (mm, 100 Hz) begin with the first IMU sample; events are IMU samples. The accelerometer
clips at 16 g at heel strike.
"""

import csv
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from fes.datasets.common import Imported, ImportProblem, checked, even_track, two_header_csv
from fes.recording import Recording
from fes.signals import G_MPS2, FloatArray

RATE_HZ: Final = 204.8
MARKER_HZ: Final = 100.0
POINTS: Final = {"heel": "FCC", "toe": "TOE"}


def read(path: Path, foot: str | None = None) -> Imported:
    """Read one IMU table and what lies beside it. Raises ImportProblem: it is no such table."""
    columns = two_header_csv(path)
    tracks = {}
    for side in ("left", "right"):
        try:
            acc, gyr = (
                np.column_stack([columns[f"{side}_sensor", f"{kind}_{axis}"] for axis in "xyz"])
                for kind in ("acc", "gyr")
            )
        except KeyError as error:
            raise ImportProblem(f"{path}: lacks the column {error.args[0]}; is it gaitmap's imu_sample.csv?") from error
        checked(path, acc, gyr)
        name = f"{side}_foot"
        tracks[name] = replace(even_track(name, RATE_HZ, acc, np.radians(gyr)), acc_range_mps2=16.0 * G_MPS2)
    stairs = "stair" in path.stem
    references: dict[str, Any] = {}
    if not stairs:
        mocap, events = (path.with_name(name) for name in ("mocap_sample.csv", "stride_events_sample.csv"))
        if mocap.is_file():
            references[".path.csv"] = _markers(mocap)
        if events.is_file():
            references[".events.csv"] = _events(events)
    notes = ["the accelerometer clips at 16 g at heel strike", "the sensors are tilted by about 15 degrees about x"]
    turns = "the reference joins two steps in a turn to one stride"
    notes.append("stairs, without truth: use --stairs" if stairs else turns)
    recording = Recording(f"gaitmap_{path.stem}", None, tracks, description="lateral shoe sensors, over ground")
    return Imported(recording, references, tuple(notes))


def _markers(path: Path) -> tuple[list[str], list[list[float]]]:
    columns = two_header_csv(path)
    names, parts = ["t_s"], [np.arange(len(next(iter(columns.values())))) / MARKER_HZ]
    for side in ("left", "right"):
        for point, label in POINTS.items():
            for axis in "xyz":
                marker = (f"{side[0].upper()}_{label}", axis)
                if marker not in columns:
                    raise ImportProblem(f"{path}: lacks the marker {marker[0]}, axis {axis}")
                names.append(f"{side}_{point}_{axis}_m")
                parts.append(1e-3 * columns[marker])
    rows: FloatArray = np.column_stack(parts)
    return names, rows.tolist()


def _events(path: Path) -> tuple[list[str], list[tuple[str, str, float]]]:
    with path.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    found = []
    for line, row in enumerate(rows, 2):
        try:
            for key, what in (("ic", "IC"), ("tc", "FO")):
                found.append((f"{row['foot']}_foot", what, float(row[key]) / RATE_HZ))
        except (KeyError, ValueError, TypeError) as error:
            raise ImportProblem(f"{path}:{line}: lacks foot, ic or tc, or they are no numbers ({error})") from error
    return ["foot", "event", "t_s"], sorted(found, key=lambda event: event[2])
