"""Zero-velocity detectors and the ZUPT-aided filter on real recordings: two tables, and an exit code for the bars.

    python benchmarks/accuracy/zero_velocity.py [--data FOLDER] [--json FILE]

One default setting for all sets. Detectors: at rest is what Vicon sees move slower than ``--limit`` (0.1 m/s), per
sample, mean over the nine walks; thresholds once from the standing second, once from the quiet stretches alone. Filter:
stride lengths between the borders that the sets give; stroke speed is the sum of stride lengths over time between the
filter's own stances in the last 120 s, against the belt. Ruler strides that the set's own trajectory contradicts by
over 8 cm are counted apart. The recordings are not part of the project; without them this says so and exits with 3.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from rich.table import Table

from benchmarks.accuracy.stroke_treadmill import data_folder
from benchmarks.accuracy.zero_velocity_sets import BoolArray, BorderedWalk, gaitmap, pyshoe, ruler, stroke, xio
from benchmarks.accuracy.zupt_reference import ZuptPath, zupt_path
from benchmarks.lib.command_line import console_of, parser_of, publish, verdict
from fes.estimation.zupt.detectors import Detector, rate_energy
from fes.estimation.zupt.thresholds import find_zero_velocity, stance_instants
from fes.recording import Track
from fes.signals import FloatArray

LIMIT_MPS = 0.1
LAST_S = 120.0
LEAST_F1 = {Detector.SHOE: 0.90, Detector.MV: 0.83, Detector.MAG: 0.87, Detector.ARE: 0.92, Detector.GYR: 0.92}
LENGTH_BAR_CM = {"pyshoe_vicon": 1.75, "ruler_walks": 1.7, "gaitmap_walk": 1.8}  # smoothed


@dataclass(frozen=True)
class DetectorResult:
    """One detector, means over walks; ``worst_f1`` is that of the worst walk."""

    detector: str
    threshold: str
    causal: bool
    f1: float
    precision: float
    recall: float
    worst_f1: float


@dataclass(frozen=True)
class LengthResult:
    """One data set, in cm; ``rmse_with_disputed_cm`` is over all strides, disputed ones too."""

    data_set: str
    smoothed: bool
    strides: int
    bias_cm: float
    rmse_cm: float
    worst_cm: float
    disputed: int
    rmse_with_disputed_cm: float


@dataclass(frozen=True)
class SpeedResult:
    """Mean speed over the belt's for each foot."""

    smoothed: bool
    feet: int
    mean: float
    sd: float
    lowest: float
    highest: float


@dataclass(frozen=True)
class LoopResult:
    """How far the end of the loop is from its beginning, horizontally and in height, and how long the way was."""

    smoothed: bool
    way_m: float
    gap_m: float
    height_m: float


def scores(truth: BoolArray, said: BoolArray) -> tuple[float, float, float]:
    """F1, precision and recall."""
    both = float(np.count_nonzero(truth & said))
    precision, recall = both / max(np.count_nonzero(said), 1), both / max(np.count_nonzero(truth), 1)
    return 2.0 * precision * recall / max(precision + recall, 1e-12), precision, recall


def evaluate_detector(
    detector: Detector, walks: list[BorderedWalk], *, use_standing: bool, causal: bool, limit_mps: float = LIMIT_MPS
) -> DetectorResult:
    rows = []
    for walk in walks:
        track, known = walk.track, np.isfinite(walk.speed_mps)
        _, said, _ = find_zero_velocity(
            track.acc_mps2, track.gyr_radps, track.rate_hz, detector, use_standing=use_standing, causal=causal
        )
        rows.append(scores(walk.speed_mps[known] < limit_mps, said[known]))
    f1, precision, recall = np.mean(rows, axis=0).tolist()
    source = "standing second" if use_standing else "quiet stretches"
    return DetectorResult(detector.name, source, causal, f1, precision, recall, min(row[0] for row in rows))


def path_of(track: Track, *, smoothed: bool, last_s: float | None = None) -> ZuptPath:
    begin = 0 if last_s is None else int(np.searchsorted(track.t_ns, track.t_ns[-1] - round(1e9 * last_s)))
    return zupt_path(track.t_ns[begin:], track.acc_mps2[begin:], track.gyr_radps[begin:], smoothed=smoothed)


def evaluate_lengths(walks: list[BorderedWalk], *, smoothed: bool) -> LengthResult:
    errors, disputed = [], []
    for walk in walks:
        lengths = path_of(walk.track, smoothed=smoothed).stride_lengths(walk.begin_ns, walk.end_ns)
        errors.append(100.0 * (lengths - walk.length_m))
        disputed.append(walk.disputed)
    every, doubt = np.concatenate(errors), np.concatenate(disputed)
    sure = every[~doubt]
    return LengthResult(
        walks[0].data_set, smoothed, len(sure), float(sure.mean()), rms(sure), float(np.abs(sure).max()),
        int(doubt.sum()), rms(every),
    )  # fmt: skip


def rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def evaluate_speed(feet: list[tuple[str, Track, float]], *, smoothed: bool) -> SpeedResult:
    ratios = []
    for _, track, belt_mps in feet:
        path = path_of(track, smoothed=smoothed, last_s=LAST_S + 10.0)
        gyr = track.gyr_radps[len(track.t_ns) - len(path.t_ns) :]
        stance_ns = path.t_ns[stance_instants(path.rest, rate_energy(gyr, track.rate_hz), track.rate_hz)]
        stance_ns = stance_ns[stance_ns >= path.t_ns[-1] - round(1e9 * LAST_S)]
        way_m = float(path.stride_lengths(stance_ns[:-1], stance_ns[1:]).sum())
        ratios.append(way_m / (1e-9 * float(stance_ns[-1] - stance_ns[0])) / belt_mps)
    values = np.array(ratios)
    mean, sd = float(values.mean()), float(values.std(ddof=1))
    return SpeedResult(smoothed, len(values), mean, sd, float(values.min()), float(values.max()))


def evaluate_loop(track: Track, *, smoothed: bool) -> LoopResult:
    path = path_of(track, smoothed=smoothed)
    stance_ns = path.t_ns[stance_instants(path.rest, rate_energy(track.gyr_radps, track.rate_hz), track.rate_hz)]
    way_m = float(path.stride_lengths(stance_ns[:-1], stance_ns[1:]).sum())
    gap = path.position_m[-1] - path.position_m[0]
    return LoopResult(smoothed, way_m, float(np.hypot(gap[0], gap[1])), float(gap[2]))


def table_of(title: str, rows: list[list[str]], columns: list[str]) -> Table:
    table = Table(*columns, title=title)
    for row in rows:
        table.add_row(*row)
    return table


def main(words: list[str] | None = None) -> int:
    """Print the tables; 0 when all bars hold, 1 when not, 3 without data."""
    parser = parser_of(__doc__, data_folder())
    parser.add_argument("--limit", type=float, default=LIMIT_MPS, help="slower is at rest, m/s")
    arguments = parser.parse_args(words)
    console = console_of(110)
    walks = pyshoe(arguments.data)
    if not walks:
        console.print(f"No recordings in {arguments.data}/pyshoe_vicon. Set FES_DATA or --data.")
        return 3
    detectors = [
        evaluate_detector(detector, walks, use_standing=standing, causal=causal, limit_mps=arguments.limit)
        for detector in Detector
        for standing in (True, False)
        for causal in (False, True)
    ]
    groups = [group for group in (walks, ruler(arguments.data), gaitmap(arguments.data)) if group]
    lengths = [evaluate_lengths(group, smoothed=smoothed) for group in groups for smoothed in (False, True)]
    feet, loop = stroke(arguments.data), xio(arguments.data)
    speeds = [evaluate_speed(feet, smoothed=smoothed) for smoothed in (False, True)] if feet else []
    loops = [evaluate_loop(loop, smoothed=smoothed) for smoothed in (False, True)] if loop else []
    named = {False: "forward", True: "smoothed"}
    tables = [
        table_of(
            f"Rest against Vicon below {arguments.limit:g} m/s: pyshoe_vicon, {len(walks)} walks",
            [
                [
                    r.detector,
                    r.threshold,
                    "causal" if r.causal else "centred",
                    f"{r.f1:.3f}",
                    f"{r.precision:.3f}",
                    f"{r.recall:.3f}",
                    f"{r.worst_f1:.3f}",
                ]
                for r in detectors
            ],
            ["detector", "threshold from", "window", "F1", "precision", "recall", "worst F1"],
        ),
        table_of(
            "ZUPT-aided filter: stride length (cm)",
            [
                [
                    r.data_set,
                    named[r.smoothed],
                    str(r.strides),
                    f"{r.bias_cm:+.2f}",
                    f"{r.rmse_cm:.2f}",
                    f"{r.worst_cm:.1f}",
                    str(r.disputed),
                    f"{r.rmse_with_disputed_cm:.2f}",
                ]
                for r in lengths
            ],
            ["data set", "filter", "strides", "bias", "RMSE", "worst", "disputed", "RMSE with disputed"],
        ),
        table_of(
            "stroke_treadmill: speed over belt speed, per foot",
            [
                [named[r.smoothed], str(r.feet), f"{r.mean:.4f}", f"{r.sd:.4f}", f"{r.lowest:.3f}", f"{r.highest:.3f}"]
                for r in speeds
            ],
            ["filter", "feet", "mean", "SD", "lowest", "highest"],
        ),
        table_of(
            "xio_walk: a loop that ends where it began (m)",
            [[named[r.smoothed], f"{r.way_m:.1f}", f"{r.gap_m:.2f}", f"{r.height_m:+.2f}"] for r in loops],
            ["filter", "way", "gap", "height"],
        ),
    ]
    failures = [
        f"{r.detector}: F1 {r.f1:.3f} below {LEAST_F1[Detector[r.detector]]}"
        for r in detectors
        if r.threshold == "standing second" and not r.causal and r.f1 < LEAST_F1[Detector[r.detector]]
    ]
    failures += [
        f"{r.data_set}: stride length RMSE {r.rmse_cm:.2f} cm above {LENGTH_BAR_CM[r.data_set]} cm"
        for r in lengths
        if r.smoothed and r.rmse_cm > LENGTH_BAR_CM[r.data_set]
    ]
    publish(console, tables, arguments, failures)
    return verdict(console, not failures, several=True)


if __name__ == "__main__":
    raise SystemExit(main())
