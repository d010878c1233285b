"""The clock of a session of exercise: it asks for bursts while the session is armed, as a person would. No I/O."""

from fes.config import Exercise
from fes.live.commands import CommandKind, OperatorCommand, State
from fes.live.operator import Operator
from fes.session_log import Note
from fes.signals import NS_PER_S, Event, OperatorAct, OperatorAction


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
