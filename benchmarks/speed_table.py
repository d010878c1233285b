"""One table of speed: the analysis and its stages, a live step, start-up, growth, an hour's session, a cohort, peers.

    make bench                                       (both environments, then this with --write)
    python benchmarks/speed_table.py --quick         everything shorter: a few minutes
    python benchmarks/speed_table.py --write         also into docs/speed.md and benchmarks/results/speed.json;
                                                     with --only, what is not measured keeps its last figures

Times are processor times, the least of several, so that other programs disturb them little; what counts by the clock
says so. Peers run in an environment of their own (`make peers`). The exit code is 1 if a bar is missed.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import shutil
import sys
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import speed
from cohort import cohort_rows
from speed_growth import growth_rows
from speed_live import PASSES, live_rows, live_step, recordings
from speed_peers import peer_rows
from speed_row import Row, markdown, print_rows
from speed_session import session_rows

ROOT = Path(__file__).resolve().parents[1]
RESULTS, PAGE = ROOT / "benchmarks" / "results" / "speed.json", ROOT / "docs" / "speed.md"
BEGIN, END = "<!-- figures: written by benchmarks/speed_table.py -->", "<!-- end of figures -->"
BUSY = 0.15  # processors that others take: from there on what counts by the clock counts little
PARTS = ("analysis", "live", "peers", "growth", "session", "cohort")


def main(arguments: list[str] | None = None) -> int:
    """Measure, print, save."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--only", nargs="+", choices=PARTS, default=PARTS, help="parts to measure; the rest is left out"
    )
    parser.add_argument("--quick", action="store_true", help="short lengths, no cold start")
    parser.add_argument("--recordings", type=int, help="of the cohort; 2000, quick 32")
    parser.add_argument("--peers", type=Path, default=ROOT / ".venv-peers" / "bin" / "python", help="their Python")
    parser.add_argument("--write", action="store_true", help=f"into {RESULTS.name} and {PAGE.name}")
    given = parser.parse_args(arguments)
    if given.quick and given.write:
        parser.error("--quick is too short for figures that stay; leave --write away")
    parts = read_parts(RESULTS) if given.write else {}
    done, failed = list[str](), list[str]()
    with TemporaryDirectory(prefix="fes-speed-") as name:
        quick = given.quick
        measured: dict[str, Callable[[Path], list[Row]]] = {
            "analysis": lambda folder: analysis_rows(1.0 if quick else 10.0, folder, cold=not quick),
            "live": lambda _: live_rows(recordings(), 2 if quick else PASSES),
            "peers": lambda _: peer_rows(speed.one_walk(), given.peers, live_step(speed.one_walk(), 2).mean_us),
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
            parts[part] = Part(rows, machine(begin.others_until(Spent.now())))
            done.append(part)
            print(f"{part}: measured in {Spent.now().clock_s - begin.clock_s:.0f} s", file=sys.stderr, flush=True)
            if given.write:
                RESULTS.parent.mkdir(parents=True, exist_ok=True)
                RESULTS.write_text(to_json(parts), encoding="utf-8")
                PAGE.write_text(written(PAGE.read_text(encoding="utf-8"), parts), encoding="utf-8")
    missed = print_rows([row for part in done for row in parts[part].rows], "Speed")
    if failed:
        print(f"Not measured: {', '.join(failed)}", file=sys.stderr)
    return missed or bool(failed)


@dataclass(frozen=True)
class Part:
    """Rows that were measured together, and on what machine."""

    rows: list[Row]
    machine: str


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


def read_parts(path: Path) -> dict[str, Part]:
    """What was measured before; nothing where there is no such file."""
    if not path.is_file():
        return {}
    saved = json.loads(path.read_text(encoding="utf-8"))
    return {part: Part([Row.from_json(row) for row in each["rows"]], each["machine"]) for part, each in saved.items()}


def analysis_rows(minutes: float, folder: Path, *, cold: bool) -> list[Row]:
    """The rows of ``speed.py``, by group."""
    measured = speed.measure(minutes, folder, cold=cold)
    return [
        Row(group_of(what, minutes), what.strip(), value, unit, bar, higher=unit == "samples/s")
        for what, value, unit, bar in measured
    ]


def group_of(what: str, minutes: float) -> str:
    """Where a figure of ``speed.py`` belongs."""
    return "start-up" if what.startswith("fes ") else f"analysis of {minutes:g} minutes of two feet"


def to_json(parts: dict[str, Part]) -> str:
    """For programs."""
    told = {
        part: {"machine": parts[part].machine, "rows": [row.to_json() for row in parts[part].rows]}
        for part in PARTS
        if part in parts
    }
    return json.dumps(told, indent=1, ensure_ascii=False) + "\n"


def written(page: str, parts: dict[str, Part]) -> str:
    """The page with the figures between its marks.

    Raises:
        ValueError: the page has no such marks.
    """
    before, begin, rest = page.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not begin or not end:
        raise ValueError(f"{PAGE.name} has no lines {BEGIN} and {END}")
    tables = (f"{markdown(parts[part].rows)}\nMeasured on {parts[part].machine}.\n" for part in PARTS if part in parts)
    return f"{before}{BEGIN}\n\n{chr(10).join(tables)}\n{END}{after}"


if __name__ == "__main__":
    raise SystemExit(main())
