"""``fes convert``: a session log for other programs."""

import json
from pathlib import Path

import click

from fes.cli.common.exits import failing
from fes.cli.common.options import PATH
from fes.config import ConfigError
from fes.session_log import SessionLogError

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
def command(
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
    from fes.session_log.export.c3d_file import to_c3d
    from fes.session_log.export.mcap_file import to_mcap
    from fes.session_log.export.tables import to_csv, to_parquet

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
