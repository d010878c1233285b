"""A small linear system, for compiled code that must not call a library whose last bit differs between machines.

Median and percentile of one row of finite numbers: numpy's values, to the bit, in a fraction of its time.

numpy asks for both neighbours of a rank at once, and then leaves its fast selection, which is for one rank, for a slow
one. Here one is asked for, and the other is the greatest or the least of what lies on its side.
"""

from __future__ import annotations

from typing import Any

from fes.estimation.numerics.jit import jit_fused

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
