"""The phases' figures with the judged walker left out of whatever chose the constants.

    python benchmarks/left_out.py [--only SET …] [--jobs N] [--data FOLDER] [--json FILE]

Every constant of guards and calibration that was chosen by data (``CHOICES``) is chosen again for each walker, by all
the other walkers of all sets together: the value with the greatest ``worth``, one constant at a time about the middle
ones. The walker is then judged once with the values so chosen. Beside it stands the same figure with the program's own
values, which is a description: they were chosen with the walker looked at. Swings, strides and labels are those of
``every_walker.py`` and ``swing_judge.py``; shanks, whose levels are their own, are not part of it.
"""

from __future__ import annotations

import os
import sys
from collections import Counter, defaultdict
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from command_line import console_of, parser_of, save
from every_walker import (
    DRIFTING,
    LYING,
    SETS,
    Foot,
    Found,
    against_labels,
    calibrate,
    causal,
    feet_of,
    pairs,
    swings_of,
)
from rich.table import Table
from stroke_treadmill import data_folder
from swing_judge import score

from fes.cohort.sweep.grid import Point
from fes.cohort.sweep.task import with_thresholds
from fes.estimation.foot import calibration as foot_calibration
from fes.estimation.foot.calibration import CalibrationError, FootCalibration
from statemachine.guards import Thresholds

# the middle one is where choosing starts
GUARDS: dict[str, tuple[float, ...]] = {
    "rest_share": (0.12, 0.15, 0.18, 0.22),
    "heel_rise_share": (0.08, 0.12, 0.18),
    "heel_rise_rad": (0.03, 0.04, 0.055),
    "toe_up_share": (0.22, 0.26, 0.3, 0.36),
    "push_off_share": (0.3, 0.4, 0.5),
    "shortest_swing": (0.5, 0.6, 0.7),
    "rising_share": (0.3, 0.4, 0.5),
    "soft_contact": (0.2, 0.3, 0.4),
    "jerk_share": (0.15, 0.2, 0.3, 0.4),
    "mid_swing_share": (0.45, 0.55, 0.65, 0.75),
    "settled_share": (0.25, 0.35, 0.45),
    "longest_loading": (1.5, 2.0, 2.5),
    "heel_rise_after": (0.25, 0.26, 0.27),
    "swung_share": (0.4, 0.45, 0.5),
    "swung_after_s": (0.2, 0.25, 0.3),
}
CALIBRATION: dict[str, tuple[float, ...]] = {
    "FALL_SHARE": (0.35, 0.45, 0.55),
    "TROUGH_SHARE": (0.2, 0.3, 0.4),
    "TYPICAL_SHARE": (0.25, 1.0 / 3.0, 0.4),
}
CHOICES = GUARDS | CALIBRATION
START = {name: values[(len(values) - 1) // 2] for name, values in CHOICES.items()}
OWN = {name: getattr(Thresholds(), name) for name in GUARDS} | {
    name: getattr(foot_calibration, name) for name in CALIBRATION
}
FLAT_MS_PER_POINT = 20.0  # of a flat foot stimulated, that count as one stride of a hundred out of order
Values = tuple[tuple[str, float], ...]


@dataclass(frozen=True)
class Judged:
    """One foot by one set of values."""

    strides: int
    in_order: int
    swings: int
    false_swings: int
    flat_ms: float

    @property
    def worth(self) -> float:
        """Strides in order, less false swings, of a hundred; less what is stimulated of a flat foot."""
        if not self.strides:
            return 0.0
        flat = 0.0 if np.isnan(self.flat_ms) else self.flat_ms / FLAT_MS_PER_POINT
        return 100.0 * (self.in_order - self.false_swings) / self.strides - flat


def judge(values: list[Values], foot: Foot) -> list[Judged]:
    """One foot by some values each."""
    swings = swings_of(foot)
    made: dict[Any, FootCalibration | None] = {}
    return [_judge(foot, swings, dict(each), made) for each in values]


def _judge(foot: Foot, swings: Any, values: dict[str, float], made: dict[Any, FootCalibration | None]) -> Judged:
    key = tuple(values[name] for name in CALIBRATION)
    if key not in made:
        kept = {name: getattr(foot_calibration, name) for name in CALIBRATION}
        for name in CALIBRATION:
            setattr(foot_calibration, name, values[name])
        try:
            found = calibrate(foot.track)
            made[key] = found if isinstance(found, FootCalibration) else None
        except CalibrationError:
            made[key] = None
        for name, value in kept.items():
            setattr(foot_calibration, name, value)
    strides = [pair for pair in pairs(swings) if foot.labels is None or foot.labels.judged(*pair)]
    calibration = made[key]
    if calibration is None:
        return Judged(len(strides), 0, len(swings.whole()), 0, float("nan"))
    sensor = foot.track.sensor
    point = Point(tuple((f"thresholds.{name}", values[name]) for name in GUARDS))
    changes, solved = causal(foot.track, with_thresholds({sensor: calibration}, point)[sensor])
    found = Found(foot.data_set, foot.part, foot.person, foot.run, foot.track.sensor)
    counts = score(swings, changes, solved)
    found.in_order, found.false_swings = counts.in_order, counts.false_swings
    if foot.labels is not None:
        against_labels(found, foot.labels, swings, changes)
    flat = float(np.median(found.flat_ms)) if found.flat_ms else float("nan")
    return Judged(len(strides), found.in_order, len(swings.whole()), found.false_swings, flat)


def walked(feet: list[Foot], values: list[Values], jobs: int) -> list[list[Judged]]:
    """All feet by all values: [foot][values]."""
    with ProcessPoolExecutor(jobs) as pool:
        return list(pool.map(partial(judge, values), feet, chunksize=1))


def chosen(tried: dict[Values, int], judged: list[list[Judged]], others: list[int]) -> dict[str, float]:
    """For each constant the value with which the other feet are worth most; ties go to the start."""
    best = dict(START)
    for name, options in CHOICES.items():
        worths = {v: _worth(tried[_values(START | {name: v})], judged, others) for v in options}
        most = max(worths.values())
        if worths[START[name]] < most - 1e-9:
            best[name] = max(worths, key=lambda v: worths[v])
    return best


def _worth(at: int, judged: list[list[Judged]], others: list[int]) -> float:
    return float(np.mean([judged[k][at].worth for k in others]))


def _values(values: dict[str, float]) -> Values:
    return tuple(sorted(values.items()))


def main(arguments: list[str] | None = None) -> int:
    """Print the table; 3 without data."""
    parser = parser_of(__doc__, data_folder())
    sets = [name for name in SETS if name != "shanks"]
    parser.add_argument("--only", nargs="+", choices=sets, default=sets, help="these sets alone")
    parser.add_argument("--jobs", type=int, default=min(2, os.cpu_count() or 1), help="processes")
    options = parser.parse_args(arguments)
    feet = [foot for foot in feet_of(options.data, options.only) if not foot.person.startswith(LYING)]
    feet = [foot for foot in feet if foot.run not in DRIFTING]
    if not feet:
        print(f"No recordings in {options.data}; set FES_DATA or give --data.", file=sys.stderr)
        return 3
    singles = [_values(START), *(_values(START | {n: v}) for n, vs in CHOICES.items() for v in vs if v != START[n])]
    judged = walked(feet, singles, options.jobs)
    tried = {values: at for at, values in enumerate(singles)}
    persons = sorted({(foot.data_set, foot.person) for foot in feet})
    folds = {
        person: _values(chosen(tried, judged, [k for k, f in enumerate(feet) if (f.data_set, f.person) != person]))
        for person in persons
    }
    combined = sorted({*folds.values(), _values(OWN)})
    final = walked(feet, combined, options.jobs)
    groups: dict[str, list[tuple[Foot, Judged, Judged]]] = defaultdict(list)
    for foot, each in zip(feet, final, strict=True):
        out, own = each[combined.index(folds[foot.data_set, foot.person])], each[combined.index(_values(OWN))]
        groups[f"{foot.data_set}, {foot.part}"].append((foot, out, own))
    table = Table("set", "feet", "strides", "left out: in order %", "worst foot", "false /100", "flat ms",
                  "in sample: in order %", "worst foot", "false /100", "flat ms")  # fmt: skip
    for name, rows in groups.items():
        table.add_row(name, str(len(rows)), str(sum(out.strides for _, out, _ in rows)),
                      *_cells([out for _, out, _ in rows]), *_cells([own for _, _, own in rows]))  # fmt: skip
    console = console_of(170)
    console.print(table)
    for name in CHOICES:
        counts = Counter(dict(values)[name] for values in folds.values())
        console.print(
            f"{name}: own {OWN[name]:g}; chosen " + ", ".join(f"{v:g} ({n})" for v, n in counts.most_common())
        )
    save([{"set": f.data_set, "part": f.part, "person": f.person, "run": f.run, "sensor": f.track.sensor,
           "left_out": vars(out), "own": vars(own)} for rows in groups.values() for f, out, own in rows],
         options.json)  # fmt: skip
    return 0


def _cells(judged: list[Judged]) -> list[str]:
    sound = [each for each in judged if each.strides]
    flat = [each.flat_ms for each in judged if not np.isnan(each.flat_ms)]
    return [
        f"{100.0 * sum(each.in_order for each in sound) / max(sum(each.strides for each in sound), 1):.2f}",
        f"{min((100.0 * each.in_order / each.strides for each in sound), default=float('nan')):.1f}",
        f"{100.0 * sum(e.false_swings for e in judged) / max(sum(e.swings for e in judged), 1):.2f}",
        f"{np.median(flat):.0f}" if flat else "–",
    ]


if __name__ == "__main__":
    raise SystemExit(main())
