"""Bias, spread and limits of agreement of paired measurements.

Bland, J. M. & Altman, D. G. (1986), "Statistical methods for assessing agreement between two methods of clinical
measurement", Lancet 327:307–310; the standard error of a limit as in their 1999 paper (Stat. Methods Med. Res.
8:135–160, section 2), of which the 1986 ``sqrt(3 s²/n)`` is the rounded form.
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
