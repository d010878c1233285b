"""Stride length and sensor lift on real recordings with truth, each method with its one default setting.

    python benchmarks/accuracy/stride_length.py [--json FILE]

Strides are found by our own phase machine, causally; each is compared with the reference between its own ends. Where
the reference is not at the sensor (footprints, heel marker), strides that turn by more than 20° are left out (and
counted apart, "turning"): the foot swivels on the ground, and what the sensor travels is not what the footprint does.
"reference borders": the strides of gaitmap's own events instead, each end at the quietest instant within 50 ms of the
given one. "lift" is the sensor's clearance; "lift, arm fitted" takes the lever arm heel to sensor that fits best over
all heights of that foot (three numbers a foot) instead of the stated "about" 0.076 m forward and 0.05 m outward.
"clearance" of PyShoe is through an arm fitted in the same way over all walks: its marker is not at the sensor. "steady
reference" leaves out strides in which single samples of that reference jump by more than 3 mm.

constrained and maximum_likelihood are known when the stride ends. "fused, off-line" is what `fes analyse` reports: the
mean of maximum_likelihood and of a filter that looks at the whole recording (fes.analysis.stride_fusion); heights are
maximum_likelihood's.

"both feet of a run" and "half of left − right" take the belt's errors apart: a belt that runs slower than it says is
common to both feet of a run, and the two feet of one run go the same way, so half their difference is our own error.

Of the fusion, three sizes of the filter were chosen from a grid of 48 with all sets at hand. Leaving out one set each
and choosing by the mean ratio to the bars of the others gives on that set: PyShoe 1.37 cm, ruler 1.29, gaitmap 1.55
(own detection) and 1.52 (reference borders), stroke SD 0.62 %, worst foot 1.9 %. Over the whole grid: 1.32–1.39,
1.22–1.34, 1.38–1.61, 1.35–1.58 cm, SD 0.56–0.62 %, worst 1.4–1.9 %. With the filter's plain defaults: 1.38, 1.26,
1.47, 1.45 cm, 0.58 %, 1.6 %. The other sizes of maximum_likelihood were chosen while looking at all sets.
"""

from __future__ import annotations

import sys
from collections import defaultdict
from dataclasses import replace
from typing import Literal, get_args

import numpy as np
from rich.table import Table

from benchmarks.accuracy.given_borders import quietest_near, solve_stride
from benchmarks.accuracy.lift import arm_fitted, clearance_errors
from benchmarks.accuracy.stroke_treadmill import LAST_S, data_folder
from benchmarks.lib.command_line import console_of, parser_of, publish
from benchmarks.lib.real_sets import PathWalk, all_walks, gaitmap_walk, stroke_feet
from fes.analysis.stride_fusion import lengths_along, mean_lengths
from fes.calibration.recording import calibrate_track
from fes.estimation.foot.calibration import FootCalibration
from fes.estimation.foot.tracker import FootTracker
from fes.estimation.strides.results import StrideMaker, StrideSettings
from fes.estimation.zupt.foot_trajectory import foot_samples
from fes.recording import Track
from fes.signals import NS_PER_S, FloatArray, StrideResult
from statemachine.phases import Transition

Method = Literal["constrained", "maximum_likelihood"]
FUSED = "fused, off-line"  # maximum_likelihood, then with the whole recording
METHODS = (*get_args(Method), FUSED)
STEADY_M = 0.003


def settings_of(calibration: FootCalibration, method: str) -> StrideSettings:
    """Default settings of a method."""
    plain: Method = "constrained" if method == "constrained" else "maximum_likelihood"
    return StrideSettings(forward=calibration.forward(), up=np.array(calibration.up), method=plain)


def afterwards(track: Track, strides: list[StrideResult], method: str) -> list[StrideResult]:
    """What a method makes of the strides of one foot once the recording is over."""
    if method != FUSED:
        return strides
    try:
        foot = foot_samples(track.t_sensor_ns, track.acc_mps2, track.gyr_radps)
    except ValueError:  # too short to tell rest from movement, or no rest
        return strides
    begin, end, own_m = (
        np.array([getattr(s, n) for s in strides]) for n in ("t_start_ns", "t_end_ns", "stride_length_m")
    )
    lengths = mean_lengths(own_m, lengths_along(foot, begin, end)).tolist()
    return [_with_length(stride, m) if np.isfinite(m) else stride for stride, m in zip(strides, lengths, strict=True)]


def _with_length(stride: StrideResult, length_m: float) -> StrideResult:
    own_m = stride.stride_length_m
    return replace(
        stride,
        stride_length_m=length_m,
        speed_mps=stride.speed_mps * length_m / own_m,
        trajectory_m=stride.trajectory_m * np.array([length_m / own_m, 1.0, 1.0]),
    )


def strides_of(track: Track, calibration: FootCalibration, method: str) -> list[StrideResult]:
    """The valid strides that the tracker finds."""
    tracker = FootTracker(calibration, StrideMaker(track.sensor, settings_of(calibration, method)))
    outcomes = tracker.advance(track.t_sensor_ns, track.acc_mps2, track.gyr_radps)
    strides = [outcome for outcome in outcomes if isinstance(outcome, StrideResult) and outcome.valid]
    return afterwards(track, strides, method)


def border_strides(walk: PathWalk, method: str) -> list[StrideResult]:
    """The strides between the reference's own borders instead of the tracker's."""
    borders_s = walk.borders_s if walk.borders_s is not None else np.zeros((0, 2))
    return strides_between(walk.track, borders_s, method)


def strides_between(track: Track, borders_s: FloatArray, method: str) -> list[StrideResult]:
    """The valid strides between given borders (K, 2), s, each moved to the quietest instant near it."""
    calibration = calibrate_track(track)
    settings = settings_of(calibration, method)
    tracker = FootTracker(calibration, StrideMaker(track.sensor, settings))
    borders_ns = np.round(borders_s * NS_PER_S)
    solved: list[StrideResult] = []
    for sample in zip(track.t_sensor_ns.tolist(), track.acc_mps2.tolist(), track.gyr_radps.tolist(), strict=True):
        outcomes = tracker.step(*sample)
        if not any(isinstance(outcome, StrideResult) or outcome.transition is Transition.T1 for outcome in outcomes):
            continue
        t_ns, acc, gyr, quaternion = tracker.history()
        for start_ns, end_ns in borders_ns.astype(np.int64)[len(solved) :]:
            if end_ns + 200_000_000 >= t_ns[-1]:
                break
            first, last = (quietest_near(t_ns, gyr, int(at_ns)) for at_ns in (start_ns, end_ns))
            number, start = len(solved) + 1, quaternion[first]
            solved.append(solve_stride(track.sensor, number, {}, first, last, t_ns, acc, gyr, start, settings))
    return afterwards(track, [stride for stride in solved if stride.valid], method)


def border_errors(method: str) -> dict[str, list[float]]:
    """Errors (m) between the reference's borders, straight strides: of length, and of lift by two lever arms."""
    name = "gaitmap_walk, reference borders"
    errors: dict[str, list[float]] = defaultdict(list)
    for walk in gaitmap_walk(data_folder()):
        if not isinstance(walk, PathWalk):
            continue
        strides = [s for s in border_strides(walk, method) if walk.comparable(s) and walk.true_length_m(s) > 0.0]
        errors[name] += [s.stride_length_m - walk.true_length_m(s) for s in strides]
        errors[f"{name}, lift"] += [s.clearance_m - walk.true_lift_m(s) for s in strides]
        errors[f"{name}, lift, arm fitted"] += arm_fitted(walk, strides)
    return dict(errors)


def length_errors(method: str) -> dict[str, list[float]]:
    """Estimate − truth (m) of every straight stride, by data set; the turning ones of the others apart."""
    errors = defaultdict(list)
    for walk in all_walks():
        for stride in strides_of(walk.track, calibrate_track(walk.track), method):
            error = stride.stride_length_m - walk.true_length_m(stride)
            if np.isfinite(error):
                errors[walk.data_set if walk.comparable(stride) else f"{walk.data_set}, turning"].append(error)
    return dict(errors)


def belt_ratios(method: str) -> list[float]:
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
    options = parser_of(__doc__).parse_args(arguments)
    table = Table("data", "method", "n", "bias", "SD", "RMSE", "worst", "unit")
    figures = []
    for method in METHODS:
        found = length_errors(method) | border_errors(method) | clearance_errors(method, strides_of)
        steady = clearance_errors(method, strides_of, STEADY_M)
        found |= {f"{name}, steady reference": values for name, values in steady.items()}
        for name, values in found.items():
            figures.append(_figures(name, method, 100.0 * np.array(values), "cm"))
        ratios = np.array(belt_ratios(method))
        if len(ratios):
            runs = ratios.reshape(-1, 2)  # left and right
            for name, off in (
                ("per foot", ratios - 1.0),
                ("both feet of a run", runs.mean(axis=1) - 1.0),
                ("half of left − right", 0.5 * (runs[:, 0] - runs[:, 1])),
            ):
                figures.append(_figures(f"stroke_treadmill, {name}", method, 100.0 * off, "% of belt"))
    if not figures:
        print(f"No recordings in {data_folder()}; set FES_DATA.", file=sys.stderr)
        return 3
    for row in sorted(figures, key=lambda f: str(f["data"])):
        numbers = [
            f"{row[key]:+.2f}" if key == "bias" else f"{row[key]:.2f}" for key in ("bias", "SD", "RMSE", "worst")
        ]
        table.add_row(str(row["data"]), str(row["method"]), str(row["n"]), *numbers, str(row["unit"]))
    publish(console_of(120), [table], options, folder=data_folder())
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
