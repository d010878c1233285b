"""The phase machine: six rows and nothing else; every clause of every guard; compiled and plain guards agree."""

from __future__ import annotations

import ast
import inspect
import itertools
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeAlias

import numba
import numpy as np
import pytest

from fes.estimation.foot import features as kernel
from statemachine import diagram, guards
from statemachine.guards import Features, Thresholds
from statemachine.machine import GaitPhaseMachine, GuardDisagreement
from statemachine.phases import Phase, PhaseChange, Transition
from statemachine.table import TABLE

DEFAULTS = Thresholds()
P = DEFAULTS._replace(  # a push-off that is more than half the fall, strides shorter than both bounds of their time
    push_off_radps=8.0,
    fall_radps=12.0,
    stride_s=0.9 * min(DEFAULTS.longest_swing_stride_s, DEFAULTS.longest_loading_stride_s),
)
FOOT = "left_foot"
SIX = {
    (Phase.STANCE, Transition.T1): Phase.PRE_SWING,
    (Phase.PRE_SWING, Transition.T2): Phase.SWING,
    (Phase.SWING, Transition.T3): Phase.LOADING_RESPONSE,
    (Phase.LOADING_RESPONSE, Transition.T4): Phase.STANCE,
    (Phase.PRE_SWING, Transition.T5): Phase.STANCE,
    (Phase.SWING, Transition.T6): Phase.STANCE,
}
NetworkGuard: TypeAlias = Callable[[Features, Thresholds], bool]
GUARDS: dict[Transition, NetworkGuard] = {row.transition: row.guard for row in TABLE}

# one set of features per guard under which it is true
NOTHING = Features(*[0.0] * 10, travelling=False)._replace(pitch_rad=1.0)
RATE, WEAK_RATE = P.push_off_radps, 0.5 * P.fall_radps
STRIDE_S, SLOW_S = P.stride_s, 1.3 * max(P.longest_swing_stride_s, P.longest_loading_stride_s)
SLOW_TO_LOAD_S = 1.3 * P.longest_loading_stride_s
LEAST_PEAK, LEAST_FALL = P.push_off_share * P.push_off_radps, P.mid_swing_share * P.fall_radps
LEFT = (1.0 - P.push_off_drop) * RATE  # the peak of a typical push-off is left below this rate
TOE_UP, WEAK_TOE_UP = P.toe_up_share * RATE, P.toe_up_share * WEAK_RATE
SWUNG = P.swung_share * P.fall_radps
JERK_MPS3 = P.jerk_share * P.contact_jerk_mps3
HEEL_RISE = NOTHING._replace(
    toe_down_radps=2.0 * P.heel_rise_share * RATE,
    turned_rad=2.0 * P.heel_rise_rad,
    since_contact_s=2.0 * P.heel_rise_after * STRIDE_S,
)
TOE_OFF = NOTHING._replace(toe_down_peak_radps=RATE, toe_down_radps=0.5 * RATE)
UP_RADPS = P.fall_radps - RATE
CONTACT = NOTHING._replace(
    toe_down_peak_radps=RATE,
    toe_up_peak_radps=UP_RADPS,
    contact_jerk_mps3=2.0 * JERK_MPS3,
    in_swing_s=2.0 * P.shortest_swing * STRIDE_S,
)
FLAT = NOTHING._replace(since_contact_s=1.1 * P.shortest_loading * STRIDE_S, resting_s=2.0 * P.flat_share * STRIDE_S)
RESTING = NOTHING._replace(resting_s=2.0 * P.put_back * STRIDE_S)
TRUE = {
    Transition.T1: HEEL_RISE,
    Transition.T2: TOE_OFF,
    Transition.T3: CONTACT,
    Transition.T4: FLAT,
    Transition.T5: RESTING,
    Transition.T6: RESTING,
}


def seen(transition: Transition, differs: dict[str, Any]) -> tuple[Features, Thresholds]:
    """What makes the guard true, but for some features or thresholds."""
    features = {name: value for name, value in differs.items() if name in Features._fields}
    thresholds = {name: value for name, value in differs.items() if name not in Features._fields}
    return TRUE[transition]._replace(**features), P._replace(**thresholds)


def below(x: float) -> float:
    return math.nextafter(x, -math.inf)


def above(x: float) -> float:
    return math.nextafter(x, math.inf)


NO_PUSH_OFF = {"turned_rad": 0.0, "since_contact_s": 2.0 * P.toe_up_after * STRIDE_S}
DRAGGED = {"toe_down_peak_radps": 0.0}
CARRIED = {**DRAGGED, "travelling": True}
SHUFFLED = {"toe_down_peak_radps": 0.0, "toe_down_radps": 0.01}  # hardly a fall
SLOW = {"stride_s": SLOW_S}
SILENT = {"contact_jerk_mps3": 0.0}
STRUCK = {
    **SILENT, "toe_down_radps": above(P.struck_share * RATE), "toe_down_change_radps2": above(P.struck_per_s * RATE)
}  # fmt: skip
SOFT_S, REST_S, FLAT_S = P.soft_contact * STRIDE_S, P.put_back * STRIDE_S, P.flat_share * STRIDE_S
LONG = {"resting_s": 0.0, "stride_s": SLOW_TO_LOAD_S}
LOADED_S = P.longest_loading * P.longest_loading_stride_s

# (transition, what the case is about, features that differ from those under which the guard is true, expected)
CASES: list[tuple[Transition, str, dict[str, Any], bool]] = [
    (Transition.T1, "the heel rises", {}, True),
    (Transition.T1, "it turns too slowly", {"toe_down_radps": P.heel_rise_share * RATE}, False),
    (Transition.T1, "it just turns fast enough", {"toe_down_radps": above(P.heel_rise_share * RATE)}, True),
    (Transition.T1, "of a weak push-off, too slowly",
     {"push_off_radps": 2.0, "toe_down_radps": P.heel_rise_share * WEAK_RATE}, False),
    (Transition.T1, "of a weak push-off",
     {"push_off_radps": 2.0, "toe_down_radps": above(P.heel_rise_share * WEAK_RATE)}, True),
    (Transition.T1, "it has hardly turned", {"turned_rad": P.heel_rise_rad}, False),
    (Transition.T1, "it has just turned enough", {"turned_rad": above(P.heel_rise_rad)}, True),
    (Transition.T1, "too soon after contact", {"since_contact_s": P.heel_rise_after * STRIDE_S}, False),
    (Transition.T1, "just late enough", {"since_contact_s": above(P.heel_rise_after * STRIDE_S)}, True),
    (Transition.T1, "toe-up at the limit", {**NO_PUSH_OFF, "toe_down_radps": -TOE_UP}, False),
    (Transition.T1, "a dragged foot", {**NO_PUSH_OFF, "toe_down_radps": -above(TOE_UP)}, True),
    (Transition.T1, "of a weak push-off, toe-up at the limit",
     {**NO_PUSH_OFF, "push_off_radps": 2.0, "toe_down_radps": -WEAK_TOE_UP}, False),
    (Transition.T1, "of a weak push-off, a dragged foot",
     {**NO_PUSH_OFF, "push_off_radps": 2.0, "toe_down_radps": -above(WEAK_TOE_UP)}, True),
    (Transition.T1, "toe-up too soon after contact",
     {"toe_down_radps": -above(TOE_UP), "since_contact_s": P.toe_up_after * STRIDE_S}, False),
    (Transition.T1, "toe-up just late enough",
     {"toe_down_radps": -above(TOE_UP), "since_contact_s": above(P.toe_up_after * STRIDE_S)}, True),
    (Transition.T1, "as much toe-up as a swing's, at the limit",
     {"toe_down_radps": -SWUNG, "since_contact_s": above(P.swung_after_s)}, False),
    (Transition.T1, "a swing that stance does not know of",
     {"toe_down_radps": -above(SWUNG), "since_contact_s": above(P.swung_after_s)}, True),
    (Transition.T1, "a contact's rebound",
     {"toe_down_radps": -above(SWUNG), "since_contact_s": P.swung_after_s}, False),
    (Transition.T2, "the peak has passed", {}, True),
    (Transition.T2, "the least push-off", {"toe_down_peak_radps": LEAST_PEAK, "toe_down_radps": 0.0}, True),
    (Transition.T2, "less than a push-off", {"toe_down_peak_radps": below(LEAST_PEAK), "toe_down_radps": 0.0}, False),
    (Transition.T2, "a ripple of the peak", {"toe_down_radps": LEFT}, False),
    (Transition.T2, "the peak is just left", {"toe_down_radps": below(LEFT)}, True),
    (Transition.T2, "not yet reversed, asked to be", {"swing_at_reversal": True}, False),
    (Transition.T2, "at rest in between", {"swing_at_reversal": True, "toe_down_radps": 0.0}, False),
    (Transition.T2, "reversed", {"swing_at_reversal": True, "toe_down_radps": below(0.0)}, True),
    (Transition.T2, "toe-up at the limit", {**DRAGGED, "toe_down_radps": -TOE_UP}, False),
    (Transition.T2, "a dragged foot", {**DRAGGED, "toe_down_radps": -above(TOE_UP)}, True),
    (Transition.T2, "a dragged foot, asked to be reversed",
     {**DRAGGED, "toe_down_radps": -above(TOE_UP), "swing_at_reversal": True}, True),
    (Transition.T2, "of a weak push-off, toe-up at the limit",
     {**DRAGGED, "push_off_radps": 2.0, "toe_down_radps": -WEAK_TOE_UP}, False),
    (Transition.T2, "of a weak push-off, a dragged foot",
     {**DRAGGED, "push_off_radps": 2.0, "toe_down_radps": -above(WEAK_TOE_UP)}, True),
    (Transition.T2, "carried along, toe-up at the limit",
     {**CARRIED, "toe_down_radps": -P.carried_share * RATE}, False),
    (Transition.T2, "carried along", {**CARRIED, "toe_down_radps": -above(P.carried_share * RATE)}, True),
    (Transition.T2, "of a weak push-off, carried along",
     {**CARRIED, "push_off_radps": 2.0, "toe_down_radps": -above(P.carried_share * WEAK_RATE)}, True),
    (Transition.T2, "a heel that is put back", {**DRAGGED, "toe_down_radps": -above(P.carried_share * RATE)}, False),
    (Transition.T3, "a jump after mid-swing", {}, True),
    (Transition.T3, "a jump at the limit", {"contact_jerk_mps3": JERK_MPS3}, False),
    (Transition.T3, "a jump just above the limit", {"contact_jerk_mps3": above(JERK_MPS3)}, True),
    (Transition.T3, "no jump", SILENT, False),
    (Transition.T3, "the least duration of a swing", {"in_swing_s": P.shortest_swing * STRIDE_S}, True),
    (Transition.T3, "the jolt of toe-off", {"in_swing_s": below(P.shortest_swing * STRIDE_S)}, False),
    (Transition.T3, "the least of a slow walker's",
     {**SLOW, "in_swing_s": P.shortest_swing * P.longest_swing_stride_s}, True),
    (Transition.T3, "a slow walker's jolt of toe-off",
     {**SLOW, "in_swing_s": below(P.shortest_swing * P.longest_swing_stride_s)}, False),
    (Transition.T3, "the least fall", {"toe_down_peak_radps": LEAST_FALL, "toe_up_peak_radps": 0.0,
                                       "toe_down_radps": 0.01}, True),
    (Transition.T3, "no mid-swing yet", {"toe_down_peak_radps": below(LEAST_FALL), "toe_up_peak_radps": 0.0,
                                         "toe_down_radps": 0.01}, False),
    (Transition.T3, "a dragged foot's mid-swing", {**SHUFFLED, "toe_up_peak_radps": TOE_UP}, True),
    (Transition.T3, "a dragged foot before that", {**SHUFFLED, "toe_up_peak_radps": below(TOE_UP)}, False),
    (Transition.T3, "of a weak push-off, a dragged foot's mid-swing",
     {**SHUFFLED, "push_off_radps": 2.0, "toe_up_peak_radps": WEAK_TOE_UP}, True),
    (Transition.T3, "of a weak push-off, a dragged foot before that",
     {**SHUFFLED, "push_off_radps": 2.0, "toe_up_peak_radps": below(WEAK_TOE_UP)}, False),
    (Transition.T3, "still in mid-swing", {"toe_down_radps": -P.rising_share * UP_RADPS}, False),
    (Transition.T3, "mid-swing is just over", {"toe_down_radps": above(-P.rising_share * UP_RADPS)}, True),
    (Transition.T3, "landed", {**SILENT, "toe_down_radps": above(P.landed_share * RATE)}, True),
    (Transition.T3, "not yet landed", {**SILENT, "toe_down_radps": P.landed_share * RATE}, False),
    (Transition.T3, "struck", STRUCK, True),
    (Transition.T3, "not yet turned back", {**STRUCK, "toe_down_radps": P.struck_share * RATE}, False),
    (Transition.T3, "runs out above the ground", {**STRUCK, "toe_down_change_radps2": P.struck_per_s * RATE}, False),
    (Transition.T3, "a soft contact", {**SILENT, "resting_s": above(SOFT_S)}, True),
    (Transition.T3, "has just come to rest", {**SILENT, "resting_s": SOFT_S}, False),
    (Transition.T3, "glides", {**SILENT, "resting_s": above(SOFT_S), "travelling": True}, False),
    (Transition.T4, "the foot is flat", {}, True),
    (Transition.T4, "too soon after contact", {"since_contact_s": P.shortest_loading * STRIDE_S}, False),
    (Transition.T4, "just late enough", {"since_contact_s": above(P.shortest_loading * STRIDE_S)}, True),
    (Transition.T4, "has just come to rest", {"resting_s": FLAT_S}, False),
    (Transition.T4, "has rested long enough", {"resting_s": above(FLAT_S)}, True),
    (Transition.T4, "moves, as it may", {"resting_s": 0.0, "since_contact_s": P.longest_loading * STRIDE_S}, False),
    (Transition.T4, "lies flat", {"resting_s": 0.0, "pitch_rad": below(P.flat_rad)}, True),
    (Transition.T4, "toe-up at the limit", {"resting_s": 0.0, "pitch_rad": P.flat_rad}, False),
    (Transition.T4, "toe-down, flat", {"resting_s": 0.0, "pitch_rad": above(-P.flat_rad)}, True),
    (Transition.T4, "toe-down at the limit", {"resting_s": 0.0, "pitch_rad": -P.flat_rad}, False),
    (Transition.T4, "moves for too long",
     {"resting_s": 0.0, "since_contact_s": above(P.longest_loading * STRIDE_S)}, True),
    (Transition.T4, "a slow walker's moves, as it may", {**LONG, "since_contact_s": LOADED_S}, False),
    (Transition.T4, "a slow walker's moves for too long", {**LONG, "since_contact_s": above(LOADED_S)}, True),
    *(
        case
        for transition in (Transition.T5, Transition.T6)
        for case in (
            (transition, "at rest for long", {}, True),
            (transition, "has just come to rest", {"resting_s": REST_S}, False),
            (transition, "has rested long enough", {"resting_s": above(REST_S)}, True),
            (transition, "travels", {"travelling": True}, False),
        )
    ),
]  # fmt: skip


@pytest.mark.requirement("SR-02")
@pytest.mark.parametrize(("transition", "about", "differs", "expected"), CASES, ids=lambda v: str(v)[:40])
def test_guard_clause(transition: Transition, about: str, differs: dict[str, Any], expected: bool) -> None:
    assert GUARDS[transition](*seen(transition, differs)) is expected


class _Mutation(ast.NodeTransformer):
    """Change one place of a guard: leave out a clause, a refusal, a ``not``, one of two bounds, a minus sign, or let a
    limit in or out."""

    def __init__(self, number: int) -> None:
        self.number = number
        self.seen = 0
        self.what = ""

    def _now(self, what: str) -> bool:
        self.seen += 1
        if self.seen - 1 != self.number:
            return False
        self.what = what
        return True

    def visit_BoolOp(self, node: ast.BoolOp) -> ast.AST:
        for index, value in enumerate(node.values):
            if self._now(f"without {ast.unparse(value)}"):
                rest = [v for k, v in enumerate(node.values) if k != index]
                return rest[0] if len(rest) == 1 else ast.BoolOp(node.op, rest)
        return self.generic_visit(node)

    def visit_If(self, node: ast.If) -> ast.AST:
        if self._now(f"never {ast.unparse(node.test)}"):
            return ast.Pass()
        return self.generic_visit(node)

    def visit_UnaryOp(self, node: ast.UnaryOp) -> ast.AST:
        if self._now(f"bare {ast.unparse(node)}"):
            return node.operand
        return self.generic_visit(node)

    def visit_Call(self, node: ast.Call) -> ast.AST:
        for bound in node.args:
            if self._now(f"only {ast.unparse(bound)} of {ast.unparse(node)}"):
                return bound
        return self.generic_visit(node)

    def visit_Compare(self, node: ast.Compare) -> ast.AST:
        other = {ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt}[type(node.ops[0])]
        if self._now(f"limit of {ast.unparse(node)}"):
            return ast.Compare(node.left, [other()], node.comparators)
        return self.generic_visit(node)


def mutants(transition: Transition) -> list[tuple[str, NetworkGuard]]:
    source = inspect.getsource(GUARDS[transition])
    found: list[tuple[str, NetworkGuard]] = []
    for number in itertools.count():
        mutation = _Mutation(number)
        tree = ast.fix_missing_locations(mutation.visit(ast.parse(source)))
        if not mutation.what:
            break
        space: dict[str, Any] = {"Features": Features, "Thresholds": Thresholds}
        exec(compile(tree, "mutant", "exec"), space)
        found.append((mutation.what, space[transition.name.lower()]))
    return found


@pytest.mark.parametrize("transition", list(GUARDS), ids=lambda t: t.name)
def test_no_clause_of_a_guard_can_be_left_out_unnoticed(transition: Transition) -> None:
    changed = mutants(transition)
    assert len(changed) >= 2
    for what, guard in changed:
        noticed = [
            about
            for of, about, differs, expected in CASES
            if of is transition and guard(*seen(of, differs)) is not expected
        ]
        assert noticed, f"{transition.name} {what}"


# --- the machine -----------------------------------------------------------------------------------------


def machine_in(phase: Phase) -> GaitPhaseMachine:
    """A machine led into a phase the regular way."""
    machine = GaitPhaseMachine(FOOT)
    for transition in {
        Phase.STANCE: (),
        Phase.PRE_SWING: (Transition.T1,),
        Phase.SWING: (Transition.T1, Transition.T2),
        Phase.LOADING_RESPONSE: (Transition.T1, Transition.T2, Transition.T3),
    }[phase]:
        machine.fire(transition, 0, TRUE[transition], P)
    assert machine.phase is phase
    return machine


FALSE = dict.fromkeys(GUARDS, NOTHING)


@pytest.mark.requirement("SR-03")
@pytest.mark.parametrize("allowed", [True, False], ids=["guard true", "guard false"])
@pytest.mark.parametrize("transition", list(Transition), ids=lambda t: t.name)
@pytest.mark.parametrize("phase", list(Phase), ids=lambda p: p.name)
def test_exactly_the_six_rows(phase: Phase, transition: Transition, allowed: bool) -> None:
    machine = machine_in(phase)
    x = (TRUE if allowed else FALSE).get(transition, NOTHING)
    destination = SIX.get((phase, transition)) if allowed else None
    if destination is not None:
        change = machine.fire(transition, 7, x, P)
        assert change == PhaseChange(7, FOOT, transition, phase, destination)
        assert machine.phase is destination
    else:
        with pytest.raises(GuardDisagreement, match=rf"{transition.name} from {phase.name} of {FOOT}"):
            machine.fire(transition, 7, x, P)
        assert machine.phase is phase


def test_the_table_is_the_six_rows_in_order() -> None:
    assert {(row.source, row.transition): row.destination for row in TABLE} == SIX
    assert [row.transition.value for row in TABLE] == [1, 2, 3, 4, 5, 6]
    assert [row.guard for row in TABLE] == [guards.t1, guards.t2, guards.t3, guards.t4, guards.t5, guards.t6]


def test_no_way_round_the_guards() -> None:
    machine = GaitPhaseMachine(FOOT)
    assert set(machine._machine.events) == {f"T{number}" for number in range(1, 7)}
    assert not [name for name in dir(machine) if name.startswith("to_")]


def test_a_guard_that_fails_is_no_refusal_in_silence() -> None:
    machine = GaitPhaseMachine(FOOT)
    nothing: Any = None
    with pytest.raises(GuardDisagreement, match=r"T1 from STANCE of left_foot: .*NoneType"):
        machine.fire(Transition.T1, 0, nothing, P)
    assert machine.phase is Phase.STANCE


@pytest.mark.parametrize("phase", list(Phase), ids=lambda p: p.name)
def test_restart_goes_to_stance_without_a_transition(phase: Phase) -> None:
    machine = machine_in(phase)
    assert machine.restart(11) == PhaseChange(11, FOOT, Transition.NONE, phase, Phase.STANCE)
    assert machine.phase is Phase.STANCE
    assert machine.fire(Transition.T1, 12, HEEL_RISE, P).destination is Phase.PRE_SWING


def test_two_feet_do_not_share_a_phase() -> None:
    left, right = GaitPhaseMachine("left_foot"), GaitPhaseMachine("right_foot")
    left.fire(Transition.T1, 0, HEEL_RISE, P)
    assert (left.phase, right.phase) == (Phase.PRE_SWING, Phase.STANCE)


# --- priority: of two rows that leave a phase, the first in the table goes -------------------------------


def by_the_table(phase: Phase, x: Features, p: Thresholds) -> int:
    return next((row.transition.value for row in TABLE if row.source is phase and row.guard(x, p)), 0)


def test_contact_goes_before_rest() -> None:
    """T3 before T6: a contact that was seen is worth more than a rest that only seems."""
    both = CONTACT._replace(resting_s=RESTING.resting_s)
    assert guards.t3(both, P)
    assert guards.t6(both, P)
    assert kernel.first_transition(Phase.SWING, both, P) == Transition.T3


def test_toe_off_goes_before_a_heel_put_back() -> None:
    both = TOE_OFF._replace(resting_s=RESTING.resting_s)
    assert guards.t2(both, P)
    assert guards.t5(both, P)
    assert kernel.first_transition(Phase.PRE_SWING, both, P) == Transition.T2


# --- compiled and plain guards agree ---------------------------------------------------------------------


def _grid() -> list[tuple[Any, ...]]:
    """All combinations of values at and just beyond every limit."""

    def beside(*limits: float) -> list[float]:
        return [f(limit) for limit in limits for f in (float, above)]

    rows: list[tuple[Any, ...]] = []
    for peak in (below(LEAST_PEAK), LEAST_PEAK, RATE):
        for up in (below(TOE_UP), TOE_UP, UP_RADPS):
            rates = (P.heel_rise_share * RATE, below(-TOE_UP), P.landed_share * RATE)
            rows += itertools.product(
                beside(*rates, P.struck_share * RATE, (1.0 - P.push_off_drop) * peak, below(0.0), -P.rising_share * up),
                beside(P.struck_per_s * RATE),
                (peak,),
                (up,),
                beside(P.heel_rise_rad),
                beside(below(-P.flat_rad), below(P.flat_rad)),
                beside(JERK_MPS3),
                beside(below(P.shortest_swing * STRIDE_S)),
                beside(*(s * STRIDE_S for s in (P.shortest_loading, P.longest_loading, P.heel_rise_after))),
                beside(*(s * STRIDE_S for s in (P.flat_share, P.soft_contact, P.put_back))),
                (False, True),
            )
    return rows


GRID = _grid()


@numba.njit
def _fired(values: np.ndarray, p: Thresholds, out: np.ndarray) -> None:
    for i in range(values.shape[0]):
        v = values[i]
        x = Features(v[0], v[1], v[2], v[3], v[4], v[5], v[6], v[7], v[8], v[9], v[10] != 0.0)
        for phase in range(4):
            out[i, phase] = kernel.first_transition(phase, x, p)


@pytest.mark.requirement("SR-03")
def test_compiled_guards_are_the_table_on_an_exhaustive_grid() -> None:
    values = np.array(GRID, dtype=np.float64)
    fired = np.empty((len(values), 4), np.int64)
    _fired(values, P, fired)
    expected = np.array([[by_the_table(phase, x, P) for phase in Phase] for x in itertools.starmap(Features, GRID)])
    assert len(GRID) > 50_000
    assert np.array_equal(fired, expected)
    for phase in Phase:  # the grid reaches every row
        assert set(fired[:, phase]) == {0} | {t.value for (source, t) in SIX if source is phase}


# --- the page that is written from the table -------------------------------------------------------------

MEASURES = ("push_off_radps", "fall_radps", "stride_s", "contact_jerk_mps3")  # no limits by themselves
PHASES_MD = Path(__file__).resolve().parents[2] / "docs" / "phases.md"


def test_the_page_is_up_to_date() -> None:
    assert diagram.main(["--check", str(PHASES_MD)]) == 0


def test_the_diagram_has_the_tables_arrows_and_no_others() -> None:
    arrows = [line.split(" : ")[0].split() for line in diagram.mermaid().splitlines() if "-->" in line]
    assert arrows[0] == ["[*]", "-->", "STANCE"]
    assert [(a, b) for a, _, b in arrows[1:]] == [(row.source.name, row.destination.name) for row in TABLE]
    assert all(len(diagram.condition(row)) > 10 for row in TABLE)


def test_every_threshold_is_described_with_its_unit() -> None:
    lines = diagram.thresholds_table().splitlines()[2:]
    assert [line.split("`")[1] for line in lines] == list(Thresholds._fields)
    for line in lines:
        name, value, unit, used, meaning = (cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1])
        default = Thresholds._field_defaults[name.strip("`")]
        assert ({"no": False, "yes": True}[value] if isinstance(default, bool) else float(value)) == default
        assert unit in {*diagram.UNITS.values(), "1/s", "–"}
        assert used.startswith("T") or name.strip("`") in MEASURES
        assert len(meaning) > 10
    for name, value in Thresholds._field_defaults.items():  # a physical quantity shows its unit, a share has none
        quantity = name.endswith(("_radps", "_rad", "_s", "_mps3"))
        assert (diagram.unit(name) != "–") is quantity, name
        assert quantity or isinstance(value, bool) or 0.0 < value < 1.0


def test_check_and_write(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    page = tmp_path / "page.md"
    page.write_text(f"above\n{diagram.BEGIN}\nof yesterday\n{diagram.END}\nbelow\n", encoding="utf-8")
    assert diagram.main(["--check", str(page)]) == 1
    assert "out of date" in capsys.readouterr().out
    assert diagram.main(["--write", str(page)]) == 0
    assert diagram.main(["--check", str(page)]) == 0
    text = page.read_text(encoding="utf-8")
    assert text.startswith("above\n")
    assert text.endswith("\nbelow\n")
    assert "yesterday" not in text
    assert diagram.main([]) == 0
    assert capsys.readouterr().out.strip() in text


@pytest.mark.parametrize("text", ["", f"{diagram.BEGIN}", f"{diagram.END}{diagram.BEGIN}"])
def test_a_page_without_markers_is_refused(tmp_path: Path, text: str, capsys: pytest.CaptureFixture[str]) -> None:
    page = tmp_path / "page.md"
    page.write_text(text, encoding="utf-8")
    with pytest.raises(SystemExit):
        diagram.main(["--write", str(page)])
    assert "page.md: expected one line" in capsys.readouterr().err
    assert page.read_text(encoding="utf-8") == text
