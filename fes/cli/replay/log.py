"""Replaying a session log: the same events through the same loop must give what was recorded, bytes first."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, NamedTuple

import click

from drivers.stimulator.can_codec import COMMAND_ID, OPEN_ID, PROTOCOL_VERSION
from fes import __version__
from fes.calibration.recording import SensorCalibrations, calibrate_phase_sensors, stored_calibrations
from fes.cli.common import FAILED, failing
from fes.cli.replay.stimulators import LoggedSink, SerialSink, polled_every_ns, repeats_bytes
from fes.cli.show import show, show_latched
from fes.config import ConfigError, Session, load_session
from fes.control.controller import CURRENT_STEP_MA, Controller
from fes.control.replay import refuse_long_silence, session_for, settings_of
from fes.control.runner import Runner
from fes.estimation.sensor_choice import Calibration, shank_phase_sensors
from fes.evaluation.log_comparison import ReplayOutput, first_difference
from fes.gate import SafetyGate, gate_of
from fes.live.supervision import OWN, UNSENT
from fes.recording import Recording, read_recording
from fes.session_log import SessionLogError, SessionRecord, iter_events, iter_inputs, read_session
from fes.signals import Event

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
        self.session, controller, gate, session_id = _decides(self.record, path)
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


def _decides(record: SessionRecord, path: Path) -> tuple[Session, Controller, SafetyGate, int]:
    """Settings, controller, gate and the stimulator's session of a log."""
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
    return session, controller, gate, session_id


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
