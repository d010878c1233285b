"""``fes run``: a live session.

The first part of a live session that was given no calibration: stand still, walk some strides.
"""

import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click

from drivers.stimulator.open import open_lead_detected_from_ma
from drivers.stimulator.port import StimulatorLost
from drivers.stimulator.serial_line import latency_hint
from drivers.switches import SwitchFailed, open_switch
from fes.calibration.recording import SensorCalibrations, load, refuse_others
from fes.cli.common import (
    LOG_SUFFIX,
    OK,
    PATH,
    Command,
    Interrupt,
    Number,
    Problem,
    StoppedEarly,
    failing,
    fresh_folder,
    interrupted,
    utc_now,
)
from fes.cli.recordings import describe, save_calibrations
from fes.cli.run import devices
from fes.config import ConfigError, Session, load_exercise, load_session, refuse_blind_targets
from fes.estimation.foot.calibration import CalibrationError
from fes.estimation.sensor_choice import Calibration, phase_sensors, shank_phase_sensors
from fes.estimation.warm_up import COMPILES, NOT_COMPILED, warm_up
from fes.live.commands import CommandKind, OperatorCommand
from fes.live.inputs import FootSwitchInput, Keyboard, StopFile, StopSwitch, Terminal, standard_keys
from fes.live.log_pipe import PipedLog
from fes.live.operator import sides_said, unchecked_side
from fes.live.processes import HelperProcess, become_real_time
from fes.live.session import COMPLETE, Calibrating, ExerciseClock, LiveSession, live_header
from fes.live.source import LiveSource, LiveStimulator, SensorStream
from fes.live.supervision import SupervisorProcess
from fes.session_log import Note, SessionLogError
from fes.session_log.framing import LogScan, RecordType
from fes.signals import Event

Streams = Sequence[SensorStream]


def calibrate(
    session: Session, streams: Streams, strides: int, folder: Path, keys: int | None, interrupt: Interrupt
) -> dict[str, Calibration]:
    """Record standing and walking, and calibrate from it; the recording and the result stay in the session's folder."""
    finding = Calibrating(session, strides)
    click.echo("Calibration: stand still for two seconds, then walk straight ahead. q gives up.", err=True)
    with failing(SessionLogError):
        header = live_header(session, {}, 0, utc_now(), time.monotonic_ns())
        log = PipedLog(folder / f"calibration{LOG_SUFFIX}", header)
    given_up: list[CommandKind] = []

    def execute(command: OperatorCommand, t_ns: int) -> list[Event]:
        if command.kind in (CommandKind.QUIT, CommandKind.STOP):
            given_up.append(command.kind)
        return []

    def ended() -> bool:
        return finding.done or bool(given_up)

    inputs = [Keyboard(keys, execute)] if keys is not None else []
    shown = ""
    with failing(SessionLogError, kind=StoppedEarly):
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
        finally:
            for keyboard in inputs:
                keyboard.close()
        log.close({"ended": COMPLETE if finding.done else "given up"})
    if not finding.done:
        raise Problem("Calibration was given up; nothing was stimulated.")
    for calibration in finding.found.values():
        click.echo(describe(calibration), err=True)
    found = SensorCalibrations(finding.found, serials=serials_of(streams))
    save_calibrations(found, folder / "calibration.json")
    return finding.found


def serials_of(streams: Streams) -> dict[str, str]:
    """By sensor, the serial number that the device there told."""
    return {sensor: serial for stream in streams for sensor, serial in stream.serials.items()}


SOCKET_NAME = "control.sock"
FES = "from fes.cli.main import main; main(prog_name='fes')"
STOP_NAME = "stop"
FAULTS_INJECTED = (
    "FAULTS OF THE SENSORS ARE INJECTED, by `fes hil --hardware`: into a dummy load only, nobody connected"
)


@dataclass(frozen=True, slots=True)
class Options:
    """How to run."""

    out: Path | None = None
    calibration: Path | None = None
    strides: int = 6
    side: str = ""
    duration_s: float | None = None
    stop_file: Path | None = None
    stop_input: str = ""
    control: Path | None = None
    keys_from: int | None = None
    view: bool | None = None
    dashboard: bool = False
    dashboard_port: int = 0
    report: bool = True


def live_options(command: Command) -> Command:
    """What sessions with and without sensors have in common."""
    stop_input = "can_bit:ID:BIT, serial_cts:PORT, serial_dsr:PORT. Default: live.stop_button."
    descriptor = click.IntRange(min=0)
    for option in (
        devices.dashboard_options,
        click.option("--report/--no-report", default=True, help="At the end, what happened and report.html."),
        click.option("--view/--no-view", default=None, help="The terminal view. Default: where there is a terminal."),
        click.option("--keys-from", type=descriptor, help="Read keys from this descriptor instead of the terminal."),
        click.option("--control", type=PATH, help="Control socket. Default: OUT/…/control.sock."),
        click.option("--stop-input", default="", help=stop_input),
        click.option("--stop-file", type=PATH, help="Emergency stop if it appears. Default: live.stop_file."),
        click.option("--duration", "duration_s", type=Number(min=0.1), help="End by itself after this long (s)."),
        click.option("--out", type=PATH, help="Results go below. Default: live.folder, or out."),
    ):
        command = option(command)
    return command


@click.command(name="run")
@click.argument("session", type=PATH)
@click.option("--calibration", type=PATH, help="From `fes calibrate`. Default: calibrate first.")
@click.option("--strides", type=click.IntRange(3, 100), default=6, show_default=True, help="To calibrate on, per foot.")
@click.option(
    "--side",
    type=click.Choice(("left", "right", "both")),
    help="Legs whose sensors sit as named; else arming asks.",
)
@live_options
@click.pass_obj
def command(faults: devices.SensorFaults | None, /, session: Path, **options: Any) -> None:
    """Run a live session with the settings in SESSION (TOML).

    Nothing is stimulated until you arm it by hand (a) and raise the intensity (+), which starts at 0. SPACE stops at
    once, and so do Ctrl-C, the stop file and the stop button.

    Exit code: 0 ended as asked, 2 unusable settings or devices, 3 stopped early, 4 a fault of fes itself, 130
    interrupted.
    """
    run_session(session, Options(**options), faults)


def run_session(path: Path, options: Options, faults: devices.SensorFaults | None = None) -> Path:
    """Run a live session; returns the session log's path.

    Raises:
        Problem: unusable settings, devices that do not answer, a log that cannot be written.
        SystemExit: interrupted.
    """
    with failing(ConfigError, CalibrationError):
        session = usable(load_session(path), path)
        refuse_blind_targets(session, path)
        stored = load(options.calibration) if options.calibration else None
        calibrations = stored.calibrations if stored else None
    folder = fresh_folder(options.out or Path(session.live.folder), path.stem)
    with ExitStack() as stack:
        supervisor = stack.enter_context(SupervisorProcess())
        streams = devices.open_sensors(session, stack, faults)
        if stored is not None:
            with failing(CalibrationError):
                refuse_others(stored, serials_of(streams), str(options.calibration))
        keys = options.keys_from if options.keys_from is not None else standard_keys()
        if keys is not None:
            stack.enter_context(Terminal(keys))
        interrupt = stack.enter_context(Interrupt())
        with failing(RuntimeError):
            warm_up()
        if calibrations is None:
            calibrations = calibrate(session, streams, options.strides, folder, keys, interrupt)
        worn = {device.sensor for device in session.sensors}
        calibrations = {sensor: each for sensor, each in calibrations.items() if sensor in worn}
        missing = sorted({str(channel.foot) for channel in session.channels} - phase_sensors(calibrations).keys())
        if missing:
            which = ", ".join(missing)
            raise Problem(f"{options.calibration}: holds no calibration of {which}, which a channel follows.")
        phase_sensor_of = phase_sensors(calibrations)
        unchecked = unchecked_side(phase_sensor_of)
        if options.side and options.side != unchecked:
            says = (
                f"the session has {sides_said(phase_sensor_of)}"
                if unchecked
                else "the session has a sensor on each foot, and tells them apart by itself"
            )
            raise Problem(f"--side {options.side}: {says}.")
        log_path, ended = run_live(
            session, calibrations, streams, options, folder, keys, interrupt, supervisor, stack, faults
        )
    finish(log_path, ended, report=options.report)
    return log_path


def finish(log_path: Path, ended: str, *, report: bool) -> None:
    """What a live session says at its end, an alarm first. Raises as :func:`said_how_it_ended`."""
    try:
        said_how_it_ended(log_path, ended)
    finally:
        if report:
            write_report(log_path)
    where = f"Session log  {log_path}"
    click.echo(where if log_path.exists() else f"{where}: it is not there")


def write_report(log_path: Path) -> None:
    """What happened, in about ten lines, and the report: by a process of its own, which may be given up.

    Everything is off and every device closed by then. The session's process never loads what a report needs.
    """
    sys.stdout.flush()
    with suppress(KeyboardInterrupt):
        done = subprocess.run((sys.executable, "-c", FES, "report", "--summary", log_path), check=False)
        if done.returncode == OK:
            return
    whole = "the session log is whole" if is_whole(log_path) else "the session log is not whole, or not there"
    click.secho(f"There is no report; {whole}: `fes report {log_path}` writes it.", fg="yellow", err=True)


def is_whole(log_path: Path) -> bool:
    """Whether a session log can be read to its summary, which is its last record."""
    scan, last = LogScan(log_path), 0
    with suppress(SessionLogError):
        for kind, _ in scan:
            last = kind
    return last == RecordType.SUMMARY and not scan.lost


def said_how_it_ended(log_path: Path, ended: str) -> None:
    """Nothing where all went well. Raises SystemExit: interrupted; StoppedEarly: anything else."""
    if ended == "interrupted":
        interrupted(f"; stimulation is off. Session log: {log_path}")
    if ended != COMPLETE:
        click.secho(f"\aALARM: the session has ended, stimulation is off. {ended}", fg="red", bold=True, err=True)
        raise StoppedEarly(ended)


def usable(session: Session, path: Path) -> Session:
    """The session, if it can run live. Raises ConfigError: something that a live session needs is missing."""
    if not session.sensors:
        raise ConfigError(f"{path}: sensors are missing; a live session needs a [[sensors]] table for each")
    feet = phase_sensors(str(device.sensor) for device in session.sensors)
    for channel in session.channels:
        if channel.foot not in feet:
            where = f"the {channel.foot}, which no [[sensors]] table is worn on"
            raise ConfigError(f"{path}: channel {channel.name!r} follows {where}")
    return session


def run_live(
    session: Session,
    calibrations: dict[str, Calibration],
    streams: Streams,
    options: Options,
    folder: Path,
    keys: int | None,
    interrupt: Interrupt,
    supervisor: SupervisorProcess,
    stack: ExitStack,
    faults: devices.SensorFaults | None = None,
) -> tuple[Path, str]:
    """Have the supervisor open the stimulator, then the one loop; the log's path and how it ended.

    Nothing else drives a real device.
    """
    stop_file = options.stop_file or (Path(session.live.stop_file) if session.live.stop_file else folder / STOP_NAME)
    up = {sensor: each.up for sensor, each in calibrations.items()}
    shanks = shank_phase_sensors(calibrations)
    line = supervisor.line_of(session, up, shanks, str(stop_file), StimulatorLost)
    opened_ns = time.monotonic_ns()
    with failing(StimulatorLost, ConfigError):
        opened = line.open(opened_ns)
    log_path = folder / f"session{LOG_SUFFIX}"
    with failing(SessionLogError):
        header = live_header(session, calibrations, opened.session_id, utc_now(), opened_ns, opened.current_step_ma)
        log = PipedLog(log_path, header if faults is None else header | {"faults_injected": True})
    kind, page_port = str(header["kind"]), options.dashboard_port
    dashboard = None
    if options.dashboard:
        dashboard = devices.open_dashboard(folder, session, kind, page_port, stack, calibrations)
    viewed = sys.stdout.isatty() if options.view is None else options.view
    view = stack.enter_context(HelperProcess("fes.live.terminal_view")) if viewed else None

    def observe(event: Event) -> None:  # in a fault campaign only
        line.observe(event)
        if faults is not None:
            faults.observe(event)

    stimulator = LiveStimulator(line, StimulatorLost, time.monotonic_ns)
    stack.callback(stimulator.close)
    live = LiveSession(
        session,
        calibrations,
        log,
        stimulator,
        time.monotonic_ns,
        view,
        options.duration_s,
        current_step_ma=opened.current_step_ma,
        open_lead_detected_from_ma=open_lead_detected_from_ma(session.stimulator),
        side=options.side or "",
        observed=line.observe if faults is None else observe,
    )
    line.on_own, line.on_fault = live.monitor.command, stimulator.add_fault
    _give_inputs(live, session, options, stop_file, folder, keys, stack)
    if session.exercise is None:
        reads = HelperProcess("fes.live.witness_process", str(log_path))
        live.add_witness(stack.enter_context(reads))
    else:
        live.add_input(ExerciseClock(session.exercise, live.operator))
    if dashboard is not None:
        devices.add_dashboard(live, dashboard)
    if faults is not None:
        live.add_input(faults)
        live.notices.lasting.append(FAULTS_INJECTED)
        live.monitor.note(Note(time.monotonic_ns(), "warning", "session", FAULTS_INJECTED))
        click.secho(FAULTS_INJECTED, fg="red", bold=True, err=True)
    if NOT_COMPILED:
        live.monitor.note(Note(time.monotonic_ns(), "warning", "session", NOT_COMPILED))
        click.secho(f"Warning: {NOT_COMPILED}. Remedy: {COMPILES}", fg="yellow", err=True)
    click.secho("A stimulator is connected. Nothing is stimulated until you arm.", fg="red", bold=True, err=True)
    for port_name in devices.serial_ports_of(session):
        if hint := latency_hint(port_name):
            click.secho(hint, fg="yellow", err=True)
    grants = become_real_time()
    for grant in grants:
        if grant.refused:
            click.secho(f"{grant}. Remedy: {grant.remedy}", fg="yellow", err=True)
    ended = COMPLETE
    try:
        live.run(streams, opened.frames, opened.alive, grants, interrupt.check)
    except KeyboardInterrupt:
        ended = "interrupted"
    except SessionLogError as error:
        ended = str(error)
        click.secho(f"\aALARM: stimulation is off, the session ends. {ended}", fg="red", bold=True, err=True)
    except Exception as error:
        ended = f"stopped: {type(error).__name__}: {error}"
        raise
    finally:
        try:
            log.close({"ended": ended, **live.summary()})
        except SessionLogError as error:
            ended = str(error)
    if dashboard is not None and ended != COMPLETE:
        dashboard.say_at_the_end(f"The session has ended: {ended}. Stimulation is off.")
    return log.path, ended


def _give_inputs(
    live: LiveSession,
    session: Session,
    options: Options,
    stop_file: Path,
    folder: Path,
    keys: int | None,
    stack: ExitStack,
) -> None:
    if keys is not None:
        live.add_keys(keys)
    live.add_input(StopFile(stop_file, live.operator.execute))
    try:
        live.add_control(options.control or folder / SOCKET_NAME)
    except OSError as error:
        if options.control:
            raise Problem(f"{options.control}: no socket can be made: {error}. Choose a shorter path.") from error
        click.secho(f"No control socket: {error}", fg="yellow", err=True)
    with failing(SwitchFailed, ConfigError):
        for settings in session.foot_switches:
            switch = open_switch(settings, session.bus)
            stack.callback(switch.close)
            live.add_input(FootSwitchInput(settings.foot, switch))
        wanted = devices.stop_switch_settings(options.stop_input) if options.stop_input else session.live.stop_button
        if wanted is not None:
            button = open_switch(wanted, session.bus)
            stack.callback(button.close)
            live.add_input(StopSwitch(button, live.operator.execute))


@click.command(name="exercise")
@click.argument("session", type=PATH)
@live_options
def exercise_command(session: Path, **options: Any) -> None:
    """Stimulate in cycles, as the [exercise] table of SESSION (TOML) says; the person lies or sits, no sensor is read.

    Nothing is stimulated until you arm it by hand (a) and raise the intensity (+), which starts at 0. SPACE stops at
    once, and so do Ctrl-C, the stop file and the stop button. After the last burst it is disarmed.

    Exit code: 0 ended as asked, 2 unusable settings or devices, 3 stopped early, 4 a fault of fes itself, 130
    interrupted.
    """
    run_exercise(session, Options(**options))


def run_exercise(path: Path, options: Options) -> Path:
    """Run a session of exercise; returns the session log's path. Raises as :func:`fes.cli.run.command.run_session`."""
    with failing(ConfigError):
        session = load_exercise(path)
    folder = fresh_folder(options.out or Path(session.live.folder), f"{path.stem}-exercise")
    with ExitStack() as stack:
        supervisor = stack.enter_context(SupervisorProcess())
        keys = options.keys_from if options.keys_from is not None else standard_keys()
        if keys is not None:
            stack.enter_context(Terminal(keys))
        interrupt = stack.enter_context(Interrupt())
        log_path, ended = run_live(session, {}, [], options, folder, keys, interrupt, supervisor, stack)
    finish(log_path, ended, report=options.report)
    return log_path
