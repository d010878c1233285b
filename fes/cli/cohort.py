"""``fes cohort``: many recordings, analysed by many processes."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from fes.cli.common import FAILED, Number, Problem, StoppedEarly, interrupted, need_extra, processors
from fes.cli.show import print_json

if TYPE_CHECKING:
    from fes.cohort.store import Store
    from fes.cohort.task import Outcome

Task = TypeVar("Task")
PER_SECOND = 2  # times that the bar is drawn: it takes its time from the work


@click.command(name="cohort")
@click.argument("recordings", nargs=-1, required=True)
@click.option("--out", default="out/cohort", show_default=True, help="A folder or address for the results.")
@click.option("--scheduler", default="", help="Address of a Dask scheduler. Default: processes of this machine.")
@click.option("--workers", type=click.IntRange(1, 512), help="Processes of this machine. Default: one a processor.")
@click.option("--subject-from", default="", help="A regular expression that finds the subject in a file's address.")
@click.option("--stairs", "--slope", "uneven", is_flag=True, help="Strides end higher or lower than they began.")
@click.option("--sync-clocks", is_flag=True, help="Each foot had its own clock: set the right one's by the walk.")
@click.option("--time-limit", type=Number(min=10), help="Give up a recording that takes longer (s). Default: none.")
@click.option("--retry-failed", is_flag=True, help="Try again what failed before.")
@click.option("--no-report", is_flag=True, help="Write no HTML pages.")
@click.option("--json", "as_json", is_flag=True, help="As JSON on stdout.")
def command(
    recordings: tuple[str, ...],
    out: str,
    scheduler: str,
    workers: int | None,
    subject_from: str,
    uneven: bool,
    sync_clocks: bool,
    time_limit: float | None,
    retry_failed: bool,
    no_report: bool,
    as_json: bool,
) -> None:
    """Analyse all RECORDINGS: files, folders, globs, or addresses on any storage that fsspec opens.

    Each needs its sidecar beside it. Results are a Parquet data set (recordings, strides, events) and pages with
    distributions, outliers and one page a subject. The subject is the sidecar's, else what --subject-from finds, else
    the folder's name.

    Run the same command again after a crash or Ctrl-C: what is finished is not done again. A recording that cannot be
    used does not stop the others; it is listed with its reason.

    Exit code: 0 all analysed, 1 some not, 2 unusable arguments or storage, 3 stopped early (no room for the results,
    the scheduler gone), 130 interrupted.
    """
    need_extra("cohort")
    from fes.cohort.engine import analyse_all, cluster
    from fes.cohort.sources import find_sources, program
    from fes.cohort.store import RECORDINGS, Store
    from fes.cohort.task import Settings, drop_replaced

    try:
        re.compile(subject_from)
    except re.error as error:
        raise Problem(f"--subject-from {subject_from}: is no regular expression: {error}.") from error
    store, settings = Store(results_at(out)), Settings(not uneven, subject_from, sync_clocks)
    with resumable(store.url) as run:
        sources = find_sources([absolute(pattern) for pattern in recordings])
        by_identity = {source.identity(settings.text()): source for source in sources}
        about = {"command": "fes cohort", "recordings": list(recordings), "settings": settings.text()}
        store.prepare(about | {"program": program()})
        todo = unfinished(store, by_identity, RECORDINGS, "recording", retry_failed)
        if todo:
            number = min(workers or processors(), len(todo))
            with cluster(number, scheduler, time_limit) as client, progress_bar(len(todo), "analysing") as advance:
                run.begun = True
                analyse_all(client, todo, store, settings, advance, time_limit)
        if replaced := drop_replaced(store, sources, settings):
            click.echo(f"{replaced} results of earlier files, settings or versions were replaced.", err=True)
        rows: list[dict[str, Any]] = store.table(RECORDINGS, by_identity).to_pylist()
        page = ""
        if not no_report:
            from fes.cohort.page import write_pages

            page = str(write_pages(store, by_identity, rows))
    failed = [row for row in rows if row["status"] != "done"]
    strides = sum(row["valid_strides"] or 0 for row in rows)
    done = len(rows) - len(failed)
    if as_json:
        unused = [{"source": row["source"], "reason": row["reason"]} for row in failed]
        found = {"recordings": len(sources), "analysed": done, "valid_strides": strides, "not_used": unused}
        print_json({"data_set": store.place(""), "report": page or None} | found)
    else:
        click.echo(f"Report     {page}\n" * bool(page) + f"Data set   {store.place('')}")
        click.echo(f"{done} of {len(sources)} recordings analysed, {strides} valid strides.")
    for row in failed:
        click.secho(f"Not used: {row['source']}: {row['reason']}", fg="red", err=True)
    if gone := len(by_identity) - len(rows):
        said = f"{gone} results are gone: another run into the same folder took them away. Run the same command again."
        click.secho(said, fg="red", err=True)
    if failed or gone:
        raise SystemExit(FAILED)


def absolute(pattern: str) -> str:
    """Workers may have another working folder."""
    return pattern if "://" in pattern else str(Path(pattern).absolute())


def results_at(out: str) -> str:
    """Where results go, for every process."""
    if out.startswith("memory:"):
        raise Problem(f"--out {out}: every process has a memory of its own; give a folder or another storage.")
    return absolute(out)


@dataclass
class Run:
    """Whether the work has begun: what ends it then has stopped it early."""

    begun: bool = False


@contextmanager
def resumable(place: str) -> Iterator[Run]:
    """End the command with what keeps many tasks from being done, their results in ``place``, and on Ctrl-C."""
    from fes.cohort.sources import CohortError
    from fes.config import ConfigError

    run = Run()
    try:
        yield run
    except (CohortError, ConfigError, OSError) as error:
        what = f"{place}: the results cannot be kept there: {error}" if isinstance(error, OSError) else str(error)
        raise (StoppedEarly if run.begun else Problem)(what) from error
    except KeyboardInterrupt:
        interrupted(". Run the same command again to go on from here.")


def unfinished(store: Store, tasks: Mapping[str, Task], table: str, key: str, retry_failed: bool) -> list[Task]:
    """The tasks, by the names of their results, of which the store holds none; those that failed only to be retried."""
    finished = store.finished() & tasks.keys()
    if retry_failed:
        again = {row[key] for row in store.table(table, finished).to_pylist() if row["status"] != "done"}
        store.forget(again)
        finished -= again
    if finished:
        click.echo(f"{len(finished)} of {len(tasks)} are finished already.", err=True)
    return [task for name, task in tasks.items() if name not in finished]


@contextmanager
def progress_bar(total: int, doing: str) -> Iterator[Callable[[Outcome], None]]:
    """How far it has come, on stderr; what it gives is called with each outcome."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    console, hidden, failed = Console(stderr=True), not sys.stderr.isatty(), 0
    with Progress(*columns, console=console, disable=hidden, transient=True, refresh_per_second=PER_SECOND) as bar:
        task = bar.add_task(doing, total=total)

        def advance(outcome: Outcome) -> None:
            nonlocal failed
            failed += outcome.status != "done"
            bar.update(task, advance=1, description=f"{doing}, {failed} failed" if failed else doing)

        yield advance
