"""The live source of events: lines to sensors and stimulator, and one poll over them, keys, control and stop inputs.

A line brings samples in the host's time and losses as events, and is opened again when it is lost. What is asked of
devices is stated here; the commands hand them in, so that the loop knows no driver.

Events come out in the order of their times, which are the host's monotonic clock when they were read; silence and
stalls are events too. Everything that has queued up while the loop was away is still given on, so that nothing is lost
to the estimator, with honest times: the gate sees by the sensors' own clocks how old it is.
"""

import select
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Final, Generic, Protocol, TypeVar

from fes import limits
from fes.control.clock_sync import BoundedClock, SensorClock
from fes.control.runner import TICK_NS
from fes.live.supervision import UNSENT, SessionOpened, StimulatorLine
from fes.signals import (
    Event,
    ImuSample,
    RawSample,
    StimAlive,
    StimCommand,
    StimOpened,
    StimStatus,
    SystemFault,
    Tick,
    WireFrame,
)


class Imu(Protocol):
    """One line to one or more sensors; see ``drivers.imu``."""

    @property
    def sensors(self) -> Sequence[str]:
        """Which sensors it brings."""

    @property
    def serials(self) -> Mapping[str, str]:
        """By sensor, the serial number of the device there, where it tells one."""

    @property
    def notices(self) -> Sequence[str]:
        """What the devices say of themselves that a person should know."""

    def fileno(self) -> int | None:
        """A descriptor that becomes readable with new samples; None where there is none."""

    def read(self, t_ns: int) -> Sequence[RawSample]:
        """All that has come; never waits."""

    def clock_answers(self) -> Sequence[tuple[str, int, int]]:
        """Of sensors by radio, since the last call: name, when it was asked for its time, what it said; ns."""

    def reopen(self) -> None:
        """Let go of the line and open it again; may wait, so it is called in a thread of its own."""

    def close(self) -> None:
        """Release the line."""


class Input(Protocol):
    """Anything else that can make something happen: keys, control messages, a stop file, a switch."""

    def fileno(self) -> int | None:
        """A descriptor to wait on; None: it is asked every turn."""

    def read_events(self, t_ns: int) -> list[Event]:
        """What it makes happen now; never waits, never raises."""


Port = TypeVar("Port")

FIRST_PAUSE_NS: Final = 250_000_000
LONGEST_PAUSE_NS: Final = 4_000_000_000


class Reopening(Generic[Port]):
    """Attempts at opening something, in a thread so that the loop goes on; pauses double from 0.25 s up to 4 s."""

    def __init__(self, opener: Callable[[], Port], t_ns: int) -> None:
        self._opener = opener
        self._pause_ns = FIRST_PAUSE_NS
        self._next_ns = t_ns + FIRST_PAUSE_NS
        self._thread: threading.Thread | None = None
        self._opened: list[Port] = []
        self.why_not = ""

    def poll(self, t_ns: int) -> Port | None:
        """Begin or collect an attempt; what was opened, once."""
        if self._thread is not None:
            if self._thread.is_alive():
                return None
            self._thread = None
            if self._opened:
                return self._opened.pop()
            self._next_ns = t_ns + self._pause_ns
            self._pause_ns = min(2 * self._pause_ns, LONGEST_PAUSE_NS)
        if t_ns >= self._next_ns:
            self._thread = threading.Thread(target=self._attempt, daemon=True)
            self._thread.start()
        return None

    def _attempt(self) -> None:
        try:
            self._opened.append(self._opener())
        except Exception as error:  # whatever a driver raises, the next attempt comes later
            self.why_not = str(error)


STUCK_NS: Final = 1_000_000_000  # a line, or a needed sensor on it, that was alive and is silent so long: opened again
EMPTY_READS: Final = 10  # in a row: one of nine of a terminal waits for what the kernel still has (serial_line.Waiting)


class SensorStream:
    """One line: its port while it is open, attempts at opening it again while it is not.

    ``clock`` makes a fresh clock: a device that was away may have restarted its own. ``lost`` is the exception that
    says that the line is gone; the loss of ``needed`` sensors must stop the stimulation. ``by_radio``: those of which a
    sample is given on only once it is known when it was measured at the earliest.
    """

    def __init__(
        self,
        port: Imu,
        clock: Callable[[], SensorClock],
        lost: type[Exception],
        needed: frozenset[str],
        by_radio: frozenset[str] = frozenset(),
    ) -> None:
        self.sensors = tuple(port.sensors)
        self.serials = dict(port.serials)
        self.port: Imu | None = port
        self._held, self._clock, self._lost = port, clock, lost
        self.needed = needed & set(self.sensors)
        self._by_radio = by_radio & set(self.sensors)
        self._clocks = self._fresh_clocks()
        self._newest_ns: int | None = None
        self._newest_of: dict[str, int] = {}  # by sensor, of those heard since the line was opened
        self._attempts: Reopening[Imu] | None = None
        self.losses = 0
        self.why_lost = ""  # while it is lost

    def fileno(self) -> int | None:
        """Readable with samples; None while the line is lost, or where there is nothing to wait on."""
        return None if self.port is None else self.port.fileno()

    @property
    def notices(self) -> Sequence[str]:
        """What the devices say of themselves; of a lost line nothing."""
        return () if self.port is None else self.port.notices

    @property
    def must_be_polled(self) -> bool:
        """Whether the line is open and has nothing to wait on."""
        return self.port is not None and self.port.fileno() is None

    def discard(self, t_ns: int) -> Iterator[Event]:
        """Let go of what has queued up; its arrival says nothing of when it was, so no clock may see it."""
        self._newest_ns = None  # nor is the time that nobody listened a silence
        self._newest_of.clear()
        empty = 0
        try:
            while self.port is not None and empty < EMPTY_READS:
                empty = 0 if self.port.read(t_ns) else empty + 1
        except self._lost as error:
            yield from self._lose(t_ns, str(error))

    def read(self, t_ns: int, clock_ns: Callable[[], int] | None = None) -> Iterator[Event]:
        """Samples since the last call, or the fault that the line is gone.

        With ``clock_ns`` a sample counts as arrived when the reading was over: taken for earlier than it was, even
        once, it would seem the least delayed of all, and all others old for a minute.
        """
        if self.port is None:
            return
        try:
            raw = self.port.read(t_ns)
        except self._lost as error:
            yield from self._lose(t_ns, str(error))
            return
        took_ns = 0 if clock_ns is None or not raw else max(clock_ns() - t_ns, 0)
        for sensor, asked_ns, said_ns in self.port.clock_answers() if self._by_radio else ():
            asked = self._clocks[sensor]
            if isinstance(asked, BoundedClock):
                asked.asked(asked_ns, said_ns)
        for sample in raw:
            self._newest_ns = self._newest_of[sample.sensor] = t_ns
            clock = self._clocks[sample.sensor]
            resets = clock.resets
            t_sensor_ns = clock.map(sample.t_host_ns + took_ns, sample.t_device_ns)
            if clock.resets != resets and sample.sensor in self.needed:
                # set, restarted, or all of it late for seconds: the new mapping cannot tell which, and would call late
                # samples fresh; on a line that is opened anew nothing is queued
                bounded = sample.sensor in self._by_radio
                or_else = "runs off by over 200 ppm" if bounded else "all that it sends comes late"
                yield from self._lose(t_ns, f"the clock of {sample.sensor} jumped, or {or_else}")
                return
            if t_sensor_ns is None:
                continue
            yield ImuSample(t_ns + took_ns, sample.sensor, t_sensor_ns, sample.acc_mps2, sample.gyr_radps)

    def supervise(self, t_ns: int) -> Iterator[Event]:
        """Notice that the line says nothing any more; go on opening a lost one."""
        if self.port is not None:
            if self._newest_ns is not None and t_ns - self._newest_ns >= STUCK_NS:
                yield from self._lose(t_ns, "nothing has come for a second")
                return
            for sensor in self.needed:  # in stance nobody asks the gate for anything: it would not notice in time
                if t_ns - self._newest_of.get(sensor, t_ns) >= STUCK_NS:
                    yield from self._lose(t_ns, f"nothing has come from {sensor} for a second")
                    return
        elif self._attempts is not None and (port := self._attempts.poll(t_ns)) is not None:
            self.port, self._attempts, self._newest_ns, self.why_lost = port, None, None, ""
            self._newest_of.clear()
            self._clocks = self._fresh_clocks()

    def _fresh_clocks(self) -> dict[str, SensorClock | BoundedClock]:
        return {sensor: BoundedClock() if sensor in self._by_radio else self._clock() for sensor in self.sensors}

    def close(self) -> None:
        """Release the line."""
        self.port = None
        self._held.close()

    def _lose(self, t_ns: int, why: str) -> Iterator[Event]:
        self.port = None
        self.losses += 1
        self._attempts = Reopening(self._reopened, t_ns)
        self.why_lost = f"{', '.join(self.sensors)}: sensor lost: {why}"[:200]
        if self.needed:
            yield SystemFault(t_ns, f"{', '.join(sorted(self.needed))}: sensor lost: {why}"[:200])

    def _reopened(self) -> Imu:
        self._held.reopen()
        for sensor, serial in self._held.serials.items():
            if serial != self.serials.get(sensor, serial):
                self._held.close()
                self.why_lost = f"{sensor}: sensor lost: another one answers ({serial}, it was {self.serials[sensor]})"
                raise self._lost(self.why_lost)
        return self._held


class ReopenedLine(StimulatorLine, Protocol):
    """One that can be opened again; see :class:`fes.live.supervision.SupervisedLine`."""

    def open(self, t_ns: int) -> SessionOpened:
        """Once it was closed; may wait, so it is called in a thread of its own."""


class LiveStimulator:
    """Wraps an open line; what it meets becomes events for the loop, stamped by ``clock_ns``, see :meth:`events`.

    ``lost`` is the exception that says that it is gone; it is opened again then. ``is_open``: whether commands go out.
    ``on_heard`` and ``on_frame`` get what belongs in the log beside commands and events.
    """

    def __init__(self, line: ReopenedLine, lost: type[Exception], clock_ns: Callable[[], int]) -> None:
        self.is_open = True
        self._line = line
        self._lost = lost
        self._clock_ns = clock_ns
        self._attempts: Reopening[SessionOpened] | None = None
        self._events: list[Event] = []
        self.unsent = 0
        self.on_heard: Callable[[int, bytes], None] = lambda t_ns, data: None
        self.on_frame: Callable[[WireFrame], None] = lambda frame: None

    @property
    def state(self) -> str:
        """ "open", or why it is not."""
        if self._attempts is None:
            return "open"
        return f"lost, is being opened again ({self._attempts.why_not})" if self._attempts.why_not else "lost"

    def send(self, command: StimCommand) -> WireFrame:
        """Write the command; a frame with identifier 0 where nothing went out.

        A process that was held up between deciding and sending must not send what was right a second ago: *on* older
        than the data it may rest on is left out and is a fault. Off always goes.
        """
        if self.is_open:
            late_ns = self._clock_ns() - command.t_ns
            if command.on and late_ns > limits.MAX_DATA_AGE_MS * 1_000_000:
                self._events.append(SystemFault(command.t_ns, f"a command was {late_ns / 1e6:.0f} ms late, not sent"))
            else:
                try:
                    frame = self._line.send(command)
                except self._lost as error:
                    self._lose(command.t_ns, error)
                else:
                    self.unsent += frame.identifier == UNSENT
                    return frame
        self.unsent += 1
        return WireFrame(command.t_ns, UNSENT, b"")

    def poll(self, t_ns: int) -> list[StimStatus | StimAlive]:
        """What has arrived; nothing from a line that is lost."""
        if not self.is_open:
            return []
        try:
            answers = self._line.poll(t_ns)
        except self._lost as error:
            self._lose(t_ns, error)
            return []
        if heard := self._line.heard:
            self.on_heard(t_ns, heard)
        return answers

    def events(self, t_ns: int) -> Iterator[Event]:
        """Losses and reopenings since the last call."""
        if self._attempts is not None and (opened := self._attempts.poll(t_ns)) is not None:
            self._attempts = None
            self.is_open = True
            for frame in opened.frames:
                self.on_frame(frame)
            self._events.append(StimOpened(t_ns, opened.session_id))
        while self._events:
            event = self._events.pop(0)
            yield SystemFault(t_ns, event.text) if isinstance(event, SystemFault) else event

    def add_fault(self, text: str) -> None:
        """The line itself has found what forbids stimulation."""
        self._events.append(SystemFault(0, text))

    def renew(self, t_ns: int) -> None:
        """Open the device again, under a new session identifier, though it was not lost."""
        if self.is_open:
            self._open_again(t_ns)

    def close(self) -> None:
        """Release the line."""
        if self.is_open:
            self._line.close()
            self.is_open = False

    def _open_again(self, t_ns: int) -> None:
        self.close()
        self._attempts = Reopening(lambda: self._line.open(self._clock_ns()), t_ns)

    def _lose(self, t_ns: int, error: Exception) -> None:
        self._open_again(t_ns)
        self._events.append(SystemFault(t_ns, f"stimulator lost: {error}"[:200]))


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
