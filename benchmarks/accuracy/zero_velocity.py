"""Zero-velocity detectors, and the ZUPT-aided smoother as `fes analyse` runs it, on real recordings; 3 without data.

One default setting for all sets. Detectors: at rest is what Vicon sees move slower than 0.1 m/s, per sample, mean over
the nine walks; thresholds once from the standing second, once from the quiet stretches alone. Smoother: stride lengths
between the borders that the sets give; on the belt the sum of stride lengths over time between the detector's own
stances in the last 120 s. Ruler strides that the set's own trajectory contradicts by over 8 cm are counted apart.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np

from benchmarks.accuracy.accuracy_rows import LENGTH_GIVEN, Row, row_of
from benchmarks.accuracy.orientation import rms
from benchmarks.lib.command_line import no_recordings, parser_of, publish, table_of, verdict
from benchmarks.lib.real_sets import (
    LAST_S,
    BoolArray,
    BorderedWalk,
    data_folder,
    gaitmap,
    pyshoe,
    ruler,
    stroke_feet,
    xio,
)
from fes.estimation.zupt.decimation import ZuptSettings
from fes.estimation.zupt.detectors import Detector
from fes.estimation.zupt.foot_trajectory import FootSamples, Trajectory, foot_samples
from fes.estimation.zupt.thresholds import find_zero_velocity
from fes.recording import Track
from fes.signals import FloatArray, IntArray

LIMIT_MPS = 0.1
WARM_UP_S = 10.0
LEAST_F1 = {Detector.SHOE: 0.90, Detector.MV: 0.83, Detector.MAG: 0.87, Detector.ARE: 0.92, Detector.GYR: 0.92}
LENGTH_BAR_CM = {"pyshoe_vicon": 1.75, "ruler_walks": 1.7, "gaitmap_walk": 1.8}


@dataclass(frozen=True)
class LoopResult:
    """How far the end of the loop is from its beginning, horizontally and in height, and how long the way was."""

    way_m: float
    gap_m: float
    height_m: float


def scores(truth: BoolArray, said: BoolArray) -> tuple[float, float, float]:
    """F1, precision and recall."""
    both = float(np.count_nonzero(truth & said))
    precision, recall = both / max(np.count_nonzero(said), 1), both / max(np.count_nonzero(truth), 1)
    return 2.0 * precision * recall / max(precision + recall, 1e-12), precision, recall


def evaluate_detector(
    detector: Detector, walks: list[BorderedWalk], *, use_standing: bool, causal: bool
) -> tuple[float, float, float, float]:
    """F1, precision and recall, means over the walks; and the worst walk's F1."""
    rows = []
    for walk in walks:
        track, known = walk.track, np.isfinite(walk.speed_mps)
        _, said, _ = find_zero_velocity(
            track.acc_mps2, track.gyr_radps, track.rate_hz, detector, use_standing=use_standing, causal=causal
        )
        rows.append(scores(walk.speed_mps[known] < LIMIT_MPS, said[known]))
    f1, precision, recall = np.mean(rows, axis=0).tolist()
    return f1, precision, recall, min(row[0] for row in rows)


def path_of(track: Track) -> tuple[FootSamples, Trajectory]:
    foot = foot_samples(track.t_ns, track.acc_mps2, track.gyr_radps)
    return foot, foot.trajectory(ZuptSettings(), level=False)


def lengths_m(path: Trajectory, begin_ns: IntArray, end_ns: IntArray) -> FloatArray:
    """Horizontal distances (M,) between instants (M,)."""
    return np.asarray(np.hypot(*(path.positions_at(end_ns) - path.positions_at(begin_ns))[:, :2].T))


def evaluate_lengths(walks: list[BorderedWalk]) -> tuple[Row, int, float]:
    """The row of the errors (cm) but for disputed strides; how many these are, and the RMSE with them."""
    errors = [100.0 * (lengths_m(path_of(w.track)[1], w.begin_ns, w.end_ns) - w.length_m) for w in walks]
    every, doubt = np.concatenate(errors), np.concatenate([walk.disputed for walk in walks])
    row = row_of(walks[0].walk.data_set, LENGTH_GIVEN, "cm", "", "", every[~doubt])
    return row, int(doubt.sum()), rms(every)


def belt_ratios(feet: list[tuple[str, Track, float]]) -> FloatArray:
    """Speed over the belt's of each foot."""
    ratios = []
    for _, track, belt_mps in feet:
        begin = int(np.searchsorted(track.t_ns, track.t_ns[-1] - round(1e9 * (LAST_S + WARM_UP_S))))
        foot, path = path_of(track.part(slice(begin, None)))
        at_ns = foot.t_ns[foot.stances()]
        at_ns = at_ns[at_ns >= foot.t_ns[-1] - round(1e9 * LAST_S)]
        ratios.append(lengths_m(path, at_ns[:-1], at_ns[1:]).sum() / (1e-9 * float(np.ptp(at_ns))) / belt_mps)
    return np.array(ratios)


def evaluate_loop(track: Track) -> LoopResult:
    foot, path = path_of(track)
    at_ns = foot.t_ns[foot.stances()]
    gap = path.position_m[-1] - path.position_m[0]
    way_m = float(lengths_m(path, at_ns[:-1], at_ns[1:]).sum())
    return LoopResult(way_m, float(np.hypot(gap[0], gap[1])), float(gap[2]))


def main(words: list[str] | None = None) -> int:
    options = parser_of(__doc__, data_folder()).parse_args(words)
    if not (walks := pyshoe(options.data)):
        return no_recordings(options.data)
    detectors, held = [], True
    for detector, standing, causal in product(Detector, (True, False), (False, True)):
        found = evaluate_detector(detector, walks, use_standing=standing, causal=causal)
        told = "standing second" if standing else "quiet stretches", "causal" if causal else "centred"
        detectors.append([detector.name, *told, *(f"{value:.3f}" for value in found)])
        held &= found[0] >= LEAST_F1[detector] or causal or not standing
    lengths = [evaluate_lengths(group) for group in (walks, ruler(options.data), gaitmap(options.data)) if group]
    told_lengths = [
        [
            row.data_set,
            str(row.n),
            f"{row.bias:+.2f}",
            f"{row.rmse:.2f}",
            f"{row.worst:.1f}",
            str(disputed),
            f"{rmse:.2f}",
        ]
        for row, disputed, rmse in lengths
    ]
    notes = []
    if feet := list(stroke_feet(options.data)):
        r = belt_ratios(feet)
        notes.append(
            f"stroke_treadmill: speed over belt, {len(r)} feet: mean {r.mean():.4f}, SD {r.std(ddof=1):.4f}, "
            f"from {r.min():.3f} to {r.max():.3f}"
        )
    if loop := xio(options.data):
        one = evaluate_loop(loop)
        notes.append(
            f"xio_walk, a loop of {one.way_m:.1f} m: ends {one.gap_m:.2f} m from its beginning, "
            f"{one.height_m:+.2f} m in height"
        )
    tables = [
        table_of(
            f"Rest against Vicon below {LIMIT_MPS:g} m/s: pyshoe_vicon, {len(walks)} walks",
            ("detector", "threshold from", "window", "F1", "precision", "recall", "worst F1"),
            detectors,
        ),
        table_of(
            "ZUPT-aided smoother: stride length (cm)",
            ("data set", "strides", "bias", "RMSE", "worst", "disputed", "RMSE with disputed"),
            told_lengths,
        ),
    ]  # fmt: skip
    publish(tables, options, notes)
    return verdict(held and all(row.rmse <= LENGTH_BAR_CM[row.data_set] for row, _, _ in lengths))


if __name__ == "__main__":
    raise SystemExit(main())
