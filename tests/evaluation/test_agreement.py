"""Statistics of agreement against published examples, and the lag between two clocks."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fes.evaluation.agreement import differences, icc_2_1, regression_line
from fes.evaluation.reference.alignment import event_trains, find_lag

# Shrout & Fleiss (1979), Table 2: six targets, four judges
SHROUT_FLEISS = np.array([[9, 2, 5, 8], [6, 1, 3, 2], [8, 4, 6, 8], [7, 1, 2, 6], [10, 5, 6, 9], [6, 2, 4, 7]], float)
# Bland & Altman (1986), Table 1: peak flow (l/min) of 17 subjects, first reading of a large and of a mini meter
LARGE = np.array([494, 395, 516, 434, 476, 557, 413, 442, 650, 433, 417, 656, 267, 478, 178, 423, 427], float)
MINI = np.array([512, 430, 520, 428, 500, 600, 364, 380, 658, 445, 432, 626, 260, 477, 259, 350, 451], float)


def test_icc_of_shrout_and_fleiss():
    icc = icc_2_1(SHROUT_FLEISS)
    assert icc.value == pytest.approx(0.2898, abs=5e-5)  # printed: .29
    assert (icc.low, icc.high) == (pytest.approx(0.019, abs=1e-3), pytest.approx(0.761, abs=1e-3))


def test_icc_of_equal_raters_is_one_and_of_constants_undefined():
    x = np.arange(8.0)
    assert icc_2_1(np.column_stack([x, x])).value == pytest.approx(1.0)
    assert np.isnan(icc_2_1(np.column_stack([np.ones(8), x])).value)
    shifted = icc_2_1(np.column_stack([x, x + 5.0]))
    assert 0.0 < shifted.value < 0.5  # absolute agreement sees a constant error
    with pytest.raises(ValueError, match="ratings"):
        icc_2_1(np.ones((4, 1)))


def test_limits_of_agreement_of_bland_and_altman():
    d = differences(MINI, LARGE, z=2.0)  # they use 2 SD
    assert d.n == 17
    assert d.bias.value == pytest.approx(-2.1, abs=0.05)
    assert d.sd == pytest.approx(38.8, abs=0.05)
    assert (d.lower_limit.value, d.upper_limit.value) == (pytest.approx(-79.7, abs=0.1), pytest.approx(75.5, abs=0.1))
    assert (d.bias.low, d.bias.high) == (pytest.approx(-22.0, abs=0.1), pytest.approx(17.8, abs=0.1))
    # their standard error of a limit, sqrt(3 s²/n), is a rounded form
    assert (d.lower_limit.low, d.lower_limit.high) == (pytest.approx(-114.3, abs=1.0), pytest.approx(-45.1, abs=1.0))
    assert (d.upper_limit.low, d.upper_limit.high) == (pytest.approx(40.9, abs=1.0), pytest.approx(110.1, abs=1.0))


@given(st.lists(st.floats(-1e3, 1e3), min_size=2, max_size=30), st.floats(-10, 10))
def test_a_constant_error_is_all_bias(values, off):
    x = np.array(values)
    d = differences(x, x + off)
    assert d.bias.value == pytest.approx(off, abs=1e-9)
    assert d.sd == pytest.approx(0.0, abs=1e-9)
    assert d.rmse == pytest.approx(abs(off), abs=1e-9)
    assert d.lower_limit.value <= d.bias.value + 1e-9 <= d.upper_limit.value + 2e-9


def test_too_few_pairs_give_no_interval_and_wrong_ones_an_error():
    assert differences(np.zeros(0), np.zeros(0)).n == 0
    one = differences(np.ones(1), np.full(1, 3.0))
    assert one.bias.value == 2.0
    assert np.isnan(one.sd)
    with pytest.raises(ValueError, match="finite"):
        differences(np.array([np.nan]), np.ones(1))
    with pytest.raises(ValueError, match="shape"):
        differences(np.ones(2), np.ones(3))


def test_the_line_and_a_trend():
    x = np.linspace(0.5, 1.5, 40)
    line = regression_line(x, 0.1 + 0.9 * x)
    assert line.slope.value == pytest.approx(0.9)
    assert line.intercept.value == pytest.approx(0.1)
    assert line.trend.value == pytest.approx(-0.1 / 0.95, rel=1e-6)
    assert np.isnan(regression_line(np.ones(5), x[:5]).slope.value)


def walk(seed: int, count: int = 40) -> np.ndarray:
    """Contacts of an irregular walk (s)."""
    return np.cumsum(np.random.default_rng(seed).normal(1.1, 0.06, count))


@pytest.mark.parametrize("lag_s", [-3.217, 0.0, 0.004, 1.25, 7.031])
def test_the_lag_of_event_trains_is_found(lag_s):
    true = walk(1)
    ours = true + lag_s + np.random.default_rng(2).normal(0.0, 0.004, len(true))
    grids = [np.arange(times.min() - 1, times.max() + 1, 0.01) for times in (true, ours)]
    found = find_lag(grids[0], event_trains([true], grids[0]), grids[1], event_trains([ours], grids[1]), 10.0)
    assert found.lag_s == pytest.approx(lag_s, abs=0.005)
    assert not found.caveat
    assert found.residual < 0.3


def test_an_even_walk_gives_a_lag_that_is_not_believed():
    even = np.arange(40) * 1.1
    grid = np.arange(-1.0, 46.0, 0.01)
    found = find_lag(grid, event_trains([even], grid), grid, event_trains([even + 0.3], grid), 3.0)
    assert "another lag fits nearly as well" in found.caveat


def test_a_drifting_clock_is_noticed():
    true = walk(3, 80)
    ours = true * (1.0 + 2e-3)
    grids = [np.arange(0.0, times.max() + 1, 0.01) for times in (true, ours)]
    found = find_lag(grids[0], event_trains([true], grids[0], 0.1), grids[1], event_trains([ours], grids[1], 0.1), 2.0)
    assert "drifts" in found.caveat
    assert found.halves_s == pytest.approx(1e-3 * true[-1], rel=0.25)


def test_signals_that_do_not_overlap_or_never_change_are_refused():
    t = np.arange(0.0, 10.0, 0.01)
    with pytest.raises(ValueError, match="overlap"):
        find_lag(t, np.sin(t), t + 100.0, np.sin(t), 5.0)
    with pytest.raises(ValueError, match="never changes"):
        find_lag(t, np.ones_like(t), t, np.sin(t), 5.0)
