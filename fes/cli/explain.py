"""``fes explain``: why a session did what it did at one instant."""

from __future__ import annotations

from pathlib import Path

import click

from fes.cli.common.exits import Problem, failing, writing
from fes.cli.common.options import PATH, Number


@click.command(name="explain")
@click.argument("log", type=PATH)
@click.option(
    "--at", "at_s", type=Number(), required=True, help="The instant: seconds of the session, as in its report."
)
@click.option("--page", type=PATH, help="The HTML page. Default: explain-SECONDS.html beside the log.")
@click.option("--no-page", is_flag=True, help="Write no page.")
@click.option("--json", "as_json", is_flag=True, help="Print it as JSON.")
def command(log: Path, at_s: float, page: Path | None, no_page: bool, as_json: bool) -> None:
    """Explain what the session log LOG shows at one instant: why it stimulated or not, what every guard of the phases
    saw against its threshold, why the foot was or was not known to walk, what the gate refused and what to do about it,
    and what the tuning had changed.

    The log is run again, by this program, up to that instant; a log that it would decide otherwise is told.
    """
    from fes.cli.common.show import print_json, screen
    from fes.cli.replay.log import Reopened
    from fes.config import ConfigError
    from fes.evaluation.explanation import explain
    from fes.report.explanation import explanation_json, explanation_table, render_explanation
    from fes.report.html import write_page_file
    from fes.report.summary import session_span
    from fes.session_log import SessionLogError
    from fes.signals import NS_PER_S

    with failing(SessionLogError, ConfigError):
        again = Reopened(log)
        origin_ns, end_ns = session_span(again.record)
        at_ns = origin_ns + round(at_s * NS_PER_S)
        if not origin_ns <= at_ns <= end_ns:
            raise Problem(
                f"{log}: --at {at_s:g} is outside the session, which lasts {(end_ns - origin_ns) / NS_PER_S:.3f} s"
            )
        found = explain(again.runner, again.events, again.now, again.session, again.record.notes, origin_ns, at_ns)
    changes = again.now.phases
    recorded = again.record.phases[: len(changes)]
    differs = (
        ""
        if recorded == changes
        else "This program decides otherwise than the one that recorded the log: what is told is this program's."
    )
    if as_json:
        print_json(explanation_json(found) | {"differs": differs})
    else:
        for text in ([f"! {differs}"] if differs else []) + found.sentences():
            click.echo(text)
        console = screen(120)
        console.print()
        console.print(explanation_table(found))
    if no_page:
        return
    target = page or log.with_name(f"explain-{at_s:.3f}.html")
    with writing(target, ". Choose another place with --page."):
        write_page_file(render_explanation(found, log.name, differs), target, "Choose another place with --page.")
    click.echo(f"Page  {target}  (open it in a browser)", err=as_json)
