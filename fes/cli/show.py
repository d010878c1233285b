"""Show a session log: table and summary, or JSON, and the report."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from fes.cli.exits import StoppedEarly

if TYPE_CHECKING:
    from fes.view.quality import Remark

PIPED_COLUMNS: Final = 110  # where no terminal says how wide it is


def show(
    log_path: Path, *, as_json: bool, report: Path | None, more: dict[str, Any] | None = None
) -> tuple[Remark, ...]:
    """Print what a session log holds and write its report; ``more`` joins the JSON. Returns the log's remarks.

    Raises:
        SessionLogError: the log cannot be read.
        StoppedEarly: the report cannot be written.
    """
    from rich.console import Console

    from fes.journal import read_session
    from fes.view.summary import summarise
    from fes.view.tables import stride_table, summary_block

    record = read_session(log_path)
    summary = summarise(record)
    if report is not None:
        from fes.view.report import write_report

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
        return summary.remarks
    console = Console(width=None if sys.stdout.isatty() else PIPED_COLUMNS)
    console.print(stride_table(summary))
    console.print(summary_block(summary))
    console.print(f"Session log  {log_path}")
    if report is not None:
        console.print(f"Report       {report}  (open it in a browser)")
    return summary.remarks
