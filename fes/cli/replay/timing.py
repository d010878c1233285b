"""``fes replay --check-timing``: triggers against a truth or an earlier log, decision latency against a budget."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final

import click

from fes.cli.common.exits import FAILED, Problem
from fes.cli.common.options import PATH, Number
from fes.cli.common.show import narrow_table, screen
from fes.evaluation.trigger_timing import Bounds, TimingCheck, TimingOptions

if TYPE_CHECKING:
    from rich.console import RenderableType

_COUNT, _MS = click.IntRange(min=0), Number(min=0, min_open=True)
_OPTIONS: Final[dict[str, dict[str, Any]]] = {
    "check_timing": {"is_flag": True, "help": "Compare transitions with the truth beside RECORDING."},
    "against": {"type": PATH, "help": "Timing: with this session log, or its truth."},
    "tolerance_ms": {"type": _MS, "help": "Timing: early or late beyond this. Default: see the table."},
    "latency_budget_ms": {"type": _MS, "help": "Timing: 99 % of the decisions must take no longer."},
    "max_missed": {"type": _COUNT, "help": "Timing: so many transitions may be missed. Default: 0."},
    "max_extra": {"type": _COUNT, "help": "Timing: so many may be there too much. Default: 0."},
    "max_early": {"type": _COUNT, "help": "Timing: so many may be too early. Default: 0."},
    "max_late": {"type": _COUNT, "help": "Timing: so many may be too late. Default: 0."},
}
PARAMETERS: Final = tuple(_OPTIONS)


def timing_options(function: Callable[..., None]) -> Callable[..., None]:
    """Give a command the options of the timing check; it gets them as ``timing``, None where it is not asked for."""

    @functools.wraps(function)
    def packed(*args: Any, **kwargs: Any) -> None:
        chosen, timing = {name: kwargs.pop(name) for name in PARAMETERS}, None
        if chosen.pop("check_timing"):
            counts = {name: chosen[f"max_{name}"] or 0 for name in ("missed", "extra", "early", "late")}
            bounds = Bounds(**counts, latency_budget_ms=chosen["latency_budget_ms"])
            timing = TimingOptions(chosen["against"], chosen["tolerance_ms"], bounds)
        elif idle := [name.replace("_", "-") for name, value in chosen.items() if value is not None]:
            raise Problem(f"--{idle[0]} has a meaning only with --check-timing. Add it.")
        function(*args, **kwargs, timing=timing)

    for name, settings in reversed(_OPTIONS.items()):
        packed = click.option(f"--{name.replace('_', '-')}", **settings)(packed)
    return packed


def show_timing(check: TimingCheck, *, as_json: bool) -> None:
    """Print the outcome and end with exit code 1 if a bound is broken."""
    if not as_json:
        screen().print(timing_table(check))
    for sentence in check.broken:
        click.secho(f"Timing: {sentence}.", fg="red", err=True)
    if check.broken:
        raise SystemExit(FAILED)
    click.secho("Timing: within its bounds.", err=True)


def timing_table(check: TimingCheck) -> RenderableType:
    """A row for each kind of transition of each foot, at most 80 columns wide, and the latency."""
    from rich.console import Group
    from rich.text import Text

    from fes.report.text import number

    caption = "errors: found − expected; early, late: beyond the tolerance ±tol."
    counted = ("exp-\nected", "\nfound", "\nmissed", "\nextra", "\nearly", "\nlate")
    measured = ("median\nms", "p5\nms", "p95\nms", "tol.\nms")
    table = narrow_table(f"Timing against {check.against}", caption, ["\nwho", "\nwhat"], [*counted, *measured])
    for row in check.rows:
        counts = (row.expected, row.found, row.missed, row.extra, row.early, row.late)
        table.add_row(
            row.who.replace("_", " "),
            row.what,
            *(str(count) if count or at < 2 else "·" for at, count in enumerate(counts)),
            *(number(value, 0) for value in (row.median_ms, row.p5_ms, row.p95_ms, row.tolerance_ms)),
            style="yellow" if any(counts[2:]) else "",
        )
    late = check.latency
    if not late.steps:
        return Group(table, Text("Decision latency: none recorded."))
    budget = "" if late.budget_ms is None else f"; {late.over} of {late.steps} over the budget of {late.budget_ms:g} ms"
    most = f"p99 {late.p99_ms:.2f}, p99.9 {late.p999_ms:.2f}, at most {late.max_ms:.2f}{budget}"
    return Group(table, Text(f"Decision latency: median {late.p50_ms:.2f} ms, {most}."))
