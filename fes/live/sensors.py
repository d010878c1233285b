"""A line to sensors as the loop sees it: samples in the host's time, losses as events, opened again when it is lost.

What the live loop asks of devices; the commands hand them in, so that the loop knows no driver.
"""

import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Final, Generic, Protocol, TypeVar

from fes.control.clock_sync import BoundedClock, SensorClock
from fes.signals import Event, ImuSample, RawSample, StimAlive, StimCommand, StimStatus, SystemFault, WireFrame


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


class StimulatorLine(Protocol):
    """An open stimulator; see ``drivers.stimulator.port``."""

    @property
    def heard(self) -> bytes:
        """What the last ``poll`` read, where the bytes that go out depend on that: it belongs in the log."""

    def send(self, command: StimCommand) -> WireFrame:
        """Write at once."""

    def poll(self, t_ns: int) -> list[StimStatus | StimAlive]:
        """What has arrived."""

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
