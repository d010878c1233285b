"""Compiled statistics of the zero-velocity detectors; :mod:`fes.estimation.rest` says what they are and where from."""

from __future__ import annotations

import math
from enum import IntEnum
from typing import Any

import numpy as np

from fes.estimation.compiled import jit, jit_ieee


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


@jit_ieee
def window_value(
    detector: int, acc: Any, gyr: Any, begin: int, end: int, g: float, bx: float, by: float, bz: float
) -> float:
    """The statistic over the samples ``begin`` … ``end - 1``; the sums always run in this order."""
    n = end - begin
    rate = 0.0
    for i in range(begin, end):
        x, y, z = gyr[i, 0] - bx, gyr[i, 1] - by, gyr[i, 2] - bz
        rate += x * x + y * y + z * z
    if detector >= 3:
        return rate * (1.0 / n)
    force = 0.0
    if detector == 0:
        return _shoe(rate, acc, begin, end, g)
    if detector == 2:
        for i in range(begin, end):
            norm = math.sqrt(acc[i, 0] * acc[i, 0] + acc[i, 1] * acc[i, 1] + acc[i, 2] * acc[i, 2])
            force += (norm - g) * (norm - g)
        return force / n
    mx = my = mz = 0.0
    for i in range(begin, end):
        mx += acc[i, 0]
        my += acc[i, 1]
        mz += acc[i, 2]
    mx, my, mz = mx / n, my / n, mz / n
    for i in range(begin, end):
        x, y, z = acc[i, 0] - mx, acc[i, 1] - my, acc[i, 2] - mz
        force += x * x + y * y + z * z
    return force / n


@jit_ieee
def _shoe(rate: float, acc: Any, begin: int, end: int, g: float) -> float:
    """SHOE of a window whose squared rates sum up to ``rate``."""
    n = end - begin
    mx = my = mz = force = 0.0
    for i in range(begin, end):
        mx += acc[i, 0]
        my += acc[i, 1]
        mz += acc[i, 2]
    # towards the mean direction, but as long as gravity; in free fall any will do
    norm = math.sqrt(mx * mx + my * my + mz * mz)
    some = norm > FREE_FALL_MPS2 * n
    per = g / norm if some else 1.0 / n
    mx, my, mz = per * mx, per * my, per * mz if some else g
    for i in range(begin, end):
        x, y, z = acc[i, 0] - mx, acc[i, 1] - my, acc[i, 2] - mz
        force += x * x + y * y + z * z
    return (force * _PER_ACC2 + rate * _PER_RATE2) * (1.0 / n)


@jit_ieee
def force_windows(detector: int, acc: Any, gyr: Any, count: int, ahead: int, g: float, out: Any) -> None:
    """MV or MAG of every window of ``count`` samples that reaches ``ahead`` beyond its sample."""
    n = acc.shape[0]
    for i in range(n):
        begin, end = max(i + ahead + 1 - count, 0), min(i + ahead + 1, n)
        out[i] = window_value(detector, acc, gyr, begin, end, g, 0.0, 0.0, 0.0)


@jit_ieee
def rate_windows(
    acc: Any, gyr: Any, count: int, ahead: int, g: float, bx: float, by: float, bz: float, energy: Any, shoe: Any
) -> None:
    """ARE, of the rate as it is, and SHOE, of the rate less its bias, of every window of ``count`` samples that reaches
    ``ahead`` beyond its sample. Each is filled unless it has no rows.

    To the bit as :func:`window_value`; but whole windows are summed side by side, some in one instruction. One that is
    cut short by an end is summed alone.
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
def _sums(x: Any, size: int, wide: int, out: Any) -> None:
    """Fill ``out`` with ``wide`` sums of ``size`` samples of ``x`` in their order, each from a sample further on."""
    for j in range(wide):
        out[j] = x[j]
    for k in range(1, size):
        for j in range(wide):
            out[j] += x[j + k]


@jit
def _spread2(x: Any, begin: int, end: int, most: float) -> float:
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
def stillest(acc: Any, gyr: Any, n: int, step: int, acc_unit: float, gyr_unit: float) -> tuple[int, float, float]:
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
def _greatest_sd(x: Any, begin: int, end: int) -> float:
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
def least_spread(acc: Any, gyr: Any, n: int, step: int, acc_weight: float) -> tuple[int, float]:
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
