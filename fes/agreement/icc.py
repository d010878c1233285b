"""Intraclass correlation ICC(2,1): two-way random effects, absolute agreement, single measurement.

Shrout, P. E. & Fleiss, J. L. (1979), "Intraclass correlations: uses in assessing rater reliability", Psychological
Bulletin 86:420–428; also McGraw & Wong (1996), Psychological Methods 1:30–46, ICC(A,1).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fes.agreement.differences import CONFIDENCE, NAN
from fes.signals import FloatArray


@dataclass(frozen=True, slots=True)
class Icc:
    """ICC(2,1) with its 95 % confidence interval; NaN where it is not defined."""

    value: float
    low: float
    high: float


def icc_2_1(ratings: FloatArray) -> Icc:
    """Agreement of k raters (columns) on n targets (rows), (n, k).

    An ICC compares the raters' disagreement with the spread of the targets: where all strides are nearly equal it is
    small however good the estimates are.

    Raises:
        ValueError: not a table of finite numbers with at least two columns.
    """
    x = np.asarray(ratings, np.float64)
    if x.ndim != 2 or x.shape[1] < 2 or not np.isfinite(x).all():
        raise ValueError("ratings are a table (targets, raters) of finite numbers, with two raters or more")
    n, k = x.shape
    if n < 3:
        return Icc(NAN, NAN, NAN)
    grand, rows, columns = x.mean(), x.mean(axis=1), x.mean(axis=0)
    between = k * float(((rows - grand) ** 2).sum()) / (n - 1)
    raters = n * float(((columns - grand) ** 2).sum()) / (k - 1)
    error = float(((x - rows[:, None] - columns[None, :] + grand) ** 2).sum()) / ((n - 1) * (k - 1))
    total = between + (k - 1) * error + k * (raters - error) / n
    if total <= 0.0 or between <= 0.0 or (np.ptp(x, axis=0) == 0.0).any():  # a rater who always says the same
        return Icc(NAN, NAN, NAN)
    value = (between - error) / total
    if error <= 1e-12 * between:  # raters differ by a constant, or not at all: nothing to estimate an interval from
        return Icc(value, *((value, value) if raters <= 1e-12 * between else (NAN, NAN)))
    low, high = _interval(n, k, between, raters, error, value)
    return Icc(value, low, high)


def _interval(n: int, k: int, between: float, raters: float, error: float, value: float) -> tuple[float, float]:
    """Shrout & Fleiss (1979), p. 424; the degrees of freedom after Satterthwaite."""
    from scipy.stats import f as fisher

    ratio, spread = raters / error, n * (1.0 + (k - 1) * value) - k * value
    upper = (k - 1) * (n - 1) * (k * value * ratio + spread) ** 2
    freedom = upper / ((n - 1) * k**2 * value**2 * ratio**2 + spread**2)
    at = 0.5 + 0.5 * CONFIDENCE
    first, second = float(fisher.ppf(at, n - 1, freedom)), float(fisher.ppf(at, freedom, n - 1))
    noise = k * raters + (k * n - k - n) * error
    low = n * (between - first * error) / (first * noise + n * between)
    high = n * (second * between - error) / (noise + n * second * between)
    return low, high
