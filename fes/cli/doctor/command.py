"""``fes doctor``: everything that can be checked before a session, and what to do about what is not right."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import click

from fes.cli.common.exits import FAILED
from fes.cli.common.options import Number, cannot_be_seen
from fes.cli.doctor.host import Finding, Verdict, as_json, failure, ok, show, warning
from fes.config import ConfigError, Session, load_session


@click.command(name="doctor")
@click.argument("session", type=click.Path(path_type=Path), required=False)
@click.option(
    "--out", type=click.Path(path_type=Path), help="Where results will go. Default: the session's live.folder."
)
@click.option("--stop-file", type=click.Path(path_type=Path), help="As for `fes run`. Default: live.stop_file.")
@click.option("--hours", type=Number(min=0.01), default=4.0, show_default=True, help="Length of the session.")
@click.option("--json", "json_wanted", is_flag=True, help="As JSON on stdout.")
def command(session: Path | None, out: Path | None, stop_file: Path | None, hours: float, json_wanted: bool) -> None:
    """Check ports, buses, rates, clocks, disk and permissions; with SESSION (TOML) also all that it names.

    Sensors are read for two seconds. The stimulator is asked whether it is there; nothing is stimulated.

    Exit code: 0 a session can begin (warnings name a cost), 1 it cannot.
    """
    findings = []
    for finding in examined(session, out, stop_file, hours):
        findings.append(finding)
        if not json_wanted:
            show(finding)
    if json_wanted:
        click.echo(as_json(findings))
    failures = sum(finding.verdict is Verdict.FAILURE for finding in findings)
    if failures:
        click.secho(f"{failures} of {len(findings)} checks failed; a session would not hold.", fg="red", err=True)
        raise SystemExit(FAILED)


def examined(path: Path | None, out: Path | None, stop_file: Path | None, hours: float) -> Iterator[Finding]:
    """One finding after the other, as they come."""
    from fes.cli.doctor.devices import devices  # the drivers, and what follows them, only now
    from fes.cli.doctor.host import host

    session: Session | None = None
    if path is not None:
        try:
            session = load_session(path)
        except ConfigError as error:
            yield failure("session", str(error), "correct the file; docs/sessions.md lists every setting")
        else:
            yield from settings(path, session, stop_file)
    elif stop_file:
        yield stop_file_finding(stop_file)
    yield from host(session, out or Path(session.live.folder if session else "out"), hours)
    if session is not None:
        yield from devices(session)


def settings(path: Path, session: Session, stop_file: Path | None = None) -> Iterator[Finding]:
    """What the session file says, as far as a live session needs it; ``stop_file`` in place of its own."""
    if not session.channels:
        yield warning("session", f"{path}: has no channel; nothing can be stimulated", "add a [[channels]] table")
    else:
        names = ", ".join(f"{c.name} ≤ {c.limits.max_current_ma:g} mA" for c in session.channels)
        yield ok("session", f"{path}: all limits are present ({names})")
    if not session.sensors:
        yield failure("session", f"{path}: has no [[sensors]] table", "add one for each sensor; see docs/live.md")
    from fes.estimation.sensor_choice import phase_sensors  # with the estimation behind it

    driven = phase_sensors(str(device.sensor) for device in session.sensors)
    for channel in session.channels:
        if session.sensors and channel.foot not in driven:
            yield failure(
                "session",
                f"{channel.name} follows the {channel.foot}, which no sensor is worn on",
                "add its [[sensors]]",
            )
    if stop_file or session.live.stop_file:
        yield stop_file_finding(stop_file or Path(session.live.stop_file))


def stop_file_finding(path: Path) -> Finding:
    """Whether the file is away, and could appear."""
    name, folder = "stop file", path.absolute().parent
    if hidden := cannot_be_seen(path):
        remedy = "name a file in a folder that this user may enter; it would never be seen to appear"
        return failure(name, f"{path}: {hidden}", remedy)
    if os.path.lexists(path):  # a link that leads nowhere is there too
        return failure(name, f"{path} is there; arming would be refused", "remove it")
    if not folder.is_dir():
        return failure(name, f"{path} cannot appear: {folder} is no folder; arming would be refused", "make the folder")
    if not os.access(folder, os.W_OK | os.X_OK):
        remedy = "name a file in a folder that all may write to who are to stop the session"
        return warning(name, f"{path}: this user may not write to {folder}, and cannot stop the session by it", remedy)
    return ok(name, f"{path} is not there")
