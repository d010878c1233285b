"""The line through paired measurements, and whether the error grows with the size."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fes.agreement.differences import CONFIDENCE, NAN, Interval, paired
from fes.signals import FloatArray


@dataclass(frozen=True, slots=True)
class Line:
    """Ordinary least squares of estimate on reference, Pearson's r, and the slope of the differences on the means.

    ``trend`` away from 0: the error depends on the size (Bland & Altman 1999, section 3.2). A slope below 1 is in part
    the noise of the reference itself.
    """

    slope: Interval
    intercept: Interval
    r: float
    trend: Interval


def line_through(reference: FloatArray, estimate: FloatArray) -> Line:
    """Fit pairs (N,); NaN with fewer than three, or where all reference values are equal.

    Raises:
        ValueError: not pairs of finite numbers.
    """
    d = paired(reference, estimate)
    none = Interval(NAN)
    if len(d) < 3 or np.ptp(reference) == 0.0:
        return Line(none, none, NAN, none)
    slope, intercept, r = _fit(np.asarray(reference, np.float64), np.asarray(estimate, np.float64))
    means = 0.5 * (np.asarray(reference) + np.asarray(estimate))
    trend = _fit(means, d)[0] if np.ptp(means) > 0.0 else none
    return Line(slope, intercept, r, trend)


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
