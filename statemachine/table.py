"""The transition table: which phase may follow which, and when. Machine, compiled core, diagram and tests read it."""

from collections.abc import Callable
from typing import Any, NamedTuple

from statemachine import guards
from statemachine.guards import Features, Thresholds
from statemachine.phases import Phase, Transition


class Row(NamedTuple):
    """One transition: its number, from where, to where, and the predicate that lets it happen."""

    transition: Transition
    source: Phase
    destination: Phase
    guard: Callable[[Features, Thresholds], bool]


TABLE: tuple[Row, ...] = (
    Row(Transition.T1, Phase.STANCE, Phase.PRE_SWING, guards.t1),
    Row(Transition.T2, Phase.PRE_SWING, Phase.SWING, guards.t2),
    Row(Transition.T3, Phase.SWING, Phase.LOADING_RESPONSE, guards.t3),
    Row(Transition.T4, Phase.LOADING_RESPONSE, Phase.STANCE, guards.t4),
    Row(Transition.T5, Phase.PRE_SWING, Phase.STANCE, guards.t5),
    Row(Transition.T6, Phase.SWING, Phase.STANCE, guards.t6),
)


def first_transition_function(compiled: Callable[[Any], Any]) -> Callable[[int, Features, Thresholds], int]:
    """The table as one function of (phase, features, thresholds), for a compiler: the number of the first row that
    leaves the phase and whose guard holds, 0 for none. ``compiled`` is applied to it and to each guard.

    A compiler that knows only the function's own source cannot loop over functions, so the rows become its lines.
    """
    scope: dict[str, Any] = {"__name__": __name__}
    lines = ["def first_transition(phase, features, thresholds):"]
    for row in TABLE:
        name = row.guard.__name__
        scope[name] = compiled(row.guard)
        lines.append(f"    if phase == {row.source.value} and {name}(features, thresholds):")
        lines.append(f"        return {row.transition.value}")
    exec(compile("\n".join([*lines, "    return 0"]), __file__, "exec"), scope)
    made: Callable[[int, Features, Thresholds], int] = compiled(scope["first_transition"])
    return made
