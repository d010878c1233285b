"""The table in ``transitions``: the one holder of a foot's gait phase."""

from collections.abc import Callable

from transitions import Machine

from statemachine.guards import Features, Thresholds
from statemachine.phases import Phase, PhaseChange, Transition
from statemachine.table import TABLE


class GuardDisagreement(RuntimeError):
    """The compiled core says a transition fired, but the table refuses it: the build is broken, stop."""


class GaitPhaseMachine:
    """Gait phase of one foot, the model of a ``transitions`` machine of its own: ``state`` and ``trigger`` are that's.

    ``transitions`` is asked only when a compiled guard has fired; it checks the guard again from the features, so the
    table stays the single truth about which phase may follow which.
    """

    state: Phase
    trigger: Callable[..., bool]

    def __init__(self, foot: str, phase: Phase = Phase.STANCE) -> None:
        self.foot = foot
        rows = [
            {"trigger": row.transition.name, "source": row.source, "dest": row.destination, "conditions": row.guard}
            for row in TABLE
        ]
        self._machine = Machine(self, states=Phase, initial=phase, transitions=rows, auto_transitions=False)

    @property
    def phase(self) -> Phase:
        """The phase now."""
        return self.state

    def fire(self, transition: Transition, t_ns: int, features: Features, thresholds: Thresholds) -> PhaseChange:
        """Go through one transition.

        Raises:
            GuardDisagreement: the table does not allow it from the present phase with these features.
        """
        source = self.phase
        try:
            done = self.trigger(transition.name, features, thresholds)
        except Exception as error:
            raise GuardDisagreement(f"{transition.name} from {source.name} of {self.foot}: {error}") from error
        if not done:
            raise GuardDisagreement(f"{transition.name} from {source.name} of {self.foot}: guard refuses {features}")
        return PhaseChange(t_ns, self.foot, transition, source, self.phase)

    def restart(self, t_ns: int) -> PhaseChange:
        """Begin anew in stance after a gap in the data; reported as a change without a transition."""
        source = self.phase
        self.go_on_in(Phase.STANCE)
        return PhaseChange(t_ns, self.foot, Transition.NONE, source, Phase.STANCE)

    def go_on_in(self, phase: Phase) -> None:
        """Be in the phase to which the compiled core has come by itself, through a recording whose changes nobody has
        asked for yet; whoever does has a machine of their own go through them."""
        self._machine.set_state(phase)
