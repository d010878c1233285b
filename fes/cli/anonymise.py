"""``fes anonymise``: a session log without names, whose replay gives the same bytes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import click

from fes.cli.common.exits import FAILED, Problem, failing
from fes.cli.common.options import PATH
from fes.config import ConfigError
from fes.session_log import SessionLogError

if TYPE_CHECKING:
    from fes.cli.replay.log import Repeated


@click.command(name="anonymise")
@click.argument("log", type=PATH)
@click.option("--out", type=PATH, help="The new log. Default: NAME.anonymous.feslog beside LOG.")
@click.option("--name", "names", multiple=True, help="Another name to take out of all texts; may be given often.")
@click.option("--keep-marks", is_flag=True, help="Keep what was marked, without these names. Default: mark 1, 2 …")
@click.option("--json", "as_json", is_flag=True, help="Print what was done as JSON.")
def command(log: Path, out: Path | None, names: tuple[str, ...], keep_marks: bool, as_json: bool) -> None:
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
    from fes.cli.replay.log import repeat

    try:
        return repeat(target)
    except BaseException:
        target.unlink()
        raise
