"""Show a session log: table and summary, or JSON, and the report; whether the gate latched."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from fes.cli.common.exits import StoppedEarly

if TYPE_CHECKING:
    from fes.report.quality import Notice

GATE: Final = "gate"
LATCHED: Final = "off until armed again: "  # as fes.control.runner notes it
ARMED_AGAIN: Final = "armed again"


def latched(notices: Iterable[Notice]) -> str:
    """How often and when the gate latched, and whether it stayed so; "" when it never did. Times are the session's."""
    of_gate = [each for each in notices if each.source == GATE]
    latches = [each for each in of_gate if each.severity == "fault" and each.text.startswith(LATCHED)]
    if not latches:
        return ""
    first, last = latches[0], latches[-1]
    rearmed = next((each.time_s for each in of_gate if each.text == ARMED_AGAIN and each.time_s >= last.time_s), None)
    times = "once" if len(latches) == 1 else f"{len(latches)} times, first"
    what = f"The gate latched {times} at {first.time_s:.3f} s: {first.text.removeprefix(LATCHED)}."
    if rearmed is None:
        return f"{what} Nothing was stimulated from {last.time_s:.3f} s to the end."
    return f"{what} It was last armed again at {rearmed:.3f} s."


def show_latched(notices: Iterable[Notice]) -> None:
    """On stderr: the exit code says nothing of it, for a gate that stops did its work."""
    if text := latched(notices):
        click.secho(text, fg="red", bold=True, err=True)


DOUBTFUL_SHARE, FEWEST_STRIDES = 0.7, 5


def poorly_measured(strides: Mapping[str, tuple[int, int]]) -> list[str]:
    """What the sidecar says of these sensors may be wrong; by sensor how many strides there are, and how many valid."""
    return [
        f"! {sensor}: only {valid} of {count} strides could be measured. Does this sensor sit on "
        f"the {sensor.replace('_', ' ')}, not on another part of the leg, and are units and rate in the "
        f"sidecar right?"
        for sensor, (count, valid) in strides.items()
        if count >= FEWEST_STRIDES and valid < DOUBTFUL_SHARE * count
    ]


PIPED_COLUMNS: Final = 110  # where no terminal says how wide it is


def show(
    log_path: Path, *, as_json: bool, report: Path | None, more: dict[str, Any] | None = None
) -> tuple[Notice, ...]:
    """Print what a session log holds and write its report; ``more`` joins the JSON. Returns the log's notices.

    Raises:
        SessionLogError: the log cannot be read.
        StoppedEarly: the report cannot be written.
    """
    from rich.console import Console

    from fes.report.summary import summarise
    from fes.report.tables import stride_table, summary_block
    from fes.session_log import read_session

    record = read_session(log_path)
    summary = summarise(record)
    if report is not None:
        from fes.report.page import write_report

        try:
            write_report(record, report)
        except OSError as error:
            raise StoppedEarly(
                f"{report}: cannot be written: {error.strerror or error}. The session log is whole: make room, then "
                f"`fes report {log_path}`."
            ) from error
    if as_json:
        files = {"session_log": str(log_path), "report": str(report) if report else None}
        click.echo(json.dumps({**summary.to_json(), **(more or {}), "files": files}, indent=2, ensure_ascii=False))
        return summary.notices
    console = Console(width=None if sys.stdout.isatty() else PIPED_COLUMNS)
    console.print(stride_table(summary))
    console.print(summary_block(summary))
    console.print(f"Session log  {log_path}")
    if report is not None:
        console.print(f"Report       {report}  (open it in a browser)")
    return summary.notices
