"""``fes recover``: a torn or damaged session log → a new one with all that is whole, and what was lost."""

from pathlib import Path

import click

from fes.cli.common.exits import FAILED, Problem, failing
from fes.cli.common.options import PATH
from fes.cli.common.show import print_json
from fes.session_log import SessionLogError
from fes.session_log.framing import RecordType
from fes.session_log.repair import NAMES, Survey, recover, survey


@click.command(name="recover")
@click.argument("log", type=PATH)
@click.option("--out", type=PATH, help="The new log. Default: NAME.recovered.feslog beside LOG.")
@click.option("--header-from", type=PATH, help="Log with the same settings, if LOG's are damaged.")
@click.option("--dry-run", is_flag=True, help="Only say what is lost.")
@click.option("--json", "as_json", is_flag=True, help="Print the findings as JSON.")
def command(log: Path, out: Path | None, header_from: Path | None, dry_run: bool, as_json: bool) -> None:
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
        _show(found, target if written else None)
    if found.lost_bytes:
        raise SystemExit(FAILED)


def _show(found: Survey, target: Path | None) -> None:
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
            else f"{count} {NAMES[RecordType[kind.upper()]][count != 1]}"
            for kind, count in sorted(found.lost_kinds.items())
        )
        span = f", {1e-6 * found.lost_ns:.0f} ms inside the session" if found.lost_ns else ""
        click.secho(f"Lost {found.lost_bytes} bytes: {kinds}{span}.", fg="red")
    else:
        click.echo("Nothing that had been stored was lost.")
    if target is not None:
        click.echo(f"Recovered log  {target}")
