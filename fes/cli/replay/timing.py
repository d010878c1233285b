"""``fes replay --check-timing``: triggers against a truth or an earlier log, decision latency against a budget."""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from fes.cli.common.exits import FAILED, Problem
from fes.cli.common.options import Number
from fes.evaluation.timing_check import TimingOptions
from fes.evaluation.trigger_timing import Bounds, TimingCheck

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


def show_timing(check: TimingCheck, *, as_json: bool) -> None:
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
