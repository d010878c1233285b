"""A cohort's scaling from one worker process to two, and what is lost when a worker is killed.

Recordings are made here: the bundled trial of two feet, cut off at 20 to 40 s, each with noise of its own. One worker
and two take turns, three times each, and the means are compared: a rented computer is not equally fast from one
half-minute to the next. The clock runs from the first recording handed out to the last one kept. Beside it stands the
processor time of the workers and of this process: the scaling that these allow, were both processors free.
"""

from __future__ import annotations

import os
import resource
import shutil
import signal
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean

import numpy as np
import pyarrow as pa
from pyarrow import parquet

from benchmarks.speed.speed_row import Row
from fes.cohort.engine import cluster, run_tasks
from fes.cohort.page import write_pages
from fes.cohort.store import RECORDINGS, Source, Store, find_sources
from fes.cohort.task import DONE, Analysis, Outcome, Settings

TRIAL = Path(__file__).parents[2] / "sim_inputs" / "both_feet_100hz"
GROUP = "a cohort"
LENGTH_S, RATE_HZ = (20.0, 40.0), 100.0
NOISE = 1e-3  # m/s² and rad/s, much below the sensors' own
KILLED, KILL_AFTER = 64, 0.3  # recordings of the run in which a worker is killed; after which share of them
REQUIRED = 1.8
TURNS = (1, 2, 2, 1, 1, 2)  # workers; what drifts falls on both


@dataclass(frozen=True)
class Run:
    """Seconds by the clock, and those until the workers were ready; processor time (s) of all workers and of this
    process; how each recording went."""

    seconds: float
    ready_s: float
    workers_s: float
    own_s: float
    outcomes: list[Outcome]


def make(folder: Path, count: int) -> None:
    """That many recordings with their sidecars below ``folder``."""
    trial = parquet.read_table(TRIAL.with_suffix(".parquet"))
    chance = np.random.default_rng(1)
    for number in range(count):
        subject = folder / f"P{number // 10:04d}"
        subject.mkdir(parents=True, exist_ok=True)
        piece = trial.slice(0, round(RATE_HZ * chance.uniform(*LENGTH_S)))
        for at, field in enumerate(piece.schema):
            if pa.types.is_floating(field.type):
                values = piece.column(at).to_numpy()
                own = pa.array(values + NOISE * chance.standard_normal(len(values)), field.type)
                piece = piece.set_column(at, field, own)
        parquet.write_table(piece, subject / f"walk{number}.parquet")
        shutil.copy(TRIAL.with_suffix(".toml"), subject / f"walk{number}.toml")


def timed(sources: list[Source], store: Store, workers: int, kill: bool = False) -> Run:
    """Analyse them all, with one of the workers killed on the way if asked."""
    store.prepare({})
    seen, start_s = 0, time.perf_counter()
    with cluster(workers) as client:
        warm = Store(store.url + "-warm")
        warm.prepare({})
        client.run(Analysis(warm, sources[0], Settings()).done)  # in each worker
        victim = min(client.run(os.getpid).values())

        def tell(_: Outcome) -> None:
            nonlocal seen
            seen += 1
            if kill and seen == int(KILL_AFTER * len(sources)):
                os.kill(victim, signal.SIGKILL)

        spent_s = sum(client.run(_spent).values())
        own_s, begin_s = time.process_time(), time.perf_counter()
        outcomes = run_tasks(client, [Analysis(store, source, Settings()) for source in sources], tell)
        seconds, own_s = time.perf_counter() - begin_s, time.process_time() - own_s
        spent_s = sum(client.run(_spent).values()) - spent_s  # nonsense where a worker was killed, and not used then
        return Run(seconds, begin_s - start_s, spent_s, own_s, outcomes)


def _spent() -> float:
    """A worker's processor time so far."""
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_utime + usage.ru_stime


def cohort_rows(count: int, folder: Path) -> Iterator[Row]:
    """The figures of a cohort of ``count`` recordings, as they are had."""
    begin_s = time.process_time()
    make(folder / "in", count)
    _tell(f"{count} recordings made, {time.process_time() - begin_s:.0f} s")
    begin_s = time.process_time()
    sources = find_sources([str(folder / "in")])
    yield Row(GROUP, f"finding {count} recordings", time.process_time() - begin_s, "s")
    runs: dict[int, list[Run]] = {1: [], 2: []}
    for turn, workers in enumerate(TURNS):
        done = timed(sources, Store(str(folder / f"out{turn}")), workers)
        runs[workers].append(done)
        _tell(f"{_workers(workers)}: {count} recordings in {done.seconds:.1f} s")
    whole = all(outcome.status == DONE for every in runs.values() for one in every for outcome in one.outcomes)
    for workers, every in runs.items():
        good = min(sum(outcome.status == DONE for outcome in one.outcomes) for one in every)
        times = ", ".join(f"{one.seconds:.1f}" for one in every)
        note = (
            f"{good} done in {times} s; {1e3 * _mean(every, 'workers_s') / count:.1f} ms of a worker and "
            f"{1e3 * _mean(every, 'own_s') / count:.2f} ms of the scheduler each; "
            f"ready after {_mean(every, 'ready_s'):.1f} s"
        )
        name = f"{_workers(workers)}, {count} recordings"
        yield Row(GROUP, name, count / _mean(every, "seconds"), "recordings/s", higher=True, note=note)
    one, two = runs[1], runs[2]
    scaling = _mean(one, "seconds") / _mean(two, "seconds") if whole else float("nan")
    note = "by the clock, means" if whole else "not all were done, so the times tell nothing"
    yield Row(GROUP, "scaling, 1 → 2 workers", scaling, "", REQUIRED, higher=True, note=note)
    # one worker has a processor to itself, two share both with the scheduler
    allowed = 2.0 * _mean(one, "workers_s") / (_mean(two, "workers_s") + _mean(two, "own_s"))
    name = "scaling that processor times allow"
    yield Row(GROUP, name, allowed if whole else float("nan"), higher=True, note="both processors free")
    begin_s = time.process_time()
    last = Store(str(folder / f"out{len(TURNS) - 1}"))
    write_pages(last, last.finished())
    yield Row(GROUP, f"pages of {count} recordings", time.process_time() - begin_s, "s")
    few, store = sources[:KILLED], Store(str(folder / "killed"))
    killed = timed(few, store, 2, kill=True)
    rows = store.table(RECORDINGS, store.finished(), ("source", "status")).to_pylist()
    lost = len(few) - len({row["source"] for row in rows if row["status"] == DONE})
    note = f"{killed.seconds:.1f} s; a new worker starts meanwhile"
    yield Row(GROUP, f"lost of {len(few)} with a worker killed", lost, "", 0.0, note=note)


def _workers(count: int) -> str:
    return f"{count} worker{'s' if count > 1 else ''}"


def _mean(runs: list[Run], name: str) -> float:
    return fmean(float(getattr(run, name)) for run in runs)


def _tell(text: str) -> None:
    print(text, file=sys.stderr, flush=True)
