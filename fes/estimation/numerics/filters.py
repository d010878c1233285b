"""Low passes without lag, moving sums, greatest values of late, peaks apart, in compiled loops; a linear system.

They give what ``scipy.signal`` and ``scipy.ndimage`` give (a test holds them to it), whose import alone takes longer
than the analysis of a short recording.
"""

import math

import numpy as np

from fes.estimation.numerics.jit import by_number, inlined, jit, jit_fused, jit_ieee
from fes.estimation.numerics.records import Mat, Vec
from fes.signals import BoolArray, FloatArray, IntArray

PADDING = 9  # samples at each end, as scipy has it for one section
SINGULAR = 1e-150  # smaller pivots are rounding

Section = tuple[float, float, float]


def low_pass(rate_hz: float, cutoff_hz: float) -> Section:
    """Butterworth of second order (bilinear, prewarped), its cut-off kept below 45 % of the sampling rate.

    ``b``, ``a1``, ``a2`` of ``b (1 + z⁻¹)² / (1 + a1 z⁻¹ + a2 z⁻²)``.
    """
    k = math.tan(math.pi * min(cutoff_hz, 0.45 * rate_hz) / rate_hz)
    damped = math.sqrt(2.0) * k
    whole = 1.0 + damped + k * k
    return k * k / whole, 2.0 * (k * k - 1.0) / whole, (1.0 - damped + k * k) / whole


def moving_mean(x: FloatArray, window: int) -> FloatArray:
    """Centred mean over ``window`` samples along the first axis, shorter at the ends, same shape."""
    if window <= 1:
        return x
    total = np.cumsum(np.concatenate((np.zeros((1, *x.shape[1:])), x)), axis=0)
    index = np.arange(len(x))
    begin = np.maximum(index - window // 2, 0)
    end = np.minimum(index - window // 2 + window, len(x))
    count = (end - begin).reshape((-1,) + (1,) * (x.ndim - 1))
    return np.asarray((total[end] - total[begin]) / count)


def runs(inside: BoolArray) -> IntArray:
    """Stretches (K, 2) of True: first sample, and one past the last."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], inside, [False])).astype(np.int8)))
    return edges.reshape(-1, 2)


@inlined
def biquad_start(x: float, section: Section) -> tuple[float, float]:
    """What a section remembers that has always been given ``x``."""
    return (1.0 - section[0]) * x, (section[0] - section[2]) * x


@inlined
def biquad_step(x: float, section: Section, early: float, late: float) -> tuple[float, float, float]:
    """What a section makes of the next sample, and what it remembers then."""
    b, a1, a2 = section
    y = b * x + early
    return y, (2.0 * b * x + late) - a1 * y, b * x - a2 * y


@jit_ieee
def filter_backwards(one: Section, two: Section, three: Section, x: Mat) -> None:
    """Run a section over each row of ``x`` (3, N), from its end to its beginning: three at once, for each has to wait
    for its own last value, and hardly longer for the others."""
    last = x.shape[1] - 1
    early_u, late_u = biquad_start(x[0, last], one)
    early_v, late_v = biquad_start(x[1, last], two)
    early_w, late_w = biquad_start(x[2, last], three)
    for i in range(last, -1, -1):
        x[0, i], early_u, late_u = biquad_step(x[0, i], one, early_u, late_u)
        x[1, i], early_v, late_v = biquad_step(x[1, i], two, early_v, late_v)
        x[2, i], early_w, late_w = biquad_step(x[2, i], three, early_w, late_w)


@jit_ieee
def moving_sums(x: Vec, count: int, ahead: int, share: float, out: Vec) -> None:
    """Fill ``out`` (N,) with ``share`` times the sum of ``x`` (N,) over ``count`` samples, ``ahead`` of them still to
    come; beyond the ends there is nothing. Both may be the same.

    What follows the beginning of a block of ``count`` samples is added to what is left of the block before: three
    additions, however many the samples, and nothing is ever taken away.
    """
    n, block, left = x.shape[0], np.empty(count), np.zeros(count + 1)  # left: of the block before, from a sample on
    for begin in range(0, n + ahead, count):
        total = 0.0
        for j in range(count):
            i = begin + j
            block[j] = x[i] if i < n else 0.0
            total += block[j]
            if 0 <= i - ahead < n:
                out[i - ahead] = share * (left[j + 1] + total)
        for j in range(count - 1, -1, -1):
            left[j] = left[j + 1] + block[j]


@jit_ieee
def likeness(x: Vec, shortest: int, out: Vec) -> None:
    """Fill ``out`` (L,) with the sums of ``x[i] x[i + lag]`` over ``x`` (N,), L lags from ``shortest`` on.

    Lags lie side by side, several in one instruction, and four samples at a time each sum is fetched once. A library's
    scalar product has threads, which take the processor that works on the other foot.
    """
    later, lags, begin = x[shortest:], out.shape[0], 0
    for lag in range(lags):
        out[lag] = 0.0
    while begin + 3 + lags <= later.shape[0]:
        a, b, c, d = x[begin], x[begin + 1], x[begin + 2], x[begin + 3]
        for lag in range(lags):
            i = begin + lag
            out[lag] = (((out[lag] + a * later[i]) + b * later[i + 1]) + c * later[i + 2]) + d * later[i + 3]
        begin += 4
    for i in range(begin, later.shape[0]):
        for lag in range(min(lags, later.shape[0] - i)):
            out[lag] += x[i] * later[i + lag]


@jit
def greatest_at(x: Vec, begin: int, end: int) -> int:
    """The first greatest of ``x[begin:end]``."""
    at, greatest = begin, x[begin]
    for i in range(begin + 1, min(end, x.shape[0])):
        if x[i] > greatest:
            at, greatest = i, x[i]
    return at


@jit
def _all_greatest_at(x: Vec, begins: Vec, ends: Vec, out: Vec) -> None:
    for k in range(out.shape[0]):
        out[k] = greatest_at(x, begins[k], ends[k])


def greatest_at_each(x: FloatArray, begins: IntArray, ends: IntArray) -> IntArray:
    """Where the greatest of ``x`` lies in each of K spans."""
    out = np.empty(len(begins), np.int64)
    _all_greatest_at(x, begins, ends, out)
    return out


def falls_apart(x: FloatArray, n: int, apart: int) -> tuple[IntArray, FloatArray]:
    """Where ``x`` (N,) lies farthest below the greatest of its last ``n`` samples, and how far.

    Before its beginning ``x`` is mirrored. No two are closer than ``apart`` samples; the larger fall stays. A flat top
    of the fall counts by its middle; the two ends are none.
    """
    at, fall = np.empty(len(x) // 2 + 1, np.int64), np.empty(len(x) // 2 + 1)
    count = _falls(x, n, at, fall)
    at, fall = at[:count], fall[:count]
    keep = np.ones(count, np.bool_)
    _thin(at, np.argsort(fall), apart, keep)
    return at[keep], fall[keep]


@jit_ieee
def _falls(x: Vec, n: int, at: Vec, fall: Vec) -> int:
    """Write all of them; how many there are. In blocks of ``n``, as :func:`moving_sums`."""
    left = np.empty(n + 1)  # the greatest of the block before, from each of its samples on
    left[n] = -math.inf
    for j in range(n - 1, -1, -1):
        left[j] = max(left[j + 1], x[n - 1 - j]) if n - 1 - j < x.shape[0] else left[j + 1]
    count, rise, before = 0, 0, math.inf  # where the fall last became larger, 0 once it is smaller again
    for begin in range(0, x.shape[0], n):
        greatest, end = -math.inf, min(begin + n, x.shape[0])
        for i in range(begin, end):
            greatest = max(greatest, x[i])
            now = max(left[i - begin + 1], greatest) - x[i]
            if now > before:
                rise = i
            elif rise > 0 and now < before:
                at[count], fall[count] = (rise + i - 1) // 2, before
                count, rise = count + 1, 0
            before = now
        greatest = -math.inf
        for i in range(end - 1, begin - 1, -1):
            greatest = max(greatest, x[i])
            left[i - begin] = greatest
    return count


@jit
def _thin(tops: Vec, rising: Vec, apart: int, keep: Vec) -> None:
    """From the highest down, each peak that still stands takes away those that are too close to it."""
    for r in range(rising.shape[0] - 1, -1, -1):
        j = rising[r]
        if not keep[j]:
            continue
        for step in (-1, 1):
            k = j + step
            while 0 <= k < tops.shape[0] and abs(tops[k] - tops[j]) < apart:
                keep[k] = False
                k += step


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


@by_number
@jit_fused
def solve(system: Mat, count: int) -> bool:
    """Solve the first ``count`` equations in place by Gauss with pivoting, the same to the last bit on any machine.

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
