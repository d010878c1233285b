"""A replay on the page: what it logs is shown as a session is, and a stop there ends it."""

from __future__ import annotations

import select
import time
from collections.abc import Callable, Mapping
from typing import Final

from fes.control.controller import Controller
from fes.control.runner import Log
from fes.gate import SafetyGate
from fes.live.commands import Ask, CommandRefused, order_of_message
from fes.live.dashboard.message_handler import AT_ONCE
from fes.live.dashboard.message_handler import ORDERS_LONGEST as LONGEST
from fes.live.dashboard.stream import DashboardStream
from fes.live.monitor import FRAME_NS, Timing
from fes.live.status import FootStatus, Status
from fes.session_log import Note
from fes.signals import Event, ImuSample, StimCommand, StrideResult, WireFrame
from statemachine.phases import PhaseChange

LOOK_NS: Final = 5_000_000


class ShownLog:
    """The replay's log: passes everything on to the real one and shows it.

    Args:
        rates_hz: by sensor, as the recording says.
        drivers: by foot, the sensor that tells its phases.
    """

    def __init__(
        self,
        log: Log,
        feed: DashboardStream,
        controller: Controller,
        gate: SafetyGate,
        rates_hz: Mapping[str, float],
        drivers: Mapping[str, str],
        belt_speed_mps: float | None,
    ) -> None:
        self._log = log
        self._feed = feed
        self._controller = controller
        self._gate = gate
        self._rates_hz = rates_hz
        self._foot_of = {sensor: foot for foot, sensor in drivers.items()}
        self._belt_speed_mps = belt_speed_mps
        self._latencies = Timing()
        self._heard_ns: dict[str, int] = {}
        self._strides: dict[str, StrideResult] = {}
        self._on: set[int] = set()
        self._samples = 0
        self._next_ns = 0

    def event(self, event: Event) -> None:
        """As the log's."""
        self._log.event(event)
        if isinstance(event, ImuSample):
            self._heard_ns[event.sensor] = event.t_ns
            self._samples += 1
        self._feed.event(event)

    def command(self, command: StimCommand, frame: WireFrame) -> None:
        """As the log's."""
        self._log.command(command, frame)
        (self._on.add if command.on else self._on.discard)(command.channel)
        self._feed.command(command)

    def phase(self, change: PhaseChange) -> None:
        """As the log's."""
        self._log.phase(change)
        self._feed.phase(change)

    def stride(self, result: StrideResult) -> None:
        """As the log's."""
        self._log.stride(result)
        self._strides[result.foot] = result
        self._feed.stride(result)

    def note(self, note: Note) -> None:
        """As the log's."""
        self._log.note(note)
        self._feed.note(note)

    def latency(self, t_ns: int, latency_ns: int) -> None:
        """As the log's."""
        self._log.latency(t_ns, latency_ns)
        self._latencies.add(latency_ns)

    def tell(self, t_ns: int, now_ns: int, *, last: bool = False) -> None:
        """Show where the replay is at its time ``t_ns``, if 100 ms have passed by the clock of ``now_ns``.

        The ``last`` time at once, or what came since the time before would never be shown.
        """
        if now_ns < self._next_ns and not last:
            return
        self._next_ns = now_ns + FRAME_NS
        feet = {sensor: self._foot(sensor, t_ns) for sensor in self._rates_hz}
        if self._gate.latched:
            state = "stopped" if self._gate.latched == "emergency stop" else "fault"
        elif not self._gate.armed:
            state = "shadow"
        else:
            state = "running" if any(foot.walking for foot in feet.values()) else "armed"
        status = Status(
            t_ns=t_ns,
            state=state,
            message="replay of a recording",
            fault=self._gate.latched,
            intensity=self._controller.intensity,
            on=bool(self._on),
            feet=feet,
            belt_speed_mps=self._belt_speed_mps,
            latency_p50_ms=self._latencies.percentile_ms(50),
            latency_p99_ms=self._latencies.percentile_ms(99),
            samples=self._samples,
            stimulator="replay",
        )
        self._feed.tell(status.encode())

    def _foot(self, sensor: str, t_ns: int) -> FootStatus:
        foot = self._foot_of.get(sensor, "")
        stride = self._strides.get(foot) or self._strides.get(sensor)
        return FootStatus(
            phase=self._controller.phase(foot).name.lower() if foot else "",
            walking=bool(foot) and self._controller.walking(foot),
            strides=stride.number if stride else 0,
            stride_length_m=round(stride.stride_length_m, 3) if stride else None,
            speed_mps=round(stride.speed_mps, 3) if stride else None,
            rate_hz=self._rates_hz[sensor],
            age_ms=round((t_ns - self._heard_ns.get(sensor, t_ns)) * 1e-6, 1),
        )


class StoppableClock:
    """Real time, waited for with an ear to the page: a stop there is a KeyboardInterrupt here, at once.

    Args:
        stopped: told before that happens.
    """

    def __init__(self, feed: DashboardStream, stopped: Callable[[], None]) -> None:
        self._feed = feed
        self._stopped = stopped
        self._looked_ns = 0

    def now_ns(self) -> int:
        """Monotonic time in ns."""
        return time.monotonic_ns()

    def wait_until_ns(self, t_ns: int) -> None:
        """Wait; returns at once when the time has passed.

        Raises:
            KeyboardInterrupt: the page's stop was pressed.
        """
        while (left_ns := t_ns - time.monotonic_ns()) > 0:
            if self._feed.lost:
                time.sleep(left_ns * 1e-9)
            elif select.select([self._feed.link], [], [], left_ns * 1e-9)[0]:
                self.look()
        if time.monotonic_ns() - self._looked_ns > LOOK_NS:  # late already: it never waits, but it looks
            self.look()

    def look(self) -> None:
        """Whether a stop has come.

        Raises:
            KeyboardInterrupt: it has.
        """
        self._looked_ns = time.monotonic_ns()
        for _ in range(AT_ONCE):
            if self._feed.lost:
                return
            try:
                message = self._feed.link.recv(LONGEST)
            except BlockingIOError:
                return
            except OSError:
                message = b""
            if not message:
                self._feed.lose("its process has ended")
            elif _is_stop(message):
                self._stopped()
                raise KeyboardInterrupt


def _is_stop(message: bytes) -> bool:
    try:
        return order_of_message(message).ask is Ask.STOP
    except CommandRefused:
        return False
