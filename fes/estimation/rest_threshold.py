"""Where rest ends in a statistic: what noise alone exceeds, and what parts a recording's rest from its movement.

Why so, :mod:`fes.estimation.rest` says.
"""

from __future__ import annotations

import math

import numpy as np

from fes.signals import FloatArray

NOISE_QUANTILE_SIGMAS = 3.09  # 99.9 %
LONG_STILL_S = 1.5  # longer than any stance of walking
LEAST = 1e-12  # so that nothing, too, has a logarithm


def chi2_quantile(degrees: int) -> float:
    """99.9 % quantile of chi² over its degrees of freedom, after Wilson and Hilferty (1931)."""
    share = 2.0 / (9.0 * degrees)
    return float((1.0 - share + NOISE_QUANTILE_SIGMAS * math.sqrt(share)) ** 3)


def _middle(rising: FloatArray) -> float:
    """The median of the logarithms of values (N,) in rising order."""
    half = len(rising) // 2
    return 0.5 * (math.log(rising[half] + LEAST) + math.log(rising[(len(rising) - 1) // 2] + LEAST))


def split(values: FloatArray, start: float, rate_hz: float) -> float:
    """Threshold between the recording's rest and movement (Ridler and Calvard 1978, on logarithms, with medians).

    Args:
        values: (N,) a detector's statistic, in its unit.
        start: the tolerance, from which it is sought, and what is returned where there is nothing to learn from.
        rate_hz: nominal sampling rate; what is still for ``LONG_STILL_S`` is left out.
    """
    still = np.concatenate(([False], values < start, [False]))
    edges = np.flatnonzero(still[1:] != still[:-1])
    begins, ends = edges[0::2], edges[1::2]
    long = ends - begins >= LONG_STILL_S * rate_hz
    pieces, after = list[FloatArray](), 0
    for begin, end in zip(begins[long].tolist(), ends[long].tolist(), strict=True):
        pieces.append(values[after:begin])
        after = end
    rising = np.concatenate((*pieces, values[after:]))
    rising.sort()  # in the order of their logarithms, of which only a few are needed
    cut = math.log(start)
    for _ in range(100):
        count = int(np.searchsorted(rising, math.exp(cut) - LEAST))
        if count in (0, len(rising)):
            return start  # all rest or all movement: nothing to learn from
        new = 0.5 * (_middle(rising[:count]) + _middle(rising[count:]))
        if abs(new - cut) < 1e-6:
            break
        cut = new
    return math.exp(cut)
