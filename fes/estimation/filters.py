"""A low pass without lag, likeness to itself, the greatest value of late, and peaks apart, in compiled loops.

They give what ``scipy.signal`` and ``scipy.ndimage`` give (a test holds them to it), whose import alone takes longer
than the analysis of a short recording.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from fes.estimation.compiled import jit, jit_ieee
from fes.signals import FloatArray, IntArray

PADDING = 9  # samples at each end, as scipy has it for one section


def low_pass(x: FloatArray, rate_hz: float, cutoff_hz: float) -> FloatArray:
    """Butterworth of second order (bilinear, prewarped) run both ways over ``x`` (N,): no lag.

    The cut-off is kept below 45 % of the sampling rate; the ends are padded with their odd reflection.

    Raises:
        ValueError: there are no more samples than ``PADDING``.
    """
    if len(x) <= PADDING:
        raise ValueError(f"{len(x)} samples are too few to filter: more than {PADDING} are needed")
    k = math.tan(math.pi * min(cutoff_hz, 0.45 * rate_hz) / rate_hz)
    damped = math.sqrt(2.0) * k
    whole = 1.0 + damped + k * k
    b, a1, a2 = k * k / whole, 2.0 * (k * k - 1.0) / whole, (1.0 - damped + k * k) / whole
    padded = np.concatenate((2.0 * x[0] - x[PADDING:0:-1], x, 2.0 * x[-1] - x[-2 : -PADDING - 2 : -1]))
    _section(padded, b, a1, a2)
    return padded[PADDING:-PADDING]


@jit
def _section(x: Any, b: float, a1: float, a2: float) -> None:
    """``b (1 + z⁻¹)² / (1 + a1 z⁻¹ + a2 z⁻²)`` over ``x`` (N,) in place, forwards and then backwards, each begun as if
    it had always been what it is there."""
    last = x.shape[0] - 1
    early, late = (1.0 - b) * x[0], (b - a2) * x[0]
    for i in range(last + 1):
        y = b * x[i] + early
        early = 2.0 * b * x[i] - a1 * y + late
        late = b * x[i] - a2 * y
        x[i] = y
    early, late = (1.0 - b) * x[last], (b - a2) * x[last]
    for i in range(last, -1, -1):
        y = b * x[i] + early
        early = 2.0 * b * x[i] - a1 * y + late
        late = b * x[i] - a2 * y
        x[i] = y


@jit
def thinned_sizes(x: Any, step: int, out: Any) -> None:
    """Fill ``out`` (K,) with the mean length of each ``step`` rows of ``x`` (N, 3), N at least K times ``step``."""
    for k in range(out.shape[0]):
        total = 0.0
        for i in range(k * step, (k + 1) * step):
            total += math.sqrt(x[i, 0] * x[i, 0] + x[i, 1] * x[i, 1] + x[i, 2] * x[i, 2])
        out[k] = total / step


@jit_ieee
def likeness(x: Any, out: Any) -> None:
    """Fill ``out`` (L,) with the sums of ``x[i] x[i + lag]`` over ``x`` (N,), lags 0 … L - 1.

    For some hundred lags that is faster than by a Fourier transform: they lie side by side, several in one instruction.
    """
    lags = out.shape[0]
    out[:] = 0.0
    for i in range(x.shape[0]):
        now = x[i]
        for lag in range(min(lags, x.shape[0] - i)):
            out[lag] += now * x[i + lag]


def greatest_of_late(x: FloatArray, n: int) -> FloatArray:
    """At each sample of ``x`` (N,) the greatest of the last ``n`` with it; before its beginning ``x`` is mirrored."""
    out = np.empty(len(x))
    if len(x) > 0:
        _greatest_of_late(np.pad(x, (n - 1, 0), "symmetric"), n, out)
    return out


@jit
def _greatest_of_late(padded: Any, n: int, out: Any) -> None:
    at = -1
    for i in range(out.shape[0]):
        if at < i:  # it has left the window
            at = i
            for j in range(i + 1, i + n):
                if padded[j] >= padded[at]:
                    at = j
        elif padded[i + n - 1] >= padded[at]:
            at = i + n - 1
        out[i] = padded[at]


def peaks_apart(x: FloatArray, apart: int) -> IntArray:
    """Indices of the peaks of ``x`` (N,) of which no two are closer than ``apart`` samples; the higher one stays.

    A flat top counts by its middle; the two ends are no peaks.
    """
    tops = np.empty(len(x) // 2 + 1, np.int64)
    tops = tops[: _tops(x, tops)]
    keep = np.ones(len(tops), np.bool_)
    _thin(tops, np.argsort(x[tops]), apart, keep)
    return tops[keep]


@jit
def _tops(x: Any, out: Any) -> int:
    """Write the indices of all peaks; how many there are."""
    count, i, last = 0, 1, x.shape[0] - 1
    while i < last:
        if x[i - 1] < x[i]:
            end = i + 1
            while end < last and x[end] == x[i]:
                end += 1
            if x[end] < x[i]:
                out[count] = (i + end - 1) // 2
                count += 1
                i = end
        i += 1
    return count


@jit
def _thin(tops: Any, rising: Any, apart: int, keep: Any) -> None:
    """From the highest down, each peak that still stands takes away those that are too close to it."""
    for r in range(rising.shape[0] - 1, -1, -1):
        j = rising[r]
        if not keep[j]:
            continue
        k = j - 1
        while k >= 0 and tops[j] - tops[k] < apart:
            keep[k] = False
            k -= 1
        k = j + 1
        while k < tops.shape[0] and tops[k] - tops[j] < apart:
            keep[k] = False
            k += 1
