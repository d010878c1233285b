"""The table in ``transitions``: the one holder of a foot's gait phase."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from typing import Any

from transitions import Event, Machine, MachineError

from statemachine.guards import Features, Thresholds
from statemachine.phases import Phase, PhaseChange, Transition
from statemachine.table import TABLE, Row

_ROWS: dict[tuple[int, int], Row] = {(row.source.value, row.transition.value): row for row in TABLE}
_DESTINATIONS: dict[tuple[int, int], int] = {key: row.destination.value for key, row in _ROWS.items()}
_PHASES: dict[str, Phase] = {phase.name: phase for phase in Phase}


class GuardDisagreement(RuntimeError):
    """The compiled core says a transition fired, but the table refuses it: the build is broken, stop."""


class GaitPhaseMachine:
    """Gait phase of one foot.

    ``transitions`` is asked only when a guard has fired; it checks the guard again from the features, so the table
    stays the single truth about which phase may follow which.
    """

    def __init__(self, foot: str) -> None:
        self.foot = foot
        self._model = _Model()
        self._machine = _machine()
        self._events = {transition: self._machine.events[transition.name] for transition in Transition if transition}

    @property
    def phase(self) -> Phase:
        """The phase now."""
        return _PHASES[self._model.state]

    def fire(self, transition: Transition, t_ns: int, x: Features, p: Thresholds) -> PhaseChange:
        """Go through one transition.

        Raises:
            GuardDisagreement: the table does not allow it from the present phase with these features.
        """
        source = self.phase
        try:
            done = self._events[transition].trigger(self._model, x, p)
        except Exception as error:
            raise GuardDisagreement(f"{transition.name} from {source.name} of {self.foot}: {error}") from error
        if not done:
            raise GuardDisagreement(f"{transition.name} from {source.name} of {self.foot}: guard refuses {x}")
        return PhaseChange(t_ns, self.foot, transition, source, self.phase)

    def follow(self, gone: Iterable[tuple[int, int, int]]) -> None:
        """Take over transitions (time in ns, number, source) that the compiled core went through by the same guards.

        For recordings: only whether such a transition may leave the present phase is asked here. What they are as
        phase changes :func:`changes_of` says.

        Raises:
            GuardDisagreement: the table has no such row, or the core was in another phase.
        """
        phase = int(self.phase)
        for _, number, source in gone:
            destination = _DESTINATIONS.get((source, number))
            if destination is None or source != phase:
                raise GuardDisagreement(f"T{number} from {Phase(phase).name} of {self.foot}: the core was in {source}")
            phase = destination
        self._model.state = Phase(phase).name

    def resume(self, phase: Phase) -> None:
        """Go on from a phase that transitions which the table allows have led to."""
        self._model.state = phase.name

    def restart(self, t_ns: int) -> PhaseChange:
        """Begin anew in stance after a gap in the data; reported as a change without a transition."""
        source = self.phase
        self._machine.set_state(Phase.STANCE.name, model=self._model)
        return PhaseChange(t_ns, self.foot, Transition.NONE, source, Phase.STANCE)


def changes_of(foot: str, gone: Iterable[tuple[int, int, int]]) -> list[PhaseChange]:
    """Transitions (time in ns, number, source) that a machine went through, as phase changes; number 0: a restart."""
    changes = []
    for t_ns, number, source in gone:
        if number == Transition.NONE:
            changes.append(PhaseChange(t_ns, foot, Transition.NONE, Phase(source), Phase.STANCE))
        else:
            row = _ROWS[source, number]
            changes.append(PhaseChange(t_ns, foot, row.transition, row.source, row.destination))
    return changes


class _Model:
    """What ``transitions`` hangs its state on."""

    state: str = Phase.STANCE.name


class _Event(Event):
    """A trigger without the callbacks before, between and after, which this machine has none of: ten times faster."""

    def trigger(self, model: Any, *args: Any, **kwargs: Any) -> bool:
        """Go through the first row that leaves the present state and whose conditions hold; whether there was one.

        Raises:
            MachineError: no row of this trigger leaves the present state.
        """
        rows: list[Any] | None = self.transitions.get(model.state)  # by index a new state would be made up
        if rows is None:
            raise MachineError(f"Can't trigger event {self.name} from state {model.state}!")
        for row in rows:
            for condition in row.conditions:
                if condition.func(*args) != condition.target:
                    break
            else:
                model.state = row.dest
                return True
        return False


class _Machine(Machine):
    event_cls = _Event


@cache
def _machine() -> _Machine:
    """The table, for all feet: what evolves is in their models, and to make it takes as long as a thousand samples."""
    return _Machine(
        model=None,
        states=[phase.name for phase in Phase],
        transitions=[
            {
                "trigger": row.transition.name,
                "source": row.source.name,
                "dest": row.destination.name,
                "conditions": row.guard,
            }
            for row in TABLE
        ],
        initial=Phase.STANCE.name,
        auto_transitions=False,
        send_event=False,
    )
