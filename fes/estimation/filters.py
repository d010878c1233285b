"""Low passes without lag, moving sums, likeness to itself, greatest values of late, peaks apart, in compiled loops.

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
BLOCK = 64  # rows
ALL_BUT_SIGN = 0x7FFF_FFFF_FFFF_FFFF


def low_passes(
    x: FloatArray, rate_hz: float, cutoffs_hz: tuple[float, float, float]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Butterworth of second order (bilinear, prewarped) run both ways over ``x`` (N,): no lag; with three cut-offs.

    A cut-off is kept below 45 % of the sampling rate; the ends are padded with their odd reflection. Three at once, for
    each has to wait for its own last value, and hardly longer for the others.

    Raises:
        ValueError: there are no more samples than ``PADDING``.
    """
    if len(x) <= PADDING:
        raise ValueError(f"{len(x)} samples are too few to filter: more than {PADDING} are needed")
    padded = np.concatenate((2.0 * x[0] - x[PADDING:0:-1], x, 2.0 * x[-1] - x[-2 : -PADDING - 2 : -1]))
    out = np.empty((3, len(padded)))
    low, middle, high = (_coefficients(rate_hz, cutoff_hz) for cutoff_hz in cutoffs_hz)
    _sections(padded, low, middle, high, out)
    one, two, three = out[:, PADDING:-PADDING]
    return one, two, three


def _coefficients(rate_hz: float, cutoff_hz: float) -> tuple[float, float, float]:
    """Of one section, as :func:`_sections` has them."""
    k = math.tan(math.pi * min(cutoff_hz, 0.45 * rate_hz) / rate_hz)
    damped = math.sqrt(2.0) * k
    whole = 1.0 + damped + k * k
    return k * k / whole, 2.0 * (k * k - 1.0) / whole, (1.0 - damped + k * k) / whole


Section = tuple[float, float, float]


@jit_ieee
def _sections(x: Any, one: Section, two: Section, three: Section, out: Any) -> None:
    """Each section ``b (1 + z⁻¹)² / (1 + a1 z⁻¹ + a2 z⁻²)`` over ``x`` (N,) into a row of ``out`` (3, N), forwards and
    then backwards, each begun as if it had always been what it is there."""
    last = x.shape[0] - 1
    (b, a1, a2), (c, d1, d2), (e, f1, f2) = one, two, three
    early_b, late_b = (1.0 - b) * x[0], (b - a2) * x[0]
    early_c, late_c = (1.0 - c) * x[0], (c - d2) * x[0]
    early_e, late_e = (1.0 - e) * x[0], (e - f2) * x[0]
    for i in range(last + 1):
        u = v = w = x[i]
        p, q, r = b * u + early_b, c * v + early_c, e * w + early_e
        early_b, late_b = (2.0 * b * u + late_b) - a1 * p, b * u - a2 * p
        early_c, late_c = (2.0 * c * v + late_c) - d1 * q, c * v - d2 * q
        early_e, late_e = (2.0 * e * w + late_e) - f1 * r, e * w - f2 * r
        out[0, i], out[1, i], out[2, i] = p, q, r
    u, v, w = out[0, last], out[1, last], out[2, last]
    early_b, late_b = (1.0 - b) * u, (b - a2) * u
    early_c, late_c = (1.0 - c) * v, (c - d2) * v
    early_e, late_e = (1.0 - e) * w, (e - f2) * w
    for i in range(last, -1, -1):
        u, v, w = out[0, i], out[1, i], out[2, i]
        p, q, r = b * u + early_b, c * v + early_c, e * w + early_e
        early_b, late_b = (2.0 * b * u + late_b) - a1 * p, b * u - a2 * p
        early_c, late_c = (2.0 * c * v + late_c) - d1 * q, c * v - d2 * q
        early_e, late_e = (2.0 * e * w + late_e) - f1 * r, e * w - f2 * r
        out[0, i], out[1, i], out[2, i] = p, q, r


@jit_ieee
def moving_sums(x: Any, count: int, ahead: int, share: float, out: Any) -> None:
    """Fill ``out`` (N,) with ``share`` times the sum of ``x`` (N,) over ``count`` samples, ``ahead`` of them still to
    come; beyond the ends there is nothing.

    What follows the beginning of a block of ``count`` samples is added to what is left of the block before: three
    additions, however many the samples, and nothing is ever taken away.
    """
    n = x.shape[0]
    left = np.zeros(count + 1)  # of the block before, from each of its samples on
    for begin in range(0, n + ahead, count):
        total = 0.0
        for j in range(count):
            i = begin + j
            total += x[i] if i < n else 0.0
            if 0 <= i - ahead < n:
                out[i - ahead] = share * (left[j + 1] + total)
        for j in range(count - 1, -1, -1):
            left[j] = left[j + 1] + (x[begin + j] if begin + j < n else 0.0)


@jit
def thinned_sizes(x: Any, step: int, out: Any) -> None:
    """Fill ``out`` (K,) with the mean length of each ``step`` rows of ``x`` (N, 3), N at least K times ``step``."""
    for k in range(out.shape[0]):
        total = 0.0
        for i in range(k * step, (k + 1) * step):
            total += math.sqrt(x[i, 0] * x[i, 0] + x[i, 1] * x[i, 1] + x[i, 2] * x[i, 2])
        out[k] = total / step


@jit_ieee
def _sizes(bits: Any, count: int, out: Any) -> None:
    """Fill ``out`` (K,) with the greatest of each ``count`` of ``bits`` (N,), without their signs.

    Numbers in IEEE's format without their signs are in the order of their bits, and what is no number comes last; and
    bits are compared several at a time.
    """
    for k in range(out.shape[0]):
        top = 0
        for i in range(k * count, min((k + 1) * count, bits.shape[0])):
            top = max(top, bits[i] & ALL_BUT_SIGN)
        out[k] = top


def largest_in_blocks(x: FloatArray) -> FloatArray:
    """The greatest size in each ``BLOCK`` rows of ``x`` (N, 3); NaN where there is one."""
    out = np.empty(-(-len(x) // BLOCK), np.int64)
    _sizes(np.ascontiguousarray(x, dtype=np.float64).ravel().view(np.int64), 3 * BLOCK, out)
    return out.view(np.float64)


def rows_of_at_least(bound: float, x: FloatArray, largest: FloatArray) -> tuple[IntArray, FloatArray]:
    """Which rows of ``x`` (N, 3) lie in blocks whose ``largest`` reaches a bound, and each one's greatest size."""
    rows = (BLOCK * np.flatnonzero(largest >= bound)[:, None] + np.arange(BLOCK)).ravel()
    rows = rows[: np.searchsorted(rows, len(x))]
    return rows, np.abs(x[rows]).max(axis=1, initial=0.0)


@jit_ieee
def likeness(x: Any, shortest: int, out: Any) -> None:
    """Fill ``out`` (L,) with the sums of ``x[i] x[i + lag]`` over ``x`` (N,), L lags from ``shortest`` on.

    For some hundred lags that is faster than by a Fourier transform: they lie side by side, several in one instruction,
    and four samples at a time each sum is fetched and put back once.
    """
    later, lags, begin = x[shortest:], out.shape[0], 0
    out[:] = 0.0
    while begin + 3 + lags <= later.shape[0]:
        a, b, c, d = x[begin], x[begin + 1], x[begin + 2], x[begin + 3]
        for lag in range(lags):
            i = begin + lag
            out[lag] = (((out[lag] + a * later[i]) + b * later[i + 1]) + c * later[i + 2]) + d * later[i + 3]
        begin += 4
    for i in range(begin, later.shape[0]):
        for lag in range(min(lags, later.shape[0] - i)):
            out[lag] += x[i] * later[i + lag]


def greatest_of_late(x: FloatArray, n: int) -> FloatArray:
    """At each sample of ``x`` (N,) the greatest of the last ``n`` with it; before its beginning ``x`` is mirrored."""
    out = np.empty(len(x))
    _greatest_of_late(x, n, out)
    return out


@jit_ieee
def _greatest_of_late(x: Any, n: int, out: Any) -> None:
    """In blocks of ``n``, as :func:`moving_sums`."""
    left = np.full(n + 1, -math.inf)  # the greatest of the block before, from each of its samples on
    for j in range(n - 1, -1, -1):
        left[j] = max(left[j + 1], x[n - 1 - j]) if n - 1 - j < x.shape[0] else left[j + 1]
    for begin in range(0, x.shape[0], n):
        greatest, end = -math.inf, min(begin + n, x.shape[0])
        for i in range(begin, end):
            greatest = max(greatest, x[i])
            out[i] = max(left[i - begin + 1], greatest)
        greatest = -math.inf
        for i in range(end - 1, begin - 1, -1):
            greatest = max(greatest, x[i])
            left[i - begin] = greatest


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
