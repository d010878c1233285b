"""Paired measurements: bias and limits of agreement, the line through them, and the intraclass correlation ICC(2,1).

Limits of agreement: Bland & Altman (1986), Lancet 327:307–310; the standard error of a limit as in their 1999 paper
(Stat. Methods Med. Res. 8:135–160, section 2), of which the 1986 ``sqrt(3 s²/n)`` is the rounded form. ICC(2,1), that
is two-way random effects, absolute agreement, single measurement: Shrout & Fleiss (1979), Psychological Bulletin
86:420–428; also McGraw & Wong (1996), Psychological Methods 1:30–46, ICC(A,1).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from fes.signals import FloatArray

CONFIDENCE: Final = 0.95
LIMIT_Z: Final = 1.96  # 95 % of normal differences lie within bias ± 1.96 SD
NAN: Final = float("nan")


@dataclass(frozen=True, slots=True)
class Interval:
    """A value and its confidence interval, NaN where there are too few values."""

    value: float
    low: float = NAN
    high: float = NAN


@dataclass(frozen=True, slots=True)
class Differences:
    """Estimate − reference of ``n`` pairs, in their unit.

    The intervals take the pairs to be independent. Steps of one walk are not quite: read them as the least width.
    """

    n: int
    bias: Interval
    sd: float
    rmse: float
    mean_absolute: float
    worst: float
    lower_limit: Interval
    upper_limit: Interval


def differences(reference: FloatArray, estimate: FloatArray, *, z: float = LIMIT_Z) -> Differences:
    """Bias, SD (n − 1), RMSE and limits of agreement ``bias ± z SD`` of pairs (N,); NaN where N is too small.

    Raises:
        ValueError: the arrays differ in shape or hold a value that is not finite.
    """
    d = paired(reference, estimate)
    n = len(d)
    if not n:
        none = Interval(NAN)
        return Differences(0, none, NAN, NAN, NAN, NAN, none, none)
    bias, rmse = float(d.mean()), float(np.sqrt(np.mean(d**2)))
    rest = (rmse, float(np.abs(d).mean()), float(np.abs(d).max()))
    if n < 2:
        return Differences(n, Interval(bias), NAN, *rest, Interval(NAN), Interval(NAN))
    from scipy.stats import t as student

    sd = float(d.std(ddof=1))
    quantile = float(student.ppf(0.5 + 0.5 * CONFIDENCE, n - 1))
    wide, narrow = quantile * sd * math.sqrt(1.0 / n + z * z / (2.0 * (n - 1))), quantile * sd / math.sqrt(n)
    low, high = bias - z * sd, bias + z * sd
    return Differences(
        n,
        Interval(bias, bias - narrow, bias + narrow),
        sd,
        *rest,
        Interval(low, low - wide, low + wide),
        Interval(high, high - wide, high + wide),
    )


def paired(reference: FloatArray, estimate: FloatArray) -> FloatArray:
    """Estimate − reference (N,), once both are seen to be pairs of finite numbers.

    Raises:
        ValueError: they are not.
    """
    reference, estimate = np.asarray(reference, np.float64), np.asarray(estimate, np.float64)
    if reference.shape != estimate.shape or reference.ndim != 1:
        raise ValueError(f"pairs have one shape (N,), not {reference.shape} and {estimate.shape}")
    if not (np.isfinite(reference).all() and np.isfinite(estimate).all()):
        raise ValueError("a pair holds a value that is not finite; leave such pairs out")
    return np.asarray(estimate - reference)


@dataclass(frozen=True, slots=True)
class RegressionLine:
    """Ordinary least squares of estimate on reference, Pearson's r, and the slope of the differences on the means.

    ``trend`` away from 0: the error depends on the size (Bland & Altman 1999, section 3.2). A slope below 1 is in part
    the noise of the reference itself.
    """

    slope: Interval
    intercept: Interval
    r: float
    trend: Interval


def regression_line(reference: FloatArray, estimate: FloatArray) -> RegressionLine:
    """Fit pairs (N,); NaN with fewer than three, or where all reference values are equal.

    Raises:
        ValueError: not pairs of finite numbers.
    """
    d = paired(reference, estimate)
    none = Interval(NAN)
    if len(d) < 3 or np.ptp(reference) == 0.0:
        return RegressionLine(none, none, NAN, none)
    slope, intercept, r = _fit(np.asarray(reference, np.float64), np.asarray(estimate, np.float64))
    means = 0.5 * (np.asarray(reference) + np.asarray(estimate))
    trend = _fit(means, d)[0] if np.ptp(means) > 0.0 else none
    return RegressionLine(slope, intercept, r, trend)


def _fit(x: FloatArray, y: FloatArray) -> tuple[Interval, Interval, float]:
    from scipy.stats import linregress
    from scipy.stats import t as student

    if np.ptp(y) == 0.0:
        return Interval(0.0, 0.0, 0.0), Interval(float(y[0])), NAN
    fit = linregress(x, y)
    reach = float(student.ppf(0.5 + 0.5 * CONFIDENCE, len(x) - 2))
    slope, intercept = float(fit.slope), float(fit.intercept)
    wide, shift = reach * float(fit.stderr), reach * float(fit.intercept_stderr)
    return (
        Interval(slope, slope - wide, slope + wide),
        Interval(intercept, intercept - shift, intercept + shift),
        float(fit.rvalue),
    )


def icc_2_1(ratings: FloatArray) -> Interval:
    """Agreement of k raters (columns) on n targets (rows), (n, k), with its 95 % interval; NaN where not defined.

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
        return Interval(NAN)
    grand, rows, columns = x.mean(), x.mean(axis=1), x.mean(axis=0)
    between = k * float(((rows - grand) ** 2).sum()) / (n - 1)
    raters = n * float(((columns - grand) ** 2).sum()) / (k - 1)
    error = float(((x - rows[:, None] - columns[None, :] + grand) ** 2).sum()) / ((n - 1) * (k - 1))
    total = between + (k - 1) * error + k * (raters - error) / n
    if total <= 0.0 or between <= 0.0 or (np.ptp(x, axis=0) == 0.0).any():  # a rater who always says the same
        return Interval(NAN)
    value = (between - error) / total
    if error <= 1e-12 * between:  # raters differ by a constant, or not at all: nothing to estimate an interval from
        return Interval(value, *((value, value) if raters <= 1e-12 * between else (NAN, NAN)))
    from scipy.stats import f as fisher

    # the interval: Shrout & Fleiss (1979), p. 424; the degrees of freedom after Satterthwaite
    ratio, spread = raters / error, n * (1.0 + (k - 1) * value) - k * value
    upper = (k - 1) * (n - 1) * (k * value * ratio + spread) ** 2
    freedom = upper / ((n - 1) * k**2 * value**2 * ratio**2 + spread**2)
    at = 0.5 + 0.5 * CONFIDENCE
    first, second = float(fisher.ppf(at, n - 1, freedom)), float(fisher.ppf(at, freedom, n - 1))
    noise = k * raters + (k * n - k - n) * error
    low = n * (between - first * error) / (first * noise + n * between)
    high = n * (second * between - error) / (noise + n * second * between)
    return Interval(value, low, high)
