"""``fes doctor``: everything that can be checked before a session, and what to do about what is not right."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import click

from fes.cli.exits import FAILED
from fes.cli.finding import Finding, Verdict, as_json, failure, ok, tell, warning
from fes.cli.ranges import Number
from fes.cli.reachable import cannot_be_seen
from fes.config import ConfigError, Session, load_session


@click.command(name="doctor")
@click.argument("session", type=click.Path(path_type=Path), required=False)
@click.option(
    "--out", type=click.Path(path_type=Path), help="Where results will go. Default: the session's live.folder."
)
@click.option("--hours", type=Number(min=0.01), default=4.0, show_default=True, help="Length of the session.")
@click.option("--json", "json_wanted", is_flag=True, help="As JSON on stdout.")
def command(session: Path | None, out: Path | None, hours: float, json_wanted: bool) -> None:
    """Check ports, buses, rates, clocks, disk and permissions; with SESSION (TOML) also all that it names.

    Sensors are read for two seconds. The stimulator is asked whether it is there; nothing is stimulated.

    Exit code: 0 a session can begin (warnings name a cost), 1 it cannot.
    """
    findings = []
    for finding in examined(session, out, hours):
        findings.append(finding)
        if not json_wanted:
            tell(finding)
    if json_wanted:
        click.echo(as_json(findings))
    failures = sum(finding.verdict is Verdict.FAILURE for finding in findings)
    if failures:
        click.secho(f"{failures} of {len(findings)} checks failed; a session would not hold.", fg="red", err=True)
        raise SystemExit(FAILED)


def examined(path: Path | None, out: Path | None, hours: float) -> Iterator[Finding]:
    """One finding after the other, as they come."""
    from fes.cli.doctor_devices import devices  # the drivers, and what follows them, only now
    from fes.cli.doctor_host import host

    session: Session | None = None
    if path is not None:
        try:
            session = load_session(path)
        except ConfigError as error:
            yield failure("session", str(error), "correct the file; docs/sessions.md lists every setting")
        else:
            yield from settings(path, session)
    yield from host(session, out or Path(session.live.folder if session else "out"), hours)
    if session is not None:
        yield from devices(session)


def settings(path: Path, session: Session) -> Iterator[Finding]:
    """What the session file says, as far as a live session needs it."""
    if not session.channels:
        yield warning("session", f"{path}: has no channel; nothing can be stimulated", "add a [[channels]] table")
    else:
        names = ", ".join(f"{c.name} ≤ {c.limits.max_current_ma:g} mA" for c in session.channels)
        yield ok("session", f"{path}: all limits are present ({names})")
    if not session.sensors:
        yield failure("session", f"{path}: has no [[sensors]] table", "add one for each sensor; see docs/live.md")
    from fes.driving import driving  # with the estimation behind it

    driven = driving(str(device.sensor) for device in session.sensors)
    for channel in session.channels:
        if session.sensors and channel.foot not in driven:
            yield failure(
                "session",
                f"{channel.name} follows the {channel.foot}, which no sensor is worn on",
                "add its [[sensors]]",
            )
    stop_file = session.live.stop_file
    if stop_file and (hidden := cannot_be_seen(stop_file)):
        remedy = "name a file in a folder that this user may enter; it would never be seen to appear"
        yield failure("stop file", f"{stop_file}: {hidden}", remedy)
    elif stop_file and Path(stop_file).exists():
        yield failure("stop file", f"{stop_file} is there; arming would be refused", "remove it")
    elif stop_file:
        yield ok("stop file", f"{stop_file} is not there")
