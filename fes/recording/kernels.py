"""What reading a recording does with every number, in one pass each: columns into rows, how far vectors spread."""

import math

from fes.estimation.numerics.jit import jit_ieee
from fes.estimation.numerics.records import Mat, Vec


@jit_ieee
def into_rows(x: Vec, y: Vec, z: Vec, out: Mat) -> float:
    """Fill the rows of ``out`` (N, 3) from columns (N,); the greatest size of a number, infinite where one is none."""
    size = 0.0
    for i in range(out.shape[0]):
        a, b, c = x[i], y[i], z[i]
        out[i, 0], out[i, 1], out[i, 2] = a, b, c
        if not (abs(a) <= size and abs(b) <= size and abs(c) <= size):  # seldom: no number waits for the one before
            number = a == a and b == b and c == c
            size = max(size, abs(a), abs(b), abs(c)) if number else math.inf
    return size


@jit_ieee
def spreads(vectors: Mat, begins: Vec, size: int, window: int, squares: Vec, out: Mat) -> None:
    """Look at the stretches of ``size`` rows from ``begins`` (B,) on, as if each followed the one before.

    Fills ``squares`` (B · size,) with their squared lengths, and ``out`` (K,) with the root of the variances' sum of
    each ``window`` rows; rows that do not fill the last one are left out.
    """
    at = inside = 0
    x = y = z = square = 0.0
    for begin in begins:
        for i in range(begin, begin + size):
            a, b, c = vectors[i, 0], vectors[i, 1], vectors[i, 2]
            squares[at] = a * a + b * b + c * c
            x, y, z, square = x + a, y + b, z + c, square + squares[at]
            at, inside = at + 1, inside + 1
            if inside == window:
                away = square - (x * x + y * y + z * z) / window
                out[at // window - 1] = math.sqrt(max(away, 0.0) / window)
                inside = 0
                x = y = z = square = 0.0
