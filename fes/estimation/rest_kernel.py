"""Compiled statistics of the zero-velocity detectors; :mod:`fes.estimation.rest` says what they are and where from."""

from __future__ import annotations

import math
from enum import IntEnum
from typing import Any

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
        return rate / n
    force = 0.0
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
    if detector == 0:  # towards the mean direction, but as long as gravity; in free fall any will do
        norm = math.sqrt(mx * mx + my * my + mz * mz)
        if norm > 1e-9:
            mx, my, mz = g * mx / norm, g * my / norm, g * mz / norm
        else:
            mz = g
    for i in range(begin, end):
        x, y, z = acc[i, 0] - mx, acc[i, 1] - my, acc[i, 2] - mz
        force += x * x + y * y + z * z
    if detector == 1:
        return force / n
    return (
        force / (ACC_TOLERANCE_MPS2 * ACC_TOLERANCE_MPS2) + rate / (RATE_TOLERANCE_RADPS * RATE_TOLERANCE_RADPS)
    ) / n


@jit_ieee
def all_windows(
    detector: int, acc: Any, gyr: Any, count: int, ahead: int, g: float, bx: float, by: float, bz: float, out: Any
) -> None:
    """The statistic of every window of ``count`` samples that reaches ``ahead`` beyond its sample."""
    n = acc.shape[0]
    for i in range(n):
        end = min(i + ahead + 1, n)
        begin = max(i + ahead + 1 - count, 0)
        out[i] = window_value(detector, acc, gyr, begin, end, g, bx, by, bz)


@jit
def _spread2(x: Any, begin: int, end: int, most: float) -> float:
    """Summed variances of the three columns over ``begin`` … ``end - 1``; infinite once that exceeds ``most``."""
    n = end - begin
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
    greatest = 0.0
    for j in range(3):
        mean = total = 0.0
        for i in range(begin, end):
            mean += x[i, j]
        mean /= end - begin
        for i in range(begin, end):
            total += (x[i, j] - mean) * (x[i, j] - mean)
        greatest = max(greatest, total / (end - begin))
    return math.sqrt(greatest)


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
