"""Work through Dask: a cluster of this machine's own processes, or one that is there already.

A time limit holds whatever a piece of work hangs in: its process is ended, as by a crash.
"""

from __future__ import annotations

import faulthandler
import os
import pickle
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from itertools import count
from typing import TYPE_CHECKING, Final

from fes.cohort.store import CohortError, program
from fes.cohort.task import Outcome, Task, reason_of

if TYPE_CHECKING:
    from distributed import Client


_SOONEST_S: Final = 1e-3  # no time left is no timer
_due_s: dict[int, float] = {}  # by thread: a worker may have several
_lock = threading.Lock()
_NOWHERE: Final = open(os.devnull, "w")  # noqa: SIM115, PTH123 - for as long as this process lives
AHEAD: Final = 2  # batches of a worker process: the one it works on, and the next
BATCH_S: Final = 2.0  # of work in a batch, about: handing one over takes this process 3 ms and the worker's as much …
BATCHES: Final = 2  # … but of what is left no more than this part of a worker's share, so that all end together …
SHORTEST_S: Final = 0.05  # … though not less than this …
LARGEST_BATCH: Final = 128  # … and never more tasks than this
CONNECT_S: Final = 10.0
DEATHS: Final = 3  # of its process, after which a task is given up
NO_DEATHS: Final = 0  # with a time limit, for each of them may last as long; tried once more it is all the same
QUIET: Final = {  # what Dask does besides the work every 10 ms to 2 s took 4 % of two processors from the work
    "distributed.worker.profile.enabled": False,
    "distributed.admin.tick.interval": "500ms",
    "distributed.worker.memory.monitor-interval": "500ms",
    "distributed.admin.system-monitor.interval": "5s",
    "distributed.scheduler.active-memory-manager.start": False,  # looks for results that two workers have
}
OnOutcome = Callable[[Outcome], None]


@contextmanager
def ended_after(limit_s: float | None) -> Iterator[None]:
    """While entered, this process ends after ``limit_s``; None: never.

    By a signal whose handler is left as it is, or where there is none by faulthandler's own thread: neither a read that
    waits for ever nor a compiled loop that lets nobody else have a turn can keep it from that.
    """
    if limit_s is None:
        yield
        return
    _set_due(time.monotonic() + limit_s)
    try:
        yield
    finally:
        _set_due(None)


def _set_due(due_s: float | None) -> None:
    with _lock:
        _due_s.pop(threading.get_ident(), None)
        if due_s is not None:
            _due_s[threading.get_ident()] = due_s
        left_s = min((max(each - time.monotonic(), _SOONEST_S) for each in _due_s.values()), default=0.0)
        if hasattr(signal, "setitimer"):
            signal.setitimer(signal.ITIMER_REAL, left_s)
        elif left_s:  # Windows: a thread outside Python; it tells where the others are, which nobody asked for
            faulthandler.dump_traceback_later(left_s, exit=True, file=_NOWHERE)
        else:
            faulthandler.cancel_dump_traceback_later()


@contextmanager
def cluster(workers: int, scheduler: str = "", limit_s: float | None = None) -> Iterator[Client]:
    """A client of the cluster at ``scheduler``, or of one with ``workers`` single-threaded processes on this machine.

    ``limit_s``: which tasks will have.

    CohortError: it does not answer, has no worker, or its workers have another version of this program.
    """
    import logging

    import dask
    from distributed import Client, LocalCluster

    deaths = DEATHS if limit_s is None else NO_DEATHS
    dask.config.set({"distributed.scheduler.allowed-failures": deaths, "distributed.comm.timeouts.connect": CONNECT_S})
    dask.config.set(QUIET)
    if scheduler:
        try:
            client = Client(scheduler, timeout=CONNECT_S)
        except Exception as error:  # whatever else listens there, or what Dask lacks for this kind of address
            remedy = "Start one with `dask scheduler`, or leave --scheduler away to use this machine."
            raise CohortError(f"{scheduler}: no Dask scheduler answers: {reason_of(error)}. {remedy}") from error
        with client:
            _check_workers(client, scheduler)
            yield client
        return
    with (
        LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            processes=True,
            dashboard_address=":0",  # health and metrics are served in any case; left away, where others serve theirs
            scheduler_kwargs={"dashboard": False},
            preload=["fes.cohort.engine"],  # whose dask_setup every worker calls
            silence_logs=logging.CRITICAL,  # a worker that died is told as what was lost, if anything was
        ) as own,
        Client(own) as client,
    ):
        yield client


def _check_workers(client: Client, scheduler: str) -> None:
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


def run_tasks(
    client: Client, tasks: Sequence[Task], on_outcome: OnOutcome, limit_s: float | None = None
) -> list[Outcome]:
    """Do every task once, many of them in a batch; ``on_outcome`` hears of each as it is finished.

    A worker that dies loses nothing: what it had is done again elsewhere, and results replace themselves. What was on a
    worker whenever it died is tried once more by itself, at the end: only the task that is to blame is given up. One
    that takes longer than ``limit_s`` dies with its process.

    CohortError: results cannot be kept any more, or the cluster is gone; what is kept stays.
    """
    from concurrent.futures import CancelledError

    from distributed import KilledWorker, as_completed
    from distributed.comm.core import CommClosedError

    workers = max(sum(client.nthreads().values()), 1)
    waiting = list(tasks)[::-1]
    suspects: list[Task] = []
    submitted: dict[str, list[Task]] = {}
    outcomes: list[Outcome] = []
    numbers, pace_s = count(), BATCH_S  # a task takes: long ones go one by one, so do the first

    def submit(batch: list[Task]) -> object:
        key = f"fes-{batch[0].key}-{next(numbers)}"
        submitted[key] = batch
        return client.submit(_work_on, pickle.dumps(batch), limit_s, key=key, pure=False)

    def next_batch() -> list[Task]:
        share = max(len(waiting) // (BATCHES * workers), int(SHORTEST_S / pace_s))
        most = max(min(share, int(BATCH_S / pace_s), LARGEST_BATCH, len(waiting)), 1)
        return [waiting.pop() for _ in range(most)]

    running = as_completed([submit(next_batch()) for _ in range(min(AHEAD * workers, len(waiting)))])
    alone, began_s = False, 0.0
    for future in running:
        batch = submitted.pop(future.key)
        finished: list[Outcome] = []
        again = f"{len(outcomes)} are kept; run the same command again: it goes on from there."
        try:
            found, seconds = future.result()
            pairs = zip(batch, found, strict=True)
            finished = [task.failed(each) if isinstance(each, str) else each for task, each in pairs]
            pace_s = max(seconds / len(batch), 1e-6)
        except KilledWorker:
            if alone:
                times = f"{DEATHS} times" if limit_s is None else "twice"
                why = f"the process that worked on it died {times}; is it too long for a worker's memory?"
                if limit_s is not None and time.monotonic() - began_s >= limit_s:
                    why = f"took longer than {limit_s:g} s"
                finished = [batch[0].failed(why)]
            else:
                suspects += batch
        except CohortError:
            raise
        except (CommClosedError, CancelledError) as error:
            raise CohortError(f"The Dask scheduler is gone. {again}") from error
        except OSError as error:
            raise CohortError(f"{batch[0].store.url}: results cannot be kept: {error}. Make room: {again}") from error
        except Exception as error:  # as of a worker that came later and has no fes
            raise CohortError(f"The workers cannot do it: {reason_of(error)}. {again}") from error
        outcomes.extend(finished)
        for outcome in finished:
            on_outcome(outcome)
        future.release()
        while waiting and len(submitted) < AHEAD * workers:
            running.add(submit(next_batch()))
        if suspects and not submitted:
            alone, began_s = True, time.monotonic()
            running.add(submit([suspects.pop()]))
    return outcomes


def _work_on(pickled: bytes, limit_s: float | None = None) -> tuple[list[Outcome | str], float]:
    """Work on a batch; the outcomes, and how long it took in s. In one piece, or Dask looks into all of it.

    Where a task ends with an error that nobody foresaw, its reason stands in place of the outcome.

    OSError, CohortError: results cannot be kept.
    """
    begin_s = time.perf_counter()
    outcomes: list[Outcome | str] = []
    for task in pickle.loads(pickled):
        try:
            with ended_after(limit_s):
                outcomes.append(task.done())
        except (OSError, CohortError):
            raise
        except Exception as error:  # must not take the others of the batch along
            outcomes.append(reason_of(error))
    return outcomes, time.perf_counter() - begin_s


def dask_setup(worker: object) -> None:
    """Leave Ctrl-C to the process that was asked: it ends its workers, which would each print a trace."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
