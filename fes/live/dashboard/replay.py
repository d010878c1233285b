"""A replay on the dashboard: what it logs is shown as a session is, and a stop there ends it."""

import select
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Final

from fes.control.controller import Controller
from fes.control.runner import Log
from fes.gate import STOPPED, SafetyGate
from fes.live.commands import CommandKind, CommandRefused, command_of_message
from fes.live.dashboard.stream import DashboardStream
from fes.live.monitor import FRAME_NS, ShownLog
from fes.live.status import Status, percent_of
from fes.signals import Event, ImuSample

CHECK_NS: Final = 5_000_000


class ReplayLog(ShownLog):
    """The replay's log: passes everything on to the real one and shows it; ``rates_hz`` by sensor."""

    def __init__(
        self,
        log: Log,
        stream: DashboardStream,
        controller: Controller,
        gate: SafetyGate,
        rates_hz: Mapping[str, float],
        phase_sensor_of: Mapping[str, str],
        belt_speed_mps: float | None,
    ) -> None:
        super().__init__(log, phase_sensor_of, stream)
        self._stream = stream
        self._controller = controller
        self._gate = gate
        self._rates_hz = rates_hz
        self._belt_speed_mps = belt_speed_mps
        self._heard_ns: dict[str, int] = {}
        self._samples = 0
        self._next_ns = 0

    def event(self, event: Event) -> None:
        """As the log's."""
        super().event(event)
        if isinstance(event, ImuSample):
            self._heard_ns[event.sensor] = event.t_ns
            self._samples += 1

    def publish(self, t_ns: int, now_ns: int, *, last: bool = False) -> None:
        """Show where the replay is at its time ``t_ns``, if 100 ms have passed by the clock of ``now_ns``.

        The ``last`` time at once, or what came since the time before would never be shown.
        """
        if now_ns < self._next_ns and not last:
            return
        self._next_ns = now_ns + FRAME_NS
        feet = {
            sensor: self.foot_status(
                sensor, self._controller, rate_hz, (t_ns - self._heard_ns.get(sensor, t_ns)) * 1e-6
            )
            for sensor, rate_hz in self._rates_hz.items()
        }
        if self._gate.latched:
            state = "stopped" if self._gate.latched == STOPPED else "fault"
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
            on=bool(self.on),
            feet=feet,
            belt_speed_mps=self._belt_speed_mps,
            incline_percent=percent_of(self._controller.incline),
            latency_p50_ms=self.latencies.percentile_ms(50),
            latency_p99_ms=self.latencies.percentile_ms(99),
            samples=self._samples,
            stimulator="replay",
        )
        self._stream.send(status.encode())


class StoppableClock:
    """Real time, waited for with an ear to the dashboard: a stop there is ``on_stop`` and KeyboardInterrupt here."""

    def __init__(self, stream: DashboardStream, on_stop: Callable[[], None]) -> None:
        self._stream = stream
        self._on_stop = on_stop
        self._checked_ns = 0

    def now_ns(self) -> int:
        """Monotonic time in ns."""
        return time.monotonic_ns()

    def wait_until_ns(self, t_ns: int) -> None:
        """Wait; returns at once when the time has passed. KeyboardInterrupt: the dashboard's stop was pressed."""
        while (left_ns := t_ns - time.monotonic_ns()) > 0:
            if self._stream.lost:
                time.sleep(left_ns * 1e-9)
            elif select.select([self._stream.link], [], [], left_ns * 1e-9)[0]:
                self.check_stop()
        if time.monotonic_ns() - self._checked_ns > CHECK_NS:  # late already: it never waits, but it checks
            self.check_stop()

    def check_stop(self) -> None:
        """Whether a stop has come. KeyboardInterrupt: it has."""
        self._checked_ns = time.monotonic_ns()
        for message in self._stream.receive():
            with suppress(CommandRefused):
                if command_of_message(message).kind is CommandKind.STOP:
                    self._on_stop()
                    raise KeyboardInterrupt
