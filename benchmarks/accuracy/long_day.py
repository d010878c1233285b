"""A virtual day of two feet through `fes analyse --bouts`: bouts, turns, terrain against the truth, time and memory.

    python benchmarks/accuracy/long_day.py [--hours 24] [--seed 1]

The day is that of ``virtual_day.py``. A bout is found where the other one covers more than half of it. Bars:
bout recall and precision 95 %, turns within 10 degrees, 4 min of one core and 1 GB for 24 h.
"""

from __future__ import annotations

import argparse
import csv
import os
import subprocess
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks.accuracy.virtual_day import TrueDay, write_day

Rows = list[dict[str, str]]
TERRAIN = {kind: f"stairs_{kind}" for kind in ("up", "down")}
RELAXED_S = 1.5  # about a change of terrain a stride is on both


@dataclass(frozen=True)
class Score:
    true_bouts: int
    bouts: int
    recall: float
    precision: float
    true_turns: int
    turns: int
    missed_turns: int
    turn_errors_rad: np.ndarray
    terrain_right: float
    stray_strides: int  # whose middle lies in nothing that is walking


def rows_of(folder: Path, name: str) -> Rows:
    with (folder / f"{name}.csv").open() as file:
        return list(csv.DictReader(file))


def score(truth: TrueDay, folder: Path) -> Score:
    """Of the tables that the command wrote."""
    found = spans(rows_of(folder, "bouts"))
    true = [(bout.begin_s, bout.end_s) for bout in truth.bouts]
    turns = [(*span, float(row["angle_rad"])) for row, span in with_spans(rows_of(folder, "turns"))]
    errors, missed = [], 0
    true_turns = [turn for bout in truth.bouts for turn in bout.turns]
    for turn in true_turns:
        near = max(turns, key=lambda one: overlap(one, (turn.begin_s, turn.end_s)), default=(0.0, 0.0, 0.0))
        if overlap(near, (turn.begin_s, turn.end_s)) > 0.0:
            errors.append(near[2] - turn.angle_rad)
        else:
            missed += 1
    stretches = [(span, row["terrain"]) for row, span in with_spans(rows_of(folder, "terrain"))]
    right = []
    for bout in truth.bouts:
        for begin, end, kind in bout.terrain:
            for t in np.arange(begin + RELAXED_S, end - RELAXED_S, 0.5):
                right += [name == TERRAIN.get(kind, kind) for span, name in stretches if span[0] <= t <= span[1]][:1]
    middles = [0.5 * (float(row["t_start_s"]) + float(row["t_end_s"])) for row in rows_of(folder, "strides")]
    stray = sum(not any(begin - 1.0 <= t <= end + 1.0 for begin, end in true) for t in middles)
    return Score(
        len(true),
        len(found),
        share(covered(one, found) for one in true),
        share(covered(one, true) for one in found),
        len(true_turns),
        len(turns),
        missed,
        np.array(errors),
        share(right),
        stray,
    )


def spans(rows: Rows) -> list[tuple[float, float]]:
    return [span for _, span in with_spans(rows)]


def with_spans(rows: Rows) -> list[tuple[dict[str, str], tuple[float, float]]]:
    return [(row, (float(row["begin_s"]), float(row["end_s"]))) for row in rows]


def overlap(one: tuple[float, ...], other: tuple[float, float]) -> float:
    return max(0.0, min(one[1], other[1]) - max(one[0], other[0]))


def covered(one: tuple[float, float], others: Iterable[tuple[float, float]]) -> bool:
    return any(overlap(one, other) > 0.5 * (one[1] - one[0]) for other in others)


def share(values: Iterable[bool]) -> float:
    listed = list(values)
    return sum(listed) / len(listed) if listed else float("nan")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--hours", type=float, default=24.0)
    parser.add_argument("--seed", type=int, default=1)
    asked = parser.parse_args()
    with TemporaryDirectory() as place:
        path = Path(place, "day.parquet")
        truth = write_day(path, asked.hours, asked.seed)
        command = [str(Path(sys.executable).with_name("fes")), "analyse", str(path), "--bouts", "--out", f"{place}/out"]
        one_core = os.environ | dict.fromkeys(("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "ARROW_NUM_THREADS"), "1")
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, env=one_core)
        _, status, used = os.wait4(process.pid, 0)
        if status:
            sys.exit(f"fes analyse failed: {status}")
        (folder,) = Path(place, "out").iterdir()
        found = score(truth, folder)
    errors = np.degrees(np.abs(found.turn_errors_rad))
    sys.stdout.write(
        f"{asked.hours:g} h, seed {asked.seed}: {used.ru_utime + used.ru_stime:.0f} s of one core, "
        f"{used.ru_maxrss / 1024:.0f} MB\n"
        f"bouts {found.bouts} of {found.true_bouts}: recall {100 * found.recall:.1f} %, "
        f"precision {100 * found.precision:.1f} %\n"
        f"turns {found.turns} of {found.true_turns}, {found.missed_turns} missed; angle off by {errors.mean():.2f} deg "
        f"(most {errors.max():.2f})\n"
        f"terrain right in {100 * found.terrain_right:.1f} % of the walking time; "
        f"{found.stray_strides} strides outside walking\n"
    )


if __name__ == "__main__":
    main()
