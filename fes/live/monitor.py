"""What people see while a session runs, gathered where the log passes by; sending it never waits."""

from __future__ import annotations

import socket
from bisect import bisect_left
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from statistics import median
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from fes.control.controller import Controller
from fes.control.runner import Log
from fes.gate import SafetyGate
from fes.live.inputs import printable
from fes.live.operator import Operator
from fes.live.sensor_monitor import SensorMonitor, SideCheck
from fes.live.source import SensorStream
from fes.live.status import FootStatus, Status, TuningStatus, percent_of, remedy
from fes.session_log import Note
from fes.signals import (
    GROUND_ACTS,
    NS_PER_S,
    Event,
    FootSwitchEvent,
    ImuSample,
    OperatorAct,
    OperatorAction,
    StimAlive,
    StimCommand,
    StimOpened,
    StimStatus,
    StrideResult,
    WireFrame,
)
from fes.stimulation.envelope import BurstParameters, difference
from fes.stimulation.ground import GroundWatch
from fes.stimulation.tuning.session import Tuners
from statemachine.phases import Phase, PhaseChange

if TYPE_CHECKING:
    from fes.live.dashboard.stream import DashboardStream

FRAME_NS: Final = 100_000_000
REFUSED_NS: Final = 150_000_000  # a missing answer is reported again within 45 ms and a command's period or two
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
        self.most_ms = max(self.most_ms, value_ms)
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


class Electrodes:
    """Which channels' electrodes are not known yet: some stimulators report an open lead only with a pulse.

    Args:
        channels: those of the session.
        detected_from_ma: the least current whose answer reports an open lead, 0 for any pulse; None: the stimulator
            reports it by itself, so that nothing is ever unknown.
    """

    def __init__(self, channels: Iterable[int], detected_from_ma: float | None) -> None:
        self._channels = tuple(sorted(channels)) if detected_from_ma is not None else ()
        self._detected_from_ma = detected_from_ma or 0.0
        self._unknown = set(self._channels)

    def add_event(self, event: Event) -> None:
        """An answer without a fault at such a current makes known; one that was away may have been rewired."""
        if isinstance(event, StimStatus):
            if event.on and not event.fault and event.current_ma >= max(self._detected_from_ma, 1e-9):
                self._unknown.discard(event.channel)
        elif isinstance(event, StimOpened):
            self._unknown = set(self._channels)

    def unknown(self) -> str:
        """Which are not known yet, for people; "" when all are."""
        if not self._unknown:
            return ""
        at = f" at {self._detected_from_ma:g} mA" if self._detected_from_ma else ""
        which = ", ".join(map(str, sorted(self._unknown)))
        return f"electrode not known until the first pulse{at} (channel {which})"


SHOWN_NS: Final = 5 * NS_PER_S  # after the newest faulty sample; the log has the first, and its end how many


class Notices:
    """What a person should know though nothing is latched: shown with every status, logged when it begins.

    Faulty samples and lost lines of sensors that no channel follows, what sensors say of themselves, electrodes of
    which nothing is known yet, and what the controller says ``of_feet``. A line goes when what it tells of is over.
    ``lasting``: what else holds until the session ends.
    """

    def __init__(self, gate: SafetyGate, electrodes: Electrodes, of_feet: Callable[[], list[str]]) -> None:
        self.electrodes = electrodes
        self.streams: Sequence[SensorStream] = ()
        self.lasting: list[str] = []
        self.log = ""  # what its disk is behind with
        self.proof: Callable[[], str] = str  # what a person has to show before arming
        self.witness: Callable[[], list[str]] = list  # what it says of the foot sensors
        self._gate = gate
        self._of_feet = of_feet
        self._losses: dict[SensorStream, int] = {}

    def now(self, t_ns: int) -> list[str]:
        """All that holds at ``t_ns``."""
        flags = [
            f"{sensor}: {flag.samples} faulty samples, the newest: {flag.fault}; it drives no channel"
            for sensor, flag in self._gate.flagged.items()
            if t_ns - flag.t_ns < SHOWN_NS
        ]
        lost = (stream.why_lost for stream in self.streams)
        of_session = self.electrodes.unknown(), self.log, self.proof(), *self.lasting
        of_sensors = (notice for stream in self.streams for notice in stream.notices)
        return list(filter(None, (*self._of_feet(), *flags, *lost, *of_sensors, *self.witness(), *of_session)))

    def new_losses(self) -> list[str]:
        """Lines lost since the last call whose loss is no fault; the others' are events."""
        new = []
        for stream in self.streams:
            if stream.losses != self._losses.get(stream, 0):
                self._losses[stream] = stream.losses
                if not stream.needed:
                    new.append(f"{stream.why_lost or ', '.join(stream.sensors)}; it drives no channel")
        return new


def tuning_status(tuning: Tuners) -> dict[str, TuningStatus]:
    """Every channel by its number, also those that only have a ledger."""
    return {str(number): _channel_status(tuning, number) for number in tuning.ledger.electrodes}


def _channel_status(tuning: Tuners, number: int) -> TuningStatus:
    dose, tuner = tuning.ledger.electrodes[number], tuning.tuners.get(number)
    charge = TuningStatus(
        step_uc=round(dose.steps_uc[-1], 1) if dose.steps_uc else 0.0,
        minute_uc=round(dose.this_minute_uc, 1),
        session_uc=round(dose.session_uc, 1),
    )
    if tuner is None:
        return charge
    texts = {kind: report.text for (channel, kind), report in tuning.latest.items() if channel == number}
    changes = [
        tuning.latest[number, kind] for kind in ("change", "roll_back", "fault") if (number, kind) in tuning.latest
    ]
    newest = max(changes, key=lambda report: report.t_ns, default=None)
    return replace(
        charge,
        mode=tuner.tuning.mode,
        frozen=tuner.frozen,
        now=describe_parameters(tuner.parameters),
        suggestion="" if tuner.pending is None else difference(tuner.parameters, tuner.pending),
        why=texts.get("suggestion", "") if tuner.pending is not None else "",
        last_change="" if newest is None else newest.text,
        last_change_ns=0 if newest is None else newest.t_ns,
        hint=texts.get("fault", "") or texts.get("hint", ""),
    )


def describe_parameters(parameters: BurstParameters) -> str:
    """Current and pulse width for people."""
    return f"{parameters.current_ma:.1f} mA, {parameters.mean_width_us:.0f} µs"


class ShownLog:
    """A loop's log that passes everything on, to the real one first, and remembers what a status needs.

    ``phase_sensor_of``: by foot, the sensor that its phases come from.
    """

    def __init__(self, log: Log, phase_sensor_of: Mapping[str, str], dashboard: DashboardStream | None = None) -> None:
        self.dashboard = dashboard
        self.latencies = Timing()
        self.on: set[int] = set()
        self._log = log
        self._foot_of = {sensor: foot for foot, sensor in phase_sensor_of.items()}
        self._strides: dict[str, StrideResult] = {}
        self._ground: dict[str, GroundWatch] = {}
        self._uneven: set[str] = set()
        self.free_ground = False  # then there is nothing to tell of it
        self._ground_said_ns: int | None = None  # by a person, in the session

    def event(self, event: Event) -> None:
        """As the log's."""
        self._log.event(event)
        if isinstance(event, OperatorAct) and event.action in GROUND_ACTS:
            self.free_ground = event.action is OperatorAction.FREE_GROUND
            self._ground_said_ns = event.t_ns
            self._ground.clear()
            self._uneven.clear()
        if self.dashboard is not None:
            self.dashboard.event(event)

    def command(self, command: StimCommand, frame: WireFrame) -> None:
        """As the log's."""
        self._log.command(command, frame)
        (self.on.add if command.on else self.on.discard)(command.channel)
        if self.dashboard is not None:
            self.dashboard.command(command)

    def phase(self, change: PhaseChange) -> None:
        """As the log's."""
        self._log.phase(change)
        if self.dashboard is not None:
            self.dashboard.phase(change)

    def stride(self, result: StrideResult) -> None:
        """As the log's."""
        self._log.stride(result)
        self._strides[result.foot] = result
        if self.dashboard is not None:
            self.dashboard.stride(result)
        saw_change = self._ground_said_ns is not None and self._ground_said_ns >= result.t_start_ns
        if result.valid and not self.free_ground and not saw_change:
            self._tell_ground(result)

    def _tell_ground(self, stride: StrideResult) -> None:
        """Say when a foot comes onto stairs or a slope, and when it is back on the ground that the session says."""
        told = self._ground.setdefault(stride.foot, GroundWatch()).unusual(stride)
        if bool(told) != (stride.foot in self._uneven):
            self._uneven ^= {stride.foot}
            text = f"{told}; tuning learns nothing there" if told else "back on the ground that the session says"
            self.note(Note(stride.t_end_ns, "info", "ground", f"{stride.foot.replace('_', ' ')}: {text}"))

    def note(self, note: Note) -> None:
        """As the log's."""
        self._log.note(note)
        if self.dashboard is not None:
            self.dashboard.note(note)

    def latency(self, t_ns: int, latency_ns: int) -> None:
        """As the log's."""
        self._log.latency(t_ns, latency_ns)
        self.latencies.add(latency_ns)

    def foot_status(self, sensor: str, controller: Controller, rate_hz: float, age_ms: float) -> FootStatus:
        """What a sensor shows of its foot; ``age_ms`` is that of its newest sample."""
        foot = self._foot_of.get(sensor, "")
        stride = self._strides.get(sensor) or self._strides.get(foot)
        return FootStatus(
            phase=controller.phase(foot).name.lower() if foot else "",
            walking=bool(foot) and controller.walking(foot),
            strides=stride.number if stride else 0,
            stride_length_m=round(stride.stride_length_m, 3) if stride else None,
            speed_mps=round(stride.speed_mps, 3) if stride else None,
            rate_hz=rate_hz,
            age_ms=round(age_ms, 1),
        )


class Monitor(ShownLog):
    """A live session's log; feeds the sensors' monitors and sends the status.

    It goes to the terminal view's socket (``view``), the dashboard and ``publish``, where there are such.
    """

    def __init__(
        self,
        log: Log,
        sensors: Mapping[str, SensorMonitor],
        phase_sensor_of: Mapping[str, str],
        view: socket.socket | None,
        publish: Callable[[bytes], None] | None = None,
        notices: Notices | None = None,
        sides: SideCheck | None = None,
    ) -> None:
        super().__init__(log, phase_sensor_of)
        self.lateness = Timing()
        self.dropped_frames = 0
        self.switches = SwitchComparison()
        self.answered_ns: int | None = None
        self.device_fault = ""
        self._refused: StimStatus | None = None
        self.observed: Callable[[Event], None] | None = None  # as the session's
        self.arrivals: dict[str, Timing] = {sensor: Timing() for sensor in sensors}
        self.sensors = sensors
        self._missed_by_lost_dashboard = 0
        self._view = view
        self._publish = publish
        self._notices = notices
        self._sides = sides
        self._next_ns = 0

    # --- the loop's log ----------------------------------------------------------------------------------

    def event(self, event: Event) -> None:
        """As the log's."""
        super().event(event)
        if self.observed is not None:
            self.observed(event)
        if self._notices is not None:
            self._notices.electrodes.add_event(event)
        if self._sides is not None:
            self._sides.add_event(event)
        if isinstance(event, ImuSample):
            if (monitor := self.sensors.get(event.sensor)) is not None:
                known = monitor.dead_band
                monitor.add(event)
                if monitor.dead_band != known:
                    self.note(Note(event.t_ns, "info", "session", monitor.dead_band))
                # later than the sensor's own clock says; both stamps are in the log, for every sample
                self.arrivals[event.sensor].add(event.t_ns - event.t_sensor_ns)
        elif isinstance(event, (StimAlive, StimStatus)):
            self.answered_ns = event.t_ns
            if isinstance(event, StimAlive):
                self.device_fault = event.fault
            elif event.fault:
                self._refused = event
        elif isinstance(event, FootSwitchEvent):
            self.switches.add_switch(event)

    def not_answering(self, t_ns: int) -> str:
        """The fault of a command's answer that came, or did not come, just now; "" where there is none.

        A stimulator that hears every command late is told of again and again, and must not be armed in between.
        """
        recent = self._refused is not None and t_ns - self._refused.t_ns <= REFUSED_NS
        return f"the stimulator reports: {self._refused.fault}" if self._refused and recent else ""

    def stride(self, result: StrideResult) -> None:
        """As the log's."""
        super().stride(result)
        if self._sides is not None:
            self._sides.add_stride(result)

    def phase(self, change: PhaseChange) -> None:
        """As the log's."""
        super().phase(change)
        self.switches.add_phase(change)

    def note(self, note: Note) -> None:
        """As the log's."""
        if not note.text.isascii():
            note = replace(note, text=printable(note.text))  # a name in it may be any bytes: that must end no session
        super().note(note)

    @property
    def dropped_dashboard_frames(self) -> int:
        """Frames that a dashboard did not take in time."""
        return self._missed_by_lost_dashboard + (self.dashboard.dropped if self.dashboard is not None else 0)

    # --- the status --------------------------------------------------------------------------------------

    def publish(self, t_ns: int, operator: Operator, stimulator: str, *, at_once: bool = False) -> None:
        """Send the status if 100 ms have passed, or at once; a listener that does not keep up misses frames."""
        if t_ns < self._next_ns and not at_once:
            return
        self._next_ns = t_ns + FRAME_NS
        controller = operator.controller
        feet = {
            sensor: self.foot_status(sensor, controller, monitor.rate_hz(t_ns), min(monitor.age_ms(t_ns), 1e6))
            for sensor, monitor in self.sensors.items()
        }
        status = Status(
            t_ns=t_ns,
            state=str(operator.state),
            message=operator.message,
            fault=operator.why_off,
            remedy=remedy(operator.why_off),
            intensity=controller.intensity,
            channel=operator.channel,
            on=bool(self.on),
            feet=feet,
            belt_speed_mps=operator.belt_speed_mps,
            incline_percent=percent_of(controller.incline),
            latency_p50_ms=self.latencies.percentile_ms(50),
            latency_p99_ms=self.latencies.percentile_ms(99),
            lateness_p99_ms=self.lateness.percentile_ms(99),
            samples=sum(monitor.count for monitor in self.sensors.values()),
            stimulator=stimulator,
            dropped_frames=self.dropped_frames,
            tuning=tuning_status(controller.tuning),
            stops=operator.stops,
            notices=self._notices.now(t_ns) if self._notices else [],
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
        if self.dashboard is not None:
            self.dashboard.send(datagram)
            if self.dashboard.lost:
                self._missed_by_lost_dashboard = self.dashboard.dropped
                why, self.dashboard = self.dashboard.lost, None
                operator.message = f"the dashboard has ended ({why}): no stop there; the session goes on"
                self.note(Note(t_ns, "warning", "dashboard", operator.message))
        if self._publish is not None:
            self._publish(datagram)
