"""What commands share: options, exit codes, errors that end one with a message, folders, tables, how a log is shown."""

from __future__ import annotations

import csv
import json
import math
import os
import signal
import sys
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from copy import copy
from datetime import UTC, datetime
from functools import partial, reduce
from importlib.util import find_spec
from pathlib import Path
from types import FrameType
from typing import IO, TYPE_CHECKING, Any, Final, NoReturn, Self, TypeVar

import click

if TYPE_CHECKING:
    from pyarrow.parquet import ParquetWriter
    from rich.console import Console

    from fes.analysis.tables import Table as Columns
    from fes.report.quality import Notice

    Rows = list[dict[str, Any]] | Columns

PATH: Final = click.Path(path_type=Path)
SIDE: Final = click.Choice(["left", "right"])
SENSOR_KINDS: Final = ("xbus", "ximu3", "capture2go", "witmotion")  # those that are simulated on lines of bytes
STIMULATORS: Final = ("can", "p24_low_level", "rehastim2")  # those that are simulated

Command = TypeVar("Command", bound=Callable[..., Any])


def choice(*names: str, of: Sequence[str], help: str | None = None) -> Callable[[Command], Command]:
    """An option that takes one of a few values, by default the first of them."""
    return click.option(*names, type=click.Choice(of), default=of[0], show_default=True, help=help)


def options(*given: Callable[[Command], Command]) -> Callable[[Command], Command]:
    """Several options as one, in this order."""
    return lambda command: reduce(lambda made, option: option(made), reversed(given), command)


def out_option(help: str = "Results go below.") -> Callable[[Command], Command]:
    """``--out``: a folder, by default ``out``."""
    return click.option("--out", type=PATH, default=Path("out"), show_default=True, help=help)


def given_options() -> set[str]:
    """The parameters of the command that stood on its command line."""
    context = click.get_current_context()
    on_the_line = click.core.ParameterSource.COMMANDLINE
    return {name for name in context.params if context.get_parameter_source(name) is on_the_line}


def utc_now() -> str:
    """For a log's header."""
    return datetime.now(UTC).isoformat(timespec="seconds")


def not_there(path: str | Path) -> str:
    """Why a port or folder cannot be found; "" when it is there."""
    try:
        Path(path).stat()
    except (FileNotFoundError, NotADirectoryError):
        return "there is no such port"
    except (OSError, ValueError) as error:
        return f"cannot be looked for: {getattr(error, 'strerror', None) or error}"
    return ""


def cannot_be_seen(path: str | Path) -> str:
    """Why nobody can tell whether it is there; "" when that can be told, whichever it is."""
    why = not_there(path)
    return why if why.startswith("cannot") else ""


class Number(click.FloatRange):
    """:class:`click.FloatRange` that takes no not-a-number and nothing infinite."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """The number. Raises BadParameter: it is none, or out of range."""
        number = super().convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"{value} is not a finite number.", param, ctx)
        return number


OK: Final = 0
FAILED: Final = 1  # it ran, and what it checked is not right
UNUSABLE: Final = 2  # wrong arguments or input; nothing was done
STOPPED: Final = 3  # it ended early: a device was lost, the disk is full
BROKEN: Final = 4  # a fault of this program
INTERRUPTED: Final = 130  # Ctrl-C

# extra (pyproject.toml) → what of it is imported
EXTRAS: Final[dict[str, tuple[str, ...]]] = {
    "fast": ("numba",),
    "analysis": ("numba", "pyarrow", "scipy"),
    "live": ("starlette", "uvicorn", "websockets"),
    "cohort": ("numba", "pyarrow", "scipy", "distributed", "fsspec"),
}


class Problem(click.ClickException):
    """Ends the command: the message says what is wrong, where, and what to do."""

    exit_code = UNUSABLE

    def show(self, file: IO[Any] | None = None) -> None:
        """On stderr, in red where there are colours."""
        click.secho(f"Error: {self.message}", fg="red", err=True)


class StoppedEarly(Problem):
    """Ends the command after it had begun."""

    exit_code = STOPPED


class Broken(Problem):
    """Ends the command on an error that nobody foresaw, in one line; ``FES_TRACEBACK=1`` shows all of it."""

    exit_code = BROKEN

    def __init__(self, error: Exception) -> None:
        trace = traceback.extract_tb(error.__traceback__)
        place = f" at {Path(trace[-1].filename).name}:{trace[-1].lineno}" if trace else ""
        super().__init__(
            f"{type(error).__name__}{place}: {error}\nThis is a fault of fes, not of your input: please report it with "
            f"the command and its input. FES_TRACEBACK=1 in the environment shows the whole trace."
        )


def fail(error: Exception, kind: type[Problem] = Problem) -> NoReturn:
    """End the command with an exception's own text; a sidecar that is missing is proposed beside its recording."""
    raise kind(error_text(error)) from error


@contextmanager
def failing(*faults: type[Exception], kind: type[Problem] = Problem) -> Iterator[None]:
    """End the command with the text of an exception of these kinds."""
    try:
        yield
    except faults as error:
        fail(error, kind)


@contextmanager
def writing(place: Path, remedy: str = "", kind: type[Problem] = Problem) -> Iterator[None]:
    """End the command where ``place`` cannot be written; the ``remedy`` follows what the system says."""
    try:
        yield
    except OSError as error:
        raise kind(f"{place}: cannot be written: {error.strerror or error}{remedy}") from error


def need_extra(extra: str, option: str = "") -> None:
    """End the command, before it does anything, where one of :data:`EXTRAS` is not installed; it is not loaded.

    ``option``: what of the command needs it, "" for all of it.
    """
    if any(find_spec(library) is None for library in EXTRAS[extra]):
        what = f"fes {click.get_current_context().info_name} {option}".strip()
        raise Problem(without_extra(what, extra))


def without_extra(what: str, extra: str) -> str:
    """What to say of it."""
    return f"{what} needs the extra {extra}, which is not installed: pip install 'fes-gait[{extra}]'"


def needing(command: click.Command, extra: str) -> click.Command:
    """The command, all of which needs an extra; its help does not."""
    whole, run = copy(command), command.callback
    assert run is not None

    def callback(*given: Any, **named: Any) -> Any:
        need_extra(extra)
        return run(*given, **named)

    whole.callback = callback
    return whole


def interrupted(said: str) -> NoReturn:
    """End the command after Ctrl-C, with what becomes of what was done."""
    click.secho(f"Interrupted{said}", fg="yellow", err=True)
    raise SystemExit(INTERRUPTED) from None


def error_text(error: Exception) -> str:
    """What to show of an error; of a missing sidecar, after writing the proposal where it is due.

    A file that is there and not empty is never touched. Where nothing can be written the proposal is shown instead.
    """
    from fes.recording.tracks import SidecarMissingError

    if not isinstance(error, SidecarMissingError):
        return str(error)
    try:
        with error.sidecar.open("a", encoding="utf-8") as file:
            if file.tell():
                return str(error)
            file.write(error.proposal)
    except OSError:
        return str(error)
    lines = error.proposal.splitlines()
    opened = [number for number, line in enumerate(lines, start=1) if "?" in line and not line.startswith("#")]
    count, line, them = (
        ("One answer is", "line", "it") if len(opened) == 1 else (f"{len(opened)} answers are", "lines", "them")
    )
    todo = f"No answer is missing. If {error.sidecar} is right, give the same command again."
    if opened:
        todo = (
            f"{count} missing: the “?” in {line} {', '.join(map(str, opened))} of {error.sidecar}. "
            f"Fill {them} in with a text editor, check the rest, then give the same command again."
        )
    return f"{error.sidecar} was missing, so a proposal is written there. It says:\n\n{error.proposal}\n{todo}"


LOG_SUFFIX = ".feslog"


def fresh_folder(out: Path, name: str) -> Path:
    """A new folder ``out/name-NNN``; what is there already is never touched. Raises Problem: it cannot be made."""
    try:
        if out.exists() and not out.is_dir():
            raise Problem(f"{out}: is a file; results need a folder. Choose another with --out.")
        out.mkdir(parents=True, exist_ok=True)
        for number in range(1, 100_000):
            with suppress(FileExistsError):
                folder = out / f"{name}-{number:03d}"
                folder.mkdir()
                return folder
    except OSError as error:
        what = f"no folder for the results can be made: {error.strerror}"
        raise Problem(f"{out}: {what}. Choose another with --out.") from error
    raise Problem(f"{out}: too many results of {name!r}; move some away or choose another --out.")


SIGNALS = (signal.SIGINT, signal.SIGTERM, *((signal.SIGHUP,) if hasattr(signal, "SIGHUP") else ()))


class Interrupt:
    """While entered, SIGINT, SIGTERM and SIGHUP are only remembered for :meth:`check`; a second one acts at once."""

    def __init__(self) -> None:
        self._asked = False
        self._before: dict[signal.Signals, Any] = {}

    def check(self) -> None:
        """Raise KeyboardInterrupt if there was a signal."""
        if self._asked:
            raise KeyboardInterrupt

    def _remember(self, number: int, frame: FrameType | None) -> None:
        if self._asked:
            raise KeyboardInterrupt
        self._asked = True

    def __enter__(self) -> Self:
        self._before = {number: signal.signal(number, self._remember) for number in SIGNALS}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)


@contextmanager
def progress_bar(what: str, total: float, unit: str = "", quiet: bool = False) -> Iterator[Callable[..., None]]:
    """How far it has come, on stderr; what it gives is called as :meth:`rich.progress.Progress.update` of one task."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    done = TextColumn("{task.completed:.0f} of {task.total:.0f}" + unit)
    columns = (TextColumn("{task.description}"), BarColumn(), done, TimeRemainingColumn())
    console, hidden = Console(stderr=True), quiet or not sys.stderr.isatty()
    # drawn twice a second: it takes its time from the work
    with Progress(*columns, console=console, disable=hidden, transient=True, refresh_per_second=2) as bar:
        yield partial(bar.update, bar.add_task(what, total=total))


STEP_NS = 250_000_000


@contextmanager
def replay_progress(what: str, begin_ns: int, end_ns: int, quiet: bool) -> Iterator[Callable[[int], None]]:
    """A bar over the recording's time; what it gives is called with the time (ns) that has been reached."""
    shown_ns = begin_ns
    with progress_bar(what, max(1e-9 * (end_ns - begin_ns), 1e-3), " s", quiet) as update:

        def reached(t_ns: int) -> None:
            nonlocal shown_ns
            if t_ns - shown_ns >= STEP_NS:
                shown_ns = t_ns
                update(completed=1e-9 * (t_ns - begin_ns))

        yield reached


def processors() -> int:
    """At least 1."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


# --- Tables for programs, and a session log shown: table and summary, or JSON, and the report ----------------


PIPED_COLUMNS: Final = 110  # where no terminal says how wide it is


def screen(piped_columns: int = PIPED_COLUMNS) -> Console:
    """Stdout, as wide as its terminal."""
    from rich.console import Console

    return Console(width=None if sys.stdout.isatty() else piped_columns, emoji=False)


def print_json(data: Mapping[str, Any], *, allow_nan: bool = True) -> None:
    """On stdout, for programs."""
    click.echo(json.dumps(data, indent=2, ensure_ascii=False, allow_nan=allow_nan))


def write_table(rows: Rows, path: Path) -> None:
    """Write flat rows, the format by the suffix; a number that is none becomes empty or null."""
    with TableFile(path) as file:
        file.add(rows)


class TableFile:
    """A table that grows: rows of the same names, in the format that the suffix says."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._text: IO[str] | None = None
        self._parquet: ParquetWriter | None = None
        self._empty = True

    def __enter__(self) -> Self:
        if self._path.suffix != ".parquet":
            self._text = self._path.open("w", encoding="utf-8", newline="")
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if self._text is not None:
            if self._path.suffix == ".json":
                self._text.write("[]" if self._empty else "\n]")
            elif self._empty:
                self._text.write("\n")
            self._text.close()
        elif self._parquet is not None:
            self._parquet.close()
        elif kind is None:
            import pyarrow as pa
            from pyarrow import parquet

            parquet.write_table(pa.table({}), self._path)

    def add(self, rows: Rows) -> None:
        """Write these below what is there."""
        if not rows:
            return
        from fes.walk_record import finite_or_none

        plain = [{key: finite_or_none(value) for key, value in row.items()} for row in rows]
        if self._text is None:
            self._add_parquet(plain)
        elif self._path.suffix == ".json":
            text = json.dumps(plain, indent=1, ensure_ascii=False)
            self._text.write(("" if self._empty else ",") + text[1 if not self._empty else 0 : -2])
        else:
            writer = csv.DictWriter(self._text, fieldnames=list(rows[0]), lineterminator="\n")
            if self._empty:
                writer.writeheader()
            cells = [{k: str(v).lower() if isinstance(v, bool) else v for k, v in row.items()} for row in plain]
            writer.writerows(cells)  # as `fes convert` writes them
        self._empty = False

    def _add_parquet(self, rows: list[dict[str, Any]]) -> None:
        import pyarrow as pa
        from pyarrow import parquet

        if self._parquet is None:
            schema = pa.Table.from_pylist(rows).schema
            known = [pa.field(f.name, pa.float64() if pa.types.is_null(f.type) else f.type) for f in schema]
            self._parquet = parquet.ParquetWriter(self._path, pa.schema(known))
        self._parquet.write_table(pa.Table.from_pylist(rows, schema=self._parquet.schema))


def latched(notices: Iterable[Notice]) -> str:
    """How often and when the gate latched, and whether it stayed so; "" when it never did. Times are the session's."""
    from fes.report.quality import LATCHED

    of_gate = [each for each in notices if each.source == "gate"]
    latches = [each for each in of_gate if each.text.startswith(LATCHED)]
    if not latches:
        return ""
    first, last = latches[0], latches[-1]
    rearmed = next((each.time_s for each in of_gate if each.text == "armed again" and each.time_s >= last.time_s), None)
    times = "once" if len(latches) == 1 else f"{len(latches)} times, first"
    what = f"The gate latched {times} at {first.time_s:.3f} s: {first.text.removeprefix(LATCHED)}."
    if rearmed is None:
        return f"{what} Nothing was stimulated from {last.time_s:.3f} s to the end."
    return f"{what} It was last armed again at {rearmed:.3f} s."


def show_latched(notices: Iterable[Notice]) -> None:
    """On stderr: the exit code says nothing of it, for a gate that stops did its work."""
    if text := latched(notices):
        click.secho(text, fg="red", bold=True, err=True)


def show(
    log_path: Path, *, as_json: bool, report: Path | None, more: dict[str, Any] | None = None
) -> tuple[Notice, ...]:
    """Print what a session log holds and write its report; ``more`` joins the JSON. Returns the log's notices.

    Raises:
        SessionLogError: the log cannot be read.
        StoppedEarly: the report cannot be written.
    """
    from fes.report.findings import session_json
    from fes.report.summary import summarise
    from fes.report.tables import stride_table, summary_block
    from fes.session_log import read_session

    record = read_session(log_path)
    summary = summarise(record)
    if report is not None:
        from fes.report.page import write_report

        remedy = f". The session log is whole: make room, then `fes report {log_path}`."
        with writing(report, remedy, StoppedEarly):
            write_report(record, report)
    if as_json:
        files = {"session_log": str(log_path), "report": str(report) if report else None}
        print_json({**session_json(summary), **(more or {}), "files": files})
        return summary.notices
    console = screen()
    console.print(stride_table(summary))
    console.print(summary_block(summary))
    console.print(f"Session log  {log_path}")
    if report is not None:
        console.print(f"Report       {report}  (open it in a browser)")
    return summary.notices
