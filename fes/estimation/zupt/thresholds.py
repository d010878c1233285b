"""Where rest ends in a statistic: what noise alone exceeds, and what parts a recording's rest from its movement.

Why so, :mod:`fes.estimation.zupt.detectors` says.

Quietest instants of rests, and of movements too long to be one swing, in compiled loops; where they come from
:mod:`fes.estimation.zupt.filter` says.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from fes.estimation.numerics.jit import jit
from fes.signals import FloatArray


@jit
def _least(x: Any, begin: int, end: int) -> int:
    """The first least of ``x[begin:end]``."""
    at, least = begin, x[begin]
    for i in range(begin + 1, end):
        if x[i] < least:
            at, least = i, x[i]
    return at


@jit
def first_lasting(rest: Any, count: int) -> int:
    """The first sample with which ``rest`` (N,) has held for ``count`` samples in a row, 0 if there is none."""
    lasted = 0
    for i in range(rest.shape[0]):
        lasted = lasted + 1 if rest[i] else 0
        if lasted == count:
            return i
    return 0


@jit
def quietest_of_rests(rest: Any, energy: Any, apart: float, out: Any) -> int:
    """Fill ``out`` with where the ``energy`` (N,) is least in each rest; rests closer than ``apart`` samples are one.

    How many there are: at most half of the samples and one.
    """
    count, begin, end = 0, -1, -1
    for i in range(rest.shape[0]):
        if not rest[i]:
            continue
        if begin < 0:
            begin = i
        elif i > end and i - end >= apart:
            out[count] = _least(energy, begin, end)
            count, begin = count + 1, i
        end = i + 1
    if begin >= 0:
        out[count] = _least(energy, begin, end)
        count += 1
    return count


@jit
def rest_in_long_moves(rest: Any, energy: Any, longest: float, half: int, margin: int) -> None:
    """Mark ``half`` samples around the least ``energy`` of every movement of more than ``longest`` samples as rest.

    Then the same of its two halves. It is sought ``margin`` samples away from a movement's ends, more than ``half``.
    """
    n, begin, end = rest.shape[0], 0, 0
    while end <= n:
        if end < n and not rest[end]:
            end += 1
        elif end - begin > longest:
            quiet = _least(energy, begin + margin, end - margin)
            for i in range(quiet - half, min(quiet + half + 1, n)):
                rest[i] = True
            end = quiet - half  # its first half may be too long still
        else:
            begin, end = end + 1, end + 1


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
