"""Replaying a session log: the same events through the same loop must give what was recorded, bytes first."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import click

from drivers.stimulator.can_codec import COMMAND_ID, OPEN_ID, PROTOCOL_VERSION
from drivers.stimulator.can_port import ByteSink
from fes import __version__
from fes.cli.common.exits import FAILED, fail
from fes.cli.common.show import show, show_latched
from fes.cli.replay.stimulators import SerialSink, repeats_bytes
from fes.cli.replay.timing import show_timing
from fes.config import ConfigError
from fes.control.controller import CURRENT_STEP_MA, Controller
from fes.control.replay import settings_of
from fes.control.runner import Runner
from fes.estimation.sensor_choice import shank_phase_sensors
from fes.evaluation.log_replay import ReplayOutput, first_difference
from fes.evaluation.timing_check import TimingError, TimingOptions, check_replayed
from fes.gate import gate_of
from fes.live.stimulator import UNSENT
from fes.session_log import SessionLogError, SessionRecord, iter_events, iter_inputs, read_session
from fes.signals import Event, StimAlive, StimCommand, StimOpened, StimStatus, WireFrame

LARGEST_STEP_MA: Final = 10.0
REPORTED: Final = ("commands", "strides", "difference")


class LoggedSink:
    """Encodes as the session did: not what it could not send, and under a new identifier after it opened again."""

    def __init__(self, session_id: int, sent: list[bool]) -> None:
        self._sink = ByteSink(session_id)
        self._sent = sent
        self._number = 0

    def opened(self, session_id: int) -> None:
        """The stimulator was opened again."""
        self._sink = ByteSink(session_id)

    def replay_events(self, events: Iterable[Event]) -> Iterator[Event]:
        """The events, and where the stimulator was opened again, that."""
        for event in events:
            if isinstance(event, StimOpened):
                self.opened(event.session_id)
            yield event

    def send(self, command: StimCommand) -> WireFrame:
        """The frame that the session sent, or left out."""
        number, self._number = self._number, self._number + 1
        if number < len(self._sent) and not self._sent[number]:
            return WireFrame(command.t_ns, UNSENT, b"")
        return self._sink.send(command)

    def poll(self, t_ns: int) -> list[StimStatus | StimAlive]:
        """Its answers are events in the log."""
        return []


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

    Raises:
        SessionLogError, ConfigError: the log cannot be read, or is of another kind.
    """
    record = read_session(path)
    try:
        session, calibrations, session_id = settings_of(record.header, path)
        current_step_ma = _step_ma(record.header.get("current_step_ma", CURRENT_STEP_MA))
        up = {sensor: each.up for sensor, each in calibrations.items()}
        gate = gate_of(session, up, shank_phase_sensors(calibrations), current_step_ma)
        controller = Controller(session, calibrations, current_step_ma=current_step_ma)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        if isinstance(error, ConfigError):
            raise
        version = record.header.get("fes_version", "unknown")
        raise SessionLogError(
            f"{path}: was left by fes {version} and cannot be replayed by fes {__version__}: its header does not fit "
            f"({error}). `fes report` still shows it; replay its recording instead."
        ) from error
    now = ReplayOutput()
    sink: LoggedSink | SerialSink
    if repeats_bytes(session, record.header):
        sink = SerialSink(session)
        recorded = sink.logged_commands(record.frames)
        sink.sent = [frame.identifier != UNSENT for frame in recorded]
        events = sink.replay_events(iter_inputs(path), session_id)
        compares_bytes = True
    else:
        recorded = [frame for frame in record.frames if frame.identifier in (COMMAND_ID, UNSENT)]
        sink = LoggedSink(session_id, [frame.identifier != UNSENT for frame in recorded])
        events = sink.replay_events(iter_events(path))
        compares_bytes = session.stimulator.device == "can"  # what another driver made of a command is not known
    runner = Runner(controller, gate, sink, now, lambda: 0)
    for event in events:
        runner.handle(event)
    if record.complete and not _cut_off(record):
        runner.all_off()
    difference = (compares_bytes and _other_protocol(record)) or first_difference(
        record, recorded if compares_bytes else None, now, runner.t_ns
    )
    return Repeated(
        min(len(record.commands), len(now.commands)), min(len(record.strides), len(now.strides)), difference, now
    )


def _cut_off(record: SessionRecord) -> bool:
    """Whether the log was recovered from one without its end: what the session did last is not in it."""
    recovered = record.summary.get("recovered")
    return isinstance(recovered, dict) and bool(recovered.get("end_missing"))


def _step_ma(stated: object) -> float:
    if isinstance(stated, bool) or not isinstance(stated, (int, float)) or not 0.0 < stated <= LARGEST_STEP_MA:
        raise ValueError(f"current_step_ma = {stated!r} is no step of a current in mA")
    return float(stated)


def _other_protocol(record: SessionRecord) -> str:
    opening = next((frame.data for frame in record.frames if frame.identifier == OPEN_ID), b"")
    if len(opening) > 1 and opening[1] % 16 != PROTOCOL_VERSION:
        return f"its frames are of the protocol's version {opening[1] % 16}, this program speaks {PROTOCOL_VERSION}"
    return ""


def replay_log(path: Path, *, as_json: bool, timing: TimingOptions | None = None) -> None:
    """Show a session log and check that it gives the same bytes, phases and strides again, or the same ``timing``."""
    try:
        again = repeat(path)
        more: dict[str, Any] = {"replayed": {name: getattr(again, name) for name in REPORTED}}
        checked = check_replayed(path, timing, again.now.phases, again.now.commands) if timing else None
        notices = show(
            path, as_json=as_json, report=None, more=more | ({"timing": checked.to_json()} if checked else {})
        )
    except (SessionLogError, ConfigError, TimingError) as error:
        fail(error)
    show_latched(notices)
    if again.difference:
        click.secho(f"Not the same when replayed: {again.difference}", fg="red", err=True)
        if not checked:
            raise SystemExit(FAILED)
    else:
        same = f"{again.commands} commands are the same byte for byte, {again.strides} strides the same"
        click.secho(f"Replayed: {same}.", err=True)
    if checked:
        show_timing(checked, as_json=as_json)
