"""``fes replay --check-timing``: triggers against a truth or an earlier log, decision latency against a budget."""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from fes.cli.common.exits import FAILED, LOG_SUFFIX, Problem, fail
from fes.cli.common.options import Number
from fes.evaluation.trigger_timing import (
    LOG_TOLERANCE_MS,
    TRUTH_TOLERANCE_MS,
    Bounds,
    Mark,
    TimingCheck,
    check_latency,
    judge_timing,
    marks_of_commands,
    marks_of_phases,
    marks_of_truth,
    timing_rows,
)
from fes.session_log import SessionLogError, SessionRecord, read_session
from fes.signals import StimCommand
from fes.simulation.truth import load_truth
from statemachine.phases import PhaseChange

if TYPE_CHECKING:
    from rich.console import RenderableType

_COUNT = click.IntRange(min=0)
_MS = Number(min=0, min_open=True)
PIPED_COLUMNS: Final = 110
_OPTIONS: Final = (
    click.option("--check-timing", is_flag=True, help="Compare transitions with the truth beside RECORDING."),
    click.option("--against", type=click.Path(path_type=Path), help="Timing: with this session log, or its truth."),
    click.option("--tolerance-ms", type=_MS, help="Timing: early or late beyond this. Default: see the table."),
    click.option("--latency-budget-ms", type=_MS, help="Timing: 99 % of the decisions must take no longer."),
    click.option("--max-missed", type=_COUNT, help="Timing: so many transitions may be missed. Default: 0."),
    click.option("--max-extra", type=_COUNT, help="Timing: so many may be there too much. Default: 0."),
    click.option("--max-early", type=_COUNT, help="Timing: so many may be too early. Default: 0."),
    click.option("--max-late", type=_COUNT, help="Timing: so many may be too late. Default: 0."),
)
PARAMETERS: Final = (
    "check_timing",
    "against",
    "tolerance_ms",
    "latency_budget_ms",
    "max_missed",
    "max_extra",
    "max_early",
    "max_late",
)


@dataclass(frozen=True, slots=True)
class TimingOptions:
    """What to hold the timing against; ``against`` None: the recording's own truth, of a log what it recorded."""

    against: Path | None = None
    tolerance_ms: float | None = None
    bounds: Bounds = field(default_factory=Bounds)


@dataclass(frozen=True, slots=True)
class Expected:
    """What should have happened: ``source`` in words, the marks, and whether they are a physical truth."""

    source: str
    marks: list[Mark]
    physical: bool


def timing_options(function: Callable[..., None]) -> Callable[..., None]:
    """Give a command the options of the timing check; it gets them as ``timing``, None where it is not asked for."""

    @functools.wraps(function)
    def packed(*args: Any, **kwargs: Any) -> None:
        chosen = {name: kwargs.pop(name) for name in PARAMETERS}
        function(*args, **kwargs, timing=_packed(chosen))

    for option in reversed(_OPTIONS):
        packed = option(packed)
    return packed


def _packed(chosen: dict[str, Any]) -> TimingOptions | None:
    if not chosen["check_timing"]:
        for name, value in chosen.items():
            if value is not None and name != "check_timing":
                raise Problem(f"--{name.replace('_', '-')} has a meaning only with --check-timing. Add it.")
        return None
    counts = {name: chosen[f"max_{name}"] or 0 for name in ("missed", "extra", "early", "late")}
    bounds = Bounds(**counts, latency_budget_ms=chosen["latency_budget_ms"])
    return TimingOptions(chosen["against"], chosen["tolerance_ms"], bounds)


def expected_from(path: Path, feet: set[str]) -> Expected:
    """What a session log did, or what the truth beside a recording says of these feet.

    Raises:
        Problem: neither is there.
    """
    if path.suffix == LOG_SUFFIX:
        try:
            record = read_session(path)
        except SessionLogError as error:
            fail(error)
        return Expected(str(path), [*marks_of_phases(record.phases), *marks_of_commands(record.commands)], False)
    try:
        return Expected(f"the truth of {path.name}", marks_of_truth(load_truth(path), feet), True)
    except FileNotFoundError as error:
        raise Problem(
            f"{path} has no truth beside it to check the timing against ({Path(str(error).split(': ')[0]).name} is not "
            f"there). Name an earlier session log: --against LOG"
        ) from error
    except (ValueError, KeyError, OSError) as error:
        raise Problem(f"{path}: its truth cannot be read: {error}") from error


def expected_of(options: TimingOptions, default: Path | Expected, sensors: Iterable[str]) -> Expected:
    """What is expected of these sensors: what ``options`` name, else ``default``.

    Raises:
        Problem: there is nothing to compare with.
    """
    source = options.against or default
    return expected_from(source, {_foot(sensor) for sensor in sensors}) if isinstance(source, Path) else source


def check_timing(
    record: SessionRecord,
    options: TimingOptions,
    expected: Expected,
    phases: Sequence[PhaseChange] | None = None,
    commands: Iterable[StimCommand] | None = None,
) -> TimingCheck:
    """Compare a session with what is expected; its latencies count.

    ``phases`` and ``commands``: what fired and what went out, if not the record's.

    Raises:
        Problem: the two tell of different times.
    """
    fired = marks_of_phases(record.phases if phases is None else phases)
    found = [Mark(mark.t_ns, _foot(mark.who) if expected.physical else mark.who, mark.what) for mark in fired]
    if not expected.physical:
        found += marks_of_commands(record.commands if commands is None else commands)
    _refuse_other_times(expected, found)
    tolerances = {} if options.tolerance_ms or not expected.physical else dict(TRUTH_TOLERANCE_MS)
    rows = timing_rows(expected.marks, found, tolerances, options.tolerance_ms or LOG_TOLERANCE_MS)
    latency = check_latency(record.latency_ns, options.bounds.latency_budget_ms)
    return judge_timing(expected.source, rows, latency, options.bounds)


def check_replayed(
    path: Path, options: TimingOptions, phases: list[PhaseChange], commands: list[StimCommand]
) -> TimingCheck:
    """Compare what a log's replay gave with the log itself, or with what ``options`` name.

    Raises:
        SessionLogError: the log cannot be read.
        Problem: there is nothing to compare with.
    """
    record = read_session(path)
    recorded = [*marks_of_phases(record.phases), *marks_of_commands(record.commands)]
    own = Expected(f"what {path.name} recorded", recorded, False)
    expected = expected_of(options, own, record.header.get("calibration", {}))
    return check_timing(record, options, expected, phases, commands)


def _foot(sensor: str) -> str:
    """The foot that a sensor tells of."""
    return sensor.replace("_shank", "_foot")


def _refuse_other_times(expected: Expected, found: list[Mark]) -> None:
    if not (expected.marks and found):
        return
    should, did = ((1e-9 * min(marks).t_ns, 1e-9 * max(marks).t_ns) for marks in (expected.marks, found))
    if did[0] > should[1] or did[1] < should[0]:
        raise Problem(
            f"{expected.source} tells of another time than this session ({should[0]:.1f}–{should[1]:.1f} s and "
            f"{did[0]:.1f}–{did[1]:.1f} s). Compare logs of the same recording; of two sessions, use `fes compare`."
        )


def tell(check: TimingCheck, *, as_json: bool) -> None:
    """Print the outcome and end with exit code 1 if a bound is broken."""
    from rich.console import Console

    if not as_json:
        Console(width=None if sys.stdout.isatty() else PIPED_COLUMNS).print(timing_table(check))
    for sentence in check.broken:
        click.secho(f"Timing: {sentence}.", fg="red", err=True)
    if check.broken:
        raise SystemExit(FAILED)
    click.secho("Timing: within its bounds.", err=True)


def timing_table(check: TimingCheck) -> RenderableType:
    """A row for each kind of transition of each foot, at most 80 columns wide, and the latency."""
    from rich import box
    from rich.console import Group
    from rich.table import Table
    from rich.text import Text

    from fes.report.text import number

    table = Table(
        title=f"Timing against {check.against}",
        caption="errors: found − expected; early, late: beyond the tolerance ±tol.",
        caption_justify="left",
        title_justify="left",
        box=box.SIMPLE_HEAD,
        padding=0,
        pad_edge=False,
        show_edge=False,
    )
    table.add_column("\nwho", no_wrap=True)
    table.add_column("\nwhat", no_wrap=True)
    for title in ("exp-\nected", "\nfound", "\nmissed", "\nextra", "\nearly", "\nlate"):
        table.add_column(title, justify="right", no_wrap=True)
    for title in ("median\nms", "p5\nms", "p95\nms", "tol.\nms"):
        table.add_column(title, justify="right", no_wrap=True)
    for row in check.rows:
        counts = (row.expected, row.found, row.missed, row.extra, row.early, row.late)
        good = not any(counts[2:])
        table.add_row(
            row.who.replace("_", " "),
            row.what,
            *(str(count) if count or at < 2 else "·" for at, count in enumerate(counts)),
            *(number(value, 0) for value in (row.median_ms, row.p5_ms, row.p95_ms, row.tolerance_ms)),
            style="" if good else "yellow",
        )
    late = check.latency
    if not late.steps:
        return Group(table, Text("Decision latency: none recorded."))
    budget = "" if late.budget_ms is None else f"; {late.over} of {late.steps} over the budget of {late.budget_ms:g} ms"
    return Group(
        table,
        Text(
            f"Decision latency: median {late.p50_ms:.2f} ms, p99 {late.p99_ms:.2f}, p99.9 {late.p999_ms:.2f}, "
            f"at most {late.max_ms:.2f}{budget}."
        ),
    )
