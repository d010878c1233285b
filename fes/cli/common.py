"""Exit codes, errors that end a command with a message instead of a traceback, a new folder for results."""

import math
import os
import signal
import sys
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from copy import copy
from datetime import UTC, datetime
from importlib.util import find_spec
from pathlib import Path
from types import FrameType
from typing import IO, Any, Final, NoReturn, Self, TypeVar

import click

PATH: Final = click.Path(path_type=Path)
SIDE: Final = click.Choice(["left", "right"])
SENSOR_KINDS: Final = ("xbus", "ximu3", "capture2go", "witmotion")  # those that are simulated on lines of bytes
STIMULATORS: Final = ("can", "p24_low_level", "rehastim2")  # those that are simulated

Command = TypeVar("Command", bound=Callable[..., Any])


def choice(*names: str, of: Sequence[str], help: str | None = None) -> Callable[[Command], Command]:
    """An option that takes one of a few values, by default the first of them."""
    return click.option(*names, type=click.Choice(of), default=of[0], show_default=True, help=help)


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


STEP_NS = 250_000_000


@contextmanager
def replay_progress(what: str, begin_ns: int, end_ns: int, quiet: bool) -> Iterator[Callable[[int], None]]:
    """A bar over the recording's time; what it gives is called with the time (ns) that has been reached."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    of_total = TextColumn("{task.completed:.0f} of {task.total:.0f} s")
    columns = (TextColumn("{task.description}"), BarColumn(), of_total, TimeRemainingColumn())
    hidden = quiet or not sys.stderr.isatty()
    shown_ns = begin_ns
    with Progress(*columns, console=Console(stderr=True), disable=hidden, transient=True) as bar:
        task = bar.add_task(what, total=max(1e-9 * (end_ns - begin_ns), 1e-3))

        def reached(t_ns: int) -> None:
            nonlocal shown_ns
            if t_ns - shown_ns >= STEP_NS:
                shown_ns = t_ns
                bar.update(task, completed=1e-9 * (t_ns - begin_ns))

        yield reached


def processors() -> int:
    """At least 1."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
