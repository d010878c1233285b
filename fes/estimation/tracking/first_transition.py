"""Which transition fires at a sample: the guards of ``statemachine/guards.py``, compiled as they stand."""

from fes.estimation.numerics.jit import jit_ieee
from statemachine.guards import Features, Thresholds
from statemachine.phases import Phase, Transition
from statemachine.table import TABLE

_t1, _t2, _t3, _t4, _t5, _t6 = (jit_ieee(row.guard) for row in TABLE)


@jit_ieee
def first_transition(phase: int, x: Features, p: Thresholds) -> int:
    """The number of the first row of the table that leaves ``phase`` and whose guard holds; 0 for none.

    A compiler does not loop over functions, so the rows stand here one by one; tests hold them to the table.
    """
    if phase == Phase.STANCE.value and _t1(x, p):
        return Transition.T1.value
    if phase == Phase.PRE_SWING.value and _t2(x, p):
        return Transition.T2.value
    if phase == Phase.SWING.value and _t3(x, p):
        return Transition.T3.value
    if phase == Phase.LOADING_RESPONSE.value and _t4(x, p):
        return Transition.T4.value
    if phase == Phase.PRE_SWING.value and _t5(x, p):
        return Transition.T5.value
    if phase == Phase.SWING.value and _t6(x, p):
        return Transition.T6.value
    return 0
