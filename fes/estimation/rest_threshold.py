"""Where rest ends in a statistic: what noise alone exceeds, and what parts a recording's rest from its movement.

Why so, :mod:`fes.estimation.rest` says.
"""

from __future__ import annotations

import math

import numpy as np

from fes.signals import FloatArray

NOISE_QUANTILE_SIGMAS = 3.09  # 99.9 %
LONG_STILL_S = 1.5  # longer than any stance of walking


def chi2_quantile(degrees: int) -> float:
    """99.9 % quantile of chi² over its degrees of freedom, after Wilson and Hilferty (1931)."""
    share = 2.0 / (9.0 * degrees)
    return float((1.0 - share + NOISE_QUANTILE_SIGMAS * math.sqrt(share)) ** 3)


def _middle(rising: FloatArray) -> float:
    """The median of values (N,) in rising order."""
    half = len(rising) // 2
    return float(rising[half] if len(rising) % 2 else 0.5 * (rising[half - 1] + rising[half]))


def split(values: FloatArray, start: float, rate_hz: float) -> float:
    """Threshold between the recording's rest and movement (Ridler and Calvard 1978, on logarithms, with medians).

    Args:
        values: (N,) a detector's statistic, in its unit.
        start: the tolerance, from which it is sought, and what is returned where there is nothing to learn from.
        rate_hz: nominal sampling rate; what is still for ``LONG_STILL_S`` is left out.
    """
    logs = np.log(values + 1e-12)
    still = np.concatenate(([False], values < start, [False]))
    edges = np.flatnonzero(still[1:] != still[:-1])
    keep = np.ones(len(logs), dtype=bool)
    begins, ends = edges[0::2], edges[1::2]
    long = ends - begins >= LONG_STILL_S * rate_hz
    for begin, end in zip(begins[long].tolist(), ends[long].tolist(), strict=True):
        keep[begin:end] = False
    logs = np.sort(logs[keep])
    cut = math.log(start)
    for _ in range(100):
        count = int(np.searchsorted(logs, cut))
        if count in (0, len(logs)):
            return start  # all rest or all movement: nothing to learn from
        new = 0.5 * (_middle(logs[:count]) + _middle(logs[count:]))
        if abs(new - cut) < 1e-6:
            break
        cut = new
    return math.exp(cut)
