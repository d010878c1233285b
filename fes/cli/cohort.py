"""``fes cohort``: many recordings, analysed by many processes."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import click

from fes.cli.common.exits import FAILED, INTERRUPTED, Problem, StoppedEarly
from fes.cli.common.options import Number

if TYPE_CHECKING:
    from fes.cohort.store import Store
    from fes.cohort.task import Outcome

PER_SECOND = 2  # times that the bar is drawn: it takes its time from the work


@click.command(name="cohort")
@click.argument("recordings", nargs=-1, required=True)
@click.option("--out", default="out/cohort", show_default=True, help="A folder or address for the results.")
@click.option("--scheduler", default="", help="Address of a Dask scheduler. Default: processes of this machine.")
@click.option("--workers", type=click.IntRange(1, 512), help="Processes of this machine. Default: one a processor.")
@click.option("--subject-from", default="", help="A regular expression that finds the subject in a file's address.")
@click.option("--stairs", "--slope", "uneven", is_flag=True, help="Strides end higher or lower than they began.")
@click.option("--time-limit", type=Number(min=10), help="Give up a recording that takes longer (s). Default: none.")
@click.option("--retry-failed", is_flag=True, help="Try again what failed before.")
@click.option("--no-report", is_flag=True, help="Write no HTML pages.")
def command(
    recordings: tuple[str, ...],
    out: str,
    scheduler: str,
    workers: int | None,
    subject_from: str,
    uneven: bool,
    time_limit: float | None,
    retry_failed: bool,
    no_report: bool,
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
    from fes.cohort.engine import analyse_all, cluster, processors
    from fes.cohort.sources import CohortError, find_sources, program
    from fes.cohort.store import Store
    from fes.cohort.task import Settings, drop_replaced

    try:
        re.compile(subject_from)
    except re.error as error:
        raise Problem(f"--subject-from {subject_from}: is no regular expression: {error}.") from error
    store, settings = Store(results_at(out)), Settings(not uneven, subject_from)
    ended: type[Problem] = Problem  # how, should it not come to its end: nothing has been done yet
    try:
        sources = find_sources([absolute(pattern) for pattern in recordings])
        by_identity = {source.identity(settings.text()): source for source in sources}
        about = {"command": "fes cohort", "recordings": list(recordings), "settings": settings.text()}
        store.prepare(about | {"program": program()})
        finished = store.finished() & by_identity.keys()
        if retry_failed:
            again = {r["recording"] for r in _rows(store, finished) if r["status"] != "done"}
            store.forget(again)
            finished -= again
        todo = [source for identity, source in by_identity.items() if identity not in finished]
        if finished:
            click.echo(f"{len(finished)} of {len(sources)} are finished already.", err=True)
        if todo:
            number = min(workers or processors(), len(todo))
            with cluster(number, scheduler, time_limit) as client, ProgressBar(len(todo), "analysing") as bar:
                ended = StoppedEarly
                analyse_all(client, todo, store, settings, bar.advance, time_limit)
        if replaced := drop_replaced(store, sources, settings):
            click.echo(f"{replaced} results of earlier files, settings or versions were replaced.", err=True)
        rows = _rows(store, by_identity)
        if not no_report:
            from fes.cohort.page import write_pages

            page = write_pages(store, by_identity, rows)
            click.echo(f"Report     {page}")
    except CohortError as error:
        raise ended(str(error)) from error
    except OSError as error:
        raise ended(f"{store.url}: the results cannot be kept there: {error}") from error
    except KeyboardInterrupt:
        click.secho("Interrupted. Run the same command again to go on from here.", fg="yellow", err=True)
        raise SystemExit(INTERRUPTED) from None
    click.echo(f"Data set   {store.place('')}")
    failed = [row for row in rows if row["status"] != "done"]
    strides = sum(row["valid_strides"] or 0 for row in rows)
    click.echo(f"{len(rows) - len(failed)} of {len(sources)} recordings analysed, {strides} valid strides.")
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


class ProgressBar:
    """How far it has come, on stderr; lines of failures above it."""

    def __init__(self, total: int, doing: str) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        console = Console(stderr=True)
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
        shown = sys.stderr.isatty()
        self._progress = Progress(
            *columns, console=console, disable=not shown, transient=True, refresh_per_second=PER_SECOND
        )
        self._task = self._progress.add_task(doing, total=total)
        self._doing, self._failed = doing, 0

    def advance(self, outcome: Outcome) -> None:
        """One more is finished."""
        self._failed += outcome.status != "done"
        said = f"{self._doing}, {self._failed} failed" if self._failed else self._doing
        self._progress.update(self._task, advance=1, description=said)

    def __enter__(self) -> Self:
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()


def _rows(store: Store, identities: Iterable[str]) -> list[dict[str, Any]]:
    from fes.cohort.store import RECORDINGS

    rows: list[dict[str, Any]] = store.table(RECORDINGS, identities).to_pylist()
    return rows
