"""The recordings that ``orientation.py`` measures on: BROAD (optical orientation) and gaitmap_walk (shoe markers)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from benchmarks.lib.real_sets import _two_header_lines as two_header_lines
from benchmarks.lib.real_sets import stroke_feet
from fes.datasets.broad import OldHdf5
from fes.estimation.zupt.thresholds import find_zero_velocity
from fes.signals import FloatArray

BoolArray = npt.NDArray[np.bool_]
Score = Callable[[FloatArray], float]  # of upward directions in the sensor frame (N, 3): RMSE in degrees

STANCE_SAMPLES, WINDOW_SAMPLES, SETTLED_SAMPLES, LEAST_STANCES = 15, 10, 500, 20  # at 100 Hz


@dataclass(frozen=True)
class Trial:
    """One sensor of one recording; ``score`` judges upward directions in the sensor frame (N, 3)."""

    data_set: str
    name: str
    rate_hz: float
    acc_mps2: FloatArray
    gyr_radps: FloatArray
    score: Score


def upward(quaternion: FloatArray) -> FloatArray:
    """The world's z axis in the sensor frame (N, 3): all that an orientation (N, 4) says besides heading."""
    w, x, y, z = quaternion.T
    return np.column_stack((2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)))


def inclination_error_deg(up: FloatArray, true_up: FloatArray) -> FloatArray:
    """Angle (N,) between two upward directions (N, 3): the heading-free part of an orientation's error."""
    cross = np.linalg.norm(np.cross(up, true_up), axis=1)
    return np.asarray(np.degrees(np.arctan2(cross, np.einsum("ij,ij->i", up, true_up))))


def rms(values: FloatArray) -> float:
    """Root of the mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def broad(folder: Path) -> list[Trial]:
    """A board moved by hand, 285.7 Hz; judged where the set's own mask says "movement" and the cameras saw it."""
    trials = []
    for path in sorted((folder / "broad").glob("*.hdf5")):
        file = OldHdf5(path)
        arrays, rate_hz = file.arrays(), file.attributes()["sampling_rate"]
        truth = np.asarray(arrays["opt_quat"], dtype=np.float64)
        judged = arrays["movement"].astype(bool) & np.isfinite(truth).all(axis=1)
        acc, gyr = (np.ascontiguousarray(arrays[name], dtype=np.float64) for name in ("imu_acc", "imu_gyr"))
        trials.append(Trial("broad", path.stem, rate_hz, acc, gyr, _against(upward(truth), judged)))
    return trials


def _against(true_up: FloatArray, judged: BoolArray) -> Score:
    return lambda up: rms(inclination_error_deg(up, true_up)[judged])


def gaitmap_pitch(folder: Path) -> list[Trial]:
    """Both shoes of a walk, 204.8 Hz: elevation of the line from the heel's marker to that of the fifth metatarsal.

    Where that line lies in the sensor's frame nobody measured; the score takes the direction that suits the method
    best (three numbers for 20 s at 100 Hz), so a constant tilt goes unpunished, the same for all methods.
    """
    path = folder / "gaitmap_walk" / "imu_sample.csv"
    if not path.is_file():
        return []
    imu, mocap = two_header_lines(path), two_header_lines(folder / "gaitmap_walk" / "mocap_sample.csv")
    trials = []
    for side in ("left", "right"):
        acc, gyr = (
            np.column_stack([imu[f"{side}_sensor", f"{kind}_{axis}"] for axis in "xyz"]) for kind in ("acc", "gyr")
        )
        heel, fifth = (
            np.column_stack([mocap[f"{side[0].upper()}_{marker}", axis] for axis in "xyz"]) for marker in ("FCC", "FM5")
        )
        line = fifth - heel
        sine = line[:, 2] / np.linalg.norm(line, axis=1)
        t_s = np.arange(len(acc)) / 204.8
        sine = np.interp(t_s, np.arange(len(sine)) / 100.0, sine, right=np.nan)
        trials.append(Trial("gaitmap_walk", f"{side} foot", 204.8, acc, np.radians(gyr), _elevation(sine)))
    return trials


def _elevation(sine: FloatArray) -> Score:
    seen = np.isfinite(sine)

    def score(up: FloatArray) -> float:
        direction = np.linalg.lstsq(up[seen], sine[seen], rcond=None)[0]
        direction /= np.linalg.norm(direction)
        found = np.arcsin(np.clip(up[seen] @ direction, -1.0, 1.0))
        return rms(np.degrees(found - np.arcsin(sine[seen])))

    return score


def stroke_stance(folder: Path) -> list[Trial]:
    """Feet of stroke survivors, 100 Hz: the upward direction against the mean force, in each stance's stillest 0.1 s.

    No truth: what the foot still accelerates is in it, about 1.5 degrees a stance, and the accelerometer's bias. It
    shows whether an orientation stays sensible over minutes of impaired walking. Rest is what the zero-velocity
    detector says; feet that hardly ever rest are left out.
    """
    trials = []
    for run, track, _ in stroke_feet(folder):
        acc, gyr = track.acc_mps2, track.gyr_radps
        _, rest, _ = find_zero_velocity(acc, gyr, 100.0)
        edges = np.flatnonzero(np.diff(np.concatenate(([0], rest.astype(int), [0]))))
        energy = np.convolve(np.sum(gyr**2, axis=1), np.full(WINDOW_SAMPLES, 1.0 / WINDOW_SAMPLES), "valid")
        windows = []
        for begin, end in zip(edges[0::2], edges[1::2], strict=True):
            if begin > SETTLED_SAMPLES and end - begin >= STANCE_SAMPLES:
                stillest = begin + int(np.argmin(energy[begin : end - WINDOW_SAMPLES + 1]))
                windows.append(np.arange(stillest, stillest + WINDOW_SAMPLES))
        if len(windows) >= LEAST_STANCES:
            at = np.array(windows)
            score = _stances(at, acc[at].mean(axis=1))
            trials.append(Trial("stroke_treadmill", f"{run} {track.sensor}", 100.0, acc, gyr, score))
    return trials


def _stances(windows: npt.NDArray[np.int64], force: FloatArray) -> Score:
    return lambda up: rms(inclination_error_deg(up[windows].mean(axis=1), force))


def later(up: FloatArray, samples: float) -> FloatArray:
    """What was estimated ``samples`` later (N, 3), for a constant delay between sensor and reference."""
    at = np.arange(len(up))
    return np.column_stack([np.interp(at + samples, at, up[:, j]) for j in range(3)])
