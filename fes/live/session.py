"""One live session: controller, gate, operator, monitor and log around the one loop.

Beside it two that go with it: calibration as its first part (stand still, walk some strides; the samples go on being
read meanwhile), and the clock of an exercise.
"""

import gc
import math
import threading
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

import numpy as np

from fes.config import Exercise, Session
from fes.config.thresholds import describe_thresholds
from fes.control.controller import CURRENT_STEP_MA, Controller
from fes.control.replay import header_of
from fes.control.runner import Runner
from fes.estimation.foot.calibration import CalibrationError, calibrate_foot
from fes.estimation.sensor_choice import Calibration, phase_sensors, shank_phase_sensors
from fes.estimation.shank.calibration import calibrate_shank
from fes.gate import gate_of
from fes.live.commands import CURRENT_ALLOWED, CommandKind, OperatorCommand, State
from fes.live.inputs import Control, Keyboard, StopFile, StopSwitch, WitnessInput
from fes.live.log_pipe import PipedLog
from fes.live.monitor import Electrodes, Monitor, Notices
from fes.live.operator import NO_STOP, Operator
from fes.live.processes import Grant, HelperProcess
from fes.live.sensor_monitor import SensorMonitor, SideCheck
from fes.live.source import Input, LiveSource, LiveStimulator, SensorStream, stall_text
from fes.live.supervision import POLL_NS
from fes.session_log import Note, Received, SessionLogError
from fes.signals import NS_PER_S, SHANK_SENSORS, Event, ImuSample, OperatorAct, OperatorAction, SystemFault, WireFrame


def live_header(
    session: Session,
    calibrations: Mapping[str, Calibration],
    stim_session_id: int,
    created: str,
    t_ns: int,
    current_step_ma: float = CURRENT_STEP_MA,
) -> dict[str, Any]:
    """A live log's header, all that its replay needs beside events; ``t_ns``: the monotonic clock at ``created``."""
    about = {
        "name": session.name,
        "rates_hz": {device.sensor: device.rate_hz for device in session.sensors},
        "belt_speed_mps": session.treadmill.belt_speed_mps if session.treadmill else None,
    }
    kind = "live" if session.exercise is None else "exercise"
    return header_of(kind, about, session, calibrations, stim_session_id, created) | {
        "created_t_ns": t_ns,
        "current_step_ma": current_step_ma,
        "polled_every_ns": POLL_NS,
        "heard": True,  # what a serial stimulator answered is in the log as it came, so that its bytes can be repeated
    }


COMPLETE = "complete"


class LiveSession:
    """Made from open devices and an open log; :meth:`run` is the session.

    Everything is stamped by ``clock_ns``, the monotonic clock. After ``duration_s`` the session ends by itself; None:
    the operator ends it. For ``open_lead_detected_from_ma`` see :class:`fes.live.monitor.Electrodes`. ``side``:
    as of :class:`fes.live.operator.Operator`. ``observed`` gets every event, in order, before anybody acts on it.
    """

    def __init__(
        self,
        session: Session,
        calibrations: dict[str, Calibration],
        log: PipedLog,
        stimulator: LiveStimulator,
        clock_ns: Callable[[], int],
        view: HelperProcess | None = None,
        duration_s: float | None = None,
        *,
        current_step_ma: float = CURRENT_STEP_MA,
        open_lead_detected_from_ma: float | None = None,
        side: str = "",
        observed: Callable[[Event], None] | None = None,
    ) -> None:
        self.controller = Controller(session, calibrations, current_step_ma=current_step_ma)
        self.gate = gate_of(
            session,
            {sensor: each.up for sensor, each in calibrations.items()},
            shank_phase_sensors(calibrations),
            current_step_ma,
        )
        monitors = {
            str(device.sensor): SensorMonitor(device, calibrations.get(device.sensor)) for device in session.sensors
        }
        phase_sensor_of = phase_sensors(calibrations)
        electrodes = Electrodes((channel.number for channel in session.channels), open_lead_detected_from_ma)
        self.notices = Notices(self.gate, electrodes, self.controller.notices)
        self.notices.lasting += filter(None, [describe_thresholds(session.thresholds)])
        self.sides = SideCheck(calibrations)
        self.monitor = Monitor(
            log, monitors, phase_sensor_of, view.link if view else None, self._publish, self.notices, self.sides
        )
        self.monitor.free_ground = session.ground.free
        self.monitor.observed = observed
        self.operator = Operator(
            session, self.controller, self.gate, monitors, phase_sensor_of, self.monitor.note,
            lambda: self.monitor.answered_ns, self._reasons_not_ready, electrodes.unknown, side,
        )  # fmt: skip
        self.notices.proof = self.operator.proof.wanted
        self.stimulator = stimulator
        self.runner = Runner(self.controller, self.gate, stimulator, self.monitor, clock_ns, from_reading=True)
        self._log = log
        stimulator.on_heard = lambda t_ns, data: log.received(Received(t_ns, data))
        stimulator.on_frame = log.frame
        self._clock_ns = clock_ns
        self._duration_s = duration_s
        self._inputs: list[Input] = [self.sides]
        self._control: Control | None = None
        self._keyboard: Keyboard | None = None
        self._state = self.operator.state
        self._end_ns: int | None = None
        self._source: LiveSource | None = None

    # --- what an operator has --------------------------------------------------------------------------

    def add_keys(self, descriptor: int) -> None:
        """Keys from a terminal or a pipe."""
        self._keyboard = Keyboard(descriptor, self.operator.execute, self._keys_gone)
        self._inputs.append(self._keyboard)

    def add_control(self, path: Path) -> None:
        """A control socket. OSError: it cannot be made."""
        self._control = Control(path, self.operator.execute)
        self._inputs.append(self._control)

    def add_witness(self, witness: HelperProcess) -> None:
        """The witness of the foot sensors: it is shown, and what it finds to lie freezes the tuning."""
        heard = WitnessInput(witness.link, self.operator.distrust)
        self.notices.witness = heard.now
        self._inputs.append(heard)

    def add_input(self, each: Input) -> None:
        """Anything else that makes something happen: a stop file or button, a foot switch, the dashboard."""
        self._inputs.append(each)

    # --- the session -------------------------------------------------------------------------------------

    def run(
        self,
        streams: Sequence[SensorStream],
        handshake: Sequence[WireFrame],
        first_answers: Sequence[Event],
        grants: Sequence[Grant],
        check: Callable[[], None],
    ) -> None:
        """Until the operator quits or the time is over. Everything is off afterwards, whatever ended it.

        ``handshake``: what opening the stimulator put on the wire; ``first_answers``: what it answered; ``grants``:
        what the operating system gave. ``check`` is called after every event and may raise KeyboardInterrupt.

        SessionLogError: the log cannot be written any more.
        """
        begin_ns = self._clock_ns()
        self.notices.streams = streams
        self._end_ns = None if self._duration_s is None else begin_ns + int(self._duration_s * NS_PER_S)
        for frame in handshake:
            self._log.frame(frame)
        for answer in first_answers:
            self.runner.handle(answer)
        for grant in grants:
            self.monitor.note(Note(begin_ns, "warning" if grant.refused else "info", "realtime", str(grant)))
        self._source = LiveSource(
            streams, self._inputs, self.stimulator, self._clock_ns, self._over,
            lambda: self.operator.state in CURRENT_ALLOWED, self.monitor.lateness.add, self._stalled,
        )  # fmt: skip
        try:
            self.runner.run(self._source, lambda event: self._after(event, check))
        except SessionLogError as error:
            # everything is off by now; whoever watches is told before the log is closed, which may take long
            self.operator.give_up(self._clock_ns(), str(error))
            with suppress(SessionLogError):
                self.monitor.publish(self._clock_ns(), self.operator, self.stimulator.state, at_once=True)
            raise
        finally:
            if self._control is not None:
                self._control.close()
            if self._keyboard is not None:
                self._keyboard.close()

    def summary(self) -> dict[str, Any]:
        """For the end of the log."""
        source = self._source
        return {
            "samples": {foot: tracker.counts.to_dict() for foot, tracker in self.controller.trackers.items()},
            "received": {sensor: monitor.count for sensor, monitor in self.monitor.sensors.items()},
            "latency": self.monitor.latencies.to_dict(),
            "lateness": self.monitor.lateness.to_dict(),
            "arrival": {sensor: timing.to_dict() for sensor, timing in self.monitor.arrivals.items()},
            "foot_switches": self.monitor.switches.to_dict(),
            "stalls": source.stalls if source else 0,
            "longest_stall_ms": round(source.longest_stall_ns * 1e-6, 1) if source else 0.0,
            "unsent": self.stimulator.unsent,
            "flagged": {sensor: flag.samples for sensor, flag in self.gate.flagged.items()},
            "dropped_view_frames": self.monitor.dropped_frames,
            "dropped_page_frames": self.monitor.dropped_dashboard_frames,
        }

    def _after(self, event: Event, check: Callable[[], None]) -> None:
        self.operator.follow(event)
        for text in self.notices.new_losses():
            self.monitor.note(Note(event.t_ns, "warning", "session", text))
        if isinstance(event, SystemFault) and not self.gate.latched:
            self.monitor.note(Note(event.t_ns, "warning", "session", event.text))
        now_ns = self._clock_ns()
        self._log.flush_due(now_ns)
        if self._log.warning != self.notices.log:
            self.notices.log = self._log.warning
            text = self._log.warning or f"{self._log.path}: the disk keeps up again"
            self.monitor.note(Note(event.t_ns, "warning" if self._log.warning else "info", "log", text))
            self.operator.message = text
        self.monitor.publish(now_ns, self.operator, self.stimulator.state)
        if self.operator.state is not self._state:
            self._state = self.operator.state
            if self._state not in CURRENT_ALLOWED:  # collection never starts by itself; here no decision waits
                begin_ns = self._clock_ns()
                gc.collect()
                if self._source is not None:
                    self._source.exclude_from_stalls(self._clock_ns() - begin_ns)
        check()

    def _stalled(self, t_ns: int, away_ns: int) -> None:
        text = stall_text(away_ns)
        self.monitor.note(Note(t_ns, "warning", "session", f"{text}; it was off before that was noticed"))
        self.operator.explain_fault(t_ns, text, away_ns)

    def _over(self) -> bool:
        return self.operator.quitting or (self._end_ns is not None and self._clock_ns() >= self._end_ns)

    def _keys_gone(self, t_ns: int) -> list[Event]:
        events = self.operator.keys_gone(t_ns, self._other_stops())
        self.notices.lasting.append(self.operator.message)
        return events

    def _other_stops(self) -> list[str]:
        """What stops beside the keyboard."""
        kinds = ((StopFile, "file"), (StopSwitch, "button"), (Control, "control socket"))
        found = [name for kind, name in kinds if any(isinstance(each, kind) for each in self._inputs)]
        return [*found, "dashboard"] if self.monitor.dashboard is not None else found

    def _reasons_not_ready(self) -> list[str]:
        reasons = [each.not_ready() for each in self._inputs if isinstance(each, (StopFile, StopSwitch))]
        reasons += [
            self.sides.exchanged,
            self._log.healthy,
            "" if self.stimulator.is_open else f"stimulator {self.stimulator.state}",
        ]
        reasons.append(self.monitor.not_answering(self.runner.t_ns))
        if self._keyboard is not None and self._keyboard.fileno() is None and not self._other_stops():
            reasons.append(NO_STOP)
        if fault := self.monitor.device_fault:
            # a device keeps such a flag until a new session is opened; what still holds is flagged again
            self.stimulator.renew(self.runner.t_ns)
            self.monitor.device_fault = ""
            reasons.append(f"the stimulator reports: {fault}; check the electrodes, its session is opened again")
        return reasons

    def _publish(self, status: bytes) -> None:
        if self._control is not None:
            self._control.publish(status)


FIRST_ATTEMPT_NS: Final = 6 * NS_PER_S
ATTEMPT_EVERY_NS: Final = 2 * NS_PER_S
LONGEST_S: Final = 60.0  # as much as a calibration from a recording takes; here the newest, however long somebody stood

_Row = tuple[int, tuple[float, ...]]


class Calibrating:
    """Collects the samples of every foot's phase sensor; tries every two seconds whether they show enough strides."""

    def __init__(self, session: Session, strides: int) -> None:
        self.found: dict[str, Calibration] = {}
        self.message = "stand still for two seconds, then walk straight ahead"
        self._strides, self._incline = strides, session.ground.incline
        rates_hz = {str(device.sensor): device.rate_hz for device in session.sensors}
        self._rates_hz = {sensor: rates_hz[sensor] for sensor in phase_sensors(rates_hz).values()}
        self._rows: dict[str, deque[_Row]] = {
            sensor: deque(maxlen=int(LONGEST_S * rate_hz)) for sensor, rate_hz in self._rates_hz.items()
        }
        self._next_ns: int | None = None
        self._thread: threading.Thread | None = None

    @property
    def done(self) -> bool:
        """Whether every foot's phase sensor is calibrated."""
        return self._thread is None and self.found.keys() == self._rates_hz.keys()

    def add_event(self, event: Event) -> None:
        """Take in an event; the calibration itself goes on in a thread of its own."""
        if isinstance(event, ImuSample) and event.sensor in self._rows:
            rows = self._rows[event.sensor]
            values = (*event.acc_mps2, *event.gyr_radps)
            # one value that is none would make a whole minute's calibration impossible
            if all(map(math.isfinite, values)) and (not rows or event.t_sensor_ns > rows[-1][0]):
                rows.append((event.t_sensor_ns, values))
        if self._next_ns is None:
            self._next_ns = event.t_ns + FIRST_ATTEMPT_NS
        if self._thread is not None and not self._thread.is_alive():
            self._thread = None
        if event.t_ns >= self._next_ns and self._thread is None and not self.done:
            self._next_ns = event.t_ns + ATTEMPT_EVERY_NS
            rows_now = {sensor: list(rows) for sensor, rows in self._rows.items() if sensor not in self.found}
            self._thread = threading.Thread(target=self._attempt, args=(rows_now,), daemon=True)
            self._thread.start()

    def _attempt(self, rows_of: dict[str, list[_Row]]) -> None:
        for sensor, rows in rows_of.items():
            if len(rows) < 3.0 * self._rates_hz[sensor]:
                self.message = f"{sensor}: only {len(rows)} samples so far"
                continue
            t_ns = np.array([t for t, _ in rows], np.int64)
            values = np.array([value for _, value in rows])
            try:
                samples = sensor, self._rates_hz[sensor], t_ns, values[:, :3], values[:, 3:]
                if sensor in SHANK_SENSORS:
                    found: Calibration = calibrate_shank(*samples, level=self._incline == 0.0)
                else:
                    found = calibrate_foot(*samples, incline=self._incline)
            except (CalibrationError, ValueError) as error:
                self.message = str(error)
                continue
            if found.strides >= self._strides:
                self.found[sensor] = found
            else:
                self.message = f"{sensor}: {found.strides} of {self._strides} strides; go on walking"


class ExerciseClock:
    """An input of the live session (see ``fes.live.source.Input``); each burst is an act, logged and replayed as such.

    Bursts begin once the session is armed and the intensity is above 0. A pause, a stop and a fault hold the count;
    after the last burst the session is disarmed, and arming again begins another set.
    """

    def __init__(self, exercise: Exercise, operator: Operator) -> None:
        self._exercise = exercise
        self._operator = operator
        self._numbers = [channel.number for channel in operator.session.channels]
        self._next_ns: int | None = None
        self.done = 0

    def fileno(self) -> int | None:
        """It is asked every turn."""
        return None

    def read_events(self, t_ns: int) -> list[Event]:
        """The bursts that are due, or the end."""
        operator = self._operator
        if operator.state is not State.ARMED or operator.controller.intensity <= 0.0:
            self._next_ns = None
            self.done %= self._exercise.count  # whoever left after the last burst begins another set
            return []
        if self._next_ns is not None and t_ns < self._next_ns:
            return []
        if self.done == self._exercise.count:
            return self._end(t_ns)
        self.done += 1
        self._next_ns = t_ns + round((self._exercise.burst_s + self._exercise.off_s) * NS_PER_S)
        operator.message = f"exercise: burst {self.done} of {self._exercise.count}"
        return [OperatorAct(t_ns, OperatorAction.EXERCISE, float(number)) for number in self._numbers]

    def _end(self, t_ns: int) -> list[Event]:
        events = self._operator.execute(OperatorCommand(CommandKind.DISARM, origin="exercise"), t_ns)
        self._operator.message = f"exercise done: {self.done} bursts; a arms for another set, q ends"
        self._operator.note(Note(t_ns, "info", "exercise", f"done: {self.done} of {self._exercise.count} bursts"))
        self.done = 0
        return events
