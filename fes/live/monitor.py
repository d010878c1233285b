"""What people are told while a session runs, gathered where the log passes by; sending it never waits."""

from __future__ import annotations

import socket
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Final, Protocol

import numpy as np

from fes.control.controller import Controller
from fes.gate import SafetyGate
from fes.live.inputs import printable
from fes.live.log_pipe import PipedLog
from fes.live.notices import Notices, tuning_status
from fes.live.operator import Operator
from fes.live.sensor_monitor import SensorMonitor
from fes.live.source import SwitchComparison
from fes.live.status import FootStatus, Status
from fes.session_log import Note
from fes.signals import Event, FootSwitchEvent, ImuSample, StimAlive, StimCommand, StimStatus, StrideResult, WireFrame
from statemachine.phases import PhaseChange

FRAME_NS: Final = 100_000_000
KEPT: Final = 4096  # latencies: eight seconds of one sensor at 500 Hz
EDGES_MS: Final = (0.1, 0.2, 0.5, 1.0, 2.0, 3.0, 5.0, 10.0, 20.0, 40.0)


class Timing:
    """The newest few thousand times in a ring, and a histogram of all of them."""

    def __init__(self) -> None:
        self._ring = np.zeros(KEPT)
        self.count = 0
        self.most_ms = 0.0
        self._over = [0] * len(EDGES_MS)

    def add(self, value_ns: int) -> None:
        """Take one in."""
        value_ms = value_ns * 1e-6
        self._ring[self.count % KEPT] = value_ms
        self.count += 1
        if value_ms > self.most_ms:
            self.most_ms = value_ms
        for number, edge_ms in enumerate(EDGES_MS):
            if value_ms <= edge_ms:
                break
            self._over[number] += 1

    def percentile_ms(self, percent: float) -> float | None:
        """Of the newest; None while there is none."""
        return float(np.percentile(self._ring[: min(self.count, KEPT)], percent)) if self.count else None

    def to_dict(self) -> dict[str, object]:
        """For the session log: how many took longer than each edge."""
        over = {f"{edge_ms:g}": over for edge_ms, over in zip(EDGES_MS, self._over, strict=True)}
        return {"count": self.count, "most_ms": round(self.most_ms, 3), "longer_than_ms": over}


class Page(Protocol):
    """What a browser's page is told; see ``fes.live.dashboard.server``.

    ``lost``: why it is told nothing any more. ``dropped``: how many frames it missed.
    """

    lost: str
    dropped: int

    def event(self, event: Event) -> None:
        """As the log's."""

    def command(self, command: StimCommand) -> None:
        """As the log's."""

    def phase(self, change: PhaseChange) -> None:
        """As the log's."""

    def stride(self, result: StrideResult) -> None:
        """As the log's."""

    def note(self, note: Note) -> None:
        """As the log's."""

    def tell(self, status: bytes) -> None:
        """Send the status and what has gathered; never waits."""


class Monitor:
    """The loop's log: passes everything on to the real one and remembers what a status needs.

    Args:
        watches: by sensor; they are fed here.
        drivers: by foot, the sensor that tells its phases.
        view: the socket of the process that shows it; None where there is none.
        publish: further listeners.
        remarks: what a person should know though nothing is latched; they are told of every event here.
    """

    def __init__(
        self,
        log: PipedLog,
        watches: Mapping[str, SensorMonitor],
        drivers: Mapping[str, str],
        view: socket.socket | None,
        publish: Callable[[bytes], None] | None = None,
        remarks: Notices | None = None,
    ) -> None:
        self.log = log
        self.latencies, self.lateness = Timing(), Timing()
        self.dropped_frames = 0
        self.page: Page | None = None
        self._missed_by_lost_page = 0
        self.switches = SwitchComparison()
        self.answered_ns: int | None = None
        self.device_fault = ""
        self.arrivals: dict[str, Timing] = {sensor: Timing() for sensor in watches}
        self.watches = watches
        self._foot_of = {sensor: foot for foot, sensor in drivers.items()}
        self._view = view
        self._publish = publish
        self._remarks = remarks
        self._strides: dict[str, StrideResult] = {}
        self._on: set[int] = set()
        self._next_ns = 0

    # --- the loop's log ----------------------------------------------------------------------------------

    def event(self, event: Event) -> None:
        """As the log's."""
        self.log.event(event)
        if self._remarks is not None:
            self._remarks.take(event)
        if isinstance(event, ImuSample):
            if (watch := self.watches.get(event.sensor)) is not None:
                watch.note(event)
                # later than the sensor's own clock says; both stamps are in the log, for every sample
                self.arrivals[event.sensor].add(event.t_ns - event.t_sensor_ns)
        elif isinstance(event, (StimAlive, StimStatus)):
            self.answered_ns = event.t_ns
            if isinstance(event, StimAlive):
                self.device_fault = event.fault
        elif isinstance(event, FootSwitchEvent):
            self.switches.switch(event)
        if self.page is not None:
            self.page.event(event)

    def command(self, command: StimCommand, frame: WireFrame) -> None:
        """As the log's."""
        self.log.command(command, frame)
        (self._on.add if command.on else self._on.discard)(command.channel)
        if self.page is not None:
            self.page.command(command)

    def phase(self, change: PhaseChange) -> None:
        """As the log's."""
        self.log.phase(change)
        self.switches.phase(change)
        if self.page is not None:
            self.page.phase(change)

    def stride(self, result: StrideResult) -> None:
        """As the log's."""
        self.log.stride(result)
        self._strides[result.foot] = result
        if self.page is not None:
            self.page.stride(result)

    def note(self, note: Note) -> None:
        """As the log's."""
        if not note.text.isascii():
            note = replace(note, text=printable(note.text))  # a name in it may be any bytes: that must end no session
        self.log.note(note)
        if self.page is not None:
            self.page.note(note)

    def latency(self, t_ns: int, latency_ns: int) -> None:
        """As the log's."""
        self.log.latency(t_ns, latency_ns)
        self.latencies.add(latency_ns)

    @property
    def dropped_page_frames(self) -> int:
        """Frames that a page did not take in time."""
        return self._missed_by_lost_page + (self.page.dropped if self.page is not None else 0)

    # --- the status --------------------------------------------------------------------------------------

    def tell(
        self, t_ns: int, operator: Operator, controller: Controller, gate: SafetyGate, stimulator: str = ""
    ) -> None:
        """Send the status if 100 ms have passed; a listener that does not keep up misses frames."""
        if t_ns < self._next_ns:
            return
        self._next_ns = t_ns + FRAME_NS
        status = Status(
            t_ns=t_ns,
            state=str(operator.state),
            message=operator.message,
            fault=gate.latched,
            intensity=controller.intensity,
            channel=operator.channel,
            on=bool(self._on),
            feet={sensor: self._foot(sensor, t_ns, controller) for sensor in self.watches},
            belt_speed_mps=operator.belt_speed_mps,
            latency_p50_ms=self.latencies.percentile_ms(50),
            latency_p99_ms=self.latencies.percentile_ms(99),
            lateness_p99_ms=self.lateness.percentile_ms(99),
            samples=sum(watch.count for watch in self.watches.values()),
            stimulator=stimulator,
            dropped_frames=self.dropped_frames,
            tuning=tuning_status(controller.tuning),
            stops=operator.stops,
            remarks=self._remarks.now() if self._remarks else [],
        )
        datagram = status.encode()
        if self._view is not None:
            try:
                self._view.send(datagram)
            except BlockingIOError:
                self.dropped_frames += 1
            except OSError:  # the view has gone; nobody else needs it
                self._view.close()
                self._view = None
                self.note(Note(t_ns, "warning", "view", "the terminal view has ended; the session goes on"))
        if self.page is not None:
            self.page.tell(datagram)
            if self.page.lost:
                self._missed_by_lost_page = self.page.dropped
                operator.message = f"the page has ended ({self.page.lost}): no stop there; the session goes on"
                self.page = None
                self.note(Note(t_ns, "warning", "page", operator.message))
        if self._publish is not None:
            self._publish(datagram)

    def _foot(self, sensor: str, t_ns: int, controller: Controller) -> FootStatus:
        watch, foot = self.watches[sensor], self._foot_of.get(sensor)
        stride = self._strides.get(sensor) or self._strides.get(foot or "")
        age_ms = watch.age_ms(t_ns)
        return FootStatus(
            phase=controller.phase(foot).name.lower() if foot else "",
            walking=foot is not None and controller.walking(foot),
            strides=stride.number if stride else 0,
            stride_length_m=round(stride.stride_length_m, 3) if stride else None,
            speed_mps=round(stride.speed_mps, 3) if stride else None,
            rate_hz=watch.rate_hz(t_ns),
            age_ms=round(min(age_ms, 1e6), 1),
        )
