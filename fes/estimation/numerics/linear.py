"""A small linear system, for compiled code that must not call a library whose last bit differs between machines."""

from fes.estimation.numerics.jit import by_number, jit_fused
from fes.estimation.numerics.records import Mat

SINGULAR = 1e-150  # smaller pivots are rounding


@by_number
@jit_fused
def solve(system: Mat, count: int) -> bool:
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
