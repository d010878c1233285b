"""Means of two walks held against each other: the interval covers as often as it says, and behaves at its edges."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.stats import ttest_ind

from fes.evaluation.agreement import combined, difference, mean_of, symmetry_index

FEW = st.lists(st.floats(-100.0, 100.0), min_size=6, max_size=40)


def autoregressive(rng: np.random.Generator, n: int, r: float) -> np.ndarray:
    x = np.empty(n)
    x[0] = rng.normal()
    noise = math.sqrt(1.0 - r * r) * rng.normal(size=n)
    for k in range(1, n):
        x[k] = r * x[k - 1] + noise[k]
    return x


@pytest.mark.parametrize("r", [0.0, 0.6])
@pytest.mark.parametrize(("n", "m"), [(15, 30), (100, 40)])
def test_it_covers_the_true_difference_as_often_as_it_says(r, n, m):
    rng = np.random.default_rng(7)
    inside, plain, runs = 0, 0, 200
    for _ in range(runs):
        a, b = autoregressive(rng, n, r), 3.0 + autoregressive(rng, m, r)
        found = difference(mean_of(a), mean_of(b))
        inside += found.low <= 3.0 <= found.high
        usual = ttest_ind(b, a, equal_var=False).confidence_interval()
        plain += usual.low <= 3.0 <= usual.high
    assert inside >= 0.92 * runs
    if r == 0.6:
        assert plain < 0.75 * runs  # what taking strides for independent would do


def test_walks_that_drift_for_minutes_are_covered_too_seldom():
    """What docs/evaluation.md says of it: fractional noise of exponent 0.75, whose correlations never die out."""
    rng, runs = np.random.default_rng(11), 200
    lag = np.arange(60)
    covariance = 0.5 * (np.abs(lag + 1) ** 1.5 - 2.0 * np.abs(lag) ** 1.5 + np.abs(lag - 1) ** 1.5)
    root = np.linalg.cholesky(covariance[np.abs(lag[:, None] - lag[None, :])])
    inside = 0
    for _ in range(runs):
        a, b = (root @ rng.normal(size=60) for _ in range(2))
        found = difference(mean_of(a[:40]), mean_of(b))
        inside += found.low <= 0.0 <= found.high
    assert 0.65 * runs < inside < 0.85 * runs


def test_of_independent_values_it_is_hardly_wider_than_welch():
    rng = np.random.default_rng(3)
    wider = []
    for _ in range(50):
        a, b = rng.normal(size=60), rng.normal(1.0, 2.0, size=90)
        found, usual = difference(mean_of(a), mean_of(b)), ttest_ind(b, a, equal_var=False).confidence_interval()
        wider.append((found.high - found.low) / (usual.high - usual.low))
    assert min(wider) > 0.99
    assert np.mean(wider) < 1.25


def test_slow_change_widens_it():
    rng = np.random.default_rng(5)
    steady = rng.normal(size=80)
    drifting = np.linspace(-2.0, 2.0, 80) + 0.3 * rng.normal(size=80)
    assert mean_of(drifting).effective < 10 < mean_of(steady).effective


def test_too_few_and_constant_values():
    few = mean_of([1.0, 2.0, 3.0, 4.0, math.nan])
    assert (few.n, few.mean) == (4, 2.5)
    assert math.isnan(few.error)
    assert math.isnan(difference(few, mean_of(range(10))).low)
    assert mean_of([]).n == 0
    same = difference(mean_of([2.0] * 9), mean_of([5.0] * 6))
    assert (same.low, same.value, same.high) == (3.0, 3.0, 3.0)


@settings(max_examples=60)
@given(FEW, FEW, st.floats(-10.0, 10.0))
@example([0.0] * 6, [0.0] * 5 + [1e-107], 0.0)  # the squares of what differs so little are nothing
@example([0.0] * 6, [0.0] * 5 + [1e-161], 0.0)
def test_it_turns_round_and_moves_with_the_values(a, b, shift):
    one, other = mean_of(a), mean_of(b)
    there, back = difference(one, other), difference(other, one)
    size = 1e-6 * (1.0 + max(map(abs, (*a, *b))))
    assert there.low == pytest.approx(-back.high, abs=size)
    moved = difference(one, mean_of(np.array(b) + shift))
    assert moved.value - there.value == pytest.approx(shift, abs=size)
    assert there.low <= there.value <= there.high


def test_symmetry_index_and_its_interval():
    rng = np.random.default_rng(1)
    a, b = mean_of(0.4 + 0.02 * rng.normal(size=50)), mean_of(0.6 + 0.02 * rng.normal(size=60))
    value, parts = symmetry_index(a, b)
    assert value == pytest.approx(-40.0, abs=1.0)
    found = combined(value, parts)
    drawn = [200 * (x - y) / (x + y) for x, y in rng.normal((a.mean, b.mean), (a.error, b.error), (4000, 2))]
    assert 0.5 * (found.high - found.low) == pytest.approx(2.0 * np.std(drawn), rel=0.08)
    assert math.isnan(symmetry_index(a, mean_of(-np.ones(9)))[0])
