"""The ends of a stride: the quietest instant of a stance, and what the sensor shows there.

The foot is never wholly at rest (Negård et al. 2005). What it still does at the chosen instant is measured: its mean
rate gives the velocity of a foot that turns about its ground contact, and says how far that is to be trusted
(``fes.estimation.strides.integration``). Also how long a stride took, of all the time that its foot walked.
"""

import math
from typing import Any

import numpy as np

from fes.estimation.numerics.jit import jit_ieee

UNSEEN_NS = -(2**63)  # of what did not happen, for compiled code


def stride_time_ns(start_ns: int, end_ns: int, before_ns: int) -> int:
    """From one stance to the next: the stride from quietest to quietest instant, and the rest before it.

    A long stance, as in slow walking, has two quiet instants: near its beginning one stride ends, before its end the
    next begins. The time between them belongs to walking, or speed and cadence would come out too high. A foot that
    stood for longer than the stride itself did not walk meanwhile.

    Args:
        start_ns: the stride's beginning.
        end_ns: its end.
        before_ns: the end of the stride before, ``UNSEEN_NS`` when there is none.
    """
    lasted_ns = end_ns - start_ns
    if before_ns == UNSEEN_NS or not 0 <= start_ns - before_ns <= lasted_ns:
        return lasted_ns
    return end_ns - before_ns


QUIET_WINDOW_S = 0.1
AROUND_S = 0.03  # on either side of an end, over which it is measured
# A foot that never turns more slowly than this has no true rest. Of the recordings that the sizes rest on, brisk walks
# reach it in a few strides; running has nothing else.
REST_RADPS = 1.0
NO_REST_RADPS = 3.0  # beyond this the velocity at the ends is a guess, and so is the stride


@jit_ieee
def mean_and_variance(values: Any, begin: int, end: int) -> tuple[float, float, float, float, float, float]:
    """Means, then variances, of the three columns over the rows ``begin`` … ``end - 1``."""
    n = end - begin
    m0 = m1 = m2 = v0 = v1 = v2 = 0.0
    for i in range(begin, end):
        m0 += values[i, 0]
        m1 += values[i, 1]
        m2 += values[i, 2]
    m0, m1, m2 = m0 / n, m1 / n, m2 / n
    for i in range(begin, end):
        v0 += (values[i, 0] - m0) ** 2
        v1 += (values[i, 1] - m1) ** 2
        v2 += (values[i, 2] - m2) ** 2
    return m0, m1, m2, v0 / n, v1 / n, v2 / n


@jit_ieee
def around_ends(t_ns: Any, first: int, last: int) -> int:
    """How many samples on either side of its ends a stride is measured over."""
    period_s: float = 1e-9 * (t_ns[last] - t_ns[first]) / (last - first)
    return max(round(AROUND_S / period_s), 1)


@jit_ieee
def index_at(t_ns: Any, begin: int, last: int, at_ns: int) -> int:
    """Of the rising stamps from row ``begin`` on the first at or after a time, ``last`` if there is none before it."""
    while begin < last:
        middle = (begin + last) // 2
        if t_ns[middle] < at_ns:
            begin = middle + 1
        else:
            last = middle
    return last


@jit_ieee
def quietest_of(t_ns: Any, gyr: Any, n: int, bx: float, by: float, bz: float, earliest_ns: int, latest_ns: int) -> int:
    """As :func:`quietest`, of the first ``n`` samples of a gyroscope with a bias."""
    begin, end = index_at(t_ns, 0, n, earliest_ns), index_at(t_ns, 0, n, latest_ns + 1)
    if end - begin < 3:
        return min(begin, n - 1)
    period_s: float = 1e-9 * (t_ns[end - 1] - t_ns[begin]) / (end - 1 - begin)
    window = min(max(round(QUIET_WINDOW_S / period_s), 1), end - begin)
    energy = np.empty(end - begin + 1)
    energy[0] = 0.0
    best, at = math.inf, 0
    for i in range(end - begin):
        x, y, z = gyr[begin + i, 0] - bx, gyr[begin + i, 1] - by, gyr[begin + i, 2] - bz
        energy[i + 1] = energy[i] + (x * x + y * y + z * z)
        if i + 1 >= window and energy[i + 1] - energy[i + 1 - window] < best:
            best, at = energy[i + 1] - energy[i + 1 - window], i + 1 - window
    return begin + at + window // 2
