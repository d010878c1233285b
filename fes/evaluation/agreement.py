"""How well two ways of measuring agree: bias, limits of agreement, line and ICC(2,1) of pairs; means of two walks.

Limits of agreement: Bland & Altman (1986), Lancet 327:307–310; their standard error as in the 1999 paper (Stat. Methods
Med. Res. 8:135–160, section 2), of which the 1986 ``sqrt(3 s²/n)`` is the rounded form. ICC(2,1): Shrout & Fleiss
(1979), Psychological Bulletin 86:420–428; McGraw & Wong (1996), Psychological Methods 1:30–46, ICC(A,1).

Strides of one walk are like their neighbours, so that n of them say less of their mean than n independent values. The
standard error of a mean is the larger of

- the variance over the effective number ``n (1 - r)/(1 + r)`` of a first-order autoregressive process, r its lag-one
  correlation without the bias of short series (Zwiers & von Storch 1995, Journal of Climate 8:336–351);
- that of the means of eight stretches of successive strides (batch means; Schmeiser 1982, Operations Research
  30:556–568), which sees slower change as well.

Two means are held against each other as by Welch (1947), Biometrika 34:28–35, with Satterthwaite's degrees of freedom.
The interval speaks of these two walks alone, not of how a person walks from day to day.
"""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

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


def _within(value: float, reach: float) -> Interval:
    return Interval(value, value - reach, value + reach)


def _student(freedom: float) -> float:
    """How many standard errors the confidence interval reaches to either side."""
    from scipy.special import stdtrit  # as scipy.stats has it, which takes many times as long to load

    return float(stdtrit(freedom, 0.5 + 0.5 * CONFIDENCE))


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

    ValueError: the arrays differ in shape or hold a value that is not finite.
    """
    d = paired(reference, estimate)
    n, none = len(d), Interval(NAN)
    if not n:
        return Differences(0, none, NAN, NAN, NAN, NAN, none, none)
    bias = float(d.mean())
    rest = (float(np.sqrt(np.mean(d**2))), float(np.abs(d).mean()), float(np.abs(d).max()))
    if n < 2:
        return Differences(n, Interval(bias), NAN, *rest, none, none)
    sd, quantile = float(d.std(ddof=1)), _student(n - 1)
    wide = quantile * sd * math.sqrt(1.0 / n + z * z / (2.0 * (n - 1)))
    limits = (_within(bias - z * sd, wide), _within(bias + z * sd, wide))
    return Differences(n, _within(bias, quantile * sd / math.sqrt(n)), sd, *rest, *limits)


def paired(reference: FloatArray, estimate: FloatArray) -> FloatArray:
    """Estimate − reference (N,), once both are seen to be pairs of finite numbers. ValueError: they are not."""
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
    if np.ptp(y) == 0.0:
        return Interval(0.0, 0.0, 0.0), Interval(float(y[0])), NAN
    from scipy.stats import linregress

    fit, reach = linregress(x, y), _student(len(x) - 2)
    slope = _within(float(fit.slope), reach * float(fit.stderr))
    return slope, _within(float(fit.intercept), reach * float(fit.intercept_stderr)), float(fit.rvalue)


def icc_2_1(ratings: FloatArray) -> Interval:
    """Agreement of k raters (columns) on n targets (rows), (n, k), with its 95 % interval; NaN where not defined.

    An ICC compares the raters' disagreement with the spread of the targets: where all strides are nearly equal it is
    small however good the estimates are.

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


BATCHES: Final = 8
LEAST: Final = 5  # fewer strides give no interval
MOST_R: Final = 0.95


@dataclass(frozen=True, slots=True)
class Mean:
    """Mean and SD (n − 1) of ``n`` successive values; ``error`` is the mean's standard error, with its freedom.

    ``effective`` is how many independent values would give an error as small; NaN where there are too few.
    """

    n: int
    mean: float
    sd: float
    error: float
    freedom: float
    effective: float


def mean_of(values: npt.ArrayLike) -> Mean:
    """Of successive values (N,); those that are not finite are left out, the others count as neighbours."""
    x = np.asarray(values, np.float64).ravel()
    x = x[np.isfinite(x)]
    n = len(x)
    mean = float(x.mean()) if n else NAN
    sd = float(x.std(ddof=1)) if n > 1 else NAN
    if n < LEAST:
        return Mean(n, mean, sd, NAN, NAN, NAN)
    if sd <= 1e-12 * abs(mean):
        return Mean(n, mean, sd, 0.0, float(n - 1), float(n))
    d = x - mean
    r = float(d[1:] @ d[:-1]) / float(d @ d)
    r = min(max((n * r + 1.0) / (n - 3.0), 0.0), MOST_R)  # Kendall (1954): the estimate is low by about (1 + 3r)/n
    effective = max(n * (1.0 - r) / (1.0 + r), 2.0)
    # no square of an SD that may be very small
    autoregressive = sd * math.sqrt((n - 1.0) / (n - n / effective) / effective), effective - 1.0
    count = min(BATCHES, n // 2)
    means = np.array([float(part.mean()) for part in np.array_split(x, count)])
    error, freedom = max(autoregressive, (float(means.std(ddof=1)) / math.sqrt(count), count - 1.0))
    return Mean(n, mean, sd, error, freedom, min(float(n), (sd / error) ** 2))


def combined(value: float, parts: list[tuple[float, float, float]]) -> Interval:
    """A value that depends on several means: its interval from (weight, error, freedom) of each.

    NaN limits where one of the errors is not known.
    """
    spreads = [(weight * error) ** 2 for weight, error, _ in parts]
    total = sum(spreads)
    if not math.isfinite(total) or not math.isfinite(value):
        return Interval(value)
    if total == 0.0:
        return Interval(value, value, value)
    freedom = 1.0 / sum((s / total) ** 2 / df for s, (_, _, df) in zip(spreads, parts, strict=True))
    return _within(value, _student(freedom) * math.sqrt(total))


def difference(a: Mean, b: Mean) -> Interval:
    """B − A with its 95 % interval; NaN limits where one of them has fewer than five values."""
    return combined(b.mean - a.mean, [(-1.0, a.error, a.freedom), (1.0, b.error, b.freedom)])


def symmetry_index(first: Mean, second: Mean) -> tuple[float, list[tuple[float, float, float]]]:
    """``200 (a − b)/(a + b)`` percent (Robinson et al. 1987) of two means, and its parts for :func:`combined`.

    To first order, the sides taken as independent. NaN, without parts, where they differ in sign.
    """
    a, b = first.mean, second.mean
    if not a * b > 0.0:
        return NAN, []
    slope = 400.0 / (a + b) ** 2
    return 200.0 * (a - b) / (a + b), [
        (slope * b, first.error, first.freedom),
        (-slope * a, second.error, second.freedom),
    ]
