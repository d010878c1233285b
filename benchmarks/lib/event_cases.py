"""Recordings with true initial contacts and foot offs, for ``events.py``: where they are and how to read them."""

from __future__ import annotations

import csv
import os
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from fes.recording import Track, read_recording
from fes.signals import FloatArray
from fes.simulation.truth import load_truth

TRIALS = Path(__file__).resolve().parents[2] / "sim_inputs"
NAMES = ("negard_patient1", "negard_patient2", "both_feet_100hz", "both_feet_200hz", "misaligned", "soft_contact")
GAITMAP_HZ = 204.8
MARKERS_HZ = 100.0


@dataclass(frozen=True)
class Case:
    """One foot of one recording, its true events in s from the start, and whether markers confirm an extra event."""

    name: str
    track: Track
    ic_s: FloatArray
    fo_s: FloatArray
    confirmed: Callable[[str, float], bool] = lambda _event, _t_s: False


def data_folder() -> Path:
    """Where the recordings are: $FES_DATA, else ../shared/data beside the project."""
    return Path(os.environ.get("FES_DATA") or Path(__file__).resolve().parents[3] / "shared" / "data")


def make_track(sensor: str, rate_hz: float, acc: FloatArray, gyr: FloatArray) -> Track:
    t_ns = np.round(np.arange(len(acc)) * 1e9 / rate_hz).astype(np.int64)
    return Track(sensor, rate_hz, t_ns, t_ns, np.ascontiguousarray(acc, float), np.ascontiguousarray(gyr, float))


def _two_row_table(path: Path) -> dict[tuple[str, str], FloatArray]:
    """Columns by both rows of the header, empty cells as NaN."""
    with path.open(encoding="utf-8", newline="") as file:
        rows = csv.reader(file)
        first, second = next(rows), next(rows)
        values = np.array([[float(cell) if cell else np.nan for cell in row] for row in rows if row[1:2] != [""]])
    return {names: values[:, k] for k, names in enumerate(zip(first, second, strict=True))}


def gaitmap_cases(folder: Path) -> list[Case]:
    """Both feet of the walk with markers; only the 57 strides of the reference count."""
    imu = _two_row_table(folder / "gaitmap_walk" / "imu_sample.csv")
    markers = _two_row_table(folder / "gaitmap_walk" / "mocap_sample.csv")
    with (folder / "gaitmap_walk" / "stride_events_sample.csv").open(encoding="utf-8", newline="") as file:
        strides = list(csv.DictReader(file))
    cases = []
    for side in ("left", "right"):
        acc, gyr = (
            np.column_stack([imu[f"{side}_sensor", f"{kind}_{axis}"] for axis in "xyz"]) for kind in ("acc", "gyr")
        )
        heel = [markers[f"{side[0].upper()}_FCC", axis] * 1e-3 for axis in "xy"]
        speed = np.hypot(*(np.gradient(x) for x in heel)) * MARKERS_HZ
        rows = [row for row in strides if row["foot"] == side]
        cases.append(
            Case(
                "gaitmap_walk",
                make_track(f"{side}_foot", GAITMAP_HZ, acc, np.radians(gyr)),
                np.array([float(row["ic"]) for row in rows]) / GAITMAP_HZ,
                np.array([float(row["tc"]) for row in rows]) / GAITMAP_HZ,
                partial(_steps, speed),
            )
        )
    return cases


def _steps(speed_mps: FloatArray, event: str, t_s: float) -> bool:
    """Does the heel marker come to rest after this IC, or leave rest about this FO?"""
    at = round(t_s * MARKERS_HZ)
    before, after = speed_mps[max(at - 40, 0) : at + 1], speed_mps[at : at + 40]
    rest, motion = (after, before) if event == "IC" else (before, after)
    return bool(np.nanmin(rest) < 0.1 and np.nanmax(motion) > 0.5)


def bundled_cases() -> list[Case]:
    """Every foot of the bundled walks."""
    cases = []
    for name in NAMES:
        recording, truth = read_recording(TRIALS / f"{name}.parquet"), load_truth(TRIALS / f"{name}.parquet")
        for foot, track in recording.tracks.items():
            strides = truth.strides_of(foot)
            contacts = np.array([s.t_loading_response_s for s in strides])
            cases.append(Case(f"bundled {name}", track, contacts, np.array([s.t_swing_s for s in strides])))
    return cases


def stroke_tracks(folder: Path) -> list[tuple[str, Track, float]]:
    """Run, foot and Vicon's mean foot-strike angle (deg)."""
    out = []
    for path in sorted((folder / "stroke_treadmill").glob("*.npz")):
        data = np.load(path)
        for side in ("left", "right"):
            track = make_track(f"{side}_foot", float(data["fs"]), data[f"acc_{side}foot"], data[f"gyr_{side}foot"])
            out.append((path.stem, track, float(data["fsa_mean_deg"])))
    return out
