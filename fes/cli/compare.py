"""``fes compare``: two session logs' differences, stride by stride; or sessions before and after, as a page."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Final

import click

from fes.cli.common import FAILED, PATH, SIDE, Problem, failing
from fes.cli.show import narrow_table, print_json, screen
from fes.session_log import SessionLogError, read_session

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rich.console import RenderableType

    from fes.evaluation.log_comparison import Comparison

ROWS: Final = 30
BY_NUMBER: Final = (
    "No shift of the clocks brings the strides together: matched by number, times count from each stride's start."
)
SETTINGS_SHOWN: Final = 20
_TITLES: Final = ("length\ncm", "clear.\ncm", "T1\nms", "T2\nms", "T3\nms", "stance\nms", "on\nms", "off\nms")


@click.command(name="compare")
@click.argument("sessions", nargs=-1, required=True, metavar="A B…", type=PATH)
@click.option("--report", type=PATH, metavar="FILE", help="Write how the walks differ, as HTML.")
@click.option(
    "--label", "labels", multiple=True, metavar="WORDS", help="With --report: a session's name; once for each."
)
@click.option("--paretic-side", type=SIDE, help="With --report: symmetry from that side.")
@click.option("--all", "every", is_flag=True, help=f"Show all strides, not only the first {ROWS} that differ.")
@click.option("--json", "as_json", is_flag=True, help="Print the differences as JSON.")
def command(
    sessions: tuple[Path, ...],
    report: Path | None,
    labels: tuple[str, ...],
    paretic_side: str | None,
    every: bool,
    as_json: bool,
) -> None:
    """Compare two session logs A and B: settings, strides, stimulation, bytes. Differences are B − A.

    Strides are matched by time, by the best shift if the clocks differ, else by number. When a log was made and how
    long decisions took makes no difference. Exit code: 0 identical, 1 different, 2 unusable input.

    With --report FILE it asks instead how the walks differ, before and after, with and without stimulation: means of
    each session, changes against the first with 95 % intervals, foot paths, phases, symmetry, charge, and what else
    differs. Sessions are then two to six logs (.feslog), folders that hold one, or recordings (CSV, Parquet), each
    analysed off-line in the same way. Exit code: 0 written, 2 unusable input.
    """
    if report is not None:
        _report(sessions, report, labels, paretic_side, as_json)
        return
    if labels or paretic_side:
        raise Problem("--label and --paretic-side belong to --report FILE")
    if len(sessions) != 2:
        raise Problem(f"name two session logs, not {len(sessions)}; for more say --report FILE")
    from fes.evaluation.log_comparison import compare_logs

    a, b = sessions
    with failing(SessionLogError):
        result = compare_logs(read_session(a), read_session(b))
    if as_json:
        print_json({"a": str(a), "b": str(b), **result.to_json()})
    else:
        screen().print(_difference_text(a, b, result, every))
    if not result.identical:
        raise SystemExit(FAILED)


def _report(
    paths: Sequence[Path], report: Path, labels: Sequence[str], paretic_side: str | None, as_json: bool
) -> None:
    from fes.report.comparison.page import MOST, compare_sessions, render_comparison
    from fes.report.comparison.session import ComparisonProblem, read_compared
    from fes.report.html import ReportError, write_page_file

    if not 2 <= len(paths) <= MOST:
        raise Problem(f"name two to {MOST} sessions, not {len(paths)}")
    if labels and len(labels) != len(paths):
        raise Problem(f"{len(labels)} labels for {len(paths)} sessions: give --label once for each, in their order")
    if len(set(labels)) < len(labels) or not all(label.strip() for label in labels):
        raise Problem("every --label must be different, and not empty")
    if report.resolve() in {path.resolve() for path in paths}:
        raise Problem(f"{report}: is one of the sessions; choose another --report")
    names = labels or [f"{chr(65 + k)} {path.stem if path.is_file() else path.name}" for k, path in enumerate(paths)]
    with failing(ComparisonProblem, ReportError):
        compared = [read_compared(path, name) for path, name in zip(paths, names, strict=True)]
        comparison = compare_sessions(compared, paretic=paretic_side)
        write_page_file(render_comparison(comparison), report, "Choose another --report.")
    if as_json:
        print_json({**comparison.to_json(), "report": str(report)}, allow_nan=False)
        return
    for finding in (*comparison.confounders, *comparison.changes):
        serious = finding.level in ("alert", "warning")
        click.secho(f"{'!' if serious else '·'} {finding.text}", fg="yellow" if serious else None)
    click.echo(f"Report {report}")


def _difference_text(a: Path, b: Path, result: Comparison, every: bool) -> RenderableType:
    from rich.console import Group
    from rich.text import Text

    lines: list[RenderableType] = [Text(f"A  {a}\nB  {b}")]
    if result.settings:
        shown = result.settings[:SETTINGS_SHOWN]
        lines.append(Text(f"{len(result.settings)} settings differ:", style="yellow"))
        lines += [Text(f"  {name}: {_short(one)} → {_short(other)}") for name, one, other in shown]
        if len(result.settings) > len(shown):
            lines.append(Text(f"  … and {len(result.settings) - len(shown)} more: --json shows them all"))
    else:
        lines.append(Text("The settings are the same."))
    if result.matched_by == "number":
        lines.append(Text(BY_NUMBER, style="yellow"))
    elif result.shift_s:
        lines.append(Text(f"B's clock is {result.shift_s:+.3f} s against A's; that is taken off.", style="yellow"))
    different = [each for each in result.pairs if not each.same]
    if different or every:
        lines.append(_table(result, every))
    for where, strides in (("A", result.only_a), ("B", result.only_b)):
        if strides:
            names = ", ".join(f"{s.foot} {s.number}" for s in strides[:8]) + (" …" if len(strides) > 8 else "")
            lines.append(Text(f"Only in {where}: {len(strides)} strides ({names})", style="yellow"))
    lines.append(Text(f"{len(result.pairs)} strides in both, {len(result.pairs) - len(different)} of them the same."))
    for what, difference in (("phases", result.phases), ("commands", result.commands), ("bytes", result.frames)):
        text = f"first difference: {difference}" if difference else "the same"
        lines.append(Text(f"{what.capitalize():<9} {text}", style="yellow" if difference else ""))
    lines.append(Text("Identical." if result.identical else "Different.", style="green" if result.identical else "red"))
    return Group(*lines)


def _short(value: object) -> str:
    text = "–" if value is None else str(value)
    return text if len(text) <= 40 else f"{text[:39]}…"


def _table(result: Comparison, every: bool) -> RenderableType:
    """A row per stride that differs (or all), the spread below; at most 80 columns wide."""
    from fes.evaluation.log_comparison import QUANTITIES
    from fes.report.text import number

    different = [each for each in result.pairs if every or not each.same]
    rows = different if every else different[:ROWS]
    left = f"; the first {ROWS} of {len(different)}" if len(rows) < len(different) else ""
    table = narrow_table(
        f"{'All strides' if every else 'Strides that differ'}, B − A{left}",
        "T1 to stance: entries into the phases; on, off: stimulation, greatest of the foot's channels.",
        ["\nfoot"],
        ["\nA", "\nB", "start\ns", "A's len.\nm", *_TITLES],
    )
    for each in rows:
        values = [number(each.differences[name], 2 if name.endswith("_cm") else 0) for name in QUANTITIES]
        foot = {"left_foot": "L", "right_foot": "R"}.get(each.foot, each.foot)
        begun, length = number(each.start_s, 1), number(each.length_m[0], 2)
        table.add_row(foot, str(each.number_a), str(each.number_b), begun, length, *values)
    table.add_section()
    for label, part in (("mean", "mean"), ("SD", "sd"), ("greatest", "greatest")):
        values = [number(getattr(result.spread(n), part), 2 if n.endswith("_cm") else 1) for n in QUANTITIES]
        table.add_row(label, "", "", "", "", *values, style="bold")
    return table
