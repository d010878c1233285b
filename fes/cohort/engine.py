"""Work through Dask: a cluster of this machine's own processes, or one that is there already."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from itertools import count
from typing import TYPE_CHECKING, Any, Final

from fes import __version__
from fes.cohort.one import Outcome, Settings, analyse_one, keep_failure
from fes.cohort.sources import CohortError, Source
from fes.cohort.store import Store

if TYPE_CHECKING:
    from distributed import Client

AHEAD: Final = 4  # batches a worker process may have waiting: the queue stays short however long the list is
BATCHES: Final = (
    12  # a worker gets at least so many, as long as there are that many tasks: the last ones end together …
)
LARGEST_BATCH: Final = 8  # … and at most so many tasks in each: handing one over costs as much as reading a recording
CONNECT_S: Final = 10.0
DEATHS: Final = 3  # of its process, after which a task is given up

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
        versions = client.run(_version)
    except Exception as error:  # whatever a foreign worker raises
        raise CohortError(f"{scheduler}: its workers cannot import fes: {error}. Install fes {__version__}.") from error
    if not versions:
        raise CohortError(f"{scheduler}: has no worker. Start some with `dask worker {scheduler}`.")
    for address, version in versions.items():
        if version != __version__:
            raise CohortError(f"{address}: has fes {version}, not {__version__}. Install the same version on all.")


def _version() -> str:
    return __version__


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
    size = min(max(len(tasks) // (BATCHES * workers), 1), LARGEST_BATCH)
    waiting = [list(tasks[at : at + size]) for at in range(0, len(tasks), size)][::-1]
    suspects: list[list[Task]] = []
    of: dict[str, list[Task]] = {}
    outcomes: list[Outcome] = []
    numbers = count()

    def submitted(batch: list[Task]) -> object:
        key = f"fes-{batch[0].key}-{next(numbers)}"
        of[key] = batch
        return client.submit(_do, [(task.work, task.arguments) for task in batch], key=key, pure=False)

    running = as_completed([submitted(waiting.pop()) for _ in range(min(AHEAD * workers, len(waiting)))])
    alone = False
    for future in running:
        batch = of.pop(future.key)
        finished: list[Outcome] = []
        try:
            finished = future.result()
        except KilledWorker:
            if alone:
                why = f"the process that worked on it died {DEATHS} times; is it too long for a worker's memory?"
                finished = [batch[0].lost(why)]
            else:
                suspects += [[task] for task in batch]
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
            running.add(submitted(waiting.pop()))
        if suspects and not of:
            alone = True
            running.add(submitted(suspects.pop()))
    return outcomes


def _do(batch: list[tuple[Callable[..., Outcome], tuple[Any, ...]]]) -> list[Outcome]:
    return [work(*arguments) for work, arguments in batch]


def workers_here() -> int:
    """As many processes as this one may use processors."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
