"""Our small filters against scipy's, whose results they must give."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.ndimage import maximum_filter1d
from scipy.signal import butter, find_peaks, sosfiltfilt

from fes.estimation.events.offline import filter_signals
from fes.estimation.numerics.filters import (
    BLOCK,
    PADDING,
    falls_apart,
    largest_in_blocks,
    likeness,
    likeness_of_lengths,
    low_pass,
    moving_sums,
    rows_of_at_least,
    thinned_sizes,
)
from fes.signals import FloatArray

ANY = st.floats(-50.0, 50.0)
FEW = st.sampled_from([-1.5, 0.0, 0.5, 1.0, 2.0])  # so that ties and flat tops are common


def signals(least: int, elements: st.SearchStrategy[float] = ANY) -> st.SearchStrategy[FloatArray]:
    return arrays(np.float64, st.integers(least, 200), elements=elements)


CUTOFF_HZ = st.floats(1.0, 100.0)


@settings(deadline=None)
@given(x=signals(PADDING + 1), rate_hz=st.floats(25.0, 2000.0), cutoffs_hz=st.tuples(CUTOFF_HZ, CUTOFF_HZ, CUTOFF_HZ))
def test_the_low_passes_are_scipys(x: FloatArray, rate_hz: float, cutoffs_hz: tuple[float, float, float]) -> None:
    bias, axis = np.array([0.1, -0.2, 0.3]), np.array([0.0, 1.0, 0.0])
    gyr = np.column_stack((0.0 * x, x, 0.0 * x)) + bias
    one, two, three = (low_pass(rate_hz, cutoff_hz) for cutoff_hz in cutoffs_hz)
    turning, energy, jump = np.empty((3, len(x) + 2 * PADDING)), np.empty(len(x)), np.empty(len(x))
    acc = np.cumsum(gyr, axis=0)
    assert filter_signals(acc, gyr, bias, axis, rate_hz, 2, 3, one, two, three, turning, energy, jump)
    for found, cutoff_hz in zip(turning[:, PADDING:-PADDING], cutoffs_hz, strict=True):
        sections = butter(2, min(cutoff_hz, 0.45 * rate_hz), fs=rate_hz, output="sos")
        assert found == pytest.approx(sosfiltfilt(sections, x), rel=1e-8, abs=1e-8)
    assert energy == pytest.approx(np.convolve(x**2, np.full(3, 1.0 / 3.0), "same"), rel=1e-9, abs=1e-9)
    jumped = 0.5 * rate_hz * np.linalg.norm(acc[2:] - acc[:-2], axis=1)
    assert jump == pytest.approx(np.concatenate((np.zeros(2), jumped)), rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("of_force", [False, True])
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("at", [0, 7, 29])
def test_what_is_not_finite_is_seen_anywhere(of_force: bool, bad: float, at: int) -> None:
    acc, gyr = np.ones((30, 3)), np.ones((30, 3))
    arrays_ = np.empty((3, 30 + 2 * PADDING)), np.empty(30), np.empty(30)
    section = low_pass(100.0, 8.0)
    for column in range(3):
        assert filter_signals(acc, gyr, np.zeros(3), np.ones(3), 100.0, 2, 3, section, section, section, *arrays_)
        (acc if of_force else gyr)[at, column] = bad
        assert not filter_signals(acc, gyr, np.zeros(3), np.ones(3), 100.0, 2, 3, section, section, section, *arrays_)
        (acc if of_force else gyr)[at, column] = 1.0


@settings(deadline=None)
@given(x=signals(1), count=st.integers(1, 40), data=st.data())
def test_moving_sums_are_a_convolution(x: FloatArray, count: int, data: st.DataObject) -> None:
    ahead = data.draw(st.integers(0, count - 1))
    out = np.full(len(x), np.nan)
    moving_sums(x, count, ahead, 0.5, out)
    whole = np.convolve(x, np.full(count, 0.5))
    assert out == pytest.approx(whole[ahead : ahead + len(x)], rel=1e-12, abs=1e-11)


@settings(deadline=None)
@given(x=st.one_of(signals(1), signals(1, FEW)), half=st.integers(0, 40), apart=st.integers(1, 30))
def test_falls_and_their_peaks_are_scipys(x: FloatArray, half: int, apart: int) -> None:
    n = 2 * half + 1
    below = maximum_filter1d(x, n, origin=half) - x
    at, fall = falls_apart(x, n, apart)
    assert np.array_equal(at, find_peaks(below, distance=apart)[0])
    assert np.array_equal(fall, below[at])


def test_no_samples_do_not_fall() -> None:
    assert [len(found) for found in falls_apart(np.zeros(0), 5, 3)] == [0, 0]


@settings(deadline=None)
@given(st.integers(0, 3 * BLOCK), st.integers(0, 2**32 - 1))
def test_the_largest_in_blocks_and_the_rows_in_them(n: int, seed: int) -> None:
    x = np.random.default_rng(seed).normal(size=(n, 3))
    sizes = np.abs(x).max(axis=1, initial=0.0)
    largest = largest_in_blocks(x)
    assert largest.tolist() == [sizes[i : i + BLOCK].max() for i in range(0, n, BLOCK)]
    rows, found = rows_of_at_least(2.5, x, largest)
    assert np.array_equal(rows[found >= 2.5], np.flatnonzero(sizes >= 2.5))
    assert np.array_equal(found, sizes[rows])
    for bad in (np.nan, -np.nan, np.inf):
        for i in range(0, n, 17):
            spoilt = x.copy()
            spoilt[i, i % 3] = bad
            assert not largest_in_blocks(spoilt)[i // BLOCK] < np.inf


@settings(deadline=None)
@given(st.integers(1, 60), st.integers(0, 30), st.integers(1, 80), st.integers(1, 4), st.integers(0, 2**32 - 1))
def test_likeness_is_the_correlation_with_itself(n: int, shortest: int, lags: int, step: int, seed: int) -> None:
    x = np.random.default_rng(seed).normal(size=(n * step + step - 1, 3))
    size, found = np.empty(n), np.empty(lags)
    thinned_sizes(x, step, size)
    assert np.allclose(size, np.linalg.norm(x, axis=1)[: n * step].reshape(n, step).mean(axis=1), rtol=1e-13)
    likeness(size, shortest, found)
    wanted = np.concatenate((np.correlate(size, size, "full")[n - 1 :], np.zeros(shortest + lags)))[shortest:][:lags]
    assert np.allclose(found, wanted, rtol=1e-12, atol=1e-12)
    level = size - size.mean()
    likeness(level, shortest, wanted)
    assert likeness_of_lengths(x, step, shortest, found) == pytest.approx(level @ level, rel=1e-11, abs=1e-13)
    assert np.allclose(found, wanted, rtol=1e-11, atol=1e-11)
