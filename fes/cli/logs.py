"""What is done with one session log: ``fes report``, ``explain``, ``convert``, ``anonymise``, ``recover``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import click

from fes.cli.common import FAILED, PATH, Number, Problem, fail, failing, print_json, screen, writing
from fes.config import ConfigError
from fes.session_log import SessionLogError, read_session
from fes.session_log.framing import RecordType
from fes.session_log.repair import Survey, recover, survey
from fes.signals import NS_PER_S

if TYPE_CHECKING:
    from fes.cli.replay.command import Repeated


@click.command(name="report")
@click.argument("log", type=PATH)
@click.option("--out", type=PATH, help="The HTML file. Default: report.html beside the log.")
@click.option("--summary", is_flag=True, help="Say in about ten lines what happened, as `fes run` does at its end.")
@click.option("--json", "as_json", is_flag=True, help="As JSON on stdout: where the report is.")
def report_command(log: Path, out: Path | None, summary: bool, as_json: bool) -> None:
    """Write the HTML report of the session log LOG."""
    from fes.report.page import write_report
    from fes.report.summary import summarise_session
    from fes.report.tables import closing_block

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


@click.command(name="explain")
@click.argument("log", type=PATH)
@click.option(
    "--at", "at_s", type=Number(), required=True, help="The instant: seconds of the session, as in its report."
)
@click.option("--page", type=PATH, help="The HTML page. Default: explain-SECONDS.html beside the log.")
@click.option("--no-page", is_flag=True, help="Write no page.")
@click.option("--json", "as_json", is_flag=True, help="Print it as JSON.")
def explain_command(log: Path, at_s: float, page: Path | None, no_page: bool, as_json: bool) -> None:
    """Explain what the session log LOG shows at one instant: why it stimulated or not, what every guard of the phases
    saw against its threshold, why the foot was or was not known to walk, what the gate refused and what to do about it,
    and what the tuning had changed.

    The log is run again, by this program, up to that instant; a log that it would decide otherwise is told.
    """
    from fes.cli.replay.command import Reopened
    from fes.evaluation.explanation import explain
    from fes.report.explanation import explanation_json, explanation_table, render_explanation
    from fes.report.html import write_page_file
    from fes.report.summary import session_span

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


FORMATS = ("csv", "parquet", "mcap", "c3d", "bids")
ONE_FILE = ("mcap", "c3d")


@click.command(name="convert")
@click.argument("log", type=PATH)
@click.option("--to", "form", type=click.Choice(FORMATS), help="Format. Default: what --out ends with, else csv.")
@click.option("--out", type=PATH, help="New folder, or MCAP or C3D file. Default: beside LOG.")
@click.option("--subject", default="", help="BIDS: the subject's label. Default: as in LOG, else 01.")
@click.option("--session", default="", help="BIDS: the session's label. Default: none.")
@click.option("--task", default="", help="BIDS: what was done. Default: walking.")
@click.option("--add", is_flag=True, help="BIDS: add to the data set that is there; nothing in it is overwritten.")
@click.option("--json", "as_json", is_flag=True, help="Print what was written as JSON.")
def convert_command(
    log: Path, form: str | None, out: Path | None, subject: str, session: str, task: str, add: bool, as_json: bool
) -> None:
    """Convert the session log LOG to CSV, Parquet, MCAP, C3D or BIDS.

    CSV and Parquet: a new folder with a file for each table (samples of each sensor, phases, strides, commands,
    answers, notes, latency …). MCAP: one file, which Foxglove and PlotJuggler open. C3D: one file for the programs of
    motion laboratories, with signals, commanded current, foot off and foot strike. BIDS: a data set of the Brain
    Imaging Data Structure, with signals as Motion-BIDS, and as events why each burst of stimulation came. Nothing is
    overwritten. Of a damaged log everything that is whole is converted.

    Exit code: 0 converted, 2 unusable input.
    """
    from fes.session_log.export import to_c3d, to_csv, to_mcap, to_parquet

    chosen = form or (out.suffix[1:] if out is not None and out.suffix[1:] in FORMATS else "csv")
    target = out or log.with_name(f"{log.stem}.{chosen}" if chosen in ONE_FILE else f"{log.stem}-{chosen}")
    if chosen != "bids" and (subject or session or task or add):
        raise click.UsageError(f"--subject, --session, --task and --add are for --to bids, not {chosen}")
    with failing(SessionLogError, ConfigError):
        if chosen == "bids":
            from fes.report.bids import TASK, to_bids  # here, for it takes the report's numbers, which load slowly

            exported = to_bids(log, target, subject=subject, session=session, task=task or TASK, add=add)
        else:
            exported = {"csv": to_csv, "parquet": to_parquet, "mcap": to_mcap, "c3d": to_c3d}[chosen](log, target)
    if exported.damages or not exported.ended:
        lost = sum(damage.size for damage in exported.damages)
        what = f"{len(exported.damages)} damaged places, {lost} bytes" if lost else "its end"
        click.secho(f"{log} lacks {what}; `fes recover {log}` says what that was.", fg="yellow", err=True)
    if as_json:
        click.echo(json.dumps({"format": chosen, "to": str(target), "rows": exported.rows}, indent=2))
        return
    width = max(map(len, exported.rows), default=0)
    for name, rows in sorted(exported.rows.items()):
        click.echo(f"  {name:<{width}}  {rows:>9} rows")
    click.echo(f"Converted  {target}")


@click.command(name="anonymise")
@click.argument("log", type=PATH)
@click.option("--out", type=PATH, help="The new log. Default: NAME.anonymous.feslog beside LOG.")
@click.option("--name", "names", multiple=True, help="Another name to take out of all texts; may be given often.")
@click.option("--keep-marks", is_flag=True, help="Keep what was marked, without these names. Default: mark 1, 2 …")
@click.option("--json", "as_json", is_flag=True, help="Print what was done as JSON.")
def anonymise_command(log: Path, out: Path | None, names: tuple[str, ...], keep_marks: bool, as_json: bool) -> None:
    """Write the session log LOG anew without what identifies a person, a place or a device.

    Names of session, subject, recording and channels, ports, serial numbers, paths and dates go, and the clock begins
    anew. Signals, settings, commands and bytes stay: the new log is replayed before this ends, and nothing is left of
    it where it does not give the same bytes. LOG itself is never changed. A walk's signals can tell who walks.

    Exit code: 0 written, 1 written with a name in it that is also a word of the program, 2 unusable input.
    """
    from fes.session_log.anonymise import anonymise

    target = out or log.with_name(f"{log.stem}.anonymous{log.suffix or '.feslog'}")
    with failing(SessionLogError, ConfigError):
        done = anonymise(log, target, names=names, keep_marks=keep_marks)
        again = _replayed(target)
        if again.difference:  # a text of the gate's, perhaps, that has lost a word which is no name there
            target.unlink()
            refused = [command.refused for command in again.now.commands]
            done = anonymise(log, target, names=names, keep_marks=keep_marks, refused=refused)
            again = _replayed(target)
        if again.difference:
            target.unlink()
            raise Problem(f"{log}: cannot be anonymised, for its replay would differ: {again.difference}")
    if as_json:
        told = {"records": done.records, "texts": done.texts, "marks": done.marks, "left": done.left}
        click.echo(json.dumps({**told, "to": str(target), "commands": again.commands}, indent=2))
    else:
        click.echo(f"{done.records} records, {done.texts} texts changed, {done.marks} marks.")
        click.echo(f"Replayed: {again.commands} commands are the same byte for byte.")
        click.echo(f"Anonymised  {target}")
    if done.left:
        click.secho(
            f"Still in its texts: {', '.join(done.left)}. Look at them with `fes convert`.", fg="yellow", err=True
        )
        raise SystemExit(FAILED)


def _replayed(target: Path) -> Repeated:
    """The new log's second run; where that cannot be, nothing is left of it."""
    from fes.cli.replay.command import repeat

    try:
        return repeat(target)
    except BaseException:
        target.unlink()
        raise


@click.command(name="recover")
@click.argument("log", type=PATH)
@click.option("--out", type=PATH, help="The new log. Default: NAME.recovered.feslog beside LOG.")
@click.option("--header-from", type=PATH, help="Log with the same settings, if LOG's are damaged.")
@click.option("--dry-run", is_flag=True, help="Only say what is lost.")
@click.option("--json", "as_json", is_flag=True, help="Print the findings as JSON.")
def recover_command(log: Path, out: Path | None, header_from: Path | None, dry_run: bool, as_json: bool) -> None:
    """Repair the session log LOG: cut off by a crash or a full disk, or damaged in the middle.

    Writes a new log with every record whose checksum holds, a note where something is missing, and a summary that says
    so. LOG itself is never changed. A log that is whole is left alone.

    Exit code: 0 nothing was lost, 1 something was, 2 nothing can be recovered.
    """
    target = out or log.with_name(f"{log.stem}.recovered{log.suffix or '.feslog'}")
    with failing(SessionLogError):
        found = survey(log)
        written = not (found.whole or dry_run)
        if written:
            other = header_from if found.header is None else None
            header = survey(other).header if other else None
            if other and header is None:
                raise Problem(f"{other}: its own header is damaged too. Name a whole log.")
            recover(found, target, header)
    if as_json:
        print_json({**found.to_dict(), "log": str(log), "recovered": str(target) if written else None})
    else:
        _show_survey(found, target if written else None)
    if found.lost_bytes:
        raise SystemExit(FAILED)


def _show_survey(found: Survey, target: Path | None) -> None:
    if found.whole:
        click.echo(f"{found.path}: is whole ({found.size} bytes); nothing to recover.")
        return
    for sentence in found.sentences():
        click.secho(f"{found.path.name}: {sentence}.", fg="yellow")
    kept = ", ".join(f"{count} {kind.name.lower()}" for kind, count in sorted(found.kept.items()))
    click.echo(f"Kept {found.size - found.lost_bytes} of {found.size} bytes: {kept or 'nothing'}.")
    if found.lost_bytes:
        kinds = ", ".join(
            f"{count} place{'s' * (count != 1)} of unknown kind"
            if kind == "unknown"
            else f"{count} {RecordType[kind.upper()].words[count != 1]}"
            for kind, count in sorted(found.lost_kinds.items())
        )
        span = f", {1e-6 * found.lost_ns:.0f} ms inside the session" if found.lost_ns else ""
        click.secho(f"Lost {found.lost_bytes} bytes: {kinds}{span}.", fg="red")
    else:
        click.echo("Nothing that had been stored was lost.")
    if target is not None:
        click.echo(f"Recovered log  {target}")
