"""Shank sensors on the stroke-treadmill recordings: phases against the foot's, speed, left from right; 3 without data.

One default setting for all runs and both sides. Strides whose shank passes the four phases in order are counted by the
foot sensor's mid-swings. Speed is the sum of stride lengths over that of stride times in the last 120 s, over the
belt's: of the causal strides, and off-line with the velocity reset to zero (zupt), with one arm of 0.35 m from ankle to
sensor (fixed), and with the arm learnt from the first minute (Wu et al.). "Held out": which foot is left, by signs
learnt from the other subjects.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from benchmarks.lib.command_line import no_recordings, parser_of, publish, verdict
from benchmarks.lib.real_sets import LAST_S, data_folder, gaitmap_feet, load_run, runs_of
from benchmarks.lib.swing_judge import IN_ORDER, mid_swings
from benchmarks.lib.walkers import causal
from fes.calibration.recording import calibrate_shank_track, calibrate_track
from fes.calibration.side_detection import MIN_AGREEING, MIN_SCORE, side_signs, tell_sides
from fes.estimation.foot.calibration import CalibrationError, stretch_for_calibration
from fes.estimation.shank.calibration import ShankCalibration
from fes.estimation.shank.motion import stride_spans, swing_peaks
from fes.estimation.shank.tracker import ShankIntegrationSettings, solve_shank_stride
from fes.recording import Track
from fes.signals import FloatArray, IntArray, StrideResult
from statemachine.phases import Transition

MIN_IN_ORDER, MIN_SIDE, MOST_FALSE_PER_100 = 0.995, 0.97, 0.2
FIXED_ARM_M, MEAN_BAR, WORST_BAR = 0.35, (0.98, 1.02), 0.08
SHOWN = {"heel off": Transition.T1, "foot off": Transition.T2, "contact": Transition.T3, "foot flat": Transition.T4}


@dataclass(frozen=True)
class SideResult:
    """One shank of one run; ``later_ms`` are of T1 to T4 against the foot's, medians; speeds are over the belt's (NaN
    where self-paced), the arm is (forward, left, up) in m."""

    run: str
    sensor: str
    strides: int
    in_order: int
    false_swings: int
    later_ms: tuple[float, ...]
    causal: float
    zupt: float
    fixed: float
    learnt: float
    arm_m: tuple[float, ...]
    condition: float
    solved: int
    invalid: int


@dataclass(frozen=True)
class Told:
    """Which foot is left, of one recording."""

    subject: str
    right: bool
    sure: bool
    held_out_right: bool
    held_out_sure: bool


def shank_strides(
    t_ns: IntArray, acc_mps2: FloatArray, gyr_radps: FloatArray, calibration: ShankCalibration,
    settings: ShankIntegrationSettings | None = None,
) -> list[StrideResult]:  # fmt: skip
    """All strides of a recording as measured, off-line; unusable ones are there too, with the reason."""
    settings = settings or ShankIntegrationSettings.for_calibration(calibration)
    acc = acc_mps2 - np.array(calibration.acc_bias_mps2)
    gyr = gyr_radps - np.array(calibration.gyr_bias_radps)
    spans = stride_spans(gyr, swing_peaks(gyr @ settings.left, calibration.rate_hz), calibration.rate_hz)
    return [
        solve_shank_stride(calibration.sensor, number, span, t_ns, acc, gyr, settings)
        for number, span in enumerate(spans, start=1)
    ]


def speed_mps(strides: list[StrideResult], track: Track) -> float:
    """Of the valid strides of the last 120 s."""
    late = [s for s in strides if s.valid and s.t_start_ns >= track.t_ns[-1] - LAST_S * 1e9]
    return sum(s.stride_length_m for s in late) / (1e-9 * sum(s.t_end_ns - s.t_start_ns for s in late))


def with_arm(track: Track, calibration: ShankCalibration, arm: FloatArray | None) -> list[StrideResult]:
    """The strides with one arm; None: zero velocity."""
    settings = ShankIntegrationSettings(np.array(calibration.up), np.array(calibration.left), arm)
    return shank_strides(track.t_ns, track.acc_mps2, track.gyr_radps, calibration, settings)


def evaluate_side(run: str, foot: Track, shank: Track, belt_mps: float) -> SideResult:
    """One side of one run."""
    calibration = calibrate_shank_track(shank)
    changes, strides = causal(shank, calibration)
    theirs, _ = causal(foot, calibrate_track(foot))
    peaks_ns = foot.t_ns[mid_swings(foot.gyr_radps[:, 1], foot.rate_hz)]
    in_order = false_swings = 0
    later: dict[Transition, list[float]] = {each: [] for each in SHOWN.values()}
    for begin, end in pairwise(peaks_ns):
        own, other = ([c for c in each if begin <= c.t_ns < end] for each in (changes, theirs))
        fired = tuple(change.transition for change in own)
        in_order += fired == IN_ORDER
        false_swings += max(fired.count(Transition.T2) - 1, 0)
        if fired == IN_ORDER == tuple(change.transition for change in other):
            for a, b in zip(own, other, strict=True):
                later[a.transition].append(1e-6 * (a.t_ns - b.t_ns))
    up, arm = np.array(calibration.up), np.array(calibration.arm.arm_m)
    solved = with_arm(shank, calibration, arm)
    speeds = [strides, *(with_arm(shank, calibration, each) for each in (None, FIXED_ARM_M * up)), solved]
    axes = np.stack((calibration.forward(), np.array(calibration.left), up))
    return SideResult(
        run, shank.sensor, len(peaks_ns) - 1, in_order, false_swings,
        tuple(float(np.median(ms)) for ms in later.values()), *(speed_mps(s, shank) / belt_mps for s in speeds),
        tuple((axes @ arm).tolist()), calibration.arm.condition, len(solved), sum(not s.valid for s in solved),
    )  # fmt: skip


def evaluate(path: Path) -> list[SideResult]:
    """Both sides of one run."""
    (feet, belt_mps), (shanks, _) = load_run(path), load_run(path, "shank")
    pairs = zip(feet.values(), shanks.values(), strict=True)
    return [evaluate_side(path.stem, foot, shank, belt_mps) for foot, shank in pairs]


def signs_of(track: Track) -> FloatArray | None:
    """The four signs of one foot, from its first minute."""
    rows = stretch_for_calibration(track.t_sensor_ns, track.gyr_radps)
    try:
        calibration = calibrate_track(track)
    except CalibrationError:
        return None
    return side_signs(track.t_sensor_ns[rows], track.acc_mps2[rows], track.gyr_radps[rows], calibration)


def tell_all(data: Path) -> list[Told]:
    """Left from right on every recording of two feet, with the module's constants and with the other subjects'."""
    both = [(path.stem[:4], load_run(path)[0]) for path in runs_of(data)]
    walks = (data / "gaitmap_walk" / f"{name}.csv" for name in ("imu_sample", "imu_sample_healthy_stair_up"))
    both += [("gaitmap", gaitmap_feet(path)) for path in walks if path.exists()]
    signs = [(subject, *(signs_of(feet[f"{side}_foot"]) for side in ("left", "right"))) for subject, feet in both]
    measured = [(subject, left, right) for subject, left, right in signs if left is not None and right is not None]
    told = []
    for subject, left, right in measured:
        found = tell_sides(left, right)
        others = np.array([a - b for other, a, b in measured if other != subject])
        learnt = np.sign(np.median(others, axis=0)) * np.median(np.abs(others), axis=0)
        votes = np.clip((left - right) / learnt, -1.0, 1.0)
        agreeing = int(max(np.count_nonzero(votes > 0.0), np.count_nonzero(votes < 0.0)))
        sure = bool(abs(votes.mean()) >= MIN_SCORE and agreeing >= MIN_AGREEING)
        told.append(Told(subject, found.left == 0, found.sure, bool(votes.sum() > 0.0), sure))
    return told


def holds(results: list[SideResult], told: list[Told]) -> bool:
    """Whether all bars hold."""
    strides = sum(r.strides for r in results)
    learnt = np.array([r.learnt for r in results if not np.isnan(r.learnt)])
    return bool(
        sum(r.in_order for r in results) >= MIN_IN_ORDER * strides
        and min(r.in_order / r.strides for r in results) >= MIN_SIDE
        and 100 * sum(r.false_swings for r in results) <= MOST_FALSE_PER_100 * strides
        and MEAN_BAR[0] <= learnt.mean() <= MEAN_BAR[1]
        and np.abs(learnt - 1.0).max() <= WORST_BAR
        and all((t.right or not t.sure) and (t.held_out_right or not t.held_out_sure) for t in told)
    )


def lines_of(results: list[SideResult], told: list[Told]) -> list[str]:
    """What it comes to."""
    strides, ordered = sum(r.strides for r in results), sum(r.in_order for r in results)
    worst = min(results, key=lambda r: r.in_order / r.strides)
    lines = [
        f"Four phases in order: {ordered} of {strides} ({100 * ordered / strides:.2f} %), worst {worst.run} "
        f"{worst.sensor} {100 * worst.in_order / worst.strides:.1f} %; false swings per 100 strides: "
        f"{100 * sum(r.false_swings for r in results) / strides:.3f}"
    ]
    for name, column in zip(SHOWN, np.array([r.later_ms for r in results]).T, strict=True):
        lines.append(
            f"{name}: later than the foot's by {np.median(column):+.0f} ms (median of sides, "
            f"{column.min():+.0f} to {column.max():+.0f})"
        )
    for name in ("causal", "zupt", "fixed", "learnt"):
        ratios = np.array([getattr(r, name) for r in results])
        ratios = ratios[~np.isnan(ratios)]
        lines.append(
            f"{name}: speed over belt, {len(ratios)} sides: mean {ratios.mean():.4f}, SD {ratios.std(ddof=1):.4f}, "
            f"from {ratios.min():.4f} to {ratios.max():.4f}"
        )
    lines.append(
        f"Left from right: {sum(t.right for t in told)} of {len(told)} rightly, {sum(t.sure for t in told)} sure; held "
        f"out by subject {sum(t.held_out_right for t in told)} rightly, {sum(t.held_out_sure for t in told)} sure "
        f"({len({t.subject for t in told})} subjects)"
    )
    return lines


def main(arguments: list[str] | None = None) -> int:
    options = parser_of(__doc__, data_folder()).parse_args(arguments)
    if not (paths := runs_of(options.data)):
        return no_recordings(options.data)
    results, told = [result for path in paths for result in evaluate(path)], tell_all(options.data)
    publish([], options, lines_of(results, told))
    return verdict(holds(results, told))


if __name__ == "__main__":
    raise SystemExit(main())
