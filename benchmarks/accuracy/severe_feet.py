"""Phases of six severe, slow feet against instants that two raters set by hand, each alone; 3 without recordings.

The marks are ``tests/accuracy/severe_feet`` (its README says how they were set and what they are worth), the recordings
``stroke_walks`` of the unseen walkers. A mark's phase change is the nearest of its kind in the swing's cycle, from the
middle of the stance before to the middle of the stance after; a mark without one counts as not within 60 ms. "One
swing" is the share of marked swings with exactly one T2 in their cycle. Beside it stands how far the raters are apart
(b − a). S22's right foot, which is dragged by stick and slip, is shown apart.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from benchmarks.accuracy.every_walker import TIMES
from benchmarks.lib.command_line import no_recordings, parser_of, publish, spread, table_of
from benchmarks.lib.real_sets import data_folder
from benchmarks.lib.walkers import Foot, calibrated, causal, stroke_walks
from statemachine.phases import PhaseChange, Transition

MARKS = Path(__file__).resolve().parents[2] / "tests" / "accuracy" / "severe_feet"
RATERS = ("a", "b")
DRAGGED = ("S22", "right")
CLOSE_MS = 60.0
EDGE_S = 1.0  # of stance beside the first mark and the last


Changes = dict[tuple[str, str], list[PhaseChange]]  # of each foot, by run and side


@dataclass(frozen=True)
class Mark:
    """One swing of one foot by one rater: T1–T4 in s from the foot's first sample, NaN where the rater left it open."""

    run: str
    side: str
    times_s: tuple[float, float, float, float]

    @property
    def span_s(self) -> tuple[float, float]:
        """From the first instant that is set to the last."""
        return float(np.nanmin(self.times_s)), float(np.nanmax(self.times_s))


@dataclass(frozen=True)
class Agreement:
    """Errors of one instant, ms late; ``marks`` are all that were set, found or not."""

    instant: str
    marks: int
    errors_ms: list[float]

    @property
    def within(self) -> float:
        """Share of the marks within ``CLOSE_MS``, %."""
        close = sum(abs(error) <= CLOSE_MS for error in self.errors_ms)
        return 100.0 * close / self.marks if self.marks else math.nan

    @property
    def text(self) -> str:
        """Median [5 %, 95 %], share within."""
        if not self.errors_ms:
            return "–"
        return f"{spread(self.errors_ms)}, {self.within:.0f} %"


def marks_of(rater: str) -> dict[tuple[str, str], list[Mark]]:
    """One rater's swings, by run and side, in the order of time."""
    found: dict[tuple[str, str], list[Mark]] = {}
    with (MARKS / f"rater_{rater}.csv").open(encoding="utf-8", newline="") as file:
        for row in csv.DictReader(file):
            t1, t2, t3, t4 = (float(row[f"t{number}_s"] or "nan") for number in (1, 2, 3, 4))
            found.setdefault((row["run"], row["foot"]), []).append(Mark(row["run"], row["foot"], (t1, t2, t3, t4)))
    return found


def name_of(run: str, side: str) -> str:
    return f"{run} {side}" + (", dragged" if (run, side) == DRAGGED else "")


def paired(first: Sequence[Mark], second: Sequence[Mark]) -> list[tuple[Mark, Mark]]:
    """The same swings of one foot by two raters: those that overlap in time, each with the one it overlaps most."""
    found = []
    for one in first:
        overlaps = [min(one.span_s[1], x.span_s[1]) - max(one.span_s[0], x.span_s[0]) for x in second]
        if overlaps and max(overlaps) > 0.0:
            found.append((one, second[int(np.argmax(overlaps))]))
    return found


def between_raters(feet: Sequence[tuple[str, str]]) -> list[Agreement]:
    """How much later than rater a rater b set each instant; of these feet together."""
    a, b = (marks_of(rater) for rater in RATERS)
    pairs = [pair for foot in feet for pair in paired(a[foot], b[foot])]
    found = []
    for k, each in enumerate(TIMES):
        off = [1e3 * (y.times_s[k] - x.times_s[k]) for x, y in pairs]
        off = [round(ms, 6) for ms in off if not math.isnan(ms)]
        found.append(Agreement(each.name, len(off), off))
    return found


def cycles(marks: Sequence[Mark]) -> list[tuple[float, float]]:
    """From the middle of the stance before each swing to the middle of that after it, s."""
    cuts = [0.5 * (before.span_s[1] + after.span_s[0]) for before, after in pairwise(marks)]
    return list(pairwise([marks[0].span_s[0] - EDGE_S, *cuts, marks[-1].span_s[1] + EDGE_S]))


def errors_ms(marks: Sequence[Mark], changes: Sequence[PhaseChange], instant: Transition) -> tuple[int, list[float]]:
    """How many swings have this instant set, and how much later each phase change was, ms."""
    count, found = 0, []
    for mark, (begin, end) in zip(marks, cycles(marks), strict=True):
        true_s = mark.times_s[TIMES.index(instant)]
        if math.isnan(true_s):
            continue
        count += 1
        late = [1e-9 * c.t_ns - true_s for c in changes if c.transition is instant and begin < 1e-9 * c.t_ns <= end]
        if late:
            found.append(1e3 * min(late, key=abs))
    return count, found


def single(marks: Sequence[Mark], changes: Sequence[PhaseChange]) -> int:
    """Swings with exactly one T2 in their cycle."""
    offs = np.array([1e-9 * change.t_ns for change in changes if change.transition is Transition.T2])
    return sum(int(np.count_nonzero((offs > begin) & (offs <= end)) == 1) for begin, end in cycles(marks))


@dataclass(frozen=True)
class Result:
    """One foot, or several together, against one rater."""

    foot: str
    rater: str
    swings: int
    one_swing: int
    instants: list[Agreement]


def severe_feet(data: Path) -> list[Foot]:
    marked = marks_of(RATERS[0])
    feet = stroke_walks(data / "unseen_walkers", "unseen")
    return [foot for foot in feet if (foot.run, foot.side) in marked]


def against(rater: str, name: str, feet: Sequence[tuple[str, str]], changes: Changes) -> Result:
    """These feet together against one rater."""
    marks, instants = marks_of(rater), []
    for each in TIMES:
        found = [errors_ms(marks[foot], changes[foot], each) for foot in feet]
        instants.append(Agreement(each.name, sum(count for count, _ in found), [ms for _, own in found for ms in own]))
    ones = sum(single(marks[foot], changes[foot]) for foot in feet)
    return Result(name, rater, sum(len(marks[foot]) for foot in feet), ones, instants)


def evaluate(data: Path) -> list[Result]:
    """Each foot and all but the dragged one together, against each rater."""
    changes: Changes = {}
    for foot in severe_feet(data):
        calibration = calibrated(foot.track)
        changes[foot.run, foot.side] = causal(foot.track, calibration)[0] if calibration else []
    groups = {name_of(*foot): [foot] for foot in changes}
    if sound := [foot for foot in changes if foot != DRAGGED]:
        groups[f"{len(sound)} feet together"] = sound
    return [against(rater, name, feet, changes) for name, feet in groups.items() for rater in RATERS]


def main(arguments: list[str] | None = None) -> int:
    options = parser_of(__doc__, data_folder()).parse_args(arguments)
    results = evaluate(options.data)
    if not results:
        return no_recordings(options.data)
    rows = []
    marked = list(marks_of(RATERS[0]))
    for name in dict.fromkeys(result.foot for result in results):
        own = [result for result in results if result.foot == name]
        for result in own:
            one = f"{100.0 * result.one_swing / result.swings:.0f}"
            rows.append([name, f"rater {result.rater}", str(result.swings), one, *(x.text for x in result.instants)])
        feet = [foot for foot in marked if name_of(*foot) == name] or [foot for foot in marked if foot != DRAGGED]
        apart = between_raters(feet)
        rows.append(["", "b − a", str(apart[0].marks), "", *(x.text for x in apart)])
    title = f"later than the mark, median [5 %, 95 %], and share within ±{CLOSE_MS:.0f} ms"
    columns = ("foot", "against", "swings", "one swing %", *(f"{each.name} ms" for each in TIMES))
    publish([table_of(title, columns, rows)], options)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
