"""The transition table: which phase may follow which, and when. Machine, compiled core, diagram and tests read it."""

from collections.abc import Callable
from typing import NamedTuple

from statemachine import guards
from statemachine.guards import Features, Thresholds
from statemachine.phases import Phase, Transition


class Row(NamedTuple):
    """One transition: its number, from where, to where, and the guard that lets it happen."""

    transition: Transition
    source: Phase
    destination: Phase
    guard: Callable[[Features, Thresholds], bool]


TABLE: tuple[Row, ...] = (  # of two rows that leave one phase, the upper one goes first
    Row(Transition.T1, Phase.STANCE, Phase.PRE_SWING, guards.t1),
    Row(Transition.T2, Phase.PRE_SWING, Phase.SWING, guards.t2),
    Row(Transition.T3, Phase.SWING, Phase.LOADING_RESPONSE, guards.t3),
    Row(Transition.T4, Phase.LOADING_RESPONSE, Phase.STANCE, guards.t4),
    Row(Transition.T5, Phase.PRE_SWING, Phase.STANCE, guards.t5),
    Row(Transition.T6, Phase.SWING, Phase.STANCE, guards.t6),
)
