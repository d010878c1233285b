"""``fes report``: write the report of a session log."""

from __future__ import annotations

from pathlib import Path

import click

from fes.cli.common.exits import Problem, fail


@click.command(name="report")
@click.argument("log", type=click.Path(path_type=Path))
@click.option("--out", type=click.Path(path_type=Path), help="The HTML file. Default: report.html beside the log.")
def command(log: Path, out: Path | None) -> None:
    """Write the HTML report of the session log LOG."""
    from fes.report.page import write_report
    from fes.session_log import SessionLogError, read_session
    from fes.session_log.framing import RecordType

    target = out or log.with_name("report.html")
    try:
        record = read_session(log, frozenset({RecordType.FRAME}))  # bytes are not shown
    except SessionLogError as error:
        fail(error)
    try:
        write_report(record, target)
    except SessionLogError as error:
        fail(SessionLogError(f"{log}: {error}"))
    except OSError as error:
        raise Problem(f"{target}: cannot be written: {error.strerror}. Choose another place with --out.") from error
    click.echo(f"Report {target}")
