"""The phase machine: six rows and nothing else; every clause of every guard; compiled and plain guards agree."""

from __future__ import annotations

import ast
import inspect
import itertools
import math
from collections.abc import Callable
from typing import Any, TypeAlias

import numba
import numpy as np
import pytest

from fes.estimation.tracking import phase_features as kernel
from statemachine import guards
from statemachine.guards import Features, Thresholds
from statemachine.machine import GaitPhaseMachine, GuardDisagreement
from statemachine.phases import Phase, PhaseChange, Transition
from statemachine.table import TABLE

P = Thresholds(push_off_radps=8.0, fall_radps=12.0)  # a push-off that is more than half the fall
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
NOTHING = Features._make([0.0] * len(Features._fields))._replace(pitch_rad=1.0, travelling=False)
RATE, WEAK_RATE = P.push_off_radps, 0.5 * P.fall_radps
WEAK: dict[str, Any] = {"push_off_radps": 2.0}
LEAST_PEAK, LEAST_FALL = P.push_off_share * P.push_off_radps, P.mid_swing_share * P.fall_radps
LEFT = (1.0 - P.push_off_drop) * RATE  # the peak of a typical push-off is left below this rate
TOE_UP, WEAK_TOE_UP = P.toe_up_share * RATE, P.toe_up_share * WEAK_RATE
UP_RADPS = P.fall_radps - RATE
SWUNG = P.swung_share * P.fall_radps
JERK_MPS3 = P.jerk_share * P.contact_jerk_mps3
LIFTS_AFTER_S = P.lifts_after * P.stride_s
SWING_S, PUT_BACK_S = P.shortest_swing_share * P.swing_s, P.put_back_share * P.swing_s
LOADED_S = P.longest_loadings * P.loading_s
LANDED, WEAK_LANDED = P.rest_share * RATE, P.rest_share * WEAK_RATE
HEEL_RISE = NOTHING._replace(
    toe_down_radps=2.0 * P.heel_rise_share * RATE,
    turned_rad=2.0 * P.turn_rad,
    since_contact_s=2.0 * LIFTS_AFTER_S,
)
TOE_OFF = NOTHING._replace(toe_down_peak_radps=RATE, toe_down_radps=0.5 * RATE, turned_rad=2.0 * P.swing_turn_rad)
CONTACT = NOTHING._replace(
    toe_down_peak_radps=RATE,
    toe_up_peak_radps=UP_RADPS,
    contact_jerk_mps3=2.0 * JERK_MPS3,
    in_swing_s=2.0 * SWING_S,
    fallen_rad=2.0 * P.turn_rad,
    speed_share=1.0,
)
FLAT = NOTHING._replace(pitch_rad=0.0, since_contact_s=2.0 * P.shortest_loading_s)
RESTING = NOTHING._replace(resting_s=2.0 * PUT_BACK_S)
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


Case: TypeAlias = tuple[Transition, str, dict[str, Any], bool]  # what differs from what makes the guard true; expected


def edge(transition: Transition, about: str, name: str, holds: float, fails: float, **others: Any) -> list[Case]:
    """A limit from both sides: with ``holds`` the guard is just true, with ``fails`` it just is not."""
    return [
        (transition, about, {**others, name: holds}, True),
        (transition, f"not {about}", {**others, name: fails}, False),
    ]


def beyond(transition: Transition, about: str, name: str, limit: float, **others: Any) -> list[Case]:
    """True beyond the limit, away from zero, and not at it."""
    return edge(transition, about, name, math.nextafter(limit, math.copysign(math.inf, limit)), limit, **others)


T1, T2, T3, T4, T5, T6 = GUARDS
UNTURNED: dict[str, Any] = {"turned_rad": 0.0, "since_contact_s": 2.0 * LIFTS_AFTER_S}
DRAGGED: dict[str, Any] = {"toe_down_peak_radps": 0.0}
CARRIED: dict[str, Any] = {**DRAGGED, "travelling": True}
SHUFFLED: dict[str, Any] = {**DRAGGED, "toe_down_radps": 0.01}  # hardly a fall
SILENT: dict[str, Any] = {"contact_jerk_mps3": 0.0}
CALM_S = above(P.soft_contact_s)
CALM: dict[str, Any] = {"contact_jerk_mps3": 0.0, "fallen_rad": 0.0, "resting_s": CALM_S, "calm_s": CALM_S}
SCUFFS: dict[str, Any] = {"fallen_rad": 0.0}
SLOWED: dict[str, Any] = {"fallen_rad": 0.0, "speed_share": 0.5 * P.slowed_share}
TILTED: dict[str, Any] = {"pitch_rad": 1.0}
PEAK = 2.0 * LANDED
PLATEAU: dict[str, Any] = {"pitch_rad": 2.0 * P.flat_rad, "pitch_sd_rad": P.flat_rad, "landing_peak_radps": PEAK}
OFF_RAD = P.near_sds * P.flat_rad

CASES: list[Case] = [
    *((transition, "all of it", {}, True) for transition in GUARDS),
    *beyond(T1, "fast enough", "toe_down_radps", P.heel_rise_share * RATE),
    *beyond(T1, "fast enough for a weak push-off", "toe_down_radps", P.heel_rise_share * WEAK_RATE, **WEAK),
    *beyond(T1, "turned enough since it stood still", "turned_rad", P.turn_rad),
    *beyond(T1, "late enough after contact", "since_contact_s", LIFTS_AFTER_S),
    *beyond(T1, "dragged off", "toe_down_radps", -TOE_UP, **UNTURNED),
    *beyond(T1, "dragged off after a weak push-off", "toe_down_radps", -WEAK_TOE_UP, **UNTURNED, **WEAK),
    *beyond(T1, "dragged off late enough", "since_contact_s", LIFTS_AFTER_S, toe_down_radps=-above(TOE_UP)),
    *beyond(T1, "a swing that stance missed", "toe_down_radps", -SWUNG, since_contact_s=above(P.swung_after_s)),
    *beyond(T1, "later than a rebound", "since_contact_s", P.swung_after_s, toe_down_radps=-above(SWUNG)),
    *edge(T2, "a push-off", "toe_down_peak_radps", LEAST_PEAK, below(LEAST_PEAK), toe_down_radps=0.0),
    *edge(T2, "more than a ripple", "toe_down_radps", below(LEFT), LEFT),
    *beyond(T2, "turned as a foot that leaves", "turned_rad", P.swing_turn_rad),
    *edge(T2, "reversed, as asked", "toe_down_radps", below(0.0), 0.0, swing_at_reversal=True),
    *beyond(T2, "dragged off", "toe_down_radps", -TOE_UP, **DRAGGED),
    *beyond(T2, "dragged off, asked to be reversed", "toe_down_radps", -TOE_UP, **DRAGGED, swing_at_reversal=True),
    *beyond(T2, "dragged off after a weak push-off", "toe_down_radps", -WEAK_TOE_UP, **DRAGGED, **WEAK),
    *beyond(T2, "carried along", "toe_down_radps", -P.rest_share * RATE, **CARRIED),
    *beyond(T2, "carried after a weak push-off", "toe_down_radps", -P.rest_share * WEAK_RATE, **CARRIED, **WEAK),
    (T2, "a heel that is put back", {**DRAGGED, "toe_down_radps": -above(P.rest_share * RATE)}, False),
    *beyond(T3, "a jump", "contact_jerk_mps3", JERK_MPS3),
    *edge(T3, "later than the jolt of foot off", "in_swing_s", SWING_S, below(SWING_S)),
    (T3, "as soon in a slow stride", {"in_swing_s": SWING_S, "stride_s": 3.0 * P.stride_s}, True),
    (T3, "a slow swing's jolt of foot off", {"in_swing_s": SWING_S, "swing_s": 1.01 * P.swing_s}, False),
    *edge(T3, "the least fall", "toe_down_peak_radps", LEAST_FALL, below(LEAST_FALL), toe_up_peak_radps=0.0,
          toe_down_radps=0.01),
    *edge(T3, "mid-swing of a dragged foot", "toe_up_peak_radps", TOE_UP, below(TOE_UP), **SHUFFLED),
    *edge(T3, "the same after a weak push-off", "toe_up_peak_radps", WEAK_TOE_UP, below(WEAK_TOE_UP), **SHUFFLED,
          **WEAK),
    *beyond(T3, "landed", "toe_down_radps", LANDED, **SILENT),
    *beyond(T3, "landed after a weak push-off", "toe_down_radps", WEAK_LANDED, **SILENT, **WEAK),
    *beyond(T3, "coming down", "fallen_rad", P.turn_rad),
    *edge(T3, "slowed", "speed_share", below(P.slowed_share), P.slowed_share, **SCUFFS),
    *edge(T3, "slowed and past mid-swing", "toe_down_radps", above(-P.slowed_share * UP_RADPS),
          -P.slowed_share * UP_RADPS, **SLOWED),
    *beyond(T3, "swung without a rate", "swung_rad", P.swing_turn_rad, **SHUFFLED, toe_up_peak_radps=0.0),
    *beyond(T3, "at rest with gravity alone", "resting_s", P.soft_contact_s, **{**CALM, "resting_s": 0.0}),
    *beyond(T3, "gravity alone", "calm_s", P.soft_contact_s, **{**CALM, "calm_s": 0.0}),
    (T3, "glides", {**CALM, "travelling": True}, False),
    *beyond(T4, "later than the jolt of contact", "since_contact_s", P.shortest_loading_s),
    *edge(T4, "flat from toe-up", "pitch_rad", below(P.flat_rad), P.flat_rad),
    *edge(T4, "flat from toe-down", "pitch_rad", above(-P.flat_rad), -P.flat_rad),
    *beyond(T4, "turned when it landed", "landing_peak_radps", LANDED, **{**PLATEAU, "toe_down_radps": 0.0}),
    *beyond(T4, "the same after a weak push-off", "landing_peak_radps", WEAK_LANDED, **PLATEAU, **WEAK),
    *edge(T4, "hardly toe-down any more", "toe_down_radps", below(P.settled_share * PEAK), P.settled_share * PEAK,
          **PLATEAU),
    *edge(T4, "hardly toe-up any more", "toe_down_radps", above(-P.settled_share * PEAK), -P.settled_share * PEAK,
          **PLATEAU),
    *edge(T4, "near enough from toe-up", "pitch_rad", below(OFF_RAD), OFF_RAD, **PLATEAU),
    *edge(T4, "near enough from toe-down", "pitch_rad", above(-OFF_RAD), -OFF_RAD, **PLATEAU),
    *beyond(T4, "stands still", "settled_s", P.settled_after_s, **TILTED),
    *beyond(T4, "loading for too long", "since_contact_s", LOADED_S, **TILTED),
    *(case for transition in (T5, T6) for case in (
        *beyond(transition, "at rest for long", "resting_s", PUT_BACK_S), (transition, "travels", {"travelling": True},
                                                                          False))),
]  # fmt: skip


@pytest.mark.requirement("SR-02")
@pytest.mark.parametrize(("transition", "about", "differs", "expected"), CASES, ids=lambda v: str(v)[:40])
def test_guard_clause(transition: Transition, about: str, differs: dict[str, Any], expected: bool) -> None:
    assert GUARDS[transition](*seen(transition, differs)) is expected


class _Mutation(ast.NodeTransformer):
    """Change one place of a guard: leave out a clause, one of two bounds or a minus sign, turn a flag round, or let a
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

    def visit_BinOp(self, node: ast.BinOp) -> ast.AST:
        if isinstance(node.op, ast.BitAnd | ast.BitOr):
            for left_out, kept in ((node.left, node.right), (node.right, node.left)):
                if self._now(f"without {ast.unparse(left_out)}"):
                    return kept
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
        other = {
            ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq
        }[type(node.ops[0])]  # fmt: skip
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
        space: dict[str, Any] = dict(vars(guards))
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


# --- compiled and plain guards agree ---------------------------------------------------------------------


def by_the_table(phase: Phase, x: Features, p: Thresholds) -> int:
    """Of two rows that leave a phase, the first in the table goes."""
    return next((row.transition.value for row in TABLE if row.source is phase and row.guard(x, p)), 0)


def _grid() -> list[tuple[Any, ...]]:
    """All combinations of values at and just beyond the limits."""

    def beside(*limits: float) -> list[float]:
        return [f(limit) for limit in limits for f in (float, above)]

    rows: list[tuple[Any, ...]] = []
    for peak, up in itertools.product((below(LEAST_PEAK), LEAST_PEAK, RATE), (below(TOE_UP), UP_RADPS)):
        rates = (P.heel_rise_share * RATE, below(-TOE_UP), LANDED, below(P.settled_share * above(LANDED)), below(0.0))
        rows += itertools.product(
            beside(*rates, (1.0 - P.push_off_drop) * peak, -P.slowed_share * up),
            (peak,),
            (up,),
            beside(LANDED),
            (P.turn_rad, above(P.turn_rad), above(P.swing_turn_rad)),
            (0.0, below(-OFF_RAD), above(-OFF_RAD)),
            (P.flat_rad,),
            beside(JERK_MPS3),
            beside(below(SWING_S)),
            (P.shortest_loading_s, *map(above, (P.shortest_loading_s, LIFTS_AFTER_S, LOADED_S))),
            (P.soft_contact_s, *map(above, (P.soft_contact_s, PUT_BACK_S))),
            beside(P.settled_after_s),
            (above(P.soft_contact_s),),
            beside(below(P.slowed_share)),
            (0.0,),
            (P.turn_rad, above(P.turn_rad)),
            (False, True),
        )
    return rows


GRID = _grid()


@numba.njit
def _fired(values: np.ndarray, p: Thresholds, out: np.ndarray) -> None:
    for i in range(values.shape[0]):
        v = values[i]
        x = Features(
            v[0], v[1], v[2], v[3], v[4], v[5], v[6], v[7], v[8], v[9], v[10], v[11], v[12], v[13],
            v[14], v[15], v[16] != 0.0
        )  # fmt: skip
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
