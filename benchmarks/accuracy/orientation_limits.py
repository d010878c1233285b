"""The orientation filter where it is hardest, or knows more: a clipped gyroscope, its own confidence, a known stance.

    python benchmarks/accuracy/orientation_limits.py [--data FOLDER] [--json FILE]

Clipped: the fast board's rates cut at 1000 °/s, with the range told to the filter and without. Confidence: the filter's
own standard deviation of the inclination about one axis, beside the error about one axis. Stance: the shoes of
gaitmap_walk, rest told by the zero-velocity detector.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from benchmarks.accuracy.orientation_sets import Trial, broad, gaitmap_pitch, upward
from benchmarks.accuracy.stroke_treadmill import data_folder
from benchmarks.lib.command_line import console_of, parser_of, publish
from fes.estimation.orientation.body import OrientationPath, smooth_orientation, track_orientation
from fes.estimation.zupt.thresholds import find_zero_velocity

RANGE_DPS = 1000.0
FILTERS: dict[str, Callable[..., OrientationPath]] = {"causal": track_orientation, "off-line": smooth_orientation}


def clipped_deg(trial: Trial, follow: Callable[..., OrientationPath], *, told: bool) -> float:
    """RMSE behind a gyroscope of 1000 °/s."""
    limit = math.radians(RANGE_DPS)
    rates = np.clip(trial.gyr_radps, -limit, limit)
    path = follow(trial.acc_mps2, rates, trial.rate_hz, gyr_range_radps=limit if told else None)
    return trial.score(upward(path.quaternion))


def main() -> int:
    """Print the figures; 3 without recordings."""
    options = parser_of(__doc__, data_folder()).parse_args()
    folder, lines = options.data, []
    console = console_of(150)
    trials, feet = broad(folder), gaitmap_pitch(folder)
    if not trials or not feet:
        console.print(f"no broad or gaitmap_walk in {folder}: set FES_DATA or give --data")
        return 3
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
    publish(console, [], options, lines)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
