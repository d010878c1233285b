"""The first part of a live session that was given no calibration: stand still, walk some strides."""

from __future__ import annotations

import time
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import click

from fes.calibration.recording import SensorCalibrations
from fes.cli.calibrate import describe, save_calibrations
from fes.cli.common.exits import LOG_SUFFIX, Problem, StoppedEarly, fail
from fes.cli.common.progress import Interrupt
from fes.config import Session
from fes.estimation.sensor_choice import Calibration
from fes.live.calibrating import Calibrating
from fes.live.commands import CommandKind, OperatorCommand
from fes.live.inputs import Keyboard
from fes.live.log_pipe import PipedLog
from fes.live.sensors import SensorStream
from fes.live.session import COMPLETE, live_header
from fes.live.source import LiveSource
from fes.session_log import SessionLogError
from fes.signals import Event


def calibrate(
    session: Session,
    streams: Sequence[SensorStream],
    strides: int,
    folder: Path,
    keys: int | None,
    interrupt: Interrupt,
) -> dict[str, Calibration]:
    """Record standing and walking, and calibrate from it; the recording and the result stay in the session's folder."""
    finding = Calibrating(session, strides)
    click.echo("Calibration: stand still for two seconds, then walk straight ahead. q gives up.", err=True)
    log = open_log(folder / f"calibration{LOG_SUFFIX}", live_header(session, {}, 0, utc_now(), time.monotonic_ns()))
    given_up: list[CommandKind] = []

    def execute(command: OperatorCommand, t_ns: int) -> list[Event]:
        if command.kind in (CommandKind.QUIT, CommandKind.STOP):
            given_up.append(command.kind)
        return []

    def ended() -> bool:
        return finding.done or bool(given_up)

    keyboard = Keyboard(keys, execute) if keys is not None else None
    inputs = [keyboard] if keyboard is not None else []
    shown = ""
    try:
        for event in LiveSource(streams, inputs, None, time.monotonic_ns, ended, lambda: False):
            log.event(event)
            log.flush_due(time.monotonic_ns())
            finding.add_event(event)
            interrupt.check()
            if finding.message != shown:
                shown = finding.message
                click.echo(shown, err=True)
    except KeyboardInterrupt:
        given_up.append(CommandKind.QUIT)
    except SessionLogError as error:
        fail(error, StoppedEarly)
    finally:
        if keyboard is not None:
            keyboard.close()
    try:
        log.close({"ended": COMPLETE if finding.done else "given up"})
    except SessionLogError as error:
        fail(error, StoppedEarly)
    if not finding.done:
        raise Problem("Calibration was given up; nothing was stimulated.")
    for calibration in finding.found.values():
        click.echo(describe(calibration), err=True)
    save_calibrations(SensorCalibrations(finding.found), folder / "calibration.json")
    return finding.found


def open_log(path: Path, header: dict[str, Any]) -> PipedLog:
    """A session log, its writer's process running.

    Raises:
        Problem: it cannot be made.
    """
    try:
        return PipedLog(path, header)
    except SessionLogError as error:
        fail(error)


def utc_now() -> str:
    """For a log's header."""
    return datetime.now(UTC).isoformat(timespec="seconds")
