"""What ``fes replay`` says of settings that it does not use, or that have no meaning."""

from __future__ import annotations

from pathlib import Path

import click

from fes.cli.exits import Problem
from fes.cli.timing import PARAMETERS
from fes.config import Session
from fes.driving import Calibration, driving


def refuse_settings_of_a_recording(*allowed: str) -> None:
    """A session log brings its own settings; one given here would change nothing, so say so.

    Raises:
        Problem: one was given that is not ``allowed``.
    """
    context = click.get_current_context()
    given = [name for name in context.params if name not in ("recording", "as_json", "page", *allowed, *PARAMETERS)]
    for name in given:
        if context.get_parameter_source(name) is click.core.ParameterSource.COMMANDLINE:
            raise Problem(
                f"--{name.replace('_', '-')} has no meaning for a session log, which is replayed with the settings it "
                f"holds. Replay its recording instead, or leave the option out."
            )


def settings_beside(path: Path) -> Path | None:
    """The session settings in the recording's folder, if there are any."""
    settings = path.parent / "session.toml"
    return settings if settings.is_file() else None


def say_what_is_left_out(
    session: Session,
    settings: Path | None,
    left_out: list[str],
    calibrations: dict[str, Calibration],
    missing: dict[str, str],
) -> None:
    """What of recording and settings is not used, and why.

    Raises:
        Problem: a channel's foot has no calibration.
    """
    for reason in missing.values():
        click.secho(f"Not calibrated, so not used: {reason}", fg="yellow", err=True)
    if not session.channels:
        feet = ", ".join(sorted(driving(calibrations)))
        why = f"{settings} has no channel for a foot in this recording ({feet})" if settings else "no --session given"
        click.secho(f"Nothing is stimulated: {why}. Phases and strides only.", fg="yellow", err=True)
    if left_out and session.channels:
        names = ", ".join(left_out)
        click.secho(f"Left out, for the recording has no sensor on that foot: {names}.", fg="yellow", err=True)
    for channel in session.channels:
        if channel.foot not in driving(calibrations):
            raise Problem(f"Channel {channel.name!r} follows the {channel.foot}, which cannot be calibrated.")
