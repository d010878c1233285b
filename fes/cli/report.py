"""``fes report``: write the report of a session log."""

from pathlib import Path

import click

from fes.cli.common.exits import fail, failing, writing
from fes.cli.common.options import PATH


@click.command(name="report")
@click.argument("log", type=PATH)
@click.option("--out", type=PATH, help="The HTML file. Default: report.html beside the log.")
def command(log: Path, out: Path | None) -> None:
    """Write the HTML report of the session log LOG."""
    from fes.report.page import write_report
    from fes.session_log import SessionLogError, read_session
    from fes.session_log.framing import RecordType

    target = out or log.with_name("report.html")
    with failing(SessionLogError):
        record = read_session(log, frozenset({RecordType.FRAME}))  # bytes are not shown
    try:
        with writing(target, ". Choose another place with --out."):
            write_report(record, target)
    except SessionLogError as error:
        fail(SessionLogError(f"{log}: {error}"))
    click.echo(f"Report {target}")
