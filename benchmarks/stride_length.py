"""Stride length on real recordings with truth, each method with its one default setting.

    python benchmarks/stride_length.py [--json FILE]

Strides are found by our own phase machine, causally; each is compared with the reference between its own ends. Where
the reference is not at the sensor (footprints, heel marker), strides that turn by more than 20° are left out: the foot
swivels on the ground, and what the sensor travels is not what the footprint does.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections import defaultdict
from pathlib import Path
from typing import Literal, get_args

import numpy as np
from real_sets import all_walks, stroke_feet
from rich.console import Console
from rich.table import Table
from stroke_treadmill import LAST_S, data_folder

from fes.estimation.calibration import FootCalibration
from fes.estimation.foot import FootTracker
from fes.estimation.strides import StrideMaker, StrideSettings
from fes.recording import Track
from fes.replay import calibrate_track
from fes.signals import StrideResult

Method = Literal["constrained", "most_likely"]


def strides_of(track: Track, calibration: FootCalibration, method: Method) -> list[StrideResult]:
    """The valid strides that the tracker finds."""
    settings = StrideSettings(forward=calibration.forward(), up=np.array(calibration.up), method=method)
    tracker = FootTracker(calibration, StrideMaker(track.sensor, settings))
    outcomes = tracker.advance(track.t_sensor_ns, track.acc_mps2, track.gyr_radps)
    return [outcome for outcome in outcomes if isinstance(outcome, StrideResult) and outcome.valid]


def length_errors(method: Method) -> dict[str, list[float]]:
    """Estimate − truth (m) of every straight stride, by data set."""
    errors = defaultdict(list)
    for walk in all_walks():
        for stride in strides_of(walk.track, calibrate_track(walk.track), method):
            error = stride.stride_length_m - walk.true_length_m(stride)
            if walk.comparable(stride) and np.isfinite(error):
                errors[walk.data_set].append(error)
    return dict(errors)


def belt_ratios(method: Method) -> list[float]:
    """Walking speed over belt speed, per foot of the stroke treadmill runs, in the last 120 s."""
    ratios = []
    for _, track, belt_mps in stroke_feet(data_folder()):
        since = track.t_ns[-1] - LAST_S * 1e9
        late = [s for s in strides_of(track, calibrate_track(track), method) if s.t_start_ns >= since]
        time_s = 1e-9 * sum(s.t_end_ns - s.t_start_ns for s in late)
        ratios.append(sum(s.stride_length_m for s in late) / time_s / belt_mps)
    return ratios


def main(arguments: list[str] | None = None) -> int:
    """Print the table; 3 without data."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, help="write the figures here as well")
    options = parser.parse_args(arguments)
    table = Table("data", "method", "n", "bias", "SD", "RMSE", "worst", "unit")
    figures = []
    for method in get_args(Method):
        for name, values in length_errors(method).items():
            figures.append(_figures(name, method, 100.0 * np.array(values), "cm"))
        ratios = np.array(belt_ratios(method))
        if len(ratios):
            figures.append(_figures("stroke_treadmill, per foot", method, 100.0 * (ratios - 1.0), "% of belt"))
    if not figures:
        print(f"No recordings in {data_folder()}; set FES_DATA.", file=sys.stderr)
        return 3
    for row in sorted(figures, key=lambda f: str(f["data"])):
        numbers = [
            f"{row[key]:+.2f}" if key == "bias" else f"{row[key]:.2f}" for key in ("bias", "SD", "RMSE", "worst")
        ]
        table.add_row(str(row["data"]), str(row["method"]), str(row["n"]), *numbers, str(row["unit"]))
    console = Console() if sys.stdout.isatty() else Console(width=120)
    console.print(table)
    if options.json:
        options.json.write_text(json.dumps(figures, indent=1))
    return 0


def _figures(name: str, method: str, errors: np.ndarray, unit: str) -> dict[str, str | float | int]:
    return {
        "data": name,
        "method": method,
        "n": len(errors),
        "bias": float(errors.mean()),
        "SD": float(errors.std(ddof=1)),
        "RMSE": float(np.sqrt((errors**2).mean())),
        "worst": float(np.abs(errors).max()),
        "unit": unit,
    }


if __name__ == "__main__":
    raise SystemExit(main())
