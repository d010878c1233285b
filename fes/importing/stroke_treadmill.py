"""Stroke survivors on a treadmill (Sint Maartenskliniek), as downloaded or packed.

As downloaded, a run is a folder of sensor texts (:mod:`fes.importing.stroke_treadmill_export`). Packed, it is one NumPy
archive, ``MRpp_TRIAL.npz``: arrays ``acc_``/``gyr_`` + left/right + foot/shank (m/s², rad/s), ``fs``, ``belt_speed``
(m/s, NaN where self-paced) and ``fsa_mean_deg``. Only the mean is true of the belt: its speed is quoted to 0.1 m/s, and
holds over the last 120 s.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from fes.importing.common import Imported, ImportProblem, checked, even_track, npz_file
from fes.importing.stroke_treadmill_export import read_tracks, run_of
from fes.recording import Recording, Track
from fes.signals import SENSORS

STEADY_S: Final = 120.0
NOTES: Final = (
    "foot: x points back and up along the instep, z out of it, +gyr_y is toe-up on both feet",
    "which side is paretic is not documented",
)


def read(path: Path, foot: str | None = None) -> Imported:
    """Read one run: an archive, a folder of texts, or one of its texts.

    Raises:
        ImportProblem: it is none of these.
    """
    if path.suffix.lower() == ".npz":
        return _packed(path)
    folder = (path if path.is_dir() else path.parent).resolve()
    tracks, notes = read_tracks(folder)
    name, subject, belt_mps = run_of(folder)
    references, said = _belt(belt_mps, tracks)
    return Imported(
        Recording(f"stroke_treadmill_{name}", None, tracks, belt_speed_mps=belt_mps, subject=subject),
        references,
        (*NOTES, said, *notes),
    )


def _packed(path: Path) -> Imported:
    data = npz_file(path, "fs", "belt_speed")
    rate_hz, belt_mps = float(data["fs"]), float(data["belt_speed"])
    if not 10.0 <= rate_hz <= 5000.0:
        raise ImportProblem(f"{path}: its rate fs is {rate_hz:g} Hz, which no such sensor has")
    tracks = {}
    for sensor in SENSORS:
        acc, gyr = (data.get(f"{kind}_{sensor.replace('_', '')}") for kind in ("acc", "gyr"))
        if acc is None or gyr is None:
            continue
        acc, gyr = np.asarray(acc, np.float64), np.asarray(gyr, np.float64)
        checked(path, acc, gyr)
        tracks[sensor] = even_track(sensor, rate_hz, acc, gyr)
    if not tracks:
        raise ImportProblem(f"{path}: holds no sensor such as acc_leftfoot and gyr_leftfoot")
    references, said = _belt(belt_mps if math.isfinite(belt_mps) and belt_mps > 0.0 else None, tracks)
    notes = [*NOTES, said]
    extra: dict[str, Any] = {}
    if "fsa_mean_deg" in data and math.isfinite(float(data["fsa_mean_deg"])):
        extra["foot_strike_mean_deg"] = float(data["fsa_mean_deg"])
        notes.append(
            "foot_strike_mean_deg: Vicon's mean of the first 50 contacts of each side, both pooled, toe-up positive"
        )
    recording = Recording(
        f"stroke_treadmill_{path.stem}",
        None,
        tracks,
        belt_speed_mps=belt_mps if references else None,
        subject=path.stem.split("_")[0],
        extra=extra,
    )
    return Imported(recording, references, tuple(notes))


def _belt(belt_mps: float | None, tracks: Mapping[str, Track]) -> tuple[dict[str, Any], str]:
    """The belt's speed as a reference, and a note."""
    if belt_mps is None:
        return {}, "self-paced, or the belt's speed is not known: there is no reference"
    end_s = max(track.duration_s for track in tracks.values())
    begin_s = max(end_s - STEADY_S, 0.0)
    rows = [(t, belt_mps) for t in (begin_s, 0.5 * (begin_s + end_s), end_s)]
    said = "the belt's speed is quoted to 0.1 m/s and taken for the last 120 s: right on average only"
    return {".belt.csv": (["t_s", "speed_mps"], rows)}, said
