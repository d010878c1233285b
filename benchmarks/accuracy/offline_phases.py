"""The off-line instants of T1 to T4, beside the live machine's: against truth, markers and footswitches.

First of each bundled trial (its truth) and of the gaitmap walk (markers; the heel is up and the foot is flat by the
truth's 5 mm and 2°): how much later than the truth ``t_…_s`` and ``t_…_live_s`` of ``fes analyse`` are. Then foot flat
and heel rise against footswitches, per walker: with the sizes in use, and with those that bring the other walkers'
medians nearest to their labels. Where the switches lie under a foot differs between walkers by more than the rules do.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path

import numpy as np

from benchmarks.lib.command_line import no_recordings, parser_of, publish, spread, table_of
from benchmarks.lib.real_sets import NAMES, data_folder, trials
from benchmarks.lib.swing_judge import pairs
from benchmarks.lib.walkers import DRIFTING, LYING, calibrated, causal, feet_of, swings_of
from fes.analysis.pipeline import analyse
from fes.analysis.results import Analysis
from fes.estimation.events.offline import FLAT_RAD, RISE_RAD, find_events, stance_instants
from fes.estimation.foot.calibration import FootCalibration
from fes.recording import Recording
from fes.recording.tracks import newer_samples
from statemachine.phases import Transition

FLAT_DEG, RISE_DEG = (2.0, 3.0, 5.0, 8.0), (1.0, 2.0, 3.0, 5.0)
FAR_S = 0.4
ENTRIES = ("t_pre_swing", "t_swing", "t_loading_response", "t_stance")
Later = dict[str, dict[tuple[str, float], list[float]]]  # by person, then rule and size: ms


def nearest(times_ns: Iterable[int], begin_ns: int, end_ns: int) -> int | None:
    """The only time in a stride."""
    inside = [at for at in times_ns if begin_ns <= at < end_ns]
    return inside[0] if len(inside) == 1 else None


def measured(data: Path) -> Later:
    """How much later than the label each rule is, of every stride."""
    later: Later = defaultdict(lambda: defaultdict(list))
    for foot in feet_of(data, ["footswitch_treadmill"]):
        if foot.person in LYING or foot.run in DRIFTING or foot.labels is None:
            continue
        if not isinstance(calibration := calibrated(foot.track), FootCalibration):
            continue
        t_ns, acc, gyr = newer_samples(foot.track)
        events, (changes, _) = find_events(t_ns, acc, gyr, calibration), causal(foot.track, calibration)
        found = {
            (which.name, 0.0): [c.t_ns for c in changes if c.transition is which]
            for which in (Transition.T4, Transition.T1)
        }
        for flat_deg, rise_deg in zip(FLAT_DEG, RISE_DEG, strict=True):
            found["heel rise", rise_deg], found["foot flat", flat_deg] = (
                each.tolist()
                for each in stance_instants(
                    t_ns, gyr, events.fo_ns, events.ic_ns, calibration,
                    flat_rad=np.radians(flat_deg), rise_rad=np.radians(rise_deg),
                )
            )  # fmt: skip
        for stride in pairs(swings_of(foot)):
            if not foot.labels.judged(*stride):
                continue
            labels = foot.labels.times(*stride)
            for (rule, size), times_ns in found.items():
                label = labels.get(Transition.T4 if rule in ("foot flat", "T4") else Transition.T1)
                at = nearest(times_ns, *stride)
                if label is not None and at is not None and abs(at - label) < 1e9 * FAR_S:
                    later[foot.person][rule, size].append(1e-6 * (at - label))
    return later


def against_truth(result: Analysis, foot: str, true_s: Iterable[dict[str, float]]) -> list[str]:
    """Off-line and live of each of T1 to T4, of the strides that hold a true foot off."""
    rows, cells = [row for row in result.stride_table() if row["foot"] == foot], []
    held = [(row, true) for true in true_s for row in rows if row["t_start_s"] < true["t_swing_s"] < row["t_end_s"]]
    for name in ENTRIES:
        for kind in ("s", "live_s"):
            cells.append(spread([1e3 * (row[f"{name}_{kind}"] - true.get(f"{name}_s", np.nan)) for row, true in held]))
    return cells


def truth_table(data: Path) -> dict[str, list[str]]:
    """By trial and foot the cells of the first table."""
    found = {}
    for name, recording, truth in trials(NAMES):
        result = analyse(recording)
        for foot in result.events:
            strides = [asdict(s) for s in truth.strides_of(foot) if s.walking]
            found[f"{name} {foot}"] = against_truth(result, foot, strides)
    for each in feet_of(data, ["gaitmap_walk"]):
        result = analyse(Recording(each.run, None, {each.track.sensor: each.track}, belt_speed_mps=None))
        found[f"gaitmap {each.track.sensor}"] = against_truth(result, each.track.sensor, each.marked_strides())
    return found


def left_out(later: Later, person: str, rule: str, sizes: Iterable[float]) -> float:
    """The size with which the others' medians are nearest to their labels."""

    def off(size: float) -> float:
        return float(np.mean([abs(np.median(own[rule, size])) for other, own in later.items() if other != person]))

    return min(sizes, key=off)


def main(arguments: list[str] | None = None) -> int:
    parser = parser_of(__doc__, data_folder())
    options = parser.parse_args(arguments)
    titles = [f"{transition} {kind}" for transition in ("T1", "T2", "T3", "T4") for kind in ("off-line", "live")]
    rows = [[trial, *cells] for trial, cells in truth_table(options.data).items()]
    tables = [table_of("later than the truth, ms, median [5–95 %]", ("trial", *titles), rows)]
    later = measured(options.data)
    if not later:
        return no_recordings(options.data)
    rules = (("foot flat", FLAT_DEG, FLAT_RAD, "T4"), ("heel rise", RISE_DEG, RISE_RAD, "T1"))
    columns = [word for rule, _, _, live in rules for word in (f"{rule} ms", "left out ms", f"live {live} ms")]
    rows = []
    for person, own in sorted(later.items()):
        cells = []
        for rule, sizes, in_use, live in rules:
            other_deg = left_out(later, person, rule, sizes)
            for key in ((rule, round(float(np.degrees(in_use)), 6)), (rule, other_deg), (live, 0.0)):
                cells.append(f"{np.median(own[key]):+.0f} ± {np.std(own[key]):.0f}" if own[key] else "–")
            cells[-2] += f" ({other_deg:.0f}°)"
        rows.append([person, *cells])
    tables.append(table_of("later than the label, median ± SD", ("walker", *columns), rows))
    publish(tables, options)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
