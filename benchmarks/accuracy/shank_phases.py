"""Phases from shank sensors, and left from right, on real walks; exit code 1 if a bar fails, 3 without data.

    python benchmarks/accuracy/shank_phases.py [--data FOLDER] [--json FILE]

Per run and side of the stroke-treadmill recordings, causally and with one default setting: strides whose shank passes
the four phases in order, counted against the FOOT sensor's mid-swings as for feet (``stroke_treadmill.py``); false
swings; how much later than the foot sensor's phases the shank's begin (median and SD, ms); speed of the causal strides
over the belt's. Then which of two unlabelled feet is left, over all recordings with two feet, also with the signs'
directions and sizes learnt from the other subjects. The bars: 99.5 % in order, no side below 97 %, at most 0.2 false
swings per 100 strides, and no side told wrongly that was told as sure.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks.accuracy.ankle import calibrate, load_shanks
from benchmarks.accuracy.stroke_treadmill import (
    IN_ORDER,
    LAST_S,
    data_folder,
    load_run,
    mid_swings,
    runs_of,
    track_foot,
    track_of,
)
from benchmarks.lib.command_line import console_of, parser_of, publish, verdict
from fes.calibration.recording import calibrate_track
from fes.calibration.side_detection import MIN_AGREEING, MIN_SCORE, side_signs, tell_sides
from fes.estimation.foot.calibration import CalibrationError, stretch_for_calibration
from fes.estimation.shank.tracker import ShankTracker
from fes.recording import Track
from fes.signals import FloatArray, StrideResult
from statemachine.phases import PhaseChange, Transition

MIN_IN_ORDER, MIN_SIDE, MOST_FALSE_PER_100 = 0.995, 0.97, 0.2
SHOWN = (Transition.T1, Transition.T2, Transition.T3, Transition.T4)


@dataclass(frozen=True)
class SideResult:
    """One shank of one run; ``later_ms`` and ``later_sd_ms`` are of T1, T2, T3, T4 against the foot's."""

    run: str
    sensor: str
    strides: int
    in_order: int
    false_swings: int
    later_ms: tuple[float, ...]
    later_sd_ms: tuple[float, ...]
    speed_ratio: float
    invalid: int
    solved: int


@dataclass(frozen=True)
class Told:
    """Which foot is left, of one recording; ``held_out``: by signs learnt from the other subjects."""

    subject: str
    recording: str
    right: bool
    sure: bool
    score: float
    agreeing: int
    held_out_right: bool
    held_out_sure: bool


def between(changes: list[PhaseChange], begin: int, end: int) -> list[PhaseChange]:
    """The changes from begin to end (ns)."""
    return [change for change in changes if begin <= change.t_ns < end]


def evaluate_side(run: str, foot: Track, shank: Track, belt_mps: float) -> SideResult:
    """One side of one run."""
    calibration = calibrate(shank.sensor, shank.rate_hz, shank.acc_mps2, shank.gyr_radps)
    outcomes = ShankTracker(calibration).advance(shank.t_sensor_ns, shank.acc_mps2, shank.gyr_radps)
    changes = [outcome for outcome in outcomes if isinstance(outcome, PhaseChange)]
    feet = [o for o in track_foot(foot, calibrate_track(foot)) if isinstance(o, PhaseChange)]
    peaks_ns = foot.t_ns[mid_swings(foot.gyr_radps[:, 1], foot.rate_hz)]
    in_order = false_swings = 0
    later: list[list[float]] = [[] for _ in SHOWN]
    for begin, end in pairwise(peaks_ns):
        mine, theirs = between(changes, begin, end), between(feet, begin, end)
        fired = tuple(change.transition for change in mine)
        in_order += fired == IN_ORDER
        false_swings += max(fired.count(Transition.T2) - 1, 0)
        if fired == IN_ORDER == tuple(change.transition for change in theirs):
            for a, b in zip(mine, theirs, strict=True):
                later[SHOWN.index(a.transition)].append(1e-6 * (a.t_ns - b.t_ns))
    strides = [outcome for outcome in outcomes if isinstance(outcome, StrideResult)]
    late = [s for s in strides if s.valid and s.t_start_ns >= shank.t_ns[-1] - LAST_S * 1e9]
    time_s = 1e-9 * sum(s.t_end_ns - s.t_start_ns for s in late)
    return SideResult(
        run=run,
        sensor=shank.sensor,
        strides=len(peaks_ns) - 1,
        in_order=in_order,
        false_swings=false_swings,
        later_ms=tuple(float(np.median(v)) for v in later),
        later_sd_ms=tuple(float(np.std(v)) for v in later),
        speed_ratio=sum(s.stride_length_m for s in late) / time_s / belt_mps,
        invalid=sum(not s.valid for s in strides),
        solved=len(strides),
    )


def signs_of(track: Track) -> FloatArray | None:
    """The four signs of one foot, from its first minute."""
    rows = stretch_for_calibration(track.t_sensor_ns, track.gyr_radps)
    try:
        calibration = calibrate_track(track)
    except CalibrationError:
        return None
    return side_signs(track.t_sensor_ns[rows], track.acc_mps2[rows], track.gyr_radps[rows], calibration)


def two_feet(data: Path) -> list[tuple[str, str, dict[str, Track]]]:
    """Subject, recording and both feet of all recordings that have them."""
    found = [(p.stem[:4], p.stem, load_run(p)[0]) for p in sorted((data / "stroke_treadmill").glob("*.npz"))]
    for name in ("imu_sample", "imu_sample_healthy_stair_up"):
        path = data / "gaitmap_walk" / f"{name}.csv"
        if path.exists():
            found.append(("gaitmap", name, gaitmap_feet(path)))
    return found


def gaitmap_feet(path: Path) -> dict[str, Track]:
    """Both feet of a gaitmap recording: names in two header lines, specific force in m/s², rates in deg/s, 204.8 Hz."""
    with path.open() as file:
        above, below = (file.readline().rstrip("\n").split(",") for _ in range(2))
        values = np.genfromtxt(file, delimiter=",")
    column = {names: k for k, names in enumerate(zip(above, below, strict=True))}
    tracks = {}
    for side in ("left", "right"):
        acc, gyr = (values[:, [column[f"{side}_sensor", f"{kind}_{a}"] for a in "xyz"]] for kind in ("acc", "gyr"))
        whole = np.isfinite(acc).all(axis=1) & np.isfinite(gyr).all(axis=1)
        tracks[f"{side}_foot"] = track_of(f"{side}_foot", 204.8, acc[whole], np.radians(gyr[whole]))
    return tracks


def tell_all(data: Path) -> list[Told]:
    """Left from right on every recording, with the module's constants and with those of the other subjects."""
    measured: list[tuple[str, str, FloatArray, FloatArray]] = []
    for subject, name, tracks in two_feet(data):
        left, right = (signs_of(tracks[f"{side}_foot"]) for side in ("left", "right"))
        if left is not None and right is not None:
            measured.append((subject, name, left, right))
    told = []
    for subject, name, left, right in measured:
        verdict = tell_sides(left, right)
        others = np.array([a - b for s, _, a, b in measured if s != subject])
        learnt = np.sign(np.median(others, axis=0)) * np.median(np.abs(others), axis=0)
        votes = np.clip((left - right) / learnt, -1.0, 1.0)
        agreeing = int(max(np.count_nonzero(votes > 0.0), np.count_nonzero(votes < 0.0)))
        sure = bool(abs(votes.mean()) >= MIN_SCORE and agreeing >= MIN_AGREEING)
        held = bool(votes.sum() > 0.0)
        told.append(Told(subject, name, verdict.left == 0, verdict.sure, verdict.score, verdict.agreeing, held, sure))
    return told


def evaluate(path: Path) -> list[SideResult]:
    """Both sides of one run."""
    feet, belt_mps = load_run(path)
    shanks, rate_hz, _ = load_shanks(path)
    return [
        evaluate_side(path.stem, feet[sensor.replace("shank", "foot")], track_of(sensor, rate_hz, *values), belt_mps)
        for sensor, values in shanks.items()
    ]


def holds(results: list[SideResult], told: list[Told]) -> bool:
    """Whether all bars hold."""
    strides = sum(r.strides for r in results)
    return (
        sum(r.in_order for r in results) >= MIN_IN_ORDER * strides
        and min(r.in_order / r.strides for r in results) >= MIN_SIDE
        and 100 * sum(r.false_swings for r in results) <= MOST_FALSE_PER_100 * strides
        and all((t.right or not t.sure) and (t.held_out_right or not t.held_out_sure) for t in told)
    )


def main(arguments: list[str] | None = None) -> int:
    """Print the tables; 0 when the bars hold, 1 when not, 3 without data."""
    options = parser_of(__doc__, data_folder()).parse_args(arguments)
    if not (paths := runs_of(options.data)):
        return 3
    results = [result for path in paths for result in evaluate(path)]
    told = tell_all(options.data)
    console = console_of(150)
    publish(console, [], options, [*show_phases(results, console), *show_sides(told, console)])
    return verdict(console, holds(results, told), several=True)


def show_phases(results: list[SideResult], console: Console) -> list[str]:
    """Print the table of phases; what it comes to."""
    names = ("heel off", "foot off", "contact", "foot flat")
    table = Table("run", "side", "in order", "false", *(f"{n} ms" for n in names), "speed / belt", "valid")
    for r in results:
        later = [f"{m:+.0f} ± {sd:.0f}" for m, sd in zip(r.later_ms, r.later_sd_ms, strict=True)]
        ratio = "–" if np.isnan(r.speed_ratio) else f"{r.speed_ratio:.3f}"
        valid = f"{r.solved - r.invalid}/{r.solved}"
        side = r.sensor.removesuffix("_shank")
        table.add_row(r.run, side, f"{r.in_order}/{r.strides}", str(r.false_swings), *later, ratio, valid)
    console.print(table)
    strides = sum(r.strides for r in results)
    worst = min(results, key=lambda r: r.in_order / r.strides)
    told = [
        f"Four phases in order: {sum(r.in_order for r in results)} of {strides} "
        f"({100 * sum(r.in_order for r in results) / strides:.2f} %), worst {worst.run} {worst.sensor} "
        f"{100 * worst.in_order / worst.strides:.1f} %; false swings per 100 strides: "
        f"{100 * sum(r.false_swings for r in results) / strides:.3f}"
    ]
    later_all = np.array([r.later_ms for r in results])
    for name, column in zip(names, later_all.T, strict=True):
        told.append(
            f"{name}: later than the foot's by {np.median(column):+.0f} ms (median of sides, "
            f"{column.min():+.0f} to {column.max():+.0f})"
        )
    ratios = np.array([r.speed_ratio for r in results if not np.isnan(r.speed_ratio)])
    told.append(
        f"Causal speed over belt, {len(ratios)} sides: mean {ratios.mean():.4f}, SD {ratios.std(ddof=1):.4f}, "
        f"from {ratios.min():.4f} to {ratios.max():.4f}"
    )
    return told


def show_sides(told: list[Told], console: Console) -> list[str]:
    """Print left from right; what it comes to."""
    table = Table("subject", "recording", "told rightly", "sure", "score", "agree", "held out: rightly", "sure")
    for t in told:
        flags = ["yes" if flag else "NO" for flag in (t.right, t.sure, t.held_out_right, t.held_out_sure)]
        table.add_row(t.subject, t.recording, *flags[:2], f"{t.score:.2f}", f"{t.agreeing}/4", *flags[2:])
    console.print(table)
    return [
        f"Left from right: {sum(t.right for t in told)} of {len(told)} rightly, {sum(t.sure for t in told)} sure; held "
        f"out by subject {sum(t.held_out_right for t in told)} rightly, {sum(t.held_out_sure for t in told)} sure "
        f"({len({t.subject for t in told})} subjects)"
    ]


if __name__ == "__main__":
    raise SystemExit(main())
