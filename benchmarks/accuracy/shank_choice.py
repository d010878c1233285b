"""The shank's constants chosen again with each patient left out, and judged on that patient; 3 without data.

    python benchmarks/accuracy/shank_choice.py [--jobs N] [--data FOLDER] [--json FILE]

Settings around the default of ``fes.estimation.shank.motion``, on all shanks of ``every_walker.py``, known and unseen.
For each patient the others choose by their strides in order less false swings, counted by the foot's swings; between
equals the default stays. The patient is then judged with what the others chose.
"""

from __future__ import annotations

import os
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass

from rich.table import Table

from benchmarks.accuracy.every_walker import Foot, calibrate, causal, feet_of
from benchmarks.accuracy.stroke_treadmill import data_folder
from benchmarks.lib.command_line import console_of, parser_of, save
from benchmarks.lib.swing_judge import score
from fes.analysis.swings import find_swings
from fes.estimation.shank import motion

SETTINGS: tuple[dict[str, float], ...] = (
    {},
    {"FLAT_TO_PEAK": 0.2},
    {"FLAT_TO_PEAK": 0.3},
    {"RISE_TO_PEAK": 0.25},
    {"RISE_TO_PEAK": 0.45},
    {"STILL_PER_FLOOR": 1.4},
    {"STILL_PER_FLOOR": 2.2},
    {"SLOWED_SHARE": 0.3},
    {"SLOWED_SHARE": 0.5},
)


@dataclass(frozen=True)
class Judged:
    """One shank by one setting."""

    part: str
    person: str
    run: str
    sensor: str
    strides: int
    in_order: int
    swings: int
    false_swings: int


def judge(foot: Foot) -> list[Judged]:
    """One shank by every setting."""
    by = foot.judge or foot.track
    swings = find_swings(by.t_ns, by.acc_mps2, by.gyr_radps)
    judged = []
    for setting in SETTINGS:
        kept = {name: getattr(motion, name) for name in setting}
        try:
            for name, value in setting.items():
                setattr(motion, name, value)
            counts = score(swings, *causal(foot.track, calibrate(foot.track)))
        finally:
            for name, value in kept.items():
                setattr(motion, name, value)
        counted = counts.strides, counts.in_order, counts.swings, counts.false_swings
        judged.append(Judged(foot.part, foot.person, foot.run, foot.track.sensor, *counted))
    return judged


def named(setting: dict[str, float]) -> str:
    """The setting in words."""
    return ", ".join(f"{name} {value:g}" for name, value in setting.items()) or "default"


def figures(judged: list[Judged]) -> list[str]:
    """In order (%), worst shank (%), false swings per 100."""
    strides, swings = sum(each.strides for each in judged), sum(each.swings for each in judged)
    worst = min(100.0 * each.in_order / each.strides for each in judged)
    return [
        f"{100.0 * sum(each.in_order for each in judged) / strides:.2f}",
        f"{worst:.1f}",
        f"{100.0 * sum(each.false_swings for each in judged) / swings:.2f}",
    ]


def main(arguments: list[str] | None = None) -> int:
    """Print every setting's figures, what the others choose for each patient, and what comes of it."""
    parser = parser_of(__doc__, data_folder())
    parser.add_argument("--jobs", type=int, default=min(2, os.cpu_count() or 1), help="processes")
    options = parser.parse_args(arguments)
    with ProcessPoolExecutor(options.jobs) as pool:
        shanks = list(pool.map(judge, feet_of(options.data, ["shanks"]), chunksize=1))
    if not shanks:
        print(f"No recordings in {options.data}; set FES_DATA or give --data.", file=sys.stderr)
        return 3
    console = console_of(120)
    table = Table("setting", "in order %", "worst", "false /100")
    for k, setting in enumerate(SETTINGS):
        table.add_row(named(setting), *figures([each[k] for each in shanks]))
    console.print(table)
    left_out: list[Judged] = []
    for person in sorted({each[0].person for each in shanks}):
        others = [each for each in shanks if each[0].person != person]
        worths = [sum(each[k].in_order - each[k].false_swings for each in others) for k in range(len(SETTINGS))]
        best = worths.index(max(worths))
        left_out += [each[best] for each in shanks if each[0].person == person]
        console.print(f"{person} left out: the others choose {named(SETTINGS[best])}")
    table = Table("part", "left out: in order %", "worst", "false /100", "in sample: in order %", "worst", "false /100")
    for part in dict.fromkeys(each.part for each in left_out):
        own = [each[0] for each in shanks if each[0].part == part]
        table.add_row(part, *figures([each for each in left_out if each.part == part]), *figures(own))
    console.print(table)
    save([asdict(each) for each in left_out], options.json)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
