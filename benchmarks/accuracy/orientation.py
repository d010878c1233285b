"""The orientation filter: its error, and where it is hardest or knows more: a clipped gyroscope, its own confidence, a
known stance; 3 without data.

BROAD: inclination of a board moved by hand against cameras. gaitmap_walk: pitch of both shoes against markers. Clipped:
the fast board's rates cut at 1000 °/s, with the range told to the filter and without. Confidence: the filter's own
standard deviation of the inclination about one axis, beside the error about one axis. Stance: rest told by the
zero-velocity detector. Other filters run among the peers of ``accuracy_table.py``.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.lib.command_line import no_recordings, parser_of, publish
from benchmarks.lib.real_sets import MARKERS_HZ, BoolArray, data_folder, gaitmap_markers, gaitmap_walk
from fes.datasets.walks import broad_trial
from fes.estimation.orientation.body import OrientationPath, smooth_orientation, track_orientation
from fes.estimation.zupt.thresholds import find_zero_velocity
from fes.signals import FloatArray

Score = Callable[[FloatArray], float]  # of upward directions in the sensor frame (N, 3): RMSE in degrees


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
    return float(np.sqrt(np.mean(np.square(values))))


def broad(folder: Path) -> list[Trial]:
    """A board moved by hand, 285.7 Hz; judged where the set's own mask says "movement" and the cameras saw it."""
    trials = []
    for path in sorted((folder / "broad").glob("*.hdf5")):
        arrays, rate_hz = broad_trial(path)
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
    trials = []
    for walk in gaitmap_walk(folder):
        heel, fifth = gaitmap_markers(folder, walk.name, "FCC", "FM5")
        sine = (fifth - heel)[:, 2] / np.linalg.norm(fifth - heel, axis=1)
        track, t_s = walk.track, 1e-9 * walk.track.t_ns
        sine = np.interp(t_s, np.arange(len(sine)) / MARKERS_HZ, sine, right=np.nan)
        own = (walk.track.acc_mps2, walk.track.gyr_radps)
        trials.append(Trial("gaitmap_walk", f"{walk.name} foot", track.rate_hz, *own, _elevation(sine)))
    return trials


def _elevation(sine: FloatArray) -> Score:
    seen = np.isfinite(sine)

    def score(up: FloatArray) -> float:
        direction = np.linalg.lstsq(up[seen], sine[seen], rcond=None)[0]
        direction /= np.linalg.norm(direction)
        found = np.arcsin(np.clip(up[seen] @ direction, -1.0, 1.0))
        return rms(np.degrees(found - np.arcsin(sine[seen])))

    return score


RANGE_DPS = 1000.0
FILTERS: dict[str, Callable[..., OrientationPath]] = {"causal": track_orientation, "off-line": smooth_orientation}


def clipped_deg(trial: Trial, follow: Callable[..., OrientationPath], *, told: bool) -> float:
    """RMSE behind a gyroscope of 1000 °/s."""
    limit = math.radians(RANGE_DPS)
    rates = np.clip(trial.gyr_radps, -limit, limit)
    path = follow(trial.acc_mps2, rates, trial.rate_hz, gyr_range_radps=limit if told else None)
    return trial.score(upward(path.quaternion))


def main() -> int:
    options = parser_of(__doc__, data_folder()).parse_args()
    folder, lines = options.data, []
    trials, feet = broad(folder), gaitmap_pitch(folder)
    if not trials or not feet:
        return no_recordings(folder)
    for name, follow in FILTERS.items():
        for each in (trials, feet):
            errors = [t.score(upward(follow(t.acc_mps2, t.gyr_radps, t.rate_hz).quaternion)) for t in each]
            what = ", ".join(f"{t.name} {error:.2f}°" for t, error in zip(each, errors, strict=True))
            lines.append(f"{each[0].data_set}, {name}: {np.mean(errors):.2f}° ({what})")
    fast = trials[0]
    share = np.mean((np.abs(fast.gyr_radps) >= math.radians(RANGE_DPS)).any(axis=1))
    for name, follow in FILTERS.items():
        lines.append(
            f"{fast.name}, gyroscope clipped at {RANGE_DPS:g} °/s in {100 * share:.1f} % of the samples, {name}: "
            f"{clipped_deg(fast, follow, told=True):.2f}° with the range known, "
            f"{clipped_deg(fast, follow, told=False):.2f}° without"
        )
    for trial in trials:
        path = track_orientation(trial.acc_mps2, trial.gyr_radps, trial.rate_hz)
        sd = math.degrees(float(np.sqrt(np.mean(path.tilt_sd_rad**2))))
        error = trial.score(upward(path.quaternion)) / math.sqrt(2.0)
        lines.append(f"{trial.name}, causal: own SD {sd:.2f}°, error about one axis {error:.2f}°")
    for name, follow in FILTERS.items():
        errors = {}
        for foot in feet:
            _, still, _ = find_zero_velocity(foot.acc_mps2, foot.gyr_radps, foot.rate_hz, causal=name == "causal")
            path = follow(foot.acc_mps2, foot.gyr_radps, foot.rate_hz, zero_velocity=still)
            errors[foot.name] = foot.score(upward(path.quaternion))
        each = ", ".join(f"{foot} {error:.2f}°" for foot, error in errors.items())
        lines.append(f"shoe, stance known, {name}: {np.mean(list(errors.values())):.2f}° ({each})")
    publish([], options, lines)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
