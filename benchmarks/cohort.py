"""A cohort's scaling from one worker process to two, and what is lost when a worker is killed.

Recordings are the bundled trial of two feet under as many names. The time is that of the analysis, from the first
recording handed out to the last one kept, with the workers up and their compiled code loaded.

    python benchmarks/cohort.py --recordings 2000
"""

from __future__ import annotations

import argparse
import os
import signal
import tempfile
import time
from pathlib import Path

from fes.cohort.engine import cluster, run
from fes.cohort.one import DONE, Outcome, Settings
from fes.cohort.report import write_pages
from fes.cohort.sources import Source, find
from fes.cohort.store import RECORDINGS, Store

TRIAL = Path(__file__).parents[1] / "sim_inputs" / "both_feet_100hz"
KILL_AFTER = 0.3  # share of the recordings
REQUIRED = 1.8


def lay(folder: Path, count: int) -> list[Source]:
    """The trial under ``count`` names, ten a subject."""
    for number in range(count):
        subject = folder / f"P{number // 10:04d}"
        subject.mkdir(exist_ok=True)
        for suffix in (".parquet", ".toml"):
            (subject / f"walk{number}{suffix}").symlink_to(TRIAL.with_suffix(suffix))
    return find([str(folder)])


def timed(sources: list[Source], store: Store, workers: int, kill: bool = False) -> tuple[float, list[Outcome]]:
    """Seconds, and how each recording went."""
    store.prepare({})
    seen = 0
    with cluster(workers) as client:
        warm = Store(store.url + "-warm")
        warm.prepare({})
        run(client, sources[: 4 * workers], warm, Settings(), lambda _: None)
        victim = min(client.run(os.getpid).values())

        def tell(_: Outcome) -> None:
            nonlocal seen
            seen += 1
            if kill and seen == int(KILL_AFTER * len(sources)):
                os.kill(victim, signal.SIGKILL)

        # the warm-up's futures are gone: these run anew
        begin_s = time.perf_counter()
        outcomes = run(client, sources, store, Settings(), tell)
        return time.perf_counter() - begin_s, outcomes


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recordings", type=int, default=2000)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="fes-cohort-") as name:
        folder = Path(name)
        (folder / "in").mkdir()
        sources = lay(folder / "in", options.recordings)
        seconds = {}
        for workers in (1, 2):
            seconds[workers], outcomes = timed(sources, Store(str(folder / f"out{workers}")), workers)
            good = sum(outcome.status == DONE for outcome in outcomes)
            rate = len(outcomes) / seconds[workers]
            print(
                f"{workers} workers    {good} of {len(sources)} in {seconds[workers]:.1f} s, {rate:.1f} a second",
                flush=True,
            )
        ratio = seconds[1] / seconds[2]
        print(f"scaling      {ratio:.2f}, required {REQUIRED}: {'met' if ratio >= REQUIRED else 'MISSED'}")
        store = Store(str(folder / "killed"))
        took_s, outcomes = timed(sources, store, 2, kill=True)
        rows = store.table(RECORDINGS, store.finished()).to_pylist()
        kept = {row["source"] for row in rows if row["status"] == DONE}
        lost = len(sources) - len(kept)
        verdict = "met" if not lost else "MISSED"
        print(f"one killed   {len(kept)} kept in {took_s:.1f} s, {lost} lost: {verdict}", flush=True)
        begin_s = time.perf_counter()
        write_pages(store, store.finished())
        print(f"pages        {time.perf_counter() - begin_s:.1f} s")


if __name__ == "__main__":
    main()
