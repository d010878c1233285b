"""The only loop: source → gate sees → controller decides → gate judges → stimulator → log. Live and replay.

Whatever ends it, the last thing it does is to switch every channel off. Functions beside it turn one iterator of events
into another; only :func:`paced` waits, on the clock that it is handed.
"""

import re
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import KW_ONLY, dataclass
from typing import Final, Protocol

from fes.control.controller import Controller
from fes.gate import STOPPED, SafetyGate
from fes.session_log import Note
from fes.signals import (
    NS_PER_S,
    Event,
    ImuSample,
    OperatorAct,
    OperatorAction,
    StimAlive,
    StimCommand,
    StimRequest,
    StimStatus,
    StrideResult,
    Tick,
    WireFrame,
)
from statemachine.phases import Phase, PhaseChange

TICK_NS = 10_000_000
MEASURES_NOTED = "thresholds"  # the source of the notes of each stride's measures
CLOSING_S = 0.5  # ticks after the last sample, so that what follows from silence is seen too


class Clock(Protocol):
    """Something to wait on."""

    def now_ns(self) -> int:
        """Monotonic time in ns."""

    def wait_until_ns(self, t_ns: int) -> None:
        """Return at ``t_ns`` or, when that has passed, at once."""


def with_ticks(events: Iterable[Event]) -> Iterator[Event]:
    """Fill silences of more than one and a half tick periods with ticks, and close with half a second of them."""
    last_ns: int | None = None
    for event in events:
        while last_ns is not None and event.t_ns - last_ns > 1.5 * TICK_NS:
            last_ns += TICK_NS
            yield Tick(last_ns)
        last_ns = event.t_ns
        yield event
    if last_ns is not None:
        for k in range(1, int(CLOSING_S * NS_PER_S) // TICK_NS + 1):
            yield Tick(last_ns + k * TICK_NS)


def armed_after(
    events: Iterable[Event],
    after_s: float,
    intensity: float,
    rearm_after_s: float | None = None,
    latched: Callable[[], bool] = lambda: False,
) -> Iterator[Event]:
    """Act as the operator of a replay: arm once the recording has run for ``after_s``, then set the intensity.

    With ``rearm_after_s`` the operator also arms again that long after a fault has latched.
    """
    started = False
    arm_ns: int | None = None
    for event in events:
        if not started:
            started, arm_ns = True, event.t_ns + int(after_s * NS_PER_S)
        yield event
        if arm_ns is not None and event.t_ns >= arm_ns:
            yield OperatorAct(event.t_ns, OperatorAction.ARM)
            yield OperatorAct(event.t_ns, OperatorAction.SET_INTENSITY, intensity)
            arm_ns = None
        elif arm_ns is None and rearm_after_s is not None and latched():
            arm_ns = event.t_ns + int(rearm_after_s * NS_PER_S)


def paced(events: Iterable[Event], clock: Clock, speed: float) -> Iterator[Event]:
    """Let each event through when its time has come, ``speed`` times as fast as recorded."""
    origin_ns: int | None = None
    start_ns = 0
    for event in events:
        if origin_ns is None:
            origin_ns, start_ns = event.t_ns, clock.now_ns()
        clock.wait_until_ns(start_ns + int((event.t_ns - origin_ns) / speed))
        yield event


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


@dataclass(eq=False)
class Runner:
    """Ties controller, gate, stimulator and log together.

    ``clock_ns`` only measures how long a decision took; no decision depends on it. ``from_reading``: the events are
    stamped by the same clock, so the time is measured from a sample's reading.
    """

    controller: Controller
    gate: SafetyGate
    stimulator: Stimulator
    log: Log
    clock_ns: Callable[[], int]
    _: KW_ONLY
    from_reading: bool = False

    def __post_init__(self) -> None:
        self.t_ns = 0  # of the newest event
        self._refused: dict[int, str] = {}  # why, "" for let out: every channel ever commanded, in that order
        self._latched = ""
        self._flagged: set[str] = set()

    def run(self, source: Iterable[Event], after: Callable[[Event], None]) -> None:
        """Go through all events; the stimulator's replies join them. ``after`` is called when an event is dealt with.

        An exception from any part, ``after`` included, latches the gate and is passed on after everything is off.
        """
        try:
            for event in source:
                begin_ns = event.t_ns if self.from_reading else self.clock_ns()
                self.handle(event)
                if isinstance(event, ImuSample):
                    self.log.latency(event.t_ns, self.clock_ns() - begin_ns)
                for reply in self.stimulator.poll(event.t_ns):
                    self.handle(reply)
                after(event)
            self.all_off()
        except BaseException as error:
            self._stop(error)
            raise

    def _stop(self, error: BaseException) -> None:
        """Off first, then words; what else goes wrong by now must not hide the first error."""
        interrupted = isinstance(error, KeyboardInterrupt)
        reason = "interrupted" if interrupted else f"stopped: {type(error).__name__}: {error}"[:200]
        self.gate.latch(self.t_ns, reason)
        self._latched = self.gate.latched
        with suppress(Exception):
            self.all_off()
        with suppress(Exception):
            self.log.note(Note(self.t_ns, "info" if interrupted else "fault", "runner", reason))

    def handle(self, event: Event) -> None:
        """One event, from the log to the wire."""
        self.t_ns = event.t_ns
        self.log.event(event)
        self.gate.observe(event)
        decision = self.controller.step(event)
        if decision.requests:
            self._send(event.t_ns, decision.requests)
        for outcome in decision.outcomes:
            if isinstance(outcome, StrideResult):
                self.log.stride(outcome)
            else:
                self.log.phase(outcome)
                if outcome.destination is Phase.STANCE:
                    self._note_thresholds(event.t_ns, outcome.foot)
        for report in decision.reports:
            text = f"channel {report.channel}: {report.text}"
            self.log.note(Note(event.t_ns, report.severity, "tuning", text))
        for note in decision.notes:
            self.log.note(note)
        if len(self.gate.flagged) > len(self._flagged):
            for sensor in sorted(self.gate.flagged.keys() - self._flagged):  # the first fault; the gate counts the rest
                self._flagged.add(sensor)
                text = f"{self.gate.flagged[sensor].fault}; {sensor} drives no channel, stimulation goes on"
                self.log.note(Note(event.t_ns, "warning", "gate", text))
        if self.gate.latched != self._latched:
            self._latched = self.gate.latched
            if self._latched:
                severity = "info" if self._latched == STOPPED else "fault"  # the stop itself is noted by who made it
                self.log.note(Note(event.t_ns, severity, "gate", f"off until armed again: {self._latched}"))
                self.all_off()  # not at the next command: now
            else:
                self.log.note(Note(event.t_ns, "info", "gate", "armed again"))

    def _note_thresholds(self, t_ns: int, sensor: str) -> None:
        """This person's measures, which follow the strides; every value is kept."""
        for tracker in self.controller.trackers.values():
            if tracker.foot == sensor:
                values = ", ".join(f"{name} {value:.4g}" for name, value in tracker.measures.items())
                self.log.note(Note(t_ns, "info", MEASURES_NOTED, f"{sensor}: {values}"))

    def all_off(self) -> None:
        """Switch off every channel that was ever commanded; each is tried, then the first error is raised.

        In the order in which they are commanded: a device that delivers all with the last one's command must have
        been sent *off* for the others by then.
        """
        errors: list[Exception] = []
        for channel in list(self._refused):
            try:
                self._send(self.t_ns, (StimRequest(channel, on=False),))
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
        frame = self.stimulator.send(command)
        self.log.command(command, frame)
        self._refused[command.channel] = command.refused
        # a refusal whose numbers alone have moved on is the same refusal
        if command.refused and _NUMBER.sub("", command.refused) != _NUMBER.sub("", before):
            text = f"channel {command.channel} refused: {command.refused}"
            self.log.note(Note(command.t_ns, "warning", "gate", text))
