"""The only loop: source → gate sees → controller decides → gate judges → stimulator → log. Live and replay.

Whatever ends it, the last thing it does is to switch every channel off.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from contextlib import suppress
from typing import Final, Protocol

from fes.control.controller import Controller
from fes.gate import SafetyGate
from fes.session_log import Note
from fes.signals import Event, ImuSample, StimAlive, StimCommand, StimRequest, StimStatus, StrideResult, WireFrame
from statemachine.phases import PhaseChange

_NUMBER: Final = re.compile(r"[-+]?\d[\d.e+-]*")


class Stimulator(Protocol):
    """What the loop needs of a stimulator; see ``drivers.stimulator.port``."""

    def send(self, command: StimCommand) -> WireFrame:
        """Write the command at once; what went out."""

    def poll(self, t_ns: int) -> list[StimStatus | StimAlive]:
        """What has arrived, stamped ``t_ns``; never waits."""


class Log(Protocol):
    """What the loop needs of the session log; see ``fes.session_log``."""

    def event(self, event: Event) -> None:
        """An event, before it is handled."""

    def command(self, command: StimCommand, frame: WireFrame) -> None:
        """A command and its bytes, after they went out."""

    def phase(self, change: PhaseChange) -> None:
        """A phase change."""

    def stride(self, result: StrideResult) -> None:
        """A stride's result."""

    def note(self, note: Note) -> None:
        """Something a person should know."""

    def latency(self, t_ns: int, latency_ns: int) -> None:
        """From the sample's release to the last byte written."""


class Runner:
    """Ties controller, gate, stimulator and log together.

    Args:
        clock_ns: only for measuring how long a decision took; no decision depends on it.
        from_reading: the events are stamped by the same clock, so the time is measured from a sample's reading.
    """

    def __init__(
        self,
        controller: Controller,
        gate: SafetyGate,
        stimulator: Stimulator,
        log: Log,
        clock_ns: Callable[[], int],
        *,
        from_reading: bool = False,
    ) -> None:
        self.controller = controller
        self.gate = gate
        self._stimulator = stimulator
        self._log = log
        self._clock_ns = clock_ns
        self._from_reading = from_reading
        self._refused: dict[int, str] = {}  # why, "" for let out: every channel ever commanded, in that order
        self._latched = ""
        self._flagged: set[str] = set()
        self._t_ns = 0

    @property
    def t_ns(self) -> int:
        """Time of the newest event."""
        return self._t_ns

    def run(self, source: Iterable[Event], after: Callable[[Event], None]) -> None:
        """Go through all events; the stimulator's replies join them. ``after`` is called when an event is dealt with.

        An exception from any part, ``after`` included, latches the gate and is passed on after everything is off.
        """
        try:
            self._go_through(source, after)
            self.all_off()
        except BaseException as error:
            self._stop(error)
            raise

    def _go_through(self, source: Iterable[Event], after: Callable[[Event], None]) -> None:
        for event in source:
            begin_ns = event.t_ns if self._from_reading else self._clock_ns()
            self.handle(event)
            if isinstance(event, ImuSample):
                self._log.latency(event.t_ns, self._clock_ns() - begin_ns)
            for reply in self._stimulator.poll(event.t_ns):
                self.handle(reply)
            after(event)

    def _stop(self, error: BaseException) -> None:
        """Off first, then words; what else goes wrong by now must not hide the first error."""
        interrupted = isinstance(error, KeyboardInterrupt)
        reason = "interrupted" if interrupted else f"stopped: {type(error).__name__}: {error}"[:200]
        self.gate.latch(self._t_ns, reason)
        self._latched = self.gate.latched
        with suppress(Exception):
            self.all_off()
        with suppress(Exception):
            self._log.note(Note(self._t_ns, "info" if interrupted else "fault", "runner", reason))

    def handle(self, event: Event) -> None:
        """One event, from the log to the wire."""
        self._t_ns = event.t_ns
        self._log.event(event)
        self.gate.observe(event)
        decision = self.controller.step(event)
        if decision.requests:
            self._send(event.t_ns, decision.requests)
        for outcome in decision.outcomes:
            if isinstance(outcome, StrideResult):
                self._log.stride(outcome)
            else:
                self._log.phase(outcome)
        for report in decision.reports:
            text = f"channel {report.channel}: {report.text}"
            self._log.note(Note(event.t_ns, report.severity, "tuning", text))
        if len(self.gate.flagged) > len(self._flagged):
            for sensor in sorted(self.gate.flagged.keys() - self._flagged):  # the first fault; the gate counts the rest
                self._flagged.add(sensor)
                text = f"{self.gate.flagged[sensor].fault}; {sensor} drives no channel, stimulation goes on"
                self._log.note(Note(event.t_ns, "warning", "gate", text))
        if self.gate.latched != self._latched:
            self._latched = self.gate.latched
            if self._latched:
                self._log.note(Note(event.t_ns, "fault", "gate", f"off until armed again: {self._latched}"))
                self.all_off()  # not at the next command: now
            else:
                self._log.note(Note(event.t_ns, "info", "gate", "armed again"))

    def all_off(self) -> None:
        """Switch off every channel that was ever commanded; each is tried, then the first error is raised.

        In the order in which they are commanded: a device that delivers all with the last one's command must have
        been sent *off* for the others by then.
        """
        errors: list[Exception] = []
        for channel in list(self._refused):
            try:
                self._send(self._t_ns, (StimRequest(channel, on=False),))
            except Exception as error:
                errors.append(error)
        if errors:
            raise errors[0]

    def _send(self, t_ns: int, requests: tuple[StimRequest, ...]) -> None:
        """Judge all, then send: what one of them latches holds for those let out before it, too."""
        commands = [self.gate.judge(t_ns, request) for request in requests]
        for command in commands:
            if command.on and self.gate.latched:
                command = self.gate.judge(t_ns, StimRequest(command.channel, on=False))
            self._deliver(command)

    def _deliver(self, command: StimCommand) -> None:
        # first: a command that fails half-way may have gone out all the same
        before = self._refused.setdefault(command.channel, "")
        frame = self._stimulator.send(command)
        self._log.command(command, frame)
        self._refused[command.channel] = command.refused
        # a refusal whose numbers alone have moved on is the same refusal
        if command.refused and _NUMBER.sub("", command.refused) != _NUMBER.sub("", before):
            text = f"channel {command.channel} refused: {command.refused}"
            self._log.note(Note(command.t_ns, "warning", "gate", text))
