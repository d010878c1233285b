"""Zero-velocity detectors of Skog et al., and the search for the stillest window of a recording.

Source: Kumar et al., Eq. (1)–(6), after Skog, Nilsson and Händel (2010), "Evaluation of zero-velocity detectors for
foot-mounted inertial navigation systems". Over a window of W samples, with ``f`` the specific force, ``w`` the rate,
``m`` the window's mean force and bars for means over the window:

======  ====================================================================  ==========================
SHOE    ``mean(|f - g·m/|m||²)/tol_a² + mean(|w|²)/tol_w²``                   force and rate
MV      ``mean(|f - m|²)``                                                    moving variance of force
MAG     ``mean((|f| - g)²)``                                                  magnitude of force
ARE     ``mean(|w|²)``                                                        angular rate energy
GYR     ``|w|²`` of one sample, the plain norm threshold                      rate
======  ====================================================================  ==========================

Departures from Kumar's print, all back to Skog: in (2) 1/W applies to both terms; in (3) the norm is squared; in (5)
the variance is the gyroscope's. Two more of our own: MV, MAG, ARE and GYR stay in their units, as a constant factor
only moves the threshold; and SHOE weighs force against rate by what a standing foot may do, which is far above the
noise of any sensor (:mod:`fes.estimation.zupt.thresholds`).
"""

import math
from enum import IntEnum
from typing import Final

import numpy as np

from fes.estimation.numerics.jit import jit, jit_ieee
from fes.estimation.numerics.records import Mat, Vec
from fes.signals import G_MPS2, FloatArray, Vector3


class Detector(IntEnum):
    """The zero-velocity detectors; the numbers are those of the compiled code."""

    SHOE = 0
    MV = 1
    MAG = 2
    ARE = 3
    GYR = 4


SPEED_TOLERANCE_MPS = 0.1
PIVOT_M = 0.13  # from an instep to the heel and to the ball of the foot
SETTLING_S = 0.15
RATE_TOLERANCE_RADPS = SPEED_TOLERANCE_MPS / PIVOT_M
ACC_TOLERANCE_MPS2 = SPEED_TOLERANCE_MPS / SETTLING_S
FREE_FALL_MPS2 = 1e-9  # so little force has no direction
WIDE = 128  # windows side by side: what they need fits into the processor's nearest cache
_PER_ACC2, _PER_RATE2 = ACC_TOLERANCE_MPS2**-2, RATE_TOLERANCE_RADPS**-2
WINDOW_S = 0.05
NOTHING: Final = np.empty(0)


@jit_ieee
def force_windows(magnitude: bool, acc: Mat, count: int, ahead: int, g: float, out: Vec) -> None:
    """MV, or MAG if ``magnitude``, of every window of ``count`` samples that reaches ``ahead`` beyond its sample."""
    for i in range(acc.shape[0]):
        begin, end = max(i + ahead + 1 - count, 0), min(i + ahead + 1, acc.shape[0])
        n, total = end - begin, 0.0
        if magnitude:
            for k in range(begin, end):
                norm = math.sqrt(acc[k, 0] * acc[k, 0] + acc[k, 1] * acc[k, 1] + acc[k, 2] * acc[k, 2])
                total += (norm - g) * (norm - g)
        else:
            mx = my = mz = 0.0
            for k in range(begin, end):
                mx += acc[k, 0]
                my += acc[k, 1]
                mz += acc[k, 2]
            mx, my, mz = mx / n, my / n, mz / n
            for k in range(begin, end):
                x, y, z = acc[k, 0] - mx, acc[k, 1] - my, acc[k, 2] - mz
                total += x * x + y * y + z * z
        out[i] = total / n


@jit_ieee
def rate_windows(
    acc: Mat, gyr: Mat, count: int, ahead: int, g: float, bx: float, by: float, bz: float, energy: Vec, shoe: Vec
) -> None:
    """ARE, of the rate as it is, and SHOE, of the rate less its bias, of every window of ``count`` samples that reaches
    ``ahead`` beyond its sample. Each is filled unless it has no rows.

    Whole windows are summed side by side, some in one instruction. One that is cut short by an end is summed alone.
    """
    n, most = acc.shape[0], WIDE + count
    x, y, z, rate = np.empty(most), np.empty(most), np.empty(most), np.empty(WIDE)  # each by itself: none can lie in …
    mx, my, mz, force = np.empty(WIDE), np.empty(WIDE), np.empty(WIDE), np.empty(WIDE)  # … another, as rows of one can
    first, last, at = count - 1 - ahead, n - ahead, 0  # of the whole windows
    while at < n:
        begin, size = max(at - first, 0), min(at + ahead + 1, n) - max(at - first, 0)
        wide = min(WIDE, last - at) if first <= at < last else 1
        per = 1.0 / size
        for biased in range(2):
            if (shoe if biased else energy).shape[0] == 0:
                continue
            u, v, w = (bx, by, bz) if biased else (0.0, 0.0, 0.0)
            for j in range(wide + size - 1):
                a, b, c = gyr[begin + j, 0] - u, gyr[begin + j, 1] - v, gyr[begin + j, 2] - w
                x[j] = a * a + b * b + c * c
            _sums(x, size, wide, rate)
            if not biased:
                for j in range(wide):
                    energy[at + j] = rate[j] * per
        if shoe.shape[0] > 0:
            for j in range(wide + size - 1):
                x[j], y[j], z[j] = acc[begin + j, 0], acc[begin + j, 1], acc[begin + j, 2]
            _sums(x, size, wide, mx)
            _sums(y, size, wide, my)
            _sums(z, size, wide, mz)
            for j in range(wide):
                a, b, c = mx[j], my[j], mz[j]
                norm = math.sqrt(a * a + b * b + c * c)
                some = norm > FREE_FALL_MPS2 * size
                by_length = (g if some else 1.0) / (norm if some else size)
                mx[j], my[j], mz[j], force[j] = by_length * a, by_length * b, by_length * c if some else g, 0.0
            for k in range(size):
                for j in range(wide):
                    a, b, c = x[j + k] - mx[j], y[j + k] - my[j], z[j + k] - mz[j]
                    force[j] += a * a + b * b + c * c
            for j in range(wide):
                shoe[at + j] = (force[j] * _PER_ACC2 + rate[j] * _PER_RATE2) * per
        at += wide


@jit_ieee
def _sums(x: Vec, size: int, wide: int, out: Vec) -> None:
    """Fill ``out`` with ``wide`` sums of ``size`` samples of ``x`` in their order, each from a sample further on."""
    for j in range(wide):
        out[j] = x[j]
    for k in range(1, size):
        for j in range(wide):
            out[j] += x[j + k]


def window_samples(window_s: float, rate_hz: float) -> int:
    """Samples in a window of ``window_s``: at least 2, for one sample has no variance."""
    if not (window_s > 0.0 and rate_hz > 0.0):
        raise ValueError(f"window_s {window_s} and rate_hz {rate_hz} must be above 0")
    return max(round(window_s * rate_hz), 2)


def statistic(
    detector: Detector, acc_mps2: FloatArray, gyr_radps: FloatArray, rate_hz: float, *, window_s: float = WINDOW_S,
    causal: bool = False, gravity_mps2: float = G_MPS2, gyr_bias_radps: Vector3 = (0.0, 0.0, 0.0),
    energy: FloatArray = NOTHING,
) -> FloatArray:  # fmt: skip
    """The detector's statistic at every sample (N,): (m/s²)² for MV and MAG, (rad/s)² for ARE and GYR, 1 for SHOE.

    Args:
        detector: which.
        acc_mps2: (N, 3) specific force, finite.
        gyr_radps: (N, 3) angular rate, finite.
        rate_hz: nominal sampling rate.
        window_s: length of the window; GYR looks at single samples whatever it is.
        causal: the window ends at the sample; else it is centred on it. It is cut short at the recording's ends.
        gravity_mps2: length of the specific force at zero velocity, for SHOE and MAG.
        gyr_bias_radps: taken off the rate.
        energy: (N,) gets ARE along with SHOE.

    Raises:
        ValueError: shapes that do not match, or a window or rate that is not positive.
    """
    if acc_mps2.ndim != 2 or acc_mps2.shape[1] != 3 or acc_mps2.shape != gyr_radps.shape:
        raise ValueError(f"specific force {acc_mps2.shape} and rate {gyr_radps.shape} must both have the shape (N, 3)")
    acc, gyr = np.ascontiguousarray(acc_mps2), np.ascontiguousarray(gyr_radps)
    count = 1 if detector is Detector.GYR else window_samples(window_s, rate_hz)
    ahead = 0 if causal else (count - 1) // 2
    out = np.empty(len(acc))
    if detector in (Detector.MV, Detector.MAG):
        force_windows(detector is Detector.MAG, acc, count, ahead, gravity_mps2, out)
    elif detector is Detector.SHOE:
        rate_windows(acc, gyr, count, ahead, gravity_mps2, *gyr_bias_radps, energy, out)
    else:
        unbiased = gyr - np.array(gyr_bias_radps) if any(gyr_bias_radps) else gyr
        rate_windows(acc, unbiased, count, ahead, gravity_mps2, 0.0, 0.0, 0.0, out, NOTHING)
    return out


def rate_energy(gyr_radps: FloatArray, rate_hz: float) -> FloatArray:
    """Mean of the squared rate (N,) over 0.05 s around every sample, (rad/s)²: the statistic ARE."""
    return statistic(Detector.ARE, gyr_radps, gyr_radps, rate_hz)


@jit
def _spread2(x: Vec, begin: int, end: int, most: float) -> float:
    """Summed variances of the three columns over ``begin`` … ``end - 1``; infinite once that exceeds ``most``.

    Two samples' squares about whatever mean are at least half their distance's, which in a movement soon is too much.
    """
    n = end - begin
    half, apart = n // 2, 0.0
    for i in range(begin, begin + half):
        dx, dy, dz = x[i, 0] - x[i + half, 0], x[i, 1] - x[i + half, 1], x[i, 2] - x[i + half, 2]
        apart += dx * dx + dy * dy + dz * dz
        if apart > 2.0 * most * n:
            return math.inf
    mx = my = mz = 0.0
    for i in range(begin, end):
        mx += x[i, 0]
        my += x[i, 1]
        mz += x[i, 2]
    mx, my, mz = mx / n, my / n, mz / n
    total, enough = 0.0, most * n
    for i in range(begin, end):
        dx, dy, dz = x[i, 0] - mx, x[i, 1] - my, x[i, 2] - mz
        total += dx * dx + dy * dy + dz * dz
        if total > enough:
            return math.inf
    return total / n


@jit
def stillest(acc: Mat, gyr: Mat, n: int, step: int, acc_unit: float, gyr_unit: float) -> tuple[int, float, float]:
    """Of the windows of ``n`` samples, every ``step``, that with the least spread: where it begins, and its spreads.

    A window's spread is that of the rate and that of the force (root of the summed variances), each in its unit. A
    window is left as soon as it cannot be the stillest any more, which most of them cannot after a few samples.
    """
    best, begin, turning, shaking = math.inf, 0, math.inf, math.inf
    for i in range(0, acc.shape[0] - n + 1, step):
        # a little more than the bound, so that rounding decides nothing
        most = best * gyr_unit * 1.000001
        turn = math.sqrt(_spread2(gyr, i, i + n, most * most))
        if turn / gyr_unit >= best:
            continue
        most = (best - turn / gyr_unit) * acc_unit * 1.000001
        shake = math.sqrt(_spread2(acc, i, i + n, most * most))
        spread = turn / gyr_unit + shake / acc_unit
        if spread < best:
            best, begin, turning, shaking = spread, i, turn, shake
    return begin, turning, shaking


@jit
def _greatest_sd(x: Vec, begin: int, end: int) -> float:
    """The greatest standard deviation of the three columns over ``begin`` … ``end - 1``."""
    mx = my = mz = 0.0  # the three side by side, for each sum has to wait for its own last value
    for i in range(begin, end):
        mx += x[i, 0]
        my += x[i, 1]
        mz += x[i, 2]
    mx, my, mz = mx / (end - begin), my / (end - begin), mz / (end - begin)
    xx = yy = zz = 0.0
    for i in range(begin, end):
        xx += (x[i, 0] - mx) * (x[i, 0] - mx)
        yy += (x[i, 1] - my) * (x[i, 1] - my)
        zz += (x[i, 2] - mz) * (x[i, 2] - mz)
    return math.sqrt(max(xx, yy, zz) / (end - begin))


@jit
def least_spread(acc: Mat, gyr: Mat, n: int, step: int, acc_weight: float) -> tuple[int, float]:
    """Of the windows of ``n`` samples, every ``step``, that with the least spread: where it begins (-1: no window).

    A window's spread is the greatest standard deviation of a rate plus ``acc_weight`` times that of a force.
    """
    begin, best = -1, math.inf
    for i in range(0, acc.shape[0] - n, step):
        spread = _greatest_sd(gyr, i, i + n)
        if spread < best:
            spread += acc_weight * _greatest_sd(acc, i, i + n)
        if spread < best:
            begin, best = i, spread
    return begin, best
