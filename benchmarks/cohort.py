"""A cohort's scaling from one worker process to two, and what is lost when a worker is killed.

Recordings are the bundled trial of two feet under as many names. The time is that of the analysis, from the first
recording handed out to the last one kept, with the workers up and their compiled code loaded. Beside it the processor
time of each worker and of this process, which hands out and collects: on a busy computer the ratio of the workers'
processor time tells more than the clock.

    python benchmarks/cohort.py --recordings 2000
"""

from __future__ import annotations

import argparse
import os
import resource
import signal
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from speed_row import Row, print_rows

from fes.cohort.engine import cluster, run
from fes.cohort.one import DONE, Outcome, Settings
from fes.cohort.report import write_pages
from fes.cohort.sources import Source, find
from fes.cohort.store import RECORDINGS, Store

TRIAL = Path(__file__).parents[1] / "sim_inputs" / "both_feet_100hz"
GROUP = "a cohort"
KILL_AFTER = 0.3  # share of the recordings
REQUIRED = 1.8


@dataclass(frozen=True)
class Run:
    """Seconds by the clock; processor time (s) of all workers and of this process; how each recording went."""

    seconds: float
    workers_s: float
    own_s: float
    outcomes: list[Outcome]


def lay(folder: Path, count: int) -> list[Source]:
    """The trial under ``count`` names, ten a subject."""
    for number in range(count):
        subject = folder / f"P{number // 10:04d}"
        subject.mkdir(exist_ok=True)
        for suffix in (".parquet", ".toml"):
            (subject / f"walk{number}{suffix}").symlink_to(TRIAL.with_suffix(suffix))
    return find([str(folder)])


def timed(sources: list[Source], store: Store, workers: int, kill: bool = False) -> Run:
    """Analyse them all, with one of the workers killed on the way if asked."""
    store.prepare({})
    seen = 0
    with cluster(workers) as client:
        warm = Store(store.url + "-warm")
        warm.prepare({})
        run(client, sources[: 16 * workers], warm, Settings(), lambda _: None)
        victim = min(client.run(os.getpid).values())

        def tell(_: Outcome) -> None:
            nonlocal seen
            seen += 1
            if kill and seen == int(KILL_AFTER * len(sources)):
                os.kill(victim, signal.SIGKILL)

        # the warm-up's futures are gone: these run anew
        spent_s = sum(client.run(_spent).values())
        own_s, begin_s = time.process_time(), time.perf_counter()
        outcomes = run(client, sources, store, Settings(), tell)
        seconds, own_s = time.perf_counter() - begin_s, time.process_time() - own_s
        return Run(seconds, sum(client.run(_spent).values()) - spent_s, own_s, outcomes)


def _spent() -> float:
    """A worker's processor time so far."""
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_utime + usage.ru_stime


def cohort_rows(count: int, folder: Path) -> list[Row]:
    """The figures of a cohort of ``count`` recordings."""
    (folder / "in").mkdir()
    sources = lay(folder / "in", count)
    rows, runs, whole = [], {}, True
    for workers in (1, 2):
        done = runs[workers] = timed(sources, Store(str(folder / f"out{workers}")), workers)
        good = sum(outcome.status == DONE for outcome in done.outcomes)
        whole = whole and good == count
        note = (
            f"{good} of {count} done; {1e3 * done.workers_s / count:.0f} ms of a worker and "
            f"{1e3 * done.own_s / count:.1f} ms of the scheduler each"
        )
        name = f"{workers} worker{'s' if workers > 1 else ''}, {count} recordings"
        rows.append(Row(GROUP, name, count / done.seconds, "recordings/s", higher=True, note=note))
    scaling = runs[1].seconds / runs[2].seconds if whole else float("nan")
    note = "by the clock" if whole else "not all were done, so the times tell nothing"
    rows.append(Row(GROUP, "scaling, 1 → 2 workers", scaling, "", REQUIRED, higher=True, note=note))
    store = Store(str(folder / "killed"))
    timed(sources, store, 2, kill=True)
    finished = store.table(RECORDINGS, store.finished()).to_pylist()
    lost = count - len({row["source"] for row in finished if row["status"] == DONE})
    rows.append(Row(GROUP, "lost with a worker killed", lost, "", 0.0))
    begin_s = time.process_time()
    write_pages(store, store.finished())
    rows.append(Row(GROUP, f"pages of {count} recordings", time.process_time() - begin_s, "s"))
    return rows


def main() -> int:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recordings", type=int, default=2000)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="fes-cohort-") as name:
        return print_rows(cohort_rows(options.recordings, Path(name)), "A cohort")


if __name__ == "__main__":
    sys.exit(main())
