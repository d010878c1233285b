"""How far two walks' means are apart, and how sure that is: unequal numbers of strides, which depend on one another.

Strides of one walk are like their neighbours, so that n of them say less of their mean than n independent values. The
standard error of each mean is the larger of two that allow for it:

- the variance over the effective number of values ``n (1 - r)/(1 + r)`` of a first-order autoregressive process, r its
  lag-one correlation with the bias of short series taken off (Zwiers & von Storch 1995, Journal of Climate 8:336–351);
- that of the means of eight stretches of successive strides (batch means; Schmeiser 1982, Operations Research
  30:556–568), which sees slower change as well.

The two means are then held against each other as by Welch (1947), Biometrika 34:28–35: variances may differ, and the
degrees of freedom are Satterthwaite's. The interval speaks of these two walks alone. How much a person walks
differently from day to day, or with a sensor put on anew, no two walks can tell.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from fes.evaluation.agreement.paired import CONFIDENCE, NAN, Interval
from fes.signals import FloatArray

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
    error, freedom = max(_autoregressive(x, mean, sd), _batches(x))
    return Mean(n, mean, sd, error, freedom, min(float(n), (sd / error) ** 2))


def _autoregressive(x: FloatArray, mean: float, sd: float) -> tuple[float, float]:
    n, d = len(x), x - mean
    r = float(d[1:] @ d[:-1]) / float(d @ d)
    r = min(max((n * r + 1.0) / (n - 3.0), 0.0), MOST_R)  # Kendall (1954): the estimate is low by about (1 + 3r)/n
    effective = max(n * (1.0 - r) / (1.0 + r), 2.0)
    error = sd * math.sqrt((n - 1.0) / (n - n / effective) / effective)  # no square of an SD that may be very small
    return error, effective - 1.0


def _batches(x: FloatArray) -> tuple[float, float]:
    count = min(BATCHES, len(x) // 2)
    means = np.array([float(part.mean()) for part in np.array_split(x, count)])
    return float(means.std(ddof=1)) / math.sqrt(count), count - 1.0


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
    from scipy.stats import t as student

    freedom = 1.0 / sum((s / total) ** 2 / df for s, (_, _, df) in zip(spreads, parts, strict=True))
    reach = float(student.ppf(0.5 + 0.5 * CONFIDENCE, freedom)) * math.sqrt(total)
    return Interval(value, value - reach, value + reach)


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
    value = 200.0 * (a - b) / (a + b)
    return value, [(slope * b, first.error, first.freedom), (-slope * a, second.error, second.freedom)]
