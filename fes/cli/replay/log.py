"""Replaying a session log: the same events through the same loop must give what was recorded, bytes first."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Final

import click

from drivers.stimulator.can_codec import COMMAND_ID, OPEN_ID, PROTOCOL_VERSION
from drivers.stimulator.can_port import ByteSink
from fes import __version__
from fes.cli.common.exits import FAILED, fail
from fes.cli.common.show import show, tell_latched
from fes.cli.replay.stimulators import SerialSink, repeats_bytes
from fes.cli.replay.timing import TimingOptions, check_replayed, tell
from fes.config import ConfigError
from fes.control.controller import CURRENT_STEP_MA, Controller
from fes.control.replay import settings_of
from fes.control.runner import Runner
from fes.estimation.sensor_choice import shank_phase_sensors
from fes.gate import gate_of
from fes.live.stimulator import UNSENT
from fes.session_log import Note, SessionLogError, SessionRecord, iter_events, iter_inputs, read_session
from fes.signals import Event, StimAlive, StimCommand, StimOpened, StimStatus, StrideResult, WireFrame
from statemachine.phases import PhaseChange

SAME: Final = 1e-6  # of a stride's numbers: another processor's last bit is no difference, another sample is
LARGEST_STEP_MA: Final = 10.0
REPORTED: Final = ("commands", "strides", "difference")
ENDED_WHOLE: Final = ("complete", "different", "interrupted")  # every event logged was dealt with to its end


class Collected:
    """A log that only remembers what came out."""

    def __init__(self) -> None:
        self.commands: list[StimCommand] = []
        self.frames: list[WireFrame] = []
        self.phases: list[PhaseChange] = []
        self.strides: list[StrideResult] = []

    def event(self, event: Event) -> None:
        """Known already."""

    def command(self, command: StimCommand, frame: WireFrame) -> None:
        """Keep both."""
        self.commands.append(command)
        self.frames.append(frame)

    def phase(self, change: PhaseChange) -> None:
        """Keep it."""
        self.phases.append(change)

    def stride(self, result: StrideResult) -> None:
        """Keep it."""
        self.strides.append(result)

    def note(self, note: Note) -> None:
        """Known already."""

    def latency(self, t_ns: int, latency_ns: int) -> None:
        """Another machine's business."""


class LoggedSink:
    """Encodes as the session did: not what it could not send, and under a new identifier after it opened again."""

    def __init__(self, session_id: int, sent: list[bool]) -> None:
        self._sink = ByteSink(session_id)
        self._sent = sent
        self._number = 0

    def opened(self, session_id: int) -> None:
        """The stimulator was opened again."""
        self._sink = ByteSink(session_id)

    def told(self, events: Iterable[Event]) -> Iterator[Event]:
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
    now: Collected


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
    now = Collected()
    sink: LoggedSink | SerialSink
    if repeats_bytes(session, record.header):
        sink = SerialSink(session)
        recorded = sink.logged_commands(record.frames)
        sink.sent = [frame.identifier != UNSENT for frame in recorded]
        events = sink.told(iter_inputs(path), session_id)
        compares_bytes = True
    else:
        recorded = [frame for frame in record.frames if frame.identifier in (COMMAND_ID, UNSENT)]
        sink = LoggedSink(session_id, [frame.identifier != UNSENT for frame in recorded])
        events = sink.told(iter_events(path))
        compares_bytes = session.stimulator.device == "can"  # what another driver made of a command is not known
    runner = Runner(controller, gate, sink, now, lambda: 0)
    for event in events:
        runner.handle(event)
    if record.complete and not _cut_off(record):
        runner.all_off()
    whole = record.complete and record.summary.get("ended") in ENDED_WHOLE
    difference = (
        (_frames_differ(record, recorded, now.frames, runner.t_ns, whole) if compares_bytes else "")
        or _commands_differ(record.commands, now.commands, whole)
        or _phases_differ(record.phases, now.phases, whole)
        or _strides_differ(record.strides, now.strides, whole)
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


def _frames_differ(
    record: SessionRecord, recorded: list[WireFrame], now: list[WireFrame], end_ns: int, whole: bool
) -> str:
    opening = next((frame.data for frame in record.frames if frame.identifier == OPEN_ID), b"")
    if len(opening) > 1 and opening[1] % 16 != PROTOCOL_VERSION:
        return f"its frames are of the protocol's version {opening[1] % 16}, this program speaks {PROTOCOL_VERSION}"
    for number, (was, is_now) in enumerate(zip(recorded, now, strict=False)):
        if was == is_now:
            continue
        rest = record.commands[number:]
        if not whole and all(not command.on and command.t_ns == end_ns for command in rest):
            return ""  # the session stopped here and switched off
        return (
            f"command {number + 1}: recorded {was.data.hex()} at {was.t_ns} ns, now {is_now.data.hex()} at "
            f"{is_now.t_ns} ns"
        )
    if whole and len(recorded) != len(now):
        return f"{len(recorded)} commands are recorded, now there are {len(now)}"
    return ""


def _commands_differ(recorded: list[StimCommand], now: list[StimCommand], whole: bool) -> str:
    for number, (was, is_now) in enumerate(zip(recorded, now, strict=False), start=1):
        if was == is_now:
            continue
        if not whole and all(not command.on and command.t_ns >= now[-1].t_ns for command in recorded[number - 1 :]):
            return ""  # the session stopped here and switched off
        return f"command {number}: recorded {was}, now {is_now}"
    if whole and len(recorded) != len(now):
        return f"{len(recorded)} commands are recorded, now there are {len(now)}"
    return ""


def _phases_differ(recorded: list[PhaseChange], now: list[PhaseChange], whole: bool) -> str:
    for number, (was, is_now) in enumerate(zip(recorded, now, strict=False), start=1):
        if was != is_now:
            return f"phase change {number}: recorded {_words(was)}, now {_words(is_now)}"
    if whole and len(recorded) != len(now):
        return f"{len(recorded)} phase changes are recorded, now there are {len(now)}"
    return ""


def _words(change: PhaseChange) -> str:
    return f"{change.foot} into {change.destination.name} at {change.t_ns} ns"


def _strides_differ(recorded: list[StrideResult], now: list[StrideResult], whole: bool) -> str:
    names = [field.name for field in fields(StrideResult) if field.compare]
    for was, is_now in zip(recorded, now, strict=False):
        for name in names:
            one, other = getattr(was, name), getattr(is_now, name)
            if not _same(one, other):
                return f"stride {was.number} of the {was.foot}: {name} is recorded as {one}, now {other}"
    if whole and len(recorded) != len(now):
        return f"{len(recorded)} strides are recorded, now there are {len(now)}"
    return ""


def _same(one: object, other: object) -> bool:
    if isinstance(one, float) and isinstance(other, float):
        return math.isclose(one, other, rel_tol=SAME, abs_tol=SAME) or (math.isnan(one) and math.isnan(other))
    return one == other


def replay_log(path: Path, *, as_json: bool, timing: TimingOptions | None = None) -> None:
    """Show a session log and check that it gives the same bytes, phases and strides again, or the same ``timing``."""
    try:
        again = repeat(path)
        more: dict[str, Any] = {"replayed": {name: getattr(again, name) for name in REPORTED}}
        checked = check_replayed(path, timing, again.now.phases, again.now.commands) if timing else None
        notices = show(
            path, as_json=as_json, report=None, more=more | ({"timing": checked.to_json()} if checked else {})
        )
    except (SessionLogError, ConfigError) as error:
        fail(error)
    tell_latched(notices)
    if again.difference:
        click.secho(f"Not the same when replayed: {again.difference}", fg="red", err=True)
        if not checked:
            raise SystemExit(FAILED)
    else:
        same = f"{again.commands} commands are the same byte for byte, {again.strides} strides the same"
        click.secho(f"Replayed: {same}.", err=True)
    if checked:
        tell(checked, as_json=as_json)
