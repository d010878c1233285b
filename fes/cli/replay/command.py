"""``fes replay``: a recording, or a session log, through the same loop as a live session.

From a session log the same events must give what was recorded, bytes first.
"""

import time
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

import click

from drivers.imu.port import ImuLost
from drivers.stimulator.bus import BusError
from drivers.stimulator.can_codec import COMMAND_ID, OPEN_ID, PROTOCOL_VERSION
from drivers.stimulator.port import ANSWER_WITHIN_NS, StimulatorLost
from fes import __version__
from fes.calibration.recording import SensorCalibrations, calibrate_phase_sensors, stored_calibrations
from fes.cli.common import (
    FAILED,
    LOG_SUFFIX,
    PATH,
    Interrupt,
    Number,
    Problem,
    StoppedEarly,
    choice,
    failing,
    fresh_folder,
    given_options,
    interrupted,
    need_extra,
    out_option,
    replay_progress,
    show,
    show_latched,
    utc_now,
)
from fes.cli.replay import stimulators
from fes.cli.replay.stimulators import LoggedSink, SerialSink, polled_every_ns, repeats_bytes
from fes.cli.run import command as run
from fes.cli.run.devices import dashboard_options, open_dashboard
from fes.config import ConfigError, Session, load_session
from fes.control.clock_sync import SensorClock
from fes.control.controller import CURRENT_STEP_MA, Controller
from fes.control.replay import digest, identity, log_header, refuse_long_silence, session_for, settings_of
from fes.control.runner import CLOSING_S, Log, Runner, armed_after, paced, with_ticks
from fes.estimation.foot.calibration import CalibrationError
from fes.estimation.sensor_choice import Calibration, phase_sensors, shank_phase_sensors
from fes.estimation.warm_up import warm_up
from fes.evaluation.log_comparison import ReplayOutput, first_difference
from fes.gate import SafetyGate, gate_of
from fes.live.dashboard.replay import ReplayLog, StoppableClock
from fes.live.inputs import Terminal, standard_keys
from fes.live.source import SensorStream
from fes.live.supervision import OWN, UNSENT, SupervisorProcess
from fes.recording import Recording, RecordingError, read_recording
from fes.recording.tracks import samples_of
from fes.session_log import Note, SessionLogError, SessionRecord, SessionWriter, iter_events, iter_inputs, read_session
from fes.signals import SHANK_SENSORS, Event
from fes.walk_record import MARK

# --- what a replay needs of a recording before it begins ------------------------------------------------------


class Prepared(NamedTuple):
    """A recording with what it is replayed with; ``session`` is None where no settings are asked for or beside it."""

    recording: Recording
    settings: Path | None
    session: Session | None
    found: SensorCalibrations


def prepared(path: Path, settings: Path | None, calibration: Path | None) -> Prepared:
    """Read a recording; ``settings`` are a session's, by default ``session.toml`` beside it.

    RecordingError, ConfigError, CalibrationError: one of the files cannot be used.
    """
    recording = read_recording(path)
    refuse_long_silence(recording)
    beside = path.parent / "session.toml"
    settings = settings or (beside if beside.is_file() else None)
    session = load_session(settings) if settings else None
    if calibration:
        recording, found = stored_calibrations(calibration, recording)
    else:
        found = calibrate_phase_sensors(recording, incline=session_for(recording, session).ground.incline)
    return Prepared(recording, settings, session, found)


LARGEST_STEP_MA: Final = 10.0
REPORTED: Final = ("commands", "strides", "difference")


def controller_and_gate(
    session: Session, calibrations: Mapping[str, Calibration], current_step_ma: float = CURRENT_STEP_MA
) -> tuple[Controller, SafetyGate]:
    """What decides in a replay, and what has the last word."""
    up = {sensor: each.up for sensor, each in calibrations.items()}
    gate = gate_of(session, up, shank_phase_sensors(calibrations), current_step_ma)
    return Controller(session, calibrations, current_step_ma=current_step_ma), gate


@dataclass(frozen=True, slots=True)
class Repeated:
    """How a log's second run went: ``commands`` and ``strides`` compared, ``difference`` the first ("": none).

    ``now`` is what came out this time.
    """

    commands: int
    strides: int
    difference: str
    now: ReplayOutput


def repeat(path: Path) -> Repeated:
    """Run a session log's events again and hold what comes out against what is recorded.

    A log that is torn, or whose session stopped half-way through an event, is compared as far as it goes.

    SessionLogError, ConfigError: the log cannot be read, or is of another kind.
    """
    again = Reopened(path)
    record, runner = again.record, again.runner
    for event in again.events:
        runner.handle(event)
    # a log that was recovered without its end lacks what the session did last
    recovered = record.summary.get("recovered")
    if record.complete and not (isinstance(recovered, dict) and recovered.get("end_missing")):
        runner.all_off()
    now, recorded = again.now, again.recorded
    difference = (recorded is not None and _other_protocol(record)) or first_difference(
        record, recorded, now, runner.t_ns
    )
    commands, strides = min(len(record.commands), len(now.commands)), min(len(record.strides), len(now.strides))
    return Repeated(commands, strides, difference, now)


class Reopened:
    """A session log about to be run again: ``runner`` is to handle ``events``; what comes out is in ``now``.

    ``recorded`` are its commands' frames, None where bytes cannot be compared.

    SessionLogError, ConfigError: as :func:`repeat`.
    """

    def __init__(self, path: Path) -> None:
        self.record, self.now = read_session(path), ReplayOutput()
        self.session, _, controller, gate, session_id = _decides(self.record, path)
        sink: LoggedSink | SerialSink
        compares_bytes = True
        if repeats_bytes(self.session, self.record.header):
            sink = SerialSink(self.session, polled_every_ns(self.record.header))
            recorded = sink.logged_commands(self.record.frames)
            sink.sent = [frame.identifier != UNSENT for frame in recorded]
            self.events: Iterator[Event] = sink.replay_events(iter_inputs(path), session_id)
        else:
            recorded = [frame for frame in self.record.frames if frame.identifier in (COMMAND_ID, UNSENT)]
            sink = LoggedSink(session_id, [frame.identifier != UNSENT for frame in recorded])
            self.events = sink.replay_events(iter_events(path))
            compares_bytes = self.session.stimulator.device == "can"  # what another driver made of one is not known
        # of a log from before there was a supervisor, none is
        sink.own = {n: command for n, command in enumerate(self.record.commands) if command.refused.startswith(OWN)}
        sink.came = self.now.command
        self.recorded = recorded if compares_bytes else None
        self.runner = Runner(controller, gate, sink, self.now, lambda: 0)


def _decides(record: SessionRecord, path: Path) -> tuple[Session, dict[str, Calibration], Controller, SafetyGate, int]:
    """Settings, calibrations, controller, gate and the stimulator's session of a log."""
    try:
        session, calibrations, session_id = settings_of(record.header, path)
        step_ma = record.header.get("current_step_ma", CURRENT_STEP_MA)
        if isinstance(step_ma, bool) or not isinstance(step_ma, (int, float)) or not 0.0 < step_ma <= LARGEST_STEP_MA:
            raise ValueError(f"current_step_ma = {step_ma!r} is no step of a current in mA")
        controller, gate = controller_and_gate(session, calibrations, float(step_ma))
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        if isinstance(error, ConfigError):
            raise
        version = record.header.get("fes_version", "unknown")
        raise SessionLogError(
            f"{path}: was left by fes {version} and cannot be replayed by fes {__version__}: its header does not fit "
            f"({error}). `fes report` still shows it; replay its recording instead."
        ) from error
    return session, calibrations, controller, gate, session_id


def _other_protocol(record: SessionRecord) -> str:
    opening = next((frame.data for frame in record.frames if frame.identifier == OPEN_ID), b"")
    if len(opening) > 1 and opening[1] % 16 != PROTOCOL_VERSION:
        return f"its frames are of the protocol's version {opening[1] % 16}, this program speaks {PROTOCOL_VERSION}"
    return ""


def replay_log(path: Path, *, as_json: bool) -> None:
    """Show a session log and check that it gives the same bytes, phases and strides again."""
    with failing(SessionLogError, ConfigError):
        again = repeat(path)
        more: dict[str, Any] = {"replayed": {name: getattr(again, name) for name in REPORTED}}
        notices = show(path, as_json=as_json, report=None, more=more)
    show_latched(notices)
    if again.difference:
        click.secho(f"Not the same when replayed: {again.difference}", fg="red", err=True)
        raise SystemExit(FAILED)
    same = f"{again.commands} commands are the same byte for byte, {again.strides} strides the same"
    click.secho(f"Replayed: {same}.", err=True)


# --- ``fes replay --dashboard``: a recording, or a session log, played to a browser -------------------------


class ReplayDashboard:
    """The dashboard of a replay: ``log`` for its loop, ``clock`` to pace it by; :meth:`publish` after every event.

    Problem: it cannot be served.
    """

    def __init__(
        self,
        folder: Path,
        session: Session,
        calibrations: Mapping[str, Calibration],
        header: Mapping[str, Any],
        log: Log,
        controller: Controller,
        gate: SafetyGate,
        port: int,
    ) -> None:
        self._stack = ExitStack()
        self._process = open_dashboard(folder, session, "replay", port, self._stack)
        recording = header.get("recording", {})
        rates_hz = {name: rate for name, rate in recording.get("rates_hz", {}).items() if name in calibrations}
        belt_mps = session.treadmill.belt_speed_mps if session.treadmill else recording.get("belt_speed_mps")
        stream = self._process.stream
        self.log = ReplayLog(log, stream, controller, gate, rates_hz, phase_sensors(calibrations), belt_mps)
        self._t_ns = 0
        said = "warning", "dashboard", "stopped on the dashboard"
        self.clock = StoppableClock(stream, lambda: self.log.note(Note(self._t_ns, *said)))

    def publish(self, t_ns: int) -> None:
        """Show what there is to show at the recording's time ``t_ns``."""
        self._t_ns = t_ns
        self.log.publish(t_ns, time.monotonic_ns())

    def close(self, ended: str) -> None:
        """End the dashboard; ``ended`` says how the replay did."""
        self.log.publish(self._t_ns, time.monotonic_ns(), last=True)
        self._process.say_at_the_end(f"The replay has ended: {ended}.")
        self._stack.close()


def play_log(path: Path, folder: Path, speed: float, port: int) -> None:
    """Play a session log's events to a dashboard, ``speed`` times as fast as they came; nothing is stimulated.

    Raises:
        Problem: the log cannot be read, or no dashboard can be served.
        SystemExit: stopped on the dashboard, or interrupted.
    """
    with failing(SessionLogError, ConfigError):
        record = read_session(path)
        session, calibrations, controller, gate, session_id = _decides(record, path)
    warm_up()
    shown = ReplayDashboard(folder, session, calibrations, record.header, ReplayOutput(), controller, gate, port)
    sink = LoggedSink(session_id, [])
    runner = Runner(controller, gate, sink, shown.log, time.perf_counter_ns)
    marks = deque(note for note in record.notes if note.source == MARK)
    ended = "interrupted"
    try:
        with Interrupt() as interrupt:

            def after(event: Event) -> None:
                while marks and marks[0].t_ns <= event.t_ns:
                    shown.log.note(marks.popleft())
                shown.publish(event.t_ns)
                interrupt.check()

            runner.run(sink.replay_events(paced(iter_events(path), shown.clock, speed)), after)
        ended = "complete"
    except KeyboardInterrupt:
        interrupted(": the log was not played to its end, and not checked.")
    finally:
        shown.close(ended)


TARGETS: Final = ("simulated", "none", "bus")


def refuse_settings_of_a_recording(*allowed: str) -> None:
    """A session log brings its own settings; one given here would change nothing, so say so.

    Problem: one was given that is not ``allowed``.
    """
    useless = given_options() - {"recording", "as_json", "dashboard", *allowed}
    for option in click.get_current_context().command.params:
        if option.name in useless:
            raise Problem(
                f"{option.opts[0]} has no meaning for a session log: it is replayed with the settings it holds, and "
                f"nothing is written. Leave the option out, or replay its recording instead."
            )


def show_what_is_left_out(
    session: Session, settings: Path | None, left_out: list[str], found: SensorCalibrations
) -> None:
    """What of recording and settings is not used, and why. Raises Problem: a channel's foot has no calibration."""
    for reason in found.missing.values():
        click.secho(f"Not calibrated, so not used: {reason}", fg="yellow", err=True)
    feet_known = phase_sensors(found.calibrations)
    if not session.channels:
        feet = ", ".join(sorted(feet_known))
        why = f"{settings} has no channel for a foot in this recording ({feet})" if settings else "no --session given"
        click.secho(f"Nothing is stimulated: {why}. Phases and strides only.", fg="yellow", err=True)
    if left_out and session.channels:
        names = ", ".join(left_out)
        click.secho(f"Left out, for the recording has no sensor on that foot: {names}.", fg="yellow", err=True)
    for channel in session.channels:
        if channel.foot not in feet_known:
            raise Problem(f"Channel {channel.name!r} follows the {channel.foot}, which cannot be calibrated.")


class MonotonicClock:
    """Real time."""

    def now_ns(self) -> int:
        """Monotonic time in ns."""
        return time.monotonic_ns()

    def wait_until_ns(self, t_ns: int) -> None:
        """Sleep until ``t_ns``; returns at once when that has passed."""
        left_ns = t_ns - time.monotonic_ns()
        if left_ns > 0:
            time.sleep(left_ns * 1e-9)


@dataclass(frozen=True, slots=True)
class Options:
    """How to replay."""

    session: Path | None = None
    out: Path = Path("out")
    speed: float | None = None
    stimulator: str = "simulated"
    arm_after_s: float = 0.5
    rearm_after_s: float | None = None
    as_json: bool = False
    report: bool = True
    calibration: Path | None = None
    dashboard: bool = False
    dashboard_port: int = 0
    dummy_load: bool = False


@click.command(name="replay")
@click.argument("recording", type=PATH)
@click.option("--session", type=PATH, help="Settings (TOML). Default: session.toml beside it.")
@click.option("--calibration", type=PATH, help="From fes calibrate. Default: from the recording.")
@out_option()
@click.option("--speed", type=Number(min=0.01), help="1 = as recorded. Default: as fast as it goes.")
@choice("--stimulator", of=TARGETS, help="bus: the session's own, as in `fes run`: a live session. IT STIMULATES.")
@click.option("--i-have-a-dummy-load", "dummy_load", is_flag=True, help="Nobody is connected to the stimulator.")
@click.option("--arm-after", "arm_after_s", type=Number(0), default=0.5, show_default=True, help="Operator arms (s).")
@click.option("--rearm-after", "rearm_after_s", type=Number(0), help="Operator arms again this long after a fault (s).")
@click.option("--json", "as_json", is_flag=True, help="Print the results as JSON.")
@click.option("--no-report", is_flag=True, help="Write no HTML report.")
@dashboard_options
def command(recording: Path, no_report: bool, **chosen: Any) -> None:
    """Replay RECORDING (CSV or Parquet with its sidecar) or a session log (.feslog).

    Prints the table of strides and a summary; writes the session log and the report. A session log is replayed from its
    own settings and must give the bytes that it recorded.

    --stimulator bus is a live session whose sensors are the recording: a person arms (a) and raises the intensity
    (+), or does so on the dashboard; SPACE, Ctrl-C, the stop file and the stop button stop.

    --dashboard shows it in a browser as it was, at recorded speed or --speed; the stop there ends the replay.

    When transitions and stimulation happen, against a truth and a baseline: fes timing.

    A gate that latched is reported last and is no failure: the exit code says whether the replay went through.

    Exit code: 0 all is well, 1 a check failed, 2 unusable input, 3 stopped early, 4 a fault of fes itself, 130
    interrupted.
    """
    options = Options(report=not no_report, **chosen)
    if options.stimulator == "bus":
        refuse_what_a_person_does(options)
    if recording.suffix != LOG_SUFFIX:
        need_extra("analysis")
        replay_recording(recording, options)
        return
    refuse_settings_of_a_recording(*(("speed", "out", "dashboard_port") if options.dashboard else ()))
    if options.dashboard:
        play_log(recording, fresh_folder(options.out, recording.stem), options.speed or 1.0, options.dashboard_port)
    replay_log(recording, as_json=options.as_json)


def replay_recording(path: Path, options: Options) -> Path:
    """Replay a recording and show the result; returns the session log's path.

    Raises:
        Problem: unusable input, a stimulator that is lost, a disk that is full.
        SystemExit: interrupted, or the stimulator did not deliver what was sent.
    """
    with failing(RecordingError, ConfigError, CalibrationError, SessionLogError):
        recording, settings, wanted, found = prepared(path, options.session, options.calibration)
        calibrations = found.calibrations
        session = session_for(recording, wanted)
    kept = {channel.number for channel in session.channels}
    left_out = [channel.name for channel in (wanted.channels if wanted else ()) if channel.number not in kept]
    show_what_is_left_out(session, settings, left_out, found)
    if options.stimulator == "bus" and session.channels:
        return _to_the_device(recording, session, calibrations, options, path.stem)
    speed = options.speed or (1.0 if options.dashboard else None)
    sha256 = digest(path)
    numbers = identity(sha256, session)
    folder = fresh_folder(options.out, path.stem)
    log_path = folder / f"session{LOG_SUFFIX}"
    header = log_header(recording, sha256, session, calibrations, numbers.session_id, utc_now())
    begin_ns = min(int(track.t_ns[0]) for track in recording.tracks.values())
    opened_with = numbers.session_id, numbers.boot_id, begin_ns, session.stimulation.validity_ms
    opening: AbstractContextManager[stimulators.Opened]
    if options.stimulator == "none" or not session.channels:
        opening = stimulators.no_stimulator(*opened_with)
    else:
        opening = stimulators.simulated(*opened_with, real_time=speed == 1.0, record=folder / "stimulator.jsonl")
    warm_up()
    with failing(StimulatorLost, BusError, SessionLogError, kind=StoppedEarly), opening as opened:
        ended = _go(recording, session, calibrations, opened, header, log_path, options, speed)
    if ended == "interrupted":
        interrupted(f"; stimulation is off. What was recorded is in {log_path}")
    page = folder / "report.html" if options.report else None
    show_latched(show(log_path, as_json=options.as_json, report=page))
    if ended == "different":
        click.secho("The stimulator did not deliver what was sent; see the summary.", fg="red", err=True)
        raise SystemExit(FAILED)
    if ended != "complete":
        raise StoppedEarly(ended)
    return log_path


def refuse_what_a_person_does(options: Options) -> None:
    """A real device is armed by a person, at the pace of the recording, and into a dummy load. Raises Problem."""
    if useless := given_options() & {"speed", "arm_after_s", "rearm_after_s"}:
        option = {"speed": "--speed", "arm_after_s": "--arm-after", "rearm_after_s": "--rearm-after"}[min(useless)]
        raise Problem(f"{option} has no meaning with --stimulator bus: a person arms, at recorded speed. Leave it out.")
    if not options.dummy_load:
        raise Problem(
            "--stimulator bus stimulates with what is connected. Connect a dummy load and nobody, then confirm with "
            "--i-have-a-dummy-load."
        )


def _to_the_device(
    recording: Recording, session: Session, calibrations: dict[str, Calibration], options: Options, name: str
) -> Path:
    """A live session with the recording for its sensors; a person arms. Returns the log's path; raises as `fes run`."""
    folder = fresh_folder(options.out, name)
    session = session.model_copy(update={"sensors": stimulators.worn_sensors(session, recording, calibrations)})
    needed = frozenset(str(phase_sensors(calibrations)[channel.foot]) for channel in session.channels)
    line = stimulators.RecordedSensors(recording, calibrations)
    length_s = max(recording.tracks[sensor].duration_s for sensor in calibrations) + CLOSING_S
    live = run.Options(duration_s=length_s, dashboard=options.dashboard, dashboard_port=options.dashboard_port)
    warm_up()
    with ExitStack() as stack:
        keys = standard_keys()
        if keys is not None:
            stack.enter_context(Terminal(keys))
        interrupt = stack.enter_context(Interrupt())
        supervisor = stack.enter_context(SupervisorProcess())
        streams = [SensorStream(line, SensorClock, ImuLost, needed)]
        log_path, ended = run.run_live(session, calibrations, streams, live, folder, keys, interrupt, supervisor, stack)
    run.said_how_it_ended(log_path, ended)
    show_latched(show(log_path, as_json=options.as_json, report=folder / "report.html" if options.report else None))
    record = read_session(log_path)
    until_ns = record.frames[-1].t_ns - ANSWER_WITHIN_NS  # what is answered after the end, nobody heard
    frames = [frame for frame in record.frames if frame.t_ns < until_ns]
    if session.stimulator.device == "can" and not stimulators.wire_truth(frames, record.statuses).ok:
        click.secho("The stimulator did not deliver what was sent; see the summary.", fg="red", err=True)
        raise SystemExit(FAILED)
    return log_path


def _go(
    recording: Recording,
    session: Session,
    calibrations: dict[str, Calibration],
    opened: stimulators.Opened,
    header: dict[str, Any],
    log_path: Path,
    options: Options,
    speed: float | None,
) -> str:
    """Run the loop over the recording; returns how it ended: complete, different, interrupted, or why it stopped."""
    log = SessionWriter(log_path, header)
    controller, gate = controller_and_gate(session, calibrations)
    shown = None
    if options.dashboard:
        port = options.dashboard_port
        shown = ReplayDashboard(log_path.parent, session, calibrations, header, log, controller, gate, port)
    runner = Runner(controller, gate, opened.stimulator, shown.log if shown else log, time.perf_counter_ns)
    events = armed_after(
        with_ticks(samples_of(recording, set(calibrations) | (set(recording.tracks) & set(SHANK_SENSORS)))),
        options.arm_after_s,
        session.stimulation.intensity,
        options.rearm_after_s,
        lambda: bool(gate.latched),
    )
    if speed is not None:
        events = paced(events, shown.clock if shown else MonotonicClock(), speed or 1.0)
    begin_ns = min(int(track.t_ns[0]) for track in recording.tracks.values())
    end_ns = max(int(track.t_ns[-1]) for track in recording.tracks.values())
    ended = "complete"
    summary: dict[str, Any] = {}
    try:
        for frame in opened.frames:
            log.frame(frame)
        for alive in opened.alive:
            runner.handle(alive)
        with Interrupt() as interrupt, replay_progress(recording.name, begin_ns, end_ns, options.as_json) as reached:

            def after(event: Event) -> None:
                log.flush_due(time.monotonic_ns())
                reached(event.t_ns)
                if shown:
                    shown.publish(event.t_ns)
                interrupt.check()

            runner.run(events, after)
        for reply in stimulators.last_answers(opened.stimulator, runner.t_ns):
            runner.handle(reply)
        if opened.answers:
            log.flush()
            so_far = read_session(log_path)
            truth = stimulators.wire_truth(so_far.frames, so_far.statuses)
            summary["wire"] = truth.to_dict()
            ended = "complete" if truth.ok else "different"
    except KeyboardInterrupt:
        ended = "interrupted"
    except StimulatorLost as error:
        ended = f"The stimulator was lost at {1e-9 * (runner.t_ns - begin_ns):.1f} s: {error}"
    finally:
        summary["ended"] = ended
        summary["samples"] = {foot: tracker.counts.to_dict() for foot, tracker in runner.controller.trackers.items()}
        log.close(summary)
        if shown:
            shown.close(ended)
    return ended
