"""Wang et al.'s way with hemiparetic walks beside the project's own strides, on the stroke-treadmill recordings.

    python benchmarks/accuracy/hemiparetic.py [--data FOLDER] [--json FILE]

Swings of both feet against the mid-swing peaks of the low-passed toe-up rate (the data set's own axis): wrong are
peaks in no stride, peaks beyond the first in a stride, and strides without one. The recordings begin and end in the
middle of a walk; what lies within a second of their ends does not count. Speed over belt in the last 120 s on belts
of known speed; which side is afflicted and how sure that is; the clocks of two feet found again after one had been
set off and both cut. Methods:

- printed: windows at the threshold that the paper prints (0.025 m²/s⁴), the healthier foot's mapped to the other;
- fitted: the same, the threshold fitted to each foot;
- own: strides of `fes analyse`; parameters: the same as fes.analysis.parameters gives them (both feet brought to a
  common way).

Clocks and sides are checked on virtual walks and the bundled ones, too, of which the truth is known. Without the
recordings this says so and exits with 3.
"""

from __future__ import annotations

import math
from dataclasses import asdict

import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks.accuracy.hemiparetic_walks import (
    METHODS,
    ClockResult,
    FootResult,
    GroundResult,
    SideResult,
    analysed,
    clock,
    ground,
    known_walks,
    stroke_run,
    told_side,
)
from benchmarks.lib.command_line import console_of, parser_of, save
from benchmarks.lib.real_sets import data_folder, load_run, runs_of, stairs
from fes.analysis.hemiparetic.walk import SIGNS
from fes.recording import Recording

COUNT_BAR = 0.01


def main(arguments: list[str] | None = None) -> int:
    """Print the tables; 0 when the bars hold, 1 when not, 3 without data."""
    options = parser_of(__doc__, data_folder()).parse_args(arguments)
    if not (paths := runs_of(options.data)):
        return 3
    feet: list[FootResult] = []
    sides: list[SideResult] = []
    clocks: list[ClockResult] = []
    grounds: list[GroundResult] = []
    for path in paths:
        found, side, over = stroke_run(path)
        feet += found
        sides.append(side)
        grounds.append(over)
        clocks.append(clock(Recording(path.stem, None, load_run(path)[0])))
    for recording, truth in known_walks(options.data):
        walk = analysed(recording)[1]
        sides.append(told_side(recording.name, walk, truth))
        grounds.append(ground(recording.name, walk, "level"))
        if truth != "left":
            clocks.append(clock(recording))
    console = console_of(140)
    climb = stairs(options.data)
    if climb is not None:
        grounds.append(ground(climb.name, analysed(climb)[1], "up, with landings"))
    _show(console, feet, sides, clocks, grounds)
    save(
        {"feet": [asdict(f) for f in feet], "sides": [asdict(s) for s in sides],
         "grounds": [asdict(g) for g in grounds], "clocks": [asdict(c) for c in clocks]}, options.json,
    )  # fmt: skip
    counted = all(foot.off("own") <= COUNT_BAR for foot in feet)
    own, ours = (_spread(feet, method) for method in ("own", "parameters"))
    speed = abs(ours[0] - 1.0) <= max(abs(own[0] - 1.0), 0.002) and ours[1] <= own[1]
    right = all(s.told in (s.truth, "not sure") for s in sides if s.truth)
    console.print(f"Strides within 1 % of the mid-swings on every foot (own strides): {'yes' if counted else 'no'}")
    console.print(f"Speed over belt of the parameters no worse than the strides' own: {'yes' if speed else 'no'}")
    console.print(f"No wrong side told where it is known: {'yes' if right else 'no'}")
    return 0 if counted and speed and right else 1


def _spread(feet: list[FootResult], method: str) -> tuple[float, float, int]:
    values = np.array([f.belt_ratio[method] for f in feet if math.isfinite(f.belt_ratio[method])])
    return (
        (float(values.mean()), float(values.std(ddof=1)), len(values)) if len(values) > 1 else (math.nan, math.nan, 0)
    )


def _show(
    console: Console,
    feet: list[FootResult],
    sides: list[SideResult],
    clocks: list[ClockResult],
    grounds: list[GroundResult],
) -> None:
    table = Table("run", "foot", "mid-swings", *(f"{m} (wrong)" for m in METHODS), *(f"{m} / belt" for m in METHODS))
    for f in feet:
        ratios = (f"{f.belt_ratio[m]:.4f}" if math.isfinite(f.belt_ratio[m]) else "–" for m in METHODS)
        table.add_row(
            f.run, f.foot[:-5], str(f.mid_swings), *(f"{f.swings[m]} ({f.wrong[m]})" for m in METHODS), *ratios
        )
    console.print(table)
    for method in METHODS:
        mean, sd, n = _spread(feet, method)
        within = sum(f.off(method) <= COUNT_BAR for f in feet)
        worst = max(f.off(method) for f in feet)
        console.print(
            f"{method}: strides within 1 % of mid-swings on {within} of {len(feet)} feet, worst {100 * worst:.1f} %; "
            f"speed over belt {mean:.4f} ± {sd:.4f} ({n} feet)"
        )
    table = Table("walk", "afflicted", "leaning", "score", "signs", "power l/r", "steady", *SIGNS, "truth")
    for s in sides:
        numbers = f"{s.score:.2f}", f"{s.agreeing} of 4", f"{s.power_ratio:.2f}", f"{100 * s.power_steady:.0f} %"
        votes = (f"{s.votes[sign]:+.2f}" for sign in SIGNS)
        table.add_row(s.walk, s.told, s.leaning, *numbers, *votes, s.truth or "not known")
    console.print(table)
    table = Table("walk, feet cut apart", "error ms", "by", "runner-up", "sure")
    for c in clocks:
        table.add_row(c.walk, f"{1e3 * c.error_s:+.0f}", c.method, f"{c.runner_up:.2f}", "yes" if c.sure else "no")
    console.print(table)
    table = Table("walk, both feet", "level", "up", "down", "truth")
    for g in grounds:
        table.add_row(g.walk, str(g.level), str(g.up), str(g.down), g.truth)
    console.print(table)
    flat = [g for g in grounds if g.truth == "level"]
    wrongly = sum(g.up + g.down for g in flat)
    console.print(f"Strides on level ground taken for stairs: {wrongly} of {wrongly + sum(g.level for g in flat)}")


if __name__ == "__main__":
    raise SystemExit(main())
