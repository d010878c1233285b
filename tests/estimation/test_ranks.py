"""Medians and percentiles are numpy's, to the bit."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fes.estimation.numerics.ranks import median, percentile

NUMBERS = st.lists(st.floats(-1e12, 1e12) | st.sampled_from([0.0, 1.0, 2.0]), min_size=1, max_size=60)


@given(NUMBERS, st.floats(0.0, 100.0) | st.sampled_from([0.0, 15.0, 50.0, 99.0, 100.0]))
def test_they_are_numpys(numbers: list[float], percent: float) -> None:
    values = np.array(numbers)
    assert median(values) == np.median(values)
    assert percentile(values, percent) == np.percentile(values, percent)
    np.testing.assert_array_equal(values, numbers, err_msg="what is given stays in its order")


@given(st.lists(st.integers(-(2**60), 2**60), min_size=1, max_size=60))
def test_a_median_of_whole_numbers(numbers: list[int]) -> None:
    assert median(np.array(numbers, np.int64)) == np.median(np.array(numbers, np.int64))


@pytest.mark.parametrize("size", [10_001, 10_002])
def test_of_many(size: int) -> None:
    values = np.random.default_rng(size).gamma(1.0, 3.0, size)
    assert median(values) == np.median(values)
    for percent in (0.0, 15.0, 38.2, 99.0, 100.0):
        assert percentile(values, percent) == np.percentile(values, percent)


@given(NUMBERS, st.integers(0, 59), st.floats(0.0, 100.0))
def test_nan_among_them_tells(numbers: list[float], at: int, percent: float) -> None:
    values = np.array(numbers)
    values[at % len(values)] = math.nan
    assert math.isnan(median(values))
    assert math.isnan(percentile(values, percent))


def test_of_none() -> None:
    assert math.isnan(median(np.zeros(0)))
    with pytest.raises(IndexError):
        percentile(np.zeros(0), 50.0)
