"""``fes report``: write the report of a session log."""

from pathlib import Path

import click

from fes.cli.common.exits import fail, failing, writing
from fes.cli.common.options import PATH


@click.command(name="report")
@click.argument("log", type=PATH)
@click.option("--out", type=PATH, help="The HTML file. Default: report.html beside the log.")
@click.option("--summary", is_flag=True, help="Say in about ten lines what happened, as `fes run` does at its end.")
@click.option("--json", "as_json", is_flag=True, help="As JSON on stdout: where the report is.")
def command(log: Path, out: Path | None, summary: bool, as_json: bool) -> None:
    """Write the HTML report of the session log LOG."""
    from fes.cli.common.show import print_json, screen
    from fes.report.page import write_report
    from fes.report.summary import summarise_session
    from fes.report.tables import closing_block
    from fes.session_log import SessionLogError, read_session
    from fes.session_log.framing import RecordType

    target = out or log.with_name("report.html")
    with failing(SessionLogError):
        record = read_session(log, frozenset({RecordType.FRAME}))  # bytes are not shown
    try:
        data = summarise_session(record)
        if summary and not as_json:
            screen().print(closing_block(data.summary))
        with writing(target, ". Choose another place with --out."):
            write_report(record, target, data=data)
    except SessionLogError as error:
        fail(SessionLogError(f"{log}: {error}"))
    if as_json:
        print_json({"report": str(target)})
    else:
        click.echo(f"Report {target}")
