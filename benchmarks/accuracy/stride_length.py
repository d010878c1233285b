"""Stride length and sensor lift on real recordings with truth, each method with its one default setting; 3 without.

Each stride of our own phase machine is compared with the reference between its own ends. Where the reference is not at
the sensor, strides that turn by more than 20° are counted apart ("turning"): the foot swivels on the ground.
"reference borders": the strides of gaitmap's own events instead, each end at the quietest instant within 50 ms. "lift,
arm fitted" takes the lever arm heel to sensor that fits best over all heights of that foot (three numbers a foot);
"clearance" of PyShoe one over all walks. "steady reference": without strides in which single samples of the reference
jump by more than 3 mm. "fused, off-line" is what `fes analyse` reports. "both feet of a run" and "half of left − right"
take the belt's errors apart: a belt that runs slower than it says is common to both feet.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import replace
from typing import Literal, get_args

import numpy as np
from scipy.signal import medfilt

from benchmarks.lib.command_line import no_recordings, parser_of, publish, table_of
from benchmarks.lib.real_sets import LAST_S, PathWalk, all_walks, data_folder, gaitmap_walk, pyshoe_vicon, stroke_feet
from fes.analysis.ground_path import lengths_along, mean_lengths
from fes.calibration.recording import calibrate_track
from fes.estimation.foot.calibration import FootCalibration
from fes.estimation.foot.tracker import FootTracker
from fes.estimation.numerics.records import new_core
from fes.estimation.strides import segmentation
from fes.estimation.strides.boundaries import QUIET_WINDOW_S, UNSEEN_NS, quietest_of
from fes.estimation.strides.results import TRAJECTORY_POINTS, StrideMaker, StrideSettings
from fes.estimation.strides.segmentation import new_out
from fes.estimation.zupt.foot_trajectory import foot_samples
from fes.recording import Track
from fes.signals import NS_PER_S, FloatArray, IntArray, StrideResult
from statemachine.phases import Phase, Transition

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
        assert walk.borders_s is not None
        found = strides_between(walk.track, walk.borders_s, method)
        strides = [s for s in found if walk.comparable(s) and walk.true_length_m(s) > 0.0]
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


# --- a stride between borders that are given from elsewhere, solved as the trackers solve their own -------------------

NO_BIASES = np.zeros((2, 3))
NEAR_S = 0.05  # of a stance's instant given from elsewhere, the quietest is sought this far on either side
ENTRIES = [f"t_{phase.name.lower()}_ns" for phase in Phase]


def solve_stride(
    foot: str, number: int, times: dict[Phase, int], first: int, last: int, t_ns: IntArray, acc: FloatArray,
    gyr: FloatArray, start_quaternion: FloatArray, settings: StrideSettings, before_ns: int | None = None,
) -> StrideResult:  # fmt: skip
    """Integrate the samples ``first`` … ``last`` of a history into a stride's numbers.

    ``acc`` (N, 3) m/s² and ``gyr`` (N, 3) rad/s free of bias; ``start_quaternion`` (4,) the orientation at ``first``;
    ``times`` the entries into the phases; ``before_ns`` where the stride before ended, for the speed.
    """
    out = new_out(1, len(t_ns), TRAJECTORY_POINTS)
    row = out.strides[0]
    row["number"], row["t_start_ns"], row["t_end_ns"] = number, t_ns[first], t_ns[last]
    for name, phase in zip(ENTRIES, Phase, strict=True):
        row[name] = times.get(phase, UNSEEN_NS)
    out.filled[segmentation.STRIDES] = 1
    own = new_core(segmentation.STRIDE_STATE, settings=settings.compiled(foot))
    segmentation.restart(own, 0)
    own["state"]["before_ns"] = UNSEEN_NS if before_ns is None else before_ns
    segmentation.solve_rows(own, first, last, len(t_ns), t_ns, acc, gyr, start_quaternion, NO_BIASES, out)
    return StrideMaker(foot, settings).stride_in(out)


def quietest_near(t_ns: IntArray, gyr: FloatArray, at_ns: int) -> int:
    """Index of the quietest instant within ±50 ms of a stance's instant that is known from elsewhere."""
    reach_ns = int(1e9 * (NEAR_S + 0.5 * QUIET_WINDOW_S))
    return int(quietest_of(t_ns, gyr, len(t_ns), 0.0, 0.0, 0.0, at_ns - reach_ns, at_ns + reach_ns))


# --- how high the sensor rises, where the reference tracks another point of the foot ----------------------------------


def fitted(estimates: list[FloatArray], references: list[FloatArray], arms: list[FloatArray]) -> list[float]:
    """Errors (m) of the greatest height of each stride after the best arm.

    Per stride: heights (K,) of sensor and tracked point above their start, and the change (K, M) of the vertical part
    of each of the arm's components.
    """
    if not estimates:
        return []
    rows = [estimate - reference for estimate, reference in zip(estimates, references, strict=True)]
    arm = np.linalg.lstsq(np.vstack(arms), np.concatenate(rows), rcond=None)[0]
    return [
        float(estimate.max() - (reference + rise @ arm).max())
        for estimate, reference, rise in zip(estimates, references, arms, strict=True)
    ]


def _rows(walk: PathWalk, stride: StrideResult, path: FloatArray) -> FloatArray:
    first, last = walk.span(stride)
    return path[first : last + 1]


def _heights(stride: StrideResult, count: int) -> FloatArray:
    at = np.linspace(0.0, 1.0, count)
    return np.interp(at, np.linspace(0.0, 1.0, len(stride.trajectory_m)), stride.trajectory_m[:, 2])


def arm_fitted(walk: PathWalk, strides: list[StrideResult]) -> list[float]:
    """Errors of the lift (m) with the arm from the tracked point to the sensor fitted to this foot's strides."""
    if walk.frame is None:
        return []
    references = [_rows(walk, s, walk.position_m)[:, 2] for s in strides]
    vertical = [_rows(walk, s, walk.frame[:, 2, :]) for s in strides]
    return fitted(
        [_heights(s, len(z)) for s, z in zip(strides, references, strict=True)],
        [z - np.median(z[:3]) for z in references],
        [v - np.median(v[:3], axis=0) for v in vertical],
    )


def glitch_m(height: FloatArray) -> float:
    """By how much a single sample of a reference (N,) leaves its neighbours: the greatest distance from a median of 5.

    A foot's own movement leaves a millimetre at 200 Hz.
    """
    return float(np.abs(height - medfilt(height, 5))[2:-2].max())


def clearance_errors(method: str, most_glitch_m: float = float("inf")) -> list[float]:
    """PyShoe's clearance (m), the marker's arm fitted over all walks in the foot's sagittal plane.

    The orientation is the estimate's pitch; strides with a glitch of the reference, over 8 m/s, are left out, and those
    where :func:`glitch_m` of its height is more than ``most_glitch_m``.
    """
    estimates, references, arms = [], [], []
    for walk in pyshoe_vicon(data_folder()):
        for stride in strides_of(walk.track, calibrate_track(walk.track), method):
            if not np.isfinite(walk.true_length_m(stride)):
                continue
            height = _rows(walk, stride, walk.position_m)[:, 2]
            if glitch_m(height) > most_glitch_m:
                continue
            at = np.linspace(0.0, 1.0, len(height))
            pitch = np.interp(at, np.linspace(0.0, 1.0, len(stride.pitch_rad)), stride.pitch_rad)
            level = height - np.median(height[:6]) - at * (np.median(height[-6:]) - np.median(height[:6]))
            estimates.append(_heights(stride, len(height)))
            references.append(level)
            arms.append(-np.column_stack((np.sin(pitch), np.cos(pitch) - 1.0)))
    return fitted(estimates, references, arms)


def main(arguments: list[str] | None = None) -> int:
    options = parser_of(__doc__).parse_args(arguments)
    found: list[tuple[str, str, FloatArray, str]] = []
    for method in METHODS:
        errors = length_errors(method) | border_errors(method)
        errors["pyshoe_vicon, clearance"] = clearance_errors(method)
        errors["pyshoe_vicon, clearance, steady reference"] = clearance_errors(method, STEADY_M)
        found += [(name, method, 100.0 * np.array(values), "cm") for name, values in errors.items() if values]
        ratios = np.array(belt_ratios(method))
        if len(ratios):
            runs = ratios.reshape(-1, 2)  # left and right
            parts = {
                "per foot": ratios - 1.0,
                "both feet of a run": runs.mean(axis=1) - 1.0,
                "half of left − right": 0.5 * (runs[:, 0] - runs[:, 1]),
            }
            found += [(f"stroke_treadmill, {name}", method, 100.0 * e, "% of belt") for name, e in parts.items()]
    if not found:
        return no_recordings(data_folder())
    rows = [
        [name, method, str(len(e)), f"{e.mean():+.2f}", f"{e.std(ddof=1):.2f}", f"{np.sqrt((e**2).mean()):.2f}",
         f"{np.abs(e).max():.2f}", unit] for name, method, e, unit in sorted(found, key=lambda row: row[0])
    ]  # fmt: skip
    table = table_of("", ("data", "method", "n", "bias", "SD", "RMSE", "worst", "unit"), rows)
    publish([table], options, folder=data_folder())
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
