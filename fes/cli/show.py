"""Show a session log: table and summary, or JSON, and the report."""

from __future__ import annotations

import json
from pathlib import Path

import click


def show(log_path: Path, *, as_json: bool, report: Path | None) -> None:
    """Print what a session log holds and write its report."""
    from rich.console import Console

    from fes.journal import read_session
    from fes.view.summary import summarise
    from fes.view.tables import stride_table, summary_block

    record = read_session(log_path)
    summary = summarise(record)
    if report is not None:
        from fes.view.report import write_report

        write_report(record, report)
    if as_json:
        files = {"session_log": str(log_path), "report": str(report) if report else None}
        click.echo(json.dumps({**summary.to_json(), "files": files}, indent=2, ensure_ascii=False))
        return
    console = Console()
    console.print(stride_table(summary))
    console.print(summary_block(summary))
    console.print(f"Session log  {log_path}")
    if report is not None:
        console.print(f"Report       {report}  (open it in a browser)")
