"""``fes run``: a live session."""

from __future__ import annotations

import secrets
import sys
import time
from contextlib import ExitStack
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import click

from drivers.stimulator.open import open_stimulator
from drivers.stimulator.port import StimulatorLost
from drivers.switches import SwitchFailed, open_switch
from fes.calibrations import Found as Calibrated
from fes.calibrations import load
from fes.cli.calibrate import describe, save_calibrations
from fes.cli.exits import INTERRUPTED, Problem, StoppedEarly, fail
from fes.cli.folders import LOG_SUFFIX, fresh_folder
from fes.cli.interrupt import Interrupt
from fes.cli.live_devices import Found, open_sensors, stop_switch_settings
from fes.config import ConfigError, Session, load_session
from fes.driving import Calibration, driving
from fes.estimation.calibration import CalibrationError
from fes.estimation.warm import warm_up
from fes.journal import SessionLogError
from fes.live.calibrating import Calibrating
from fes.live.header import live_header
from fes.live.inputs import Keyboard, Terminal, standard_keys
from fes.live.log_pipe import PipedLog
from fes.live.orders import Ask, Order
from fes.live.realtime import become_real_time
from fes.live.session import COMPLETE, LiveSession
from fes.live.source import LiveSource
from fes.live.stimulator import LiveStimulator, Opened
from fes.live.view_process import ViewProcess
from fes.signals import Event

SOCKET_NAME = "control.sock"
STOP_NAME = "stop"


@dataclass(frozen=True, slots=True)
class Options:
    """How to run."""

    out: Path = Path("out")
    calibration: Path | None = None
    strides: int = 6
    duration_s: float | None = None
    stop_file: Path | None = None
    stop_input: str = ""
    control: Path | None = None
    keys_from: int | None = None
    view: bool | None = None


@click.command(name="run")
@click.argument("session", type=click.Path(path_type=Path))
@click.option(
    "--out", type=click.Path(path_type=Path), default=Path("out"), show_default=True, help="Results go below."
)
@click.option("--calibration", type=click.Path(path_type=Path), help="From `fes calibrate`. Default: calibrate first.")
@click.option("--strides", type=click.IntRange(3, 100), default=6, show_default=True, help="To calibrate on, per foot.")
@click.option("--duration", "duration_s", type=click.FloatRange(min=0.1), help="End by itself after this long (s).")
@click.option("--stop-file", type=click.Path(path_type=Path), help="Emergency stop if it appears. Default: OUT/…/stop.")
@click.option("--stop-input", default="", help="Stop button: can_bit:ID:BIT, serial_cts:PORT or serial_dsr:PORT.")
@click.option("--control", type=click.Path(path_type=Path), help="Control socket. Default: OUT/…/control.sock.")
@click.option("--keys-from", type=click.IntRange(min=0), help="Read keys from this descriptor instead of the terminal.")
@click.option("--view/--no-view", default=None, help="The terminal view. Default: where there is a terminal.")
def command(
    session: Path,
    out: Path,
    calibration: Path | None,
    strides: int,
    duration_s: float | None,
    stop_file: Path | None,
    stop_input: str,
    control: Path | None,
    keys_from: int | None,
    view: bool | None,
) -> None:
    """Run a live session with the settings in SESSION (TOML).

    Nothing is stimulated until you arm it by hand (a) and raise the intensity (+), which starts at 0. SPACE stops at
    once, and so do Ctrl-C, the stop file and the stop button.

    Exit code: 0 ended as asked, 2 unusable settings or devices, 3 stopped early, 4 a fault of fes itself, 130
    interrupted.
    """
    options = Options(out, calibration, strides, duration_s, stop_file, stop_input, control, keys_from, view)
    run_session(session, options)


def run_session(path: Path, options: Options) -> Path:
    """Run a live session; returns the session log's path.

    Raises:
        Problem: unusable settings, devices that do not answer, a log that cannot be written.
        SystemExit: interrupted.
    """
    try:
        session = usable(load_session(path), path)
        calibrations = load(options.calibration).calibrations if options.calibration else None
    except (ConfigError, CalibrationError) as error:
        fail(error)
    folder = fresh_folder(options.out, path.stem)
    with ExitStack() as stack:
        found = open_sensors(session, stack)
        keys = options.keys_from if options.keys_from is not None else standard_keys()
        if keys is not None:
            stack.enter_context(Terminal(keys))
        interrupt = stack.enter_context(Interrupt())
        warm_up()
        if calibrations is None:
            calibrations = _calibrate(session, found, options, folder, keys, interrupt)
        worn = {device.sensor for device in session.sensors}
        calibrations = {sensor: each for sensor, each in calibrations.items() if sensor in worn}
        missing = sorted({str(channel.foot) for channel in session.channels} - driving(calibrations).keys())
        if missing:
            raise Problem(
                f"{options.calibration}: holds no calibration of {', '.join(missing)}, which a channel follows."
            )
        log_path, ended = _run(session, calibrations, found, options, folder, keys, interrupt, stack)
    if ended == "interrupted":
        click.secho(f"Interrupted; stimulation is off. Session log: {log_path}", fg="yellow", err=True)
        raise SystemExit(INTERRUPTED)
    if ended != COMPLETE:
        click.secho(f"\aALARM: the session has ended, stimulation is off. {ended}", fg="red", bold=True, err=True)
        raise StoppedEarly(ended)
    click.echo(f"Session log  {log_path}")
    return log_path


def usable(session: Session, path: Path) -> Session:
    """The session, if it can run live.

    Raises:
        ConfigError: something that a live session needs is missing.
    """
    if not session.sensors:
        raise ConfigError(f"{path}: sensors are missing; a live session needs a [[sensors]] table for each")
    worn = {device.sensor for device in session.sensors}
    for channel in session.channels:
        if channel.foot not in worn:
            raise ConfigError(
                f"{path}: channel {channel.name!r} follows the {channel.foot}, which no [[sensors]] table is worn on"
            )
    return session


def _calibrate(
    session: Session, found: Found, options: Options, folder: Path, keys: int | None, interrupt: Interrupt
) -> dict[str, Calibration]:
    """Record standing and walking, and calibrate from it; the recording and the result stay in the session's folder."""
    finding = Calibrating(session, options.strides)
    click.echo("Calibration: stand still for two seconds, then walk straight ahead. q gives up.", err=True)
    log = _open_log(folder / f"calibration{LOG_SUFFIX}", live_header(session, {}, 0, _now(), time.monotonic_ns()))
    given_up: list[Ask] = []

    def carry(order: Order, t_ns: int) -> list[Event]:
        if order.ask in (Ask.QUIT, Ask.STOP):
            given_up.append(order.ask)
        return []

    inputs = [Keyboard(keys, carry)] if keys is not None else []
    over = lambda: finding.done or bool(given_up)  # noqa: E731
    said = ""
    try:
        for event in LiveSource(found.lines, inputs, None, time.monotonic_ns, over, lambda: False):
            log.event(event)
            log.flush_due(time.monotonic_ns())
            finding.take(event)
            interrupt.check()
            if finding.message != said:
                said = finding.message
                click.echo(said, err=True)
    except KeyboardInterrupt:
        given_up.append(Ask.QUIT)
    except SessionLogError as error:
        fail(error, StoppedEarly)
    try:
        log.close({"ended": COMPLETE if finding.done else "given up"})
    except SessionLogError as error:
        fail(error, StoppedEarly)
    if not finding.done:
        raise Problem("Calibration was given up; nothing was stimulated.")
    for calibration in finding.found.values():
        click.echo(describe(calibration), err=True)
    save_calibrations(Calibrated(finding.found), folder / "calibration.json")
    return finding.found


def _run(
    session: Session,
    calibrations: dict[str, Calibration],
    found: Found,
    options: Options,
    folder: Path,
    keys: int | None,
    interrupt: Interrupt,
    stack: ExitStack,
) -> tuple[Path, str]:
    """Open the stimulator, then the one loop; the log's path and how it ended."""
    session_id = new_session_id()
    opened_ns = time.monotonic_ns()
    try:
        port = open_stimulator(session.stimulator, session, session_id)
        stack.callback(port.close)
        handshake = port.open(opened_ns)
    except (StimulatorLost, ConfigError) as error:
        fail(error)
    log_path = folder / f"session{LOG_SUFFIX}"
    log = _open_log(log_path, live_header(session, calibrations, session_id, _now(), opened_ns))
    terminal = sys.stdout.isatty()
    view = stack.enter_context(ViewProcess()) if (terminal if options.view is None else options.view) else None
    stimulator = LiveStimulator(port, lambda: _open_again(session), StimulatorLost, time.monotonic_ns)
    stack.callback(stimulator.close)
    live = LiveSession(session, calibrations, log, stimulator, time.monotonic_ns, view, options.duration_s)
    _give_inputs(live, session, options, folder, keys, stack)
    click.secho("A stimulator is connected. Nothing is stimulated until you arm.", fg="red", bold=True, err=True)
    grants = become_real_time()
    for grant in grants:
        if grant.refused:
            click.secho(f"{grant}. Remedy: {grant.remedy}", fg="yellow", err=True)
    ended = COMPLETE
    try:
        live.run(found.lines, handshake.frames, handshake.alive, grants, interrupt.check)
    except KeyboardInterrupt:
        ended = "interrupted"
    except SessionLogError as error:
        ended = str(error)
    finally:
        try:
            log.close({"ended": ended, **live.summary()})
        except SessionLogError as error:
            ended = str(error) if ended == COMPLETE else ended
    return log_path, ended


def _give_inputs(
    live: LiveSession, session: Session, options: Options, folder: Path, keys: int | None, stack: ExitStack
) -> None:
    if keys is not None:
        live.add_keys(keys)
    live.add_stop_file(options.stop_file or folder / STOP_NAME)
    try:
        live.add_control(options.control or folder / SOCKET_NAME)
    except OSError as error:
        if options.control:
            raise Problem(f"{options.control}: no socket can be made: {error}. Choose a shorter path.") from error
        click.secho(f"No control socket: {error}", fg="yellow", err=True)
    try:
        for settings in session.foot_switches:
            switch = open_switch(settings, session.bus)
            stack.callback(switch.close)
            live.add_foot_switch(settings.foot, switch)
        if options.stop_input:
            button = open_switch(stop_switch_settings(options.stop_input), session.bus)
            stack.callback(button.close)
            live.add_stop_switch(button)
    except (SwitchFailed, ConfigError) as error:
        fail(error)


def _open_log(path: Path, header: dict[str, Any]) -> PipedLog:
    try:
        return PipedLog(path, header)
    except SessionLogError as error:
        fail(error)


def _open_again(session: Session) -> Opened:
    session_id = new_session_id()
    port = open_stimulator(session.stimulator, session, session_id)
    try:
        port.open(time.monotonic_ns())
    except Exception:
        port.close()
        raise
    return port, session_id


def new_session_id() -> int:
    """A number that the stimulator has most likely not seen since it was switched on (1–65535)."""
    return secrets.randbelow(65535) + 1


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")
