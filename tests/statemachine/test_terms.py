"""A guard's terms are the guard: the same answer whatever it is given; why not is what failed."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from statemachine.guards import Features, Thresholds
from statemachine.table import TABLE, Row
from statemachine.terms import Term, Terms, terms_of

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
    assert terms.holds == row.guard(x, p)
    assert bool(terms.why_not()) == (not terms.holds)
    assert len(list(terms.each())) >= 2


def late(x: Features, p: Thresholds) -> bool:
    """Only for this test."""
    least_s = 2.0 * p.stride_s
    if x.in_swing_s < least_s or not x.travelling:
        return False
    return x.toe_down_radps > 1.0 or not x.turned_rad <= 0.5


def test_values_limits_signs_and_reasons() -> None:
    x = Features(*[0.0] * (len(Features._fields) - 1), False)._replace(in_swing_s=3.0, toe_down_radps=0.25)
    terms = terms_of(late, x, Thresholds(stride_s=1.0))
    assert list(terms.each()) == [
        Term("in swing", 3.0, "≥", 2.0, "least_s", "s", True),
        Term("travelling", False, "=", True, "", "yes or no", False),
        Term("toe down", 0.25, ">", 1.0, "1.0", "rad/s", False),
        Term("turned", 0.0, ">", 0.5, "0.5", "rad", False),
    ]
    assert terms.why_not() == (
        "travelling: no, must be yes, and none of these: toe down 0.25 ≤ 1 rad/s; turned 0 ≤ 0.5 rad"
    )
    assert isinstance(terms, Terms)


def odd(x: Features, p: Thresholds) -> bool:
    """Only for this test."""
    for _ in range(2):
        pass
    return x.travelling


def test_a_guard_that_is_written_otherwise_is_refused() -> None:
    with pytest.raises(ValueError, match=r"odd: .* is not understood"):
        terms_of(odd, Features(*[0.0] * len(Features._fields)), Thresholds())
