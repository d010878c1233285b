"""Work through Dask: a cluster of this machine's own processes, or one that is there already."""

from __future__ import annotations

import os
import pickle
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from itertools import count
from typing import TYPE_CHECKING, Any, Final

from fes.cohort.one import Outcome, Settings, analyse_one, keep_failure
from fes.cohort.program import program
from fes.cohort.sources import CohortError, Source
from fes.cohort.store import Store

if TYPE_CHECKING:
    from distributed import Client

AHEAD: Final = 4  # batches a worker process may have waiting: the queue stays short however long the list is
BATCH_S: Final = 1.0  # of work in a batch, about: handing one over costs as much as reading a recording …
BATCHES: Final = 6  # … but of what is left no more than this part of a worker's share, so that all end together …
LARGEST_BATCH: Final = 64  # … and never more tasks than this
CONNECT_S: Final = 10.0
DEATHS: Final = 3  # of its process, after which a task is given up
QUIET: Final = {  # what Dask does besides the work every 10, 20 and 100 ms took 4 % of two processors from the work
    "distributed.worker.profile.enabled": False,
    "distributed.admin.tick.interval": "500ms",
    "distributed.worker.memory.monitor-interval": "500ms",
    "distributed.admin.system-monitor.interval": "5s",
}

Tell = Callable[[Outcome], None]


@dataclass(frozen=True, slots=True)
class Task:
    """One piece of work that keeps its own results.

    Attributes:
        key: names it; no two tasks have the same.
        work: called with ``arguments`` in a worker process.
        arguments: must survive pickling, as ``work`` must.
        lost: called here with the reason when the task cannot be worked on; what it says is the outcome.
    """

    key: str
    work: Callable[..., Outcome]
    arguments: tuple[Any, ...]
    lost: Callable[[str], Outcome]


@contextmanager
def cluster(workers: int, scheduler: str = "") -> Iterator[Client]:
    """A client of the cluster at ``scheduler``, or of one with ``workers`` single-threaded processes on this machine.

    Raises:
        CohortError: it does not answer, has no worker, or its workers have another version of this program.
    """
    import logging

    import dask
    from distributed import Client, LocalCluster

    dask.config.set({"distributed.scheduler.allowed-failures": DEATHS, "distributed.comm.timeouts.connect": CONNECT_S})
    dask.config.set(QUIET)
    if scheduler:
        try:
            client = Client(scheduler, timeout=CONNECT_S)
        except (OSError, TimeoutError, ValueError) as error:
            raise CohortError(
                f"{scheduler}: no Dask scheduler answers: {error}. Start one with `dask scheduler`, or leave "
                f"--scheduler away to use this machine."
            ) from error
        with client:
            _check(client, scheduler)
            yield client
        return
    with (
        LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            processes=True,
            dashboard_address=None,
            silence_logs=logging.ERROR,  # a worker that died is told as what was lost, if anything was
        ) as own,
        Client(own) as client,
    ):
        yield client


def _check(client: Client, scheduler: str) -> None:
    """All workers must be able to do what this process would do."""
    try:
        versions = client.run(program)
    except Exception as error:  # whatever a foreign worker raises
        raise CohortError(f"{scheduler}: its workers cannot import fes: {error}. Install fes {program()}.") from error
    if not versions:
        raise CohortError(f"{scheduler}: has no worker. Start some with `dask worker {scheduler}`.")
    for address, version in versions.items():
        if version != program():
            raise CohortError(f"{address}: has fes {version}, not {program()}. Install the same version on all.")


def run(client: Client, sources: Sequence[Source], store: Store, settings: Settings, tell: Tell) -> list[Outcome]:
    """Analyse recordings on a cluster, each once; ``tell`` hears of each as it is finished.

    Raises:
        CohortError: as :func:`run_tasks`.
    """

    def task(source: Source) -> Task:
        lost = partial(keep_failure, source, store, settings)
        return Task(source.identity(settings.text()), analyse_one, (source, store, settings), lost)

    return run_tasks(client, [task(source) for source in sources], store.url, tell)


def run_tasks(client: Client, tasks: Sequence[Task], place: str, tell: Tell) -> list[Outcome]:
    """Do every task once, many of them in a batch; ``place`` is where results are kept, for messages.

    A worker that dies loses nothing: what it had is done again elsewhere, and results replace themselves. What was on a
    worker whenever it died is tried once more by itself, at the end: only the task that is to blame is given up.

    Raises:
        CohortError: results cannot be kept any more, or the cluster is gone; what is kept stays.
    """
    from distributed import KilledWorker, as_completed

    workers = max(sum(client.nthreads().values()), 1)
    waiting = list(tasks)[::-1]
    suspects: list[Task] = []
    of: dict[str, list[Task]] = {}
    outcomes: list[Outcome] = []
    numbers, pace_s = count(), BATCH_S  # a task takes: long ones go one by one, so do the first

    def submitted(batch: list[Task]) -> object:
        key = f"fes-{batch[0].key}-{next(numbers)}"
        of[key] = batch
        return client.submit(_do, pickle.dumps([(task.work, task.arguments) for task in batch]), key=key, pure=False)

    def following() -> list[Task]:
        most = min(int(BATCH_S / max(pace_s, 1e-6)), len(waiting) // (BATCHES * workers), LARGEST_BATCH)
        return [waiting.pop() for _ in range(max(most, 1))]

    running = as_completed([submitted(following()) for _ in range(min(AHEAD * workers, len(waiting)))])
    alone = False
    for future in running:
        batch = of.pop(future.key)
        finished: list[Outcome] = []
        try:
            finished, seconds = future.result()
            pace_s = seconds / len(batch)
        except KilledWorker:
            if alone:
                why = f"the process that worked on it died {DEATHS} times; is it too long for a worker's memory?"
                finished = [batch[0].lost(why)]
            else:
                suspects += batch
        except OSError as error:
            raise CohortError(
                f"{place}: results cannot be kept: {error}. {len(outcomes)} are; make room and run the same "
                f"command again: it goes on from there."
            ) from error
        outcomes.extend(finished)
        for outcome in finished:
            tell(outcome)
        future.release()
        while waiting and len(of) < AHEAD * workers:
            running.add(submitted(following()))
        if suspects and not of:
            alone = True
            running.add(submitted([suspects.pop()]))
    return outcomes


def _do(pickled: bytes) -> tuple[list[Outcome], float]:
    """Work on a batch; the outcomes, and how long it took in s. In one piece, or Dask looks into all of it."""
    begin_s = time.perf_counter()
    outcomes = [work(*arguments) for work, arguments in pickle.loads(pickled)]
    return outcomes, time.perf_counter() - begin_s


def workers_here() -> int:
    """As many processes as this one may use processors."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
