"""A small linear system, for compiled code that must not call a library whose last bit differs between machines.

Median and percentile of one row of finite numbers: numpy's values, to the bit, in a fraction of its time.

numpy asks for both neighbours of a rank at once, and then leaves its fast selection, which is for one rank, for a slow
one. Here one is asked for, and the other is the greatest or the least of what lies on its side.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from fes.estimation.numerics.jit import jit_fused
from fes.signals import FloatArray


def median(values: np.ndarray[Any, np.dtype[Any]]) -> float:
    """The median of values (N,); NaN where one of them is, or where there are none."""
    if len(values) < 2:
        return float(values[0]) if len(values) else math.nan
    half = len(values) // 2
    parted = np.partition(values, half)
    above = float(parted[half:].max())
    if math.isnan(above):  # which ranks last
        return above
    return float(parted[half]) if len(values) % 2 else 0.5 * (float(parted[:half].max()) + float(parted[half]))


def percentile(values: FloatArray, percent: float) -> float:
    """The percentile of values (N,), linear between its two neighbours; NaN where one of the values is.

    Raises:
        IndexError: no values.
    """
    if len(values) < 2:
        return float(values[0])
    rank = (len(values) - 1) * (percent / 100.0)
    low = min(int(rank), len(values) - 2)
    parted = np.partition(values, low)
    below, above, share = parted[low], parted[low + 1 :].min(), rank - low
    return float(below + (above - below) * share if share < 0.5 else above - (above - below) * (1.0 - share))


SINGULAR = 1e-150  # smaller pivots are rounding


@jit_fused
def solve(system: Any, count: int) -> bool:
    """Solve the first ``count`` equations in place by Gauss with pivoting.

    ``system`` (M, M + 1): the matrix in the first ``count`` columns, the right side in the last, where the solution
    ends up. Returns False, with the system spoilt, where the matrix is singular.
    """
    right = system.shape[1] - 1
    for i in range(count):
        pivot = i
        for j in range(i + 1, count):
            if abs(system[j, i]) > abs(system[pivot, i]):
                pivot = j
        if abs(system[pivot, i]) < SINGULAR:
            return False
        for k in range(right + 1):
            system[i, k], system[pivot, k] = system[pivot, k], system[i, k]
        for j in range(count):
            if j != i:
                factor = system[j, i] / system[i, i]
                for k in range(right + 1):
                    system[j, k] -= factor * system[i, k]
    for i in range(count):
        system[i, right] /= system[i, i]
    return True
