"""Replaying a session log: the same events through the same loop must give the bytes that were recorded."""

from __future__ import annotations

from pathlib import Path

import click

from drivers.stimulator.byte_sink import ByteSink
from drivers.stimulator.can_codec import COMMAND_ID
from fes.cli.exits import FAILED, fail
from fes.cli.show import show
from fes.config import ConfigError
from fes.controller import Controller
from fes.estimation.foot import Outcome
from fes.gate import SafetyGate
from fes.journal import Note, SessionLogError, iter_events, read_session
from fes.replay import settings_of
from fes.runner import Runner
from fes.signals import Event, StimCommand, StrideResult, WireFrame
from statemachine.phases import PhaseChange


class Collected:
    """A log that only remembers: the frames and the outcomes."""

    def __init__(self) -> None:
        self.frames: list[WireFrame] = []
        self.outcomes: list[Outcome] = []

    def event(self, event: Event) -> None:
        """Known already."""

    def command(self, command: StimCommand, frame: WireFrame) -> None:
        """Keep the bytes."""
        self.frames.append(frame)

    def phase(self, change: PhaseChange) -> None:
        """Keep it."""
        self.outcomes.append(change)

    def stride(self, result: StrideResult) -> None:
        """Keep it."""
        self.outcomes.append(result)

    def note(self, note: Note) -> None:
        """Known already."""

    def latency(self, t_ns: int, latency_ns: int) -> None:
        """Another machine's business."""


def same_bytes(path: Path) -> tuple[int, str]:
    """Run a session log's events again; returns how many commands were compared and the first difference ("": none).

    Raises:
        SessionLogError, ConfigError: the log cannot be read, or is of another kind.
    """
    record = read_session(path)
    try:
        session, calibrations, session_id = settings_of(record.header, path)
    except (KeyError, TypeError) as error:
        raise SessionLogError(f"{path}: its header lacks {error}; it is no session log that can be replayed") from error
    stimulation = session.stimulation
    gate = SafetyGate(
        session.channels, max_data_age_ms=stimulation.max_data_age_ms, validity_ms=stimulation.validity_ms
    )
    collected = Collected()
    runner = Runner(Controller(session, calibrations), gate, ByteSink(session_id), collected, lambda: 0)
    for event in iter_events(path):
        runner.handle(event)
    if record.complete:
        runner.all_off()
    recorded = [frame for frame in record.frames if frame.identifier == COMMAND_ID]
    for number, (was, now) in enumerate(zip(recorded, collected.frames, strict=False), start=1):
        if was != now:
            return number, (
                f"command {number} at {was.t_ns} ns: recorded {was.data.hex()}, now {now.data.hex()} at {now.t_ns} ns"
            )
    if len(recorded) != len(collected.frames) and record.complete:
        return len(recorded), f"recorded {len(recorded)} commands, now {len(collected.frames)}"
    return len(recorded), ""


def replay_log(path: Path, *, as_json: bool) -> None:
    """Show a session log and check that it gives the same bytes again."""
    try:
        count, difference = same_bytes(path)
        show(path, as_json=as_json, report=None)
    except (SessionLogError, ConfigError) as error:
        fail(error)
    if difference:
        click.secho(f"Not the same bytes: {difference}", fg="red", err=True)
        raise SystemExit(FAILED)
    click.secho(f"Replayed: all {count} commands are the same, byte for byte.", err=True)
