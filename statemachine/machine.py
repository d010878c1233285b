"""The table in ``transitions``: the one holder of a foot's gait phase."""

from collections.abc import Iterable
from functools import cache

from transitions import EventData, Machine
from transitions import Transition as Passage

from statemachine.guards import Features, Thresholds
from statemachine.phases import Phase, PhaseChange, Transition
from statemachine.table import TABLE, Row

_ROWS: dict[tuple[int, int], Row] = {(row.source.value, row.transition.value): row for row in TABLE}


class GuardDisagreement(RuntimeError):
    """The compiled core says a transition fired, but the table refuses it: the build is broken, stop."""


class GaitPhaseMachine:
    """Gait phase of one foot: a model of the ``transitions`` machine that all feet share.

    ``transitions`` is asked only when a guard has fired; it checks the guard again from the features, so the table
    stays the single truth about which phase may follow which.
    """

    def __init__(self, foot: str) -> None:
        self.foot = foot
        self.state = Phase.STANCE.name  # where ``transitions`` keeps the phase
        self._machine = _machine()

    @property
    def phase(self) -> Phase:
        """The phase now."""
        return Phase[self.state]

    def fire(self, transition: Transition, t_ns: int, features: Features, thresholds: Thresholds) -> PhaseChange:
        """Go through one transition.

        Raises:
            GuardDisagreement: the table does not allow it from the present phase with these features.
        """
        source = self.phase
        try:
            done = self._machine.events[transition.name].trigger(self, features, thresholds)
        except Exception as error:
            raise GuardDisagreement(f"{transition.name} from {source.name} of {self.foot}: {error}") from error
        if not done:
            raise GuardDisagreement(f"{transition.name} from {source.name} of {self.foot}: guard refuses {features}")
        return PhaseChange(t_ns, self.foot, transition, source, self.phase)

    def follow(self, gone: Iterable[tuple[int, int, int]]) -> None:
        """Take over transitions (time in ns, number, source) that the compiled core went through by the same guards.

        For recordings: only whether such a transition may leave the present phase is asked here. What they are as
        phase changes :func:`changes_of` says.

        Raises:
            GuardDisagreement: the table has no such row, or the core was in another phase.
        """
        phase = self.phase
        for _, number, source in gone:
            row = _ROWS.get((source, number))
            if row is None or source != phase:
                raise GuardDisagreement(f"T{number} from {phase.name} of {self.foot}: the core was in {source}")
            phase = row.destination
        self._machine.set_state(phase.name, self)

    def restart(self, t_ns: int) -> PhaseChange:
        """Begin anew in stance after a gap in the data; reported as a change without a transition."""
        source = self.phase
        self._machine.set_state(Phase.STANCE.name, self)
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


class _Passage(Passage):
    """A transition without callbacks, of which the table has none: they would take as long as all else."""

    def execute(self, event_data: EventData) -> bool:
        """Change the model's state if the guard holds."""
        if not all(condition.check(event_data) for condition in self.conditions):
            return False
        event_data.machine.set_state(str(self.dest), event_data.model)
        return True


class _Machine(Machine):
    transition_cls = _Passage


@cache
def _machine() -> Machine:
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
