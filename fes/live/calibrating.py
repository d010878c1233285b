"""Calibration as a session's first part: stand still, walk some strides; the samples go on being read meanwhile."""

import math
import threading
from collections import deque
from typing import Final

import numpy as np

from fes.config import Exercise, Session
from fes.estimation.foot.calibration import CalibrationError, calibrate_foot
from fes.estimation.sensor_choice import Calibration, phase_sensors
from fes.estimation.shank.calibration import calibrate_shank
from fes.live.commands import CommandKind, OperatorCommand, State
from fes.live.operator import Operator
from fes.session_log import Note
from fes.signals import NS_PER_S, SHANK_SENSORS, Event, ImuSample, OperatorAct, OperatorAction

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
    """An input of the live session (see ``fes.live.sensors.Input``); each burst is an act, logged and replayed as such.

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
