"""The live source of events: one poll over sensors, keys, control and stop inputs; silence and stalls are events.

Events come out in the order of their times, which are the host's monotonic clock when they were read. Everything that
has queued up while the loop was away is still given on, so that nothing is lost to the estimator, with honest times:
the gate sees by the sensors' own clocks how old it is.
"""

import select
from bisect import bisect_left
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from statistics import median
from typing import Any, Final

from fes.control.runner import TICK_NS
from fes.live.sensors import Input, SensorStream
from fes.live.stimulator import LiveStimulator
from fes.signals import Event, FootSwitchEvent, ImuSample, SystemFault, Tick
from statemachine.phases import Phase, PhaseChange

PAIRED_WITHIN_NS: Final = 300_000_000  # half of a quick stride


class SwitchComparison:
    """How a foot switch differs from the sensor's phases: contact against loading response, release against swing."""

    def __init__(self) -> None:
        self._switch: dict[tuple[str, str], list[int]] = defaultdict(list)
        self._phase: dict[tuple[str, str], list[int]] = defaultdict(list)

    def add_switch(self, event: FootSwitchEvent) -> None:
        """The switch closed or opened."""
        if event.pressed is not None:
            self._switch[event.foot, "contact" if event.pressed else "release"].append(event.t_ns)

    def add_phase(self, change: PhaseChange) -> None:
        """The sensor's foot came into a phase."""
        what = {Phase.LOADING_RESPONSE: "contact", Phase.SWING: "release"}.get(change.destination)
        if what is not None:
            self._phase[change.foot, what].append(change.t_ns)

    def to_dict(self) -> dict[str, Any]:
        """By foot and kind: the sensor's delay behind the switch (ms; median, least, most), and what had no pair."""
        found: dict[str, Any] = {}
        for (foot, what), switched in self._switch.items():
            of_phases = sorted(self._phase[foot, what])
            delays_ms = [delay * 1e-6 for t_ns in switched if (delay := _nearest(of_phases, t_ns)) is not None]
            entry: dict[str, Any] = {"pairs": len(delays_ms), "switch_only": len(switched) - len(delays_ms)}
            entry["sensor_only"] = max(len(of_phases) - len(delays_ms), 0)
            if delays_ms:
                entry["delay_ms"] = [round(f(delays_ms), 1) for f in (median, min, max)]
            found.setdefault(foot, {})[what] = entry
        return found


def _nearest(times_ns: list[int], t_ns: int) -> int | None:
    """How much later than ``t_ns`` the nearest of the times is; None if none is near enough."""
    at = bisect_left(times_ns, t_ns)
    near = [other - t_ns for other in times_ns[max(at - 1, 0) : at + 1]]
    best = min(near, key=abs, default=None)
    return best if best is not None and abs(best) <= PAIRED_WITHIN_NS else None


STALL_NS: Final = 40_000_000  # data must not be older when used, so a loop that was away longer has lost its ground
CHECK_AFTER: Final = 32  # samples of a backlog between two checks of the clock and the stop inputs
CHECK_NS: Final = 5_000_000
CHECKS: Final = 3  # in a row, at most
PROMPT_NS: Final = 500_000
POLLED_NS: Final = 1_000_000  # between two looks at a device that has nothing to wait on


@dataclass(eq=False)
class LiveSource:
    """Iterate it once; it ends when ``ended``, asked every turn, says so.

    A stall is a fault while ``current_allowed``; otherwise it is only counted. ``on_lateness`` gets how late each wait
    without an event ended (ns). ``on_stall`` gets (when, how long) of a stall that began while current was allowed and
    is found when it no longer is: what came of it, an answer of the stimulator's perhaps, was dealt with first and has
    switched off.
    """

    streams: Sequence[SensorStream]
    inputs: Sequence[Input]
    stimulator: LiveStimulator | None
    clock_ns: Callable[[], int]
    ended: Callable[[], bool]
    current_allowed: Callable[[], bool]
    on_lateness: Callable[[int], None] = lambda late_ns: None
    on_stall: Callable[[int, int], None] = lambda t_ns, away_ns: None
    stalls: int = 0
    longest_stall_ns: int = 0

    def __post_init__(self) -> None:
        # edge by edge: what has been read empty is not asked again, which for a terminal would wait for a kernel worker
        # of ordinary priority (see drivers.stimulator.serial_line.Waiting); everything is read every turn anyway
        self._epoll = select.epoll()
        self._registered: dict[SensorStream | Input, int] = {}
        self._checked_ns = self._stamp_ns = self.clock_ns()  # the last look at everything; the newest event's time
        self._was_allowed = False  # at that look

    def exclude_from_stalls(self, time_ns: int) -> None:
        """The loop has just done something on purpose that took so long; it counts in no stall."""
        self._checked_ns += time_ns

    def __iter__(self) -> Iterator[Event]:
        try:
            yield from self._turns()
        finally:
            self._epoll.close()

    def _turns(self) -> Iterator[Event]:
        for stream in self.streams:  # what queued up before anybody listened belongs to no session
            yield from stream.discard(self.clock_ns())
        self._checked_ns = self._stamp_ns = heard_ns = self.clock_ns()
        while not self.ended():
            self._register()
            self._wait(heard_ns + TICK_NS)
            yield from self._check_until_prompt()
            for stream in self.streams:
                for event in self._restamped(stream.read(self._checked_ns, self.clock_ns)):
                    heard_ns = self._stamp_ns
                    yield event
            if self.clock_ns() - heard_ns >= TICK_NS:
                yield from self._check_inputs()
                heard_ns = self._checked_ns
                yield Tick(heard_ns)
            for stream in self.streams:
                yield from stream.supervise(self._stamp_ns)

    def _restamped(self, events: Iterator[Event]) -> Iterator[Event]:
        """A backlog takes time to go through: check now and then, and never let time run backward."""
        for number, event in enumerate(events, start=1):
            if isinstance(event, ImuSample):
                if event.t_ns - self._checked_ns > CHECK_NS:  # held up between check and reading
                    yield from self._check_inputs()
                self._stamp_ns = max(self._stamp_ns, event.t_ns)
                if event.t_ns != self._stamp_ns:
                    event = ImuSample(self._stamp_ns, event.sensor, event.t_sensor_ns, event.acc_mps2, event.gyr_radps)
            yield event
            if number % CHECK_AFTER == 0 and self.clock_ns() - self._checked_ns > CHECK_NS:
                yield from self._check_inputs()

    def _check_until_prompt(self) -> Iterator[Event]:
        """What was found may take long to deal with; samples that came meanwhile must not be dated before it."""
        for _ in range(CHECKS):
            yield from self._check_inputs()
            if self.clock_ns() - self._checked_ns <= PROMPT_NS:
                return

    def _check_inputs(self) -> Iterator[Event]:
        """What the clock, the stop inputs and the stimulator's line have to say; a stop waits for nobody."""
        now_ns = self.clock_ns()
        away_ns, self._checked_ns = now_ns - self._checked_ns, now_ns
        self._stamp_ns = now_ns
        was_allowed, self._was_allowed = self._was_allowed, self.current_allowed()
        if away_ns > STALL_NS:
            self.stalls += 1
            self.longest_stall_ns = max(self.longest_stall_ns, away_ns)
            if self._was_allowed:
                yield SystemFault(now_ns, stall_text(away_ns))
            elif was_allowed:
                self.on_stall(now_ns, away_ns)
        for each in self.inputs:
            yield from each.read_events(now_ns)
        if self.stimulator is not None:
            yield from self.stimulator.events(now_ns)

    def _wait(self, deadline_ns: int) -> None:
        if any(stream.must_be_polled for stream in self.streams):
            deadline_ns = min(deadline_ns, self.clock_ns() + POLLED_NS)
        left_ns = deadline_ns - self.clock_ns()
        if not self._epoll.poll(max(left_ns, 0) * 1e-9) and left_ns > 0:
            self.on_lateness(self.clock_ns() - deadline_ns)

    def _register(self) -> None:
        """Wait on what is open now and has something to wait on."""
        everything: list[SensorStream | Input] = [*self.streams, *self.inputs]
        for each in everything:
            descriptor, known = each.fileno(), self._registered.get(each)
            if descriptor == known:
                continue
            if known is not None:
                del self._registered[each]
                with suppress(OSError, ValueError):  # closed with its line
                    self._epoll.unregister(known)
            if descriptor is not None:
                self._epoll.register(descriptor, select.EPOLLIN | select.EPOLLET)
                self._registered[each] = descriptor


def stall_text(away_ns: int) -> str:
    """A stall for people."""
    return f"controller stalled for {away_ns / 1e6:.0f} ms"
