"""Every state with every combination of guards that can be true together: one transition or none, by the table."""

from __future__ import annotations

import itertools

import pytest
from test_statemachine import GRID, P, machine_in

from fes.estimation.tracking import phase_features as kernel
from statemachine.guards import Features
from statemachine.machine import GuardDisagreement
from statemachine.phases import Phase, Transition
from statemachine.table import TABLE

Truth = tuple[bool, ...]  # of T1 to T6


def possible(truth: Truth) -> bool:
    """T5 and T6 ask the same; a heel rises later after contact than the foot can be said not to be flat yet."""
    t1, _, _, t4, t5, t6 = truth
    return t5 == t6 and (t4 or not t1)


def examples_of_each() -> dict[Truth, Features]:
    found: dict[Truth, Features] = {}
    for x in itertools.starmap(Features, GRID):
        found.setdefault(tuple(row.guard(x, P) for row in TABLE), x)
    return found


FOUND = examples_of_each()


def test_all_combinations_that_are_possible_are_found_and_no_other() -> None:
    assert set(FOUND) == {truth for truth in itertools.product((False, True), repeat=6) if possible(truth)}
    assert len(FOUND) == 24


@pytest.mark.requirement("SR-03")
@pytest.mark.parametrize("truth", sorted(FOUND), ids=lambda truth: "".join(str(int(true)) for true in truth))
@pytest.mark.parametrize("phase", list(Phase), ids=lambda phase: phase.name)
def test_one_transition_or_none(phase: Phase, truth: Truth) -> None:
    x = FOUND[truth]
    leaving = [row for row in TABLE if row.source is phase and truth[row.transition.value - 1]]
    expected = leaving[0].transition if leaving else Transition.NONE
    assert kernel.first_transition(phase, x, P) == expected
    for transition in Transition:
        machine = machine_in(phase)
        row = next((row for row in leaving if row.transition is transition), None)
        if row is None:
            with pytest.raises(GuardDisagreement):
                machine.fire(transition, 0, x, P)
            assert machine.phase is phase
        else:
            assert machine.fire(transition, 0, x, P).destination is row.destination
            assert machine.phase is row.destination
