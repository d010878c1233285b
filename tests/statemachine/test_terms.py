"""A guard's terms are the guard: the same answer whatever it is given; why not is what failed."""

from __future__ import annotations

import ast
import inspect

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from statemachine.guards import NO, YES, Features, Thresholds
from statemachine.table import TABLE, Row
from statemachine.terms import Term, terms_of

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
