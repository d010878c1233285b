"""Recordings through Dask: a cluster of this machine's own processes, or one that is there already."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Final

from fes import __version__
from fes.cohort.one import Outcome, Settings, analyse_one, keep_failure
from fes.cohort.sources import CohortError, Source
from fes.cohort.store import Store

if TYPE_CHECKING:
    from distributed import Client

AHEAD: Final = 4  # tasks a worker process may have waiting: the queue stays short however long the list is
CONNECT_S: Final = 10.0
DEATHS: Final = 3  # of its process, after which a recording is given up

Tell = Callable[[Outcome], None]


@contextmanager
def cluster(workers: int, scheduler: str = "") -> Iterator[Client]:
    """A client of the cluster at ``scheduler``, or of one with ``workers`` single-threaded processes on this machine.

    Raises:
        CohortError: it does not answer, has no worker, or its workers have another version of this program.
    """
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
        LocalCluster(n_workers=workers, threads_per_worker=1, processes=True, dashboard_address=None) as own,
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

    A worker that dies loses nothing: what it had is done again elsewhere, and results replace themselves.

    Raises:
        CohortError: results cannot be kept any more, or the cluster is gone; what is kept stays.
    """
    from distributed import KilledWorker, as_completed

    waiting = iter(sources)
    of: dict[str, Source] = {}
    outcomes: list[Outcome] = []

    def submitted(source: Source) -> object:
        identity = source.identity(settings.text())
        of[f"fes-{identity}"] = source
        return client.submit(analyse_one, source, store, settings, key=f"fes-{identity}", pure=False)

    width = AHEAD * max(sum(client.nthreads().values()), 1)
    running = as_completed([submitted(source) for _, source in zip(range(width), waiting, strict=False)])
    for future in running:
        source = of.pop(future.key)
        try:
            outcome = future.result()
        except KilledWorker:
            why = f"the process that analysed it died {DEATHS} times; is it too long for a worker's memory?"
            outcome = keep_failure(source, store, settings, why)
        except OSError as error:
            raise CohortError(
                f"{store.url}: results cannot be kept: {error}. {len(outcomes)} are; make room and run the same "
                f"command again: it goes on from there."
            ) from error
        outcomes.append(outcome)
        tell(outcome)
        future.release()
        after = next(waiting, None)
        if after is not None:
            running.add(submitted(after))
    return outcomes


def workers_here() -> int:
    """As many processes as this one may use processors."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
