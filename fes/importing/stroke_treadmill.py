"""Stroke survivors on a treadmill (Sint Maartenskliniek): one NumPy archive a run, ``MRpp_TRIAL.npz``.

Arrays ``acc_``/``gyr_`` + left/right + foot/shank (m/s², rad/s), ``fs``, ``belt_speed`` (m/s, NaN where self-paced) and
``fsa_mean_deg``. Only the mean is true of the belt: its speed is quoted to 0.1 m/s, and holds over the last 120 s.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, Final

import numpy as np

from fes.importing.common import Imported, ImportProblem, checked, even_track, npz_file
from fes.recording import Recording
from fes.signals import SENSORS

STEADY_S: Final = 120.0


def read(path: Path, foot: str | None = None) -> Imported:
    """Read one run.

    Raises:
        ImportProblem: it is no such archive.
    """
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
    notes = [
        "foot: x points back and up along the instep, z out of it, +gyr_y is toe-up on both feet",
        "which side is paretic is not documented",
    ]
    references: dict[str, Any] = {}
    if math.isfinite(belt_mps) and belt_mps > 0.0:
        end_s = max(track.duration_s for track in tracks.values())
        begin_s = max(end_s - STEADY_S, 0.0)
        rows = [(t, belt_mps) for t in (begin_s, 0.5 * (begin_s + end_s), end_s)]
        references[".belt.csv"] = (["t_s", "speed_mps"], rows)
        notes.append("the belt's speed is quoted to 0.1 m/s and taken for the last 120 s: right on average only")
    else:
        notes.append("self-paced: the belt's speed is not known, there is no reference")
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
