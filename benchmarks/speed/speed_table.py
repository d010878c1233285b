"""One table of speed: the user's road, stages, start-up, a live step, growth, an hour's session, a cohort, peers.

    make bench                                       both environments, then this with --keep: a result a part

Peers run in an environment of their own (`make peers`). The exit code is 1 if a bar is missed.
"""

from __future__ import annotations

import argparse
import os
import platform
import shutil
import sys
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from tempfile import TemporaryDirectory

from benchmarks.lib.figures import RESULTS, Figures, Result
from benchmarks.speed import speed
from benchmarks.speed.cohort import cohort_rows
from benchmarks.speed.speed_row import Row, print_rows
from benchmarks.speed.speed_session import growth_rows, live_rows, session_rows, step_rows

ROOT = Path(__file__).resolve().parents[2]
BUSY = 0.15  # processors that others take: from there on what counts by the clock counts little
PARTS = ("road", "analysis", "live", "peers", "growth", "session", "cohort")


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--only", nargs="+", choices=PARTS, default=PARTS, help="parts to measure; the rest is left out"
    )
    parser.add_argument("--quick", action="store_true", help="short lengths, no cold start")
    parser.add_argument("--recordings", type=int, help="of the cohort; 2000, quick 32")
    parser.add_argument("--peers", type=Path, default=ROOT / ".venv-peers" / "bin" / "python", help="their Python")
    parser.add_argument("--keep", action="store_true", help="in benchmarks/results/")
    parser.add_argument("--json", type=Path, help="keep the only part here")
    given = parser.parse_args(arguments)
    if given.quick and (given.keep or given.json):
        parser.error("--quick is too short for figures that stay")
    if given.json and len(given.only) != 1:
        parser.error("--json keeps one part: name it with --only")
    parts = dict[str, list[Row]]()
    failed = list[str]()
    with TemporaryDirectory(prefix="fes-speed-") as name:
        quick = given.quick
        measured: dict[str, Callable[[Path], list[Row]]] = {
            "road": lambda folder: speed.road_rows(1.0 if quick else 10.0, folder),
            "analysis": lambda folder: speed.measure(1.0 if quick else 10.0, folder, cold=not quick),
            "live": lambda _: live_rows(),
            "peers": lambda _: speed.peer_rows(speed.one_walk(), given.peers, step_rows(speed.one_walk())[0].value),
            "growth": lambda folder: growth_rows([0.2, 0.6] if quick else [1.0, 2.0, 5.0, 10.0], folder),
            "session": lambda folder: session_rows(0.05 if quick else 1.0, folder),
            "cohort": lambda folder: list(cohort_rows(given.recordings or (32 if quick else 2000), folder)),
        }
        for part in (part for part in PARTS if part in given.only):
            folder, begin = Path(name) / part, Spent.now()
            folder.mkdir()
            try:
                rows = measured[part](folder)
            except KeyboardInterrupt:
                print(f"Interrupted; {part} and what follows are not measured.", file=sys.stderr, flush=True)
                failed.append(part)
                break
            except Exception:  # the others are measured all the same
                traceback.print_exc()
                failed.append(part)
                continue
            finally:
                shutil.rmtree(folder, ignore_errors=True)
            parts[part] = rows
            print(f"{part}: measured in {Spent.now().clock_s - begin.clock_s:.0f} s", file=sys.stderr, flush=True)
            if given.keep or given.json:
                told = machine(begin.others_until(Spent.now()))
                result = result_of(f"speed/speed_table.py --only {part}", rows, told)
                result.keep(given.json or RESULTS / f"speed-{part}.json")
    missed = print_rows([row for rows in parts.values() for row in rows], "Speed")
    if failed:
        print(f"Not measured: {', '.join(failed)}", file=sys.stderr)
    return missed or bool(failed)


@dataclass(frozen=True)
class Spent:
    """Up to now, in s: by the clock, processor time of the whole machine, and of this process with its children."""

    clock_s: float
    machine_s: float
    own_s: float

    @staticmethod
    def now() -> Spent:
        """From the system; where it does not tell, the machine's is this process's."""
        own_s = sum(os.times()[:4])
        stat = Path("/proc/stat")
        if not stat.is_file():
            return Spent(time.monotonic(), own_s, own_s)
        user, nice, system, _, _, *interrupts = (int(word) for word in stat.read_text().splitlines()[0].split()[1:9])
        return Spent(time.monotonic(), (user + nice + system + sum(interrupts)) / os.sysconf("SC_CLK_TCK"), own_s)

    def others_until(self, end: Spent) -> float:
        """How many processors other programs took from now to ``end``, on average."""
        taken_s = (end.machine_s - self.machine_s) - (end.own_s - self.own_s)
        return max(taken_s, 0.0) / max(end.clock_s - self.clock_s, 1e-9)


def machine(others: float) -> str:
    """In words; one that others keep busy is said to be."""
    processors = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    told = f"{platform.machine()}, {processors} processors, {platform.system()}, Python {platform.python_version()}"
    return f"{told}; other programs took {others:.2f} of them{', so a BUSY machine' if others > BUSY else ''}"


def result_of(script: str, rows: list[Row], machine: str) -> Result:
    """For the page, a table a group."""
    groups = groupby(rows, lambda row: row.group)
    tables = [
        Figures(
            f"{group[:1].upper()}{group[1:]}", ("what", "figure", "bar", "met", ""), [row.cells() for row in members]
        )
        for group, members in groups
    ]
    return Result(f"python benchmarks/{script}", tables, machine=machine)


if __name__ == "__main__":
    raise SystemExit(main())
