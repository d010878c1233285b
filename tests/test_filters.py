"""Our small filters against scipy's, whose results they must give."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.ndimage import maximum_filter1d
from scipy.signal import butter, find_peaks, sosfiltfilt

from fes.estimation.filters import (
    PADDING,
    greatest_of_late,
    likeness,
    low_passes,
    moving_sums,
    peaks_apart,
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
    before = x.copy()
    for found, cutoff_hz in zip(low_passes(x, rate_hz, cutoffs_hz), cutoffs_hz, strict=True):
        sections = butter(2, min(cutoff_hz, 0.45 * rate_hz), fs=rate_hz, output="sos")
        assert found == pytest.approx(sosfiltfilt(sections, x), rel=1e-8, abs=1e-8)
    assert np.array_equal(x, before)


@settings(deadline=None)
@given(x=signals(1), count=st.integers(1, 40), data=st.data())
def test_moving_sums_are_a_convolution(x: FloatArray, count: int, data: st.DataObject) -> None:
    ahead = data.draw(st.integers(0, count - 1))
    out = np.full(len(x), np.nan)
    moving_sums(x, count, ahead, 0.5, out)
    whole = np.convolve(x, np.full(count, 0.5))
    assert out == pytest.approx(whole[ahead : ahead + len(x)], rel=1e-12, abs=1e-11)


@pytest.mark.parametrize("n", [0, 1, PADDING])
def test_too_few_samples_to_filter(n: int) -> None:
    with pytest.raises(ValueError, match=f"{n} samples are too few to filter"):
        low_passes(np.zeros(n), 100.0, (8.0, 40.0, 60.0))


@settings(deadline=None)
@given(x=st.one_of(signals(1), signals(1, FEW)), half=st.integers(0, 40))
def test_the_greatest_of_late_is_scipys(x: FloatArray, half: int) -> None:
    n = 2 * half + 1
    assert np.array_equal(greatest_of_late(x, n), maximum_filter1d(x, n, origin=half))


def test_the_greatest_of_nothing() -> None:
    assert len(greatest_of_late(np.zeros(0), 5)) == 0


@settings(deadline=None)
@given(x=st.one_of(signals(0), signals(0, FEW)), apart=st.integers(1, 30))
def test_peaks_are_scipys(x: FloatArray, apart: int) -> None:
    assert np.array_equal(peaks_apart(x, apart), find_peaks(x, distance=apart)[0])


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
