"""Foot flat and heel rise off-line against footswitches (``footswitch_treadmill``), beside the causal machine's T4, T1.

    python benchmarks/offline_phases.py [--data FOLDER] [--json FILE]

Per walker: how much later than the label, median ± SD in ms, of labelled strides that the labels can judge; with the
sizes in use (``fes/estimation/events/offline.py``), and with those that bring the other walkers' medians nearest to
their labels. Where the switches lie under a foot differs between walkers by more than the rules do.
"""

from __future__ import annotations

import sys
from collections import defaultdict
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from command_line import console_of, parser_of, save
from every_walker import DRIFTING, LYING, calibrate, causal, feet_of, swings_of
from rich.table import Table
from stroke_treadmill import data_folder
from swing_judge import pairs

from fes.estimation.events.offline import FLAT_RAD, RISE_RAD, find_events, stance_instants
from fes.estimation.foot.calibration import CalibrationError, FootCalibration
from fes.recording.tracks import newer_samples
from statemachine.phases import Transition

FLAT_DEG, RISE_DEG = (2.0, 3.0, 5.0, 8.0), (1.0, 2.0, 3.0, 5.0)
FAR_S = 0.4
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
        try:
            calibration = calibrate(foot.track)
        except CalibrationError:
            continue
        assert isinstance(calibration, FootCalibration)
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


def left_out(later: Later, person: str, rule: str, sizes: Iterable[float]) -> float:
    """The size with which the others' medians are nearest to their labels."""

    def off(size: float) -> float:
        return float(np.mean([abs(np.median(own[rule, size])) for other, own in later.items() if other != person]))

    return min(sizes, key=off)


def main(arguments: list[str] | None = None) -> int:
    """Print the table; 3 without data."""
    parser = parser_of(__doc__, data_folder())
    options = parser.parse_args(arguments)
    later = measured(options.data)
    if not later:
        print(f"No recordings in {options.data}; set FES_DATA or give --data.", file=sys.stderr)
        return 3
    rules = (("foot flat", FLAT_DEG, FLAT_RAD, "T4"), ("heel rise", RISE_DEG, RISE_RAD, "T1"))
    columns = [word for rule, _, _, live in rules for word in (f"{rule} ms", "left out ms", f"live {live} ms")]
    table = Table("walker", *columns, title="later than the label, median ± SD")
    rows = {}
    for person, own in sorted(later.items()):
        cells = []
        for rule, sizes, in_use, live in rules:
            other_deg = left_out(later, person, rule, sizes)
            for key in ((rule, round(float(np.degrees(in_use)), 6)), (rule, other_deg), (live, 0.0)):
                cells.append(f"{np.median(own[key]):+.0f} ± {np.std(own[key]):.0f}" if own[key] else "–")
            cells[-2] += f" ({other_deg:.0f}°)"
        table.add_row(person, *cells)
        rows[person] = dict(zip(columns, cells, strict=True))
    console_of(150).print(table)
    save(rows, options.json)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
