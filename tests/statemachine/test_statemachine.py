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

P = Thresholds()
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
MOVING = Features(
    a_rest=False, g_rest=False, toe_down_radps=1.0, toe_down_change_radps2=-5.0, toe_down_peak_radps=3.0,
    toe_up_peak_radps=0.0, vertical_jerk_mps3=0.0, in_phase_s=0.2, resting_s=0.0,
)  # fmt: skip
CONTACT = MOVING._replace(toe_down_radps=0.0, toe_up_peak_radps=2.0, vertical_jerk_mps3=700.0)
RESTING = Features(True, True, 0.0, 0.0, 3.0, 2.0, 0.0, 0.6, 0.2)
TRUE = {
    Transition.T1: MOVING,
    Transition.T2: MOVING,
    Transition.T3: CONTACT,
    Transition.T4: RESTING,
    Transition.T5: RESTING,
    Transition.T6: RESTING,
}


def seen(transition: Transition, differs: dict[str, Any]) -> tuple[Features, Thresholds]:
    """What makes the guard true, but for some features or thresholds."""
    features = {name: value for name, value in differs.items() if name in Features._fields}
    thresholds = {name: value for name, value in differs.items() if name in Thresholds._fields}
    assert len(features) + len(thresholds) == len(differs)
    return TRUE[transition]._replace(**features), P._replace(**thresholds)


def below(x: float) -> float:
    return math.nextafter(x, -math.inf)


def above(x: float) -> float:
    return math.nextafter(x, math.inf)


# (transition, what the case is about, features that differ from those under which the guard is true, expected)
CASES: list[tuple[Transition, str, dict[str, Any], bool]] = [
    (Transition.T1, "both move", {}, True),
    (Transition.T1, "the accelerometer rests", {"a_rest": True}, False),
    (Transition.T1, "the gyroscope rests", {"g_rest": True}, False),
    (Transition.T2, "both move", {}, True),
    (Transition.T2, "only the gyroscope moves", {"a_rest": True}, True),
    (Transition.T2, "only the accelerometer moves", {"g_rest": True}, True),
    (Transition.T2, "both rest", {"a_rest": True, "g_rest": True}, False),
    (Transition.T2, "the rate keeps still", {"toe_down_change_radps2": 0.0}, False),
    (Transition.T2, "the rate still rises", {"toe_down_change_radps2": 5.0}, False),
    (Transition.T2, "the rate falls ever so slowly", {"toe_down_change_radps2": below(0.0)}, True),
    (Transition.T2, "the least push-off", {"toe_down_peak_radps": 0.8, "toe_down_radps": 0.5}, True),
    (Transition.T2, "less than a push-off", {"toe_down_peak_radps": below(0.8), "toe_down_radps": 0.5}, False),
    (Transition.T2, "a ripple of the peak", {"toe_down_radps": (1.0 - 0.05) * 3.0}, False),
    (Transition.T2, "the peak is just left", {"toe_down_radps": below((1.0 - 0.05) * 3.0)}, True),
    (Transition.T2, "not yet reversed, asked to be", {"swing_at_reversal": True}, False),
    (Transition.T2, "at rest in between", {"swing_at_reversal": True, "toe_down_radps": 0.0}, False),
    (Transition.T2, "reversed", {"swing_at_reversal": True, "toe_down_radps": below(0.0)}, True),
    (Transition.T3, "a jump upward after mid-swing", {}, True),
    (Transition.T3, "a jump downward", {"vertical_jerk_mps3": -700.0}, True),
    (Transition.T3, "a jump at the limit", {"vertical_jerk_mps3": 600.0}, False),
    (Transition.T3, "a jump just above the limit", {"vertical_jerk_mps3": above(600.0)}, True),
    (Transition.T3, "no jump", {"vertical_jerk_mps3": 0.0}, False),
    (Transition.T3, "the least duration of a swing", {"in_phase_s": 0.12}, True),
    (Transition.T3, "the jolt of toe-off", {"in_phase_s": below(0.12)}, False),
    (Transition.T3, "the least mid-swing peak", {"toe_up_peak_radps": 0.75}, True),
    (Transition.T3, "no mid-swing peak yet", {"toe_up_peak_radps": below(0.75)}, False),
    (Transition.T3, "still in mid-swing", {"toe_down_radps": -0.3 * 2.0}, False),
    (Transition.T3, "mid-swing is just over", {"toe_down_radps": above(-0.3 * 2.0)}, True),
    (Transition.T3, "a dragged foot, early", {"toe_up_peak_radps": 0.1, "in_phase_s": below(0.45)}, False),
    (Transition.T3, "a dragged foot, late", {"toe_up_peak_radps": 0.1, "in_phase_s": 0.45}, True),
    (Transition.T3, "late, and still turning toe-up", {"toe_down_radps": -2.0, "in_phase_s": 0.45}, True),
    (Transition.T4, "both rest", {}, True),
    (Transition.T4, "the accelerometer moves", {"a_rest": False}, False),
    (Transition.T4, "the gyroscope moves", {"g_rest": False}, False),
    (Transition.T5, "both rest", {}, True),
    (Transition.T5, "the accelerometer moves", {"a_rest": False}, False),
    (Transition.T5, "the gyroscope moves", {"g_rest": False}, False),
    (Transition.T6, "both rest for long", {}, True),
    (Transition.T6, "the accelerometer moves", {"a_rest": False}, False),
    (Transition.T6, "the gyroscope moves", {"g_rest": False}, False),
    (Transition.T6, "the rate rises", {"toe_down_change_radps2": 15.0}, False),
    (Transition.T6, "the rate falls", {"toe_down_change_radps2": -20.0}, False),
    (Transition.T6, "the rate hardly changes", {"toe_down_change_radps2": below(15.0)}, True),
    (Transition.T6, "turns toe-down", {"toe_down_radps": 0.5}, False),
    (Transition.T6, "turns toe-up", {"toe_down_radps": -0.6}, False),
    (Transition.T6, "hardly turns", {"toe_down_radps": below(0.5)}, True),
    (Transition.T6, "has just come to rest", {"resting_s": below(0.15)}, False),
    (Transition.T6, "has rested long enough", {"resting_s": 0.15}, True),
]


@pytest.mark.parametrize(("transition", "about", "differs", "expected"), CASES, ids=lambda v: str(v)[:40])
def test_guard_clause(transition: Transition, about: str, differs: dict[str, Any], expected: bool) -> None:
    assert GUARDS[transition](*seen(transition, differs)) is expected


class _Mutation(ast.NodeTransformer):
    """Change one place of a guard: leave out a clause, a ``not``, an ``abs``, or let a limit in or out."""

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

    def visit_UnaryOp(self, node: ast.UnaryOp) -> ast.AST:
        if isinstance(node.op, ast.Not) and self._now(f"no not in {ast.unparse(node)}"):
            return node.operand
        return self.generic_visit(node)

    def visit_Call(self, node: ast.Call) -> ast.AST:
        if isinstance(node.func, ast.Name) and node.func.id == "abs" and self._now(f"no {ast.unparse(node)}"):
            return node.args[0]
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


FALSE = {transition: RESTING if transition.value <= 3 else MOVING for transition in GUARDS}


@pytest.mark.requirement("SR-03")
@pytest.mark.parametrize("allowed", [True, False], ids=["guard true", "guard false"])
@pytest.mark.parametrize("transition", list(Transition), ids=lambda t: t.name)
@pytest.mark.parametrize("phase", list(Phase), ids=lambda p: p.name)
def test_exactly_the_six_rows(phase: Phase, transition: Transition, allowed: bool) -> None:
    machine = machine_in(phase)
    x = (TRUE if allowed else FALSE).get(transition, MOVING)
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
    assert machine.fire(Transition.T1, 12, MOVING, P).destination is Phase.PRE_SWING


def test_two_feet_do_not_share_a_phase() -> None:
    left, right = GaitPhaseMachine("left_foot"), GaitPhaseMachine("right_foot")
    left.fire(Transition.T1, 0, MOVING, P)
    assert (left.phase, right.phase) == (Phase.PRE_SWING, Phase.STANCE)


# --- priority: of two rows that leave a phase, the first in the table goes -------------------------------


def by_the_table(phase: Phase, x: Features, p: Thresholds) -> int:
    return next((row.transition.value for row in TABLE if row.source is phase and row.guard(x, p)), 0)


def test_contact_goes_before_rest() -> None:
    """T3 before T6: a contact that was seen is worth more than a rest that only seems."""
    both = RESTING._replace(vertical_jerk_mps3=700.0)
    assert guards.t3(both, P)
    assert guards.t6(both, P)
    assert kernel.first_transition(Phase.SWING, both, P) == Transition.T3


def test_toe_off_and_heel_put_back_exclude_each_other() -> None:
    """T2 needs a sensor that moves, T5 two that rest: their order cannot matter."""
    for x in itertools.starmap(Features, GRID[::7]):
        assert not (guards.t2(x, P) and guards.t5(x, P))


# --- compiled and plain guards agree ---------------------------------------------------------------------


def _grid() -> list[tuple[Any, ...]]:
    """All combinations of values below, at and above every limit."""
    rows: list[tuple[Any, ...]] = []
    for peak in (below(0.8), 0.8, 3.0):
        ups = (below(P.mid_swing_share * peak), P.mid_swing_share * peak, 2.0)
        for up in ups:
            left, late = (1.0 - P.push_off_drop) * peak, -P.rising_share * up
            rates = {below(left), left, above(left), below(late), late, above(late)}
            rates |= {sign * f(P.still_rate_radps) for sign in (-1.0, 1.0) for f in (below, float, above)}
            rows += itertools.product(
                (False, True),
                (False, True),
                sorted(rates),
                (-20.0, -15.0, below(0.0), 0.0, below(15.0), 15.0),
                (peak,),
                (up,),
                (-above(600.0), -600.0, 0.0, 600.0, above(600.0)),
                (below(0.12), 0.12, below(0.45), 0.45),
                (below(0.15), 0.15),
            )
    return rows


GRID = _grid()


@numba.njit
def _fired(values: np.ndarray, p: Thresholds, out: np.ndarray) -> None:
    for i in range(values.shape[0]):
        v = values[i]
        x = Features(v[0] != 0.0, v[1] != 0.0, v[2], v[3], v[4], v[5], v[6], v[7], v[8])
        for phase in range(4):
            out[i, phase] = kernel.first_transition(phase, x, p)


@pytest.mark.requirement("SR-03")
def test_compiled_guards_are_the_table_on_an_exhaustive_grid() -> None:
    values = np.array(GRID, dtype=np.float64)
    fired = np.empty((len(values), 4), np.int64)
    _fired(values, P, fired)
    expected = np.array([[by_the_table(phase, x, P) for phase in Phase] for x in itertools.starmap(Features, GRID)])
    assert len(GRID) > 100_000
    assert np.array_equal(fired, expected)
    for phase in Phase:  # the grid reaches every row
        assert set(fired[:, phase]) == {0} | {t.value for (source, t) in SIX if source is phase}


# --- the page that is written from the table -------------------------------------------------------------

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
        assert unit in {*diagram.UNITS.values(), "–"}
        assert used.startswith("T")
        assert len(meaning) > 10
    for name in Thresholds._fields:  # a physical quantity shows its unit, a share or a factor has none
        none = name.endswith(("_drop", "_share", "leave_gyr", "leave_acc", "_at_reversal"))
        assert (diagram.unit(name) == "–") is none


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
