"""docs/phases.md and its pictures are what the code says now."""

from __future__ import annotations

import ast
import inspect
import re
from pathlib import Path

import numpy as np
import phases_page
import pytest
from hypothesis import given
from hypothesis import strategies as st
from phases_page import ARROWS, BOX, PLACES, Shown, condition, looks_at

from benchmarks.accuracy import left_out
from statemachine.guards import NO, YES, Features, Thresholds
from statemachine.phases import Phase, Transition
from statemachine.table import TABLE, Row
from statemachine.terms import UNITS, Term, terms_of, unit

MEASURES = (  # no limits by themselves
    "push_off_radps", "fall_radps", "stride_s", "swing_s", "loading_s", "contact_jerk_mps3"
)  # fmt: skip
MULTIPLES = ("near_sds", "longest_loadings")  # which may be more than one


@pytest.fixture(scope="module")
def stride() -> Shown:
    return phases_page.stride_shown()


def test_the_page_is_up_to_date() -> None:
    assert phases_page.main(["--check"]) == 0


def on_the_edge(phase: Phase, x: float, y: float) -> bool:
    left, top = abs(x - PLACES[phase][0]), abs(y - PLACES[phase][1])
    return (left == BOX[0] / 2 and top <= BOX[1] / 2) or (top == BOX[1] / 2 and left <= BOX[0] / 2)


def test_the_picture_has_the_tables_arrows_and_no_others() -> None:
    assert list(ARROWS) == [row.transition for row in TABLE]
    picture = re.sub(r"</text>\n<text[^>]*>", " ", phases_page.states_picture())
    assert picture.count("marker-end") == len(TABLE)
    for row in TABLE:
        x1, y1, x2, y2, *_ = ARROWS[row.transition]
        assert on_the_edge(row.source, x1, y1)
        assert on_the_edge(row.destination, x2, y2)
        assert len(condition(row)) > 10
        assert f"{row.transition.name} {condition(row)}<" in picture
    assert all(f">{phases_page.name_of(phase)}</text>" in picture for phase in Phase)


def test_what_a_guard_looks_at_is_what_it_compares() -> None:
    seen = {row.transition: looks_at(row) for row in TABLE}
    assert "turned" in seen[Transition.T1]
    assert "contact jerk" in seen[Transition.T3]
    assert seen[Transition.T5] == ["resting", "travelling"]


def test_every_threshold_is_described_with_its_unit_and_origin() -> None:
    lines = phases_page.thresholds_table().splitlines()[2:]
    assert [line.split("`")[1] for line in lines] == list(Thresholds._fields)
    for line in lines:
        name, value, of, used, meaning, origin = (cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1])
        default = Thresholds._field_defaults[name.strip("`")]
        assert ({"no": False, "yes": True}[value] if isinstance(default, bool) else float(value)) == default
        assert of in {*UNITS.values(), "–"}
        assert (used == "measure") is (name.strip("`") in MEASURES)
        assert used == "measure" or re.fullmatch(r"T\d(, T\d)*", used)
        assert re.fullmatch(r"[A-Z][^…]{15,}\.", meaning), "a sentence of its own"
        assert re.fullmatch(r"[A-Z0-9].{3,}\.", origin)
        assert (re.search(r"\bdata\b", origin, re.IGNORECASE) is not None) is (name.strip("`") in left_out.GUARDS)
    for name, value in Thresholds._field_defaults.items():  # a physical quantity shows its unit, a share has none
        quantity = name.endswith(("_radps", "_rad", "_s", "_mps3"))
        assert (unit(name) != "–") is quantity, name
        assert quantity or isinstance(value, bool) or 0.0 < value < (10.0 if name in MULTIPLES else 1.0)


def test_the_stride_that_is_shown_is_a_whole_one(stride: Shown) -> None:
    assert [transition for _, transition, _ in stride.changes] == [Transition(k) for k in (1, 2, 3, 4)]
    for k, transition, terms in stride.changes:
        (row,) = (row for row in TABLE if row.transition is transition)
        assert terms.holds is row.guard(*stride.seen[k]) is True
        assert stride.phase[k] is row.source
        held = list(phases_page.held_by(terms))
        assert held
        assert all(term.holds for term in held)
    assert len(stride.table().splitlines()) == 2 + 4


def test_check_and_write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("PAGE", "STATES", "STRIDE"):
        monkeypatch.setattr(phases_page, name, tmp_path / getattr(phases_page, name).name)
    page = tmp_path / "phases.md"
    page.write_text(f"above\n{phases_page.BEGIN}\nof yesterday\n{phases_page.END}\nbelow\n", encoding="utf-8")
    assert phases_page.main(["--check"]) == 1
    told = capsys.readouterr().out
    assert all(f"{name} is out of date" in told for name in ("phases.md", "phases.svg", "phases_stride.svg"))
    assert phases_page.main([]) == 0
    assert phases_page.main(["--check"]) == 0
    text = page.read_text(encoding="utf-8")
    assert text.startswith("above\n")
    assert text.endswith("\nbelow\n")
    assert "yesterday" not in text


@pytest.mark.parametrize("text", ["", f"{phases_page.BEGIN}", f"{phases_page.END}{phases_page.BEGIN}"])
def test_a_page_without_markers_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="expected one line"):
        phases_page.updated(text, "new")


# --- A guard's terms are the guard: the same answer whatever it is given; why not is what failed ---


numbers = st.floats(-20.0, 20.0) | st.sampled_from([0.0, 0.07, 0.3])
features = st.builds(Features, *[numbers] * (len(Features._fields) - 1), st.booleans())
thresholds = st.builds(
    lambda shares, flag: Thresholds(
        *[
            flag if isinstance(default, bool) else default * share
            for default, share in zip(Thresholds(), shares, strict=True)
        ]
    ),
    st.lists(st.floats(0.1, 5.0), min_size=len(Thresholds._fields), max_size=len(Thresholds._fields)),
    st.booleans(),
)


@pytest.mark.parametrize("row", TABLE, ids=lambda row: row.transition.name)
@given(x=features, p=thresholds)
def test_terms_say_what_the_guard_says(row: Row, x: Features, p: Thresholds) -> None:
    terms = terms_of(row.guard, x, p)
    assert terms.holds is row.guard(x, p)
    assert bool(terms.why_not()) == (not terms.holds)
    assert len(list(terms.each())) >= 2


@pytest.mark.parametrize("row", TABLE, ids=lambda row: row.transition.name)
@given(samples=st.lists(features, min_size=1, max_size=5), p=thresholds)
def test_terms_of_many_samples_are_those_of_each(row: Row, samples: list[Features], p: Thresholds) -> None:
    together = terms_of(row.guard, Features._make(map(np.array, zip(*samples, strict=True))), p)
    for k, x in enumerate(samples):
        alone = terms_of(row.guard, x, p)
        assert np.broadcast_to(together.holds, len(samples))[k] == alone.holds
        for one, each in zip(together.each(), alone.each(), strict=True):
            assert (one.what, one.sign, one.limit_is, one.unit) == (each.what, each.sign, each.limit_is, each.unit)
            for many, single in ((one.seen, each.seen), (one.limit, each.limit), (one.holds, each.holds)):
                assert np.broadcast_to(many, len(samples))[k] == single


@pytest.mark.parametrize("row", TABLE, ids=lambda row: row.transition.name)
def test_every_comparison_of_a_guard_is_always_made(row: Row) -> None:
    """What ``and``, ``or``, ``not`` and an early return pass over, an explanation would not show."""
    tree = ast.parse(inspect.getsource(row.guard))
    used = {type(node) for node in ast.walk(tree)}
    assert not used & {ast.BoolOp, ast.Not, ast.If, ast.IfExp, ast.While, ast.For}
    compared = sum(isinstance(node, ast.Compare) for node in ast.walk(tree))
    none = Features._make([0.0] * (len(Features._fields) - 1) + [False])
    assert len(list(terms_of(row.guard, none, Thresholds()).each())) == compared


def late(x: Features, p: Thresholds) -> bool:
    """Only for this test."""
    least_s = 2.0 * min(p.stride_s, p.longest_loadings)
    turned = (abs(x.toe_down_radps) > 1.0 - 0.5 * p.push_off_drop) | (-x.turned_rad > 0.5) | (p.swing_at_reversal == NO)
    return (x.in_swing_s - 1.0 >= least_s) & (x.travelling == YES) & turned


def test_values_limits_signs_and_reasons() -> None:
    x = Features._make([0.0] * (len(Features._fields) - 1) + [False])._replace(in_swing_s=3.5, toe_down_radps=-0.25)
    terms = terms_of(late, x, Thresholds(stride_s=1.0, push_off_drop=0.5, swing_at_reversal=True))
    assert list(terms.each()) == [
        Term("in swing − 1", 2.5, "≥", 2.0, "2 · stride_s", "s", True),
        Term("travelling", False, "=", True, "", "yes or no", False),
        Term("|toe down|", 0.25, ">", 0.75, "1 − 0.5 · push_off_drop", "rad/s", False),
        Term("−turned", 0.0, ">", 0.5, "0.5", "rad", False),
        Term("swing_at_reversal", True, "=", False, "", "yes or no", False),
    ]
    assert terms.why_not() == (
        "travelling: no, must be yes, and none of these holds: |toe down| 0.25 > 0.75 rad/s; −turned 0 > 0.5 rad; "
        "swing_at_reversal: yes, must be no"
    )
    assert not terms.holds
    alone = terms_of(lambda x, p: x.toe_up_peak_radps * (p.rest_share + 1.0) < 3.0 / p.stride_s, x, Thresholds())
    assert [(str(term), term.limit_is) for term in alone.each()] == [
        ("toe up peak · (rest_share + 1) 0 < 2.5 rad/s", "3 / stride_s")
    ]
