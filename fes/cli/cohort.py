"""``fes cohort``: many recordings, analysed by many processes."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fes.cli.common import (
    FAILED,
    PATH,
    Number,
    Problem,
    StoppedEarly,
    failing,
    interrupted,
    need_extra,
    print_json,
    processors,
    progress_bar,
    screen,
    writing,
)
from fes.walk_record import finite_or_none

if TYPE_CHECKING:
    from collections.abc import Sequence

    from fes.cohort.store import Measure, Store
    from fes.cohort.sweep.table import Combination
    from fes.cohort.sweep.task import Case
    from fes.cohort.task import Outcome, Task


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
def cohort_command(
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
    from fes.cohort.engine import cluster, run_tasks
    from fes.cohort.store import RECORDINGS, Store, find_sources, program
    from fes.cohort.task import Analysis, Settings, drop_replaced

    try:
        re.compile(subject_from)
    except re.error as error:
        raise Problem(f"--subject-from {subject_from}: is no regular expression: {error}.") from error
    store, settings = Store(results_at(out)), Settings(not uneven, subject_from, sync_clocks)
    with resumable(store.url) as run:
        sources = find_sources([absolute(pattern) for pattern in recordings])
        by_identity = {task.key: task for task in (Analysis(store, source, settings) for source in sources)}
        about = {"command": "fes cohort", "recordings": list(recordings), "settings": settings.text()}
        store.prepare(about | {"program": program()})
        todo = unfinished(store, by_identity, retry_failed)
        if todo:
            number = min(workers or processors(), len(todo))
            with cluster(number, scheduler, time_limit) as client, outcomes_bar(len(todo), "analysing") as advance:
                run.begun = True
                run_tasks(client, todo, advance, time_limit)
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
    from fes.cohort.store import CohortError
    from fes.config import ConfigError

    run = Run()
    try:
        yield run
    except (CohortError, ConfigError, OSError) as error:
        what = f"{place}: the results cannot be kept there: {error}" if isinstance(error, OSError) else str(error)
        raise (StoppedEarly if run.begun else Problem)(what) from error
    except KeyboardInterrupt:
        interrupted(". Run the same command again to go on from here.")


def unfinished(store: Store, tasks: Mapping[str, Task], retry_failed: bool) -> list[Task]:
    """The tasks, by the names of their results, of which the store holds none; those that failed only to be retried."""
    finished = store.finished() & tasks.keys()
    if retry_failed:
        key, rows = store.schemas[store.last].names[0], store.table(store.last, finished).to_pylist()
        again = {row[key] for row in rows if row["status"] != "done"}
        store.forget(again)
        finished -= again
    if finished:
        click.echo(f"{len(finished)} of {len(tasks)} are finished already.", err=True)
    return [task for name, task in tasks.items() if name not in finished]


@contextmanager
def outcomes_bar(total: int, doing: str) -> Iterator[Callable[[Outcome], None]]:
    """How far it has come, on stderr; what it gives is called with each outcome."""
    failed = 0
    with progress_bar(doing, total) as update:

        def advance(outcome: Outcome) -> None:
            nonlocal failed
            failed += outcome.status != "done"
            update(advance=1, description=f"{doing}, {failed} failed" if failed else doing)

        yield advance


# --- ``fes sweep``: many combinations of settings, tried on recordings or on virtual patients, by many processes ---


LISTED = 10
MOST_TRIALS = 1_000_000  # what is still to do is kept in memory
PAGE, TABLE = "index.html", "combinations.parquet"


def _list_names(context: click.Context, _: click.Parameter, asked: bool) -> None:
    if asked:
        need_extra("cohort")
        from fes.cohort.sweep.grid import swept_names

        click.echo("\n".join(swept_names()))
        context.exit()


@click.command(name="sweep")
@click.argument("session", type=PATH)
@click.argument("recordings", nargs=-1)
@click.option("--set", "asked", multiple=True, metavar="NAME=VALUES", help="A setting and its values; repeat it.")
@click.option("--sample", type=click.IntRange(1), help="Try so many combinations by chance instead of all.")
@click.option("--seed", type=click.IntRange(0), default=1, show_default=True, help="Of the sample and the patients.")
@click.option("--patients", type=click.IntRange(1, 10_000), help="Try on so many virtual patients, in closed loop.")
@click.option("--seconds", type=Number(20, 3600), default=90.0, show_default=True, help="A virtual patient walks for.")
@click.option("--out", default="out/sweep", show_default=True, help="A folder or address for the results.")
@click.option("--scheduler", default="", help="Address of a Dask scheduler. Default: processes of this machine.")
@click.option("--workers", type=click.IntRange(1, 512), help="Processes of this machine. Default: one a processor.")
@click.option("--time-limit", type=Number(min=10), help="Give up a trial that takes longer (s). Default: none.")
@click.option("--retry-failed", is_flag=True, help="Try again what failed before.")
@click.option("--apply", "apply_to", type=PATH, help="Write the best thresholds into this copy of SESSION.")
@click.option("--no-report", is_flag=True, help="Write no HTML page.")
@click.option("--json", "as_json", is_flag=True, help="As JSON on stdout.")
@click.option(
    "--names", is_flag=True, is_eager=True, expose_value=False, callback=_list_names, help="List what can be swept."
)
def sweep_command(
    session: Path,
    recordings: tuple[str, ...],
    asked: tuple[str, ...],
    sample: int | None,
    seed: int,
    patients: int | None,
    seconds: float,
    out: str,
    scheduler: str,
    workers: int | None,
    time_limit: float | None,
    retry_failed: bool,
    apply_to: Path | None,
    no_report: bool,
    as_json: bool,
) -> None:
    """Try combinations of settings of SESSION on RECORDINGS, or with --patients on virtual ones.

    NAME is a setting of the session file (phases.swing_begins, stimulation.strides_before_start, channels.tuning.gain;
    channels.0.… for one channel) or a guard's threshold (thresholds.heel_rise_share). VALUES are separated by commas;
    LOW:HIGH:COUNT is COUNT values from LOW to HIGH, and x1.2, for thresholds, is 1.2 times what calibration gives.

    A recording with its truth beside it is judged by missed, extra and mistimed transitions, one without by its
    strides, a virtual patient by toe clearance, stumbles and charge. The session as it is comes along for comparison.

    Run the same command again after a crash or Ctrl-C, or with more values: what is finished is not done again. A
    combination that fails does not stop the others; it is listed with its reason.

    Exit code: 0 all tried, 1 some trials failed, 2 unusable arguments, settings or storage, 3 stopped early (no room
    for the results, the scheduler gone), 130 interrupted.
    """
    need_extra("cohort")
    import pyarrow as pa
    from pyarrow import parquet

    from fes.cohort.engine import cluster, run_tasks
    from fes.cohort.store import find_sources
    from fes.cohort.sweep.grid import combinations_of, parse_axis
    from fes.cohort.sweep.table import RESULTS, combination_table, combinations, measures_in, sweep_store
    from fes.cohort.sweep.task import TRUTH_FILES, Bench, Patient, Trial
    from fes.config import load_session

    if bool(recordings) == bool(patients):
        raise Problem("Give RECORDINGS to try on, or --patients N; one of the two.")
    if not asked:
        raise Problem("Nothing to sweep. Give --set NAME=VALUE,VALUE; `fes sweep --names` lists the names.")
    with resumable(out) as run:
        axes = [parse_axis(each) for each in asked]
        tried = combinations_of(axes, sample, seed)
        bench = Bench(load_session(session), str(session), seconds if patients else 0.0)
        cases: list[Case] = [Patient(number, seed) for number in range(patients or 0)]
        cases += find_sources([absolute(pattern) for pattern in recordings], TRUTH_FILES) if recordings else []
        if len(cases) * len(tried) > MOST_TRIALS:
            raise Problem(
                f"{len(tried)} combinations on {len(cases)} cases are {len(cases) * len(tried)} trials, more than "
                f"{MOST_TRIALS}; give fewer, or --sample N."
            )
        store = sweep_store(results_at(out))
        store.prepare({"command": "fes sweep", "session": str(session), "set": list(asked), "seed": seed})
        tasks = {task.key: task for task in (Trial(store, *each, bench) for each in product(cases, tried))}
        todo = unfinished(store, tasks, retry_failed)
        if todo:
            number = min(workers or processors(), len(todo))
            with cluster(number, scheduler, time_limit) as client, outcomes_bar(len(todo), "trying") as advance:
                run.begun = True
                run_tasks(client, todo, advance, time_limit)
        rows = store.table(RESULTS, tasks).to_pylist()
        measures = measures_in(rows)
        found = combinations(rows, measures)
        sink = pa.BufferOutputStream()
        parquet.write_table(combination_table(found, measures), sink)
        store.write(TABLE, sink.getvalue().to_pybytes())
        if not no_report:
            from fes.cohort.sweep.table import sweep_page

            store.write(PAGE, sweep_page(axes, found, measures, [case.url for case in cases], bench.session.name))
    page, place = None if no_report else str(store.place(PAGE)), str(store.place(TABLE))
    if as_json:
        print_json({"table": place, "report": page, "combinations": [finite_or_none(asdict(one)) for one in found]})
    else:
        click.echo(f"Report     {page}\n" * bool(page) + f"Table      {place}")
        _show_best(found, measures)
    if apply_to is not None:
        apply_best(found, session, apply_to, len(cases), as_json)
    if failed := sum(one.failed for one in found):
        for one in [one for one in found if one.failed][:LISTED]:
            click.secho(f"Failed: {one.text}: {'; '.join(one.reasons)}", fg="red", err=True)
        click.secho(f"{failed} of {len(rows)} trials failed.", fg="red", err=True)
        raise SystemExit(FAILED)


def apply_best(found: Sequence[Combination], session: Path, target: Path, cases: int, as_json: bool = False) -> None:
    """Write a copy of the session file with the best combination's thresholds and their origin; say what else was best.

    ``as_json``: on stderr, for stdout holds the JSON alone.

    Problem: there is none, they are not allowed, or the file cannot be written.
    """
    from fes.cohort.sweep.grid import THRESHOLDS
    from fes.config import ConfigError, load_session, validate_session
    from fes.config.thresholds import ORIGIN, with_thresholds_table

    best = next((one for one in found if not one.failed), None)
    swept = {} if best is None else dict(best.settings)
    chosen = {name.partition(".")[2]: value for name, value in swept.items() if name.startswith(f"{THRESHOLDS}.")}
    if not chosen:
        raise Problem(f"--apply {target}: the session as it is came out best; there is nothing to write.")
    kept = load_session(session).thresholds
    origin = f"fes sweep: best of {len(found)} combinations on {cases} cases"
    merged = {name: value for name, value in kept.items() if name != ORIGIN} | chosen | {ORIGIN: origin}
    text = with_thresholds_table(session.read_text(encoding="utf-8"), merged)
    with failing(ConfigError), writing(target, ". Choose another file with --apply."):
        validate_session(tomllib.loads(text), target, text)
        target.write_text(text, encoding="utf-8")
    click.echo(f"Thresholds {target}: {', '.join(f'{name} = {value}' for name, value in chosen.items())}", err=as_json)
    if others := [name for name in swept if not name.startswith(f"{THRESHOLDS}.")]:
        click.echo(f"Not written, for they are no thresholds: {', '.join(others)}", err=as_json)


def _show_best(found: Sequence[Combination], measures: Sequence[Measure]) -> None:
    """The best, and the session as it is, on the terminal."""
    from rich.table import Table

    judged = [measure for measure in measures if measure.best] or list(measures[:3])
    table = Table(title=f"Best of {len(found)} combinations", title_justify="left")
    table.add_column("settings", no_wrap=True)
    for measure in judged:
        table.add_column(measure.axis, justify="right")
    listed = [one for at, one in enumerate(found) if not one.failed and (at < LISTED or not one.settings)]
    for one in listed:
        table.add_row(one.text.replace(", ", "\n"), *(measure.text(one.figures[measure.name]) for measure in judged))
    if listed:
        screen().print(table)
