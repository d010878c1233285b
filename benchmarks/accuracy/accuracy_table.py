"""One table: every data set, each of our methods, each peer that installs from a registry.

    make bench-accuracy        (both environments, then this, and the page)

Peers run in an environment of their own (`make peers`); without it the table has our rows alone and says so. The exit
code is 0 however the numbers come out, and 3 without recordings: the table says which bars are met.
"""

from __future__ import annotations

import subprocess
from dataclasses import replace
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks.accuracy.accuracy_rows import (
    BELT,
    CAUSAL,
    CLOSURE,
    HEEL,
    LENGTH_GIVEN,
    LENGTH_OWN,
    LIFT_ARM,
    LIFT_GIVEN,
    LIFT_OWN,
    OFFLINE,
    PATH,
    PHASES,
    SHANK_BELT,
    STRIKE,
    TOE,
    Row,
    in_order,
    row_of,
    tables,
    verdicts,
    with_bar,
)
from benchmarks.accuracy.clearance import marker_rows
from benchmarks.accuracy.events import METHODS as EVENT_METHODS
from benchmarks.accuracy.events import Score, holds, score, strike_angles, strike_score, stroke_tracks
from benchmarks.accuracy.orientation import FILTERS, broad, gaitmap_pitch, upward
from benchmarks.accuracy.shank_phases import evaluate as evaluate_shanks
from benchmarks.accuracy.stride_length import FUSED, METHODS, belt_ratios, clearance_errors, strides_between, strides_of
from benchmarks.accuracy.zero_velocity import evaluate_detector, evaluate_loop, lengths_m, path_of
from benchmarks.lib.command_line import no_recordings, parser_of, publish
from benchmarks.lib.real_sets import PathWalk, Walk, data_folder, gaitmap_cases, gaitmap_walk, pyshoe, runs_of, xio
from benchmarks.lib.swing_judge import score as order
from benchmarks.lib.walkers import calibrate, causal, stroke_treadmill, swings_of
from benchmarks.peers.cases import (
    OUR_ENDS,
    Asked,
    all_asked,
    f1_row,
    judge,
    orientation_row,
    own_border_errors,
    strides_hit,
)
from fes.analysis.ground_path import GroundPath, ground_path, without_relative_drift
from fes.calibration.recording import calibrate_track
from fes.estimation.zupt.detectors import Detector

NAMES = {"maximum_likelihood": "fes maximum likelihood (default)", "constrained": "fes constrained (Negård)"}
NAMES[FUSED] = "fes analyse (maximum likelihood and ZUPT)"
KNOWN = {"maximum_likelihood": CAUSAL, "constrained": CAUSAL, FUSED: OFFLINE}
ZUPT = "fes ZUPT filter, smoothed"
LEAST_IN_ORDER, LEAST_FOOT, MOST_FALSE = 0.995, 0.97, 0.1


Walked = list[tuple[Asked, Walk]]


def by_set(asked: list[Asked]) -> dict[str, Walked]:
    """The walks with a reference for single strides."""
    groups: dict[str, Walked] = {}
    for one in asked:
        if one.walk is not None:
            groups.setdefault(one.data_set, []).append((one, one.walk))
    return groups


def stride_rows(asked: list[Asked]) -> list[Row]:
    """Length and lift of the strides that our phase machine finds, each known when it ends."""
    rows = []
    for method, (data_set, walks) in product(METHODS, by_set(asked).items()):
        errors, lifts, hit, swings = [], [], 0, 0
        for one, walk in walks:
            strides = strides_of(walk.track, calibrate_track(walk.track), method)
            ends_s = np.array([(1e-9 * s.t_start_ns, 1e-9 * s.t_end_ns) for s in strides])
            errors += own_border_errors(one, ends_s, np.array([s.stride_length_m for s in strides]))
            lifts += [100.0 * (s.clearance_m - walk.true_clearance_m(s)) for s in strides]
            hit, swings = hit + strides_hit(one.swings_s, ends_s), swings + len(one.swings_s)
        rows.append(row_of(data_set, LENGTH_OWN, "cm", NAMES[method], KNOWN[method], errors, hit / swings))
        if np.isfinite(lifts).any() and method != FUSED:  # which takes heights as they are
            rows.append(row_of(data_set, LIFT_OWN, "cm", NAMES[method], KNOWN[method], lifts, hit / swings))
    return rows


def given_rows(asked: list[Asked]) -> list[Row]:
    """Length and lift by our stride integration between the references' borders, each moved to quiet within 50 ms."""
    rows = []
    for method, (data_set, walks) in product(METHODS, by_set(asked).items()):
        lengths, lifts = [], []
        for one, walk in walks:
            strides = strides_between(walk.track, one.case.borders / one.case.rate_hz, method)
            for stride, known_m in zip(strides, one.length_m, strict=False):
                if stride.valid and np.isfinite(known_m):
                    lengths.append(100.0 * (stride.stride_length_m - walk.true_length_m(stride)))
                    lifts.append(100.0 * (stride.clearance_m - walk.true_lift_m(stride)))
        wanted = sum(np.isfinite(one.length_m).sum() for one, _ in walks)
        for quantity, errors in ((LENGTH_GIVEN, lengths), (LIFT_GIVEN, lifts)):
            if np.isfinite(errors).any() and (method != FUSED or quantity == LENGTH_GIVEN):
                share = float(np.isfinite(errors).sum() / wanted)
                rows.append(row_of(data_set, quantity, "cm", NAMES[method], KNOWN[method], errors, share))
    return rows


def arm_rows() -> list[Row]:
    """Lift on pyshoe_vicon, whose marker is not at the sensor, through the arm that fits best."""
    rows = []
    for method in METHODS[:-1]:
        if errors := clearance_errors(method):
            rows.append(row_of("pyshoe_vicon", LIFT_ARM, "cm", NAMES[method], KNOWN[method], 100.0 * np.array(errors)))
    return rows


def zupt_rows(folder: Path, asked: list[Asked]) -> list[Row]:
    """Length between the references' borders by the smoother over the whole recording; the loop's gap."""
    rows = []
    for data_set, walks in by_set(asked).items():
        errors = []
        for one, walk in walks:
            begin_ns, end_ns = walk.track.t_ns[one.case.borders].T
            errors += (100.0 * (lengths_m(path_of(walk.track)[1], begin_ns, end_ns) - one.length_m)).tolist()
        rows.append(row_of(data_set, LENGTH_GIVEN, "cm", ZUPT, OFFLINE, errors, 1.0))
    if loop := xio(folder):
        rows.append(row_of("xio_walk", CLOSURE, "m", ZUPT, OFFLINE, [evaluate_loop(loop).gap_m]))
    return rows


def rest_rows(folder: Path) -> list[Row]:
    """Detectors of rest against Vicon, thresholds from the standing second."""
    walks = pyshoe(folder)
    rows = []
    for detector in Detector if walks else ():
        for known in (CAUSAL, OFFLINE):
            f1, _, recall, worst = evaluate_detector(detector, walks, use_standing=True, causal=known == CAUSAL)
            rows.append(f1_row("pyshoe_vicon", f"fes {detector.name}", known, len(walks), f1, recall, worst))
    return rows


def stroke_rows(folder: Path) -> list[Row]:
    """Speed of feet and shanks against the belt, phases in order, foot-strike angle."""
    if not (paths := runs_of(folder)):
        return []
    data_set = "stroke_treadmill"
    rows = [
        row_of(data_set, BELT, "%", NAMES[method], KNOWN[method], 100.0 * (np.array(belt_ratios(method)) - 1.0))
        for method in METHODS
    ]
    shanks = [shank for path in paths for shank in evaluate_shanks(path)]
    for name, key in (("fes shank, arm learnt", "learnt"), ("fes shank, velocity to zero", "zupt")):
        errors = [100.0 * (getattr(shank, key) - 1.0) for shank in shanks]
        rows.append(row_of(data_set, SHANK_BELT, "%", name, CAUSAL, errors))
    feet = [order(swings_of(foot), *causal(foot.track, calibrate(foot.track))) for foot in stroke_treadmill(folder, "")]
    shares = [foot.in_order / foot.strides for foot in feet]
    strides = sum(foot.strides for foot in feet)
    recall = sum(foot.in_order for foot in feet) / strides
    false = 100.0 * sum(foot.false_swings for foot in feet) / strides
    rows.append(
        Row(
            data_set, PHASES, "%", "fes phase machine", CAUSAL, n=strides, worst=100.0 * (1.0 - min(shares)),
            recall=recall, bar="≥ 99.5 %, worst foot ≥ 97 %, false swings ≤ 0.1 in 100",
            bar_met=recall >= LEAST_IN_ORDER and min(shares) >= LEAST_FOOT and false <= MOST_FALSE,
            note=f"false swings per 100 strides: {false:.2f}; worst: the worst foot's share out of order",
        )
    )  # fmt: skip
    angles = strike_angles(stroke_tracks(folder))
    correlation, _, sd = strike_score(angles)
    vicon, ours = np.array(list(angles.values())).T
    row = row_of(data_set, STRIKE, "°", "fes off-line events", OFFLINE, ours - vicon)
    met = correlation >= 0.96 and sd <= 2.0
    bar, note = "correlation ≥ 0.96, SD ≤ 2.0°", f"correlation {correlation:.3f}"
    rows.append(replace(row, bar=bar, bar_met=met, note=note))
    return rows


def event_rows(folder: Path) -> list[Row]:
    """Initial contact and foot off against the markers' events; causal: the delay of the decision."""
    if not (folder / "gaitmap_walk").is_dir():
        return []
    scores = [s for method in EVENT_METHODS for s in score("gaitmap_walk", gaitmap_cases(folder), method)]
    return [_event_row(s) for s in scores]


def _event_row(s: Score) -> Row:
    offline = s.method == "off-line"
    decided = s.method == "causal, instants"
    return Row(
        s.data, f"{s.event} time" if offline else f"{s.event} decision after the event", "ms",
        "fes events" if offline else f"fes {s.method.removeprefix('causal, ')}", OFFLINE if offline else CAUSAL,
        s.found, s.mean_ms, s.sd_ms, float(np.sqrt(s.mean_ms**2 + s.sd_ms**2 * (s.found - 1) / s.found)),
        max(abs(s.least_ms), abs(s.most_ms)), s.recall, "median ≤ 20, 95 % ≤ 50 ms, none missed" if decided else "",
        holds(s) if decided else None, f"median {s.median_ms:+.0f}, 95 % {s.p95_ms:+.0f} ms; {s.extra} extra",
    )  # fmt: skip


def orientation_rows(folder: Path) -> list[Row]:
    """Our orientation filter; others run among the peers."""
    rows = []
    for trials in (broad(folder), gaitmap_pitch(folder)):
        for known, follow in FILTERS.items():
            errors = [t.score(upward(follow(t.acc_mps2, t.gyr_radps, t.rate_hz).quaternion)) for t in trials]
            name = f"fes orientation filter{'' if known == CAUSAL else ', smoothed'}"
            rows += [orientation_row(trials[0].data_set, name, known, errors)] if trials else []
    return rows


def clearance_rows(folder: Path) -> list[Row]:
    """Toe and heel against markers, for every way to know where they are on the foot."""
    rows = []
    for r in marker_rows(folder):
        method = f"fes, geometry {r.geometry}" + (", contact levels" if r.anchored else "")
        for quantity, (mean_m, sd_m) in ((TOE, r.toe_m), (HEEL, r.heel_m)):
            bias, sd = 100.0 * mean_m, 100.0 * sd_m
            rows.append(
                Row(
                    "gaitmap_walk", quantity, "cm", method, OFFLINE if r.anchored else CAUSAL, n=r.strides,
                    bias=bias, sd=sd, rmse=float(np.sqrt(bias**2 + sd**2 * (r.strides - 1) / r.strides)),
                )
            )  # fmt: skip
    return rows


def path_rows(folder: Path) -> list[Row]:
    """The path of `fes analyse` against the heel's marker, each foot alone and both together."""
    walks = [walk for walk in gaitmap_walk(folder) if isinstance(walk, PathWalk)]
    if len(walks) != 2:
        return []
    alone = [ground_path(walk.track, calibrate_track(walk.track)) for walk in walks]
    named = {"fes path, each foot alone": alone, "fes path, both feet together": list(without_relative_drift(*alone))}
    rows = []
    for method, paths in named.items():
        rms_m = [_fitted_rms_m(walk, path) for walk, path in zip(walks, paths, strict=True)]
        mean, worst = float(np.mean(rms_m)), max(rms_m)
        rows.append(Row("gaitmap_walk", PATH, "m", method, OFFLINE, n=2, rmse=mean, worst=worst, note="of two feet"))
    return rows


def _fitted_rms_m(walk: PathWalk, path: GroundPath) -> float:
    """Horizontal distance of path and marker, root mean square, after the best shift and turn."""
    t_ns = path.t_ns[0] + np.round(np.arange(len(walk.position_m)) * 1e9 / walk.rate_hz).astype(np.int64)
    known = np.isfinite(walk.position_m).all(axis=1) & (t_ns <= path.t_ns[-1])
    true, found = walk.position_m[known, :2], path.places_at(t_ns[known])[:, :2]
    true, found = ((xy - xy.mean(axis=0)) @ np.array([1.0, 1.0j]) for xy in (true, found))
    turn = np.vdot(found, true)
    return float(np.sqrt(np.mean(np.abs(found * turn / abs(turn) - true) ** 2)))


def our_rows(folder: Path, asked: list[Asked]) -> list[Row]:
    """All of them; what is put to peers alone is left out."""
    asked = [one for one in asked if OUR_ENDS not in one.case.tasks]
    rows = [*stride_rows(asked), *given_rows(asked), *arm_rows(), *zupt_rows(folder, asked)]
    for of_folder in (rest_rows, stroke_rows, event_rows, orientation_rows, clearance_rows, path_rows):
        rows += of_folder(folder)
    return rows


# --- the table --------------------------------------------------------------------------------------------------------

ROOT = Path(__file__).resolve().parents[2]
RUNNERS = ("run_orientation.py", "run_gaitmap.py")


def main(arguments: list[str] | None = None) -> int:
    parser = parser_of(__doc__, data_folder())
    parser.add_argument("--peers", type=Path, default=ROOT / ".venv-peers" / "bin" / "python", help="their Python")
    options = parser.parse_args(arguments)
    asked = all_asked(options.data)
    if not asked:
        return no_recordings(options.data)
    with TemporaryDirectory(prefix="fes-peers-") as name:
        exchange = Path(name)
        for one in asked:
            one.case.write(exchange)
        runs = peers_at_work(options.peers, exchange)
        try:
            rows = our_rows(options.data, asked)
            failures = [f"{runner} ended with {run.wait()}" for runner, run in runs.items() if run.wait() != 0]
        finally:
            for run in runs.values():
                run.kill()
                run.wait()
        rows += judge(exchange, asked)
    rows = in_order([with_bar(row) for row in rows])
    notes = [] if runs else [f"Peers are not in this table: {options.peers} is not there; `make peers` makes it."]
    notes += [f"Peers are not complete: {failure}." for failure in failures]
    publish(tables(rows), options, [*verdicts(rows), *notes])
    return 0


def peers_at_work(python: Path, exchange: Path) -> dict[str, subprocess.Popen[bytes]]:
    """The peers' processes, which leave their results in ``exchange``; none where their environment is not there."""
    if not python.is_file():
        return {}
    scripts = Path(__file__).parents[1] / "peers"
    return {runner: subprocess.Popen([python, scripts / runner, exchange]) for runner in RUNNERS}


if __name__ == "__main__":
    raise SystemExit(main())
