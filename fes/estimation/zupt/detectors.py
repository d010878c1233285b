"""Is the foot at rest? The zero-velocity detectors of Skog et al., with thresholds that calibrate themselves.

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
the variance is the gyroscope's. Two more of our own. A constant factor moves the threshold and nothing else, so MV,
MAG, ARE and GYR stay in their units. And SHOE weighs force against rate by what a resting foot may do instead of by
the sensor's noise, for a foot in stance turns and sways far above the noise of any sensor.

**Thresholds** (:func:`calibrate_zero_velocity`), the part that the paper leaves open. Rest means that the sensor moves
slower than 0.1 m/s. As stance begins and ends the foot turns about heel or ball, 0.13 m away from an instep, and takes
0.15 s to come to speed (the constants of ``rest_kernel``). That bounds the rate by ``tol_w = v/r`` and the force by
``tol_a = v/t``; the sensor's noise comes on top:

- somebody stood still for a second: ``tolerance² + q·E0``, where ``E0`` is the statistic's mean in that second and
  ``q`` the 99.9 % quantile of chi²/dof, so that noise alone hardly ever breaks a rest;
- nobody did: midway, in logarithms, between the medians of what lies below and what lies above the threshold, the
  fixed point of Ridler and Calvard (1978), of the recording itself. Long stillness is left out, or it would stand for
  the stance of walking; the result stays within a factor of two of the tolerance.

Compiled statistics of the zero-velocity detectors; :mod:`fes.estimation.zupt.detectors` says what they are and where
from.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Final

import numpy as np

from fes.estimation.numerics.jit import jit, jit_ieee
from fes.estimation.numerics.ranks import median, percentile
from fes.estimation.zupt.thresholds import chi2_quantile, split
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


WINDOW_S = 0.05
STANDING_S = 1.0
STANDING_RATE_RADPS = 0.08  # spread about the mean, and …
STANDING_ACC_MPS2 = 0.3  # … the same of the force, that a second of standing does not exceed
GREATEST_BIAS_RADPS = 0.2
SPLIT_FACTOR = 2.0  # how far, in speed, a split may lie from the tolerance

_TOLERANCE = {
    Detector.SHOE: 2.0,  # both terms at their limit
    Detector.MV: ACC_TOLERANCE_MPS2**2,
    Detector.MAG: ACC_TOLERANCE_MPS2**2,
    Detector.ARE: RATE_TOLERANCE_RADPS**2,
    Detector.GYR: RATE_TOLERANCE_RADPS**2,
}
NOTHING: Final = np.empty(0)
_DEGREES_PER_SAMPLE = {Detector.SHOE: 6, Detector.MV: 3, Detector.MAG: 1, Detector.ARE: 3, Detector.GYR: 3}


@dataclass(frozen=True, slots=True)
class ZeroVelocityThresholds:
    """What rest looks like in one sensor.

    Attributes:
        detector: what the threshold belongs to.
        threshold: the statistic is below it at rest; in the statistic's unit (see :func:`statistic`).
        gravity_mps2: length of the specific force at rest, with the accelerometer's bias in it.
        gyr_bias_radps: of the standing second; zero where nobody stood.
        window_s: for which window the threshold holds.
        standing: a second of standing was found.
    """

    detector: Detector
    threshold: float
    gravity_mps2: float
    gyr_bias_radps: Vector3
    window_s: float
    standing: bool


def window_samples(window_s: float, rate_hz: float) -> int:
    """Samples in a window of ``window_s``: at least 2, for one sample has no variance."""
    if not (window_s > 0.0 and rate_hz > 0.0):
        raise ValueError(f"window_s {window_s} and rate_hz {rate_hz} must be above 0")
    return max(round(window_s * rate_hz), 2)


def statistic(
    detector: Detector,
    acc_mps2: FloatArray,
    gyr_radps: FloatArray,
    rate_hz: float,
    *,
    window_s: float = WINDOW_S,
    causal: bool = False,
    gravity_mps2: float = G_MPS2,
    gyr_bias_radps: Vector3 = (0.0, 0.0, 0.0),
) -> FloatArray:
    """The detector's statistic at every sample (N,): (m/s²)² for MV and MAG, (rad/s)² for ARE and GYR, 1 for SHOE.

    Args:
        detector: which.
        acc_mps2: (N, 3) specific force.
        gyr_radps: (N, 3) angular rate.
        rate_hz: nominal sampling rate.
        window_s: length of the window; GYR looks at single samples whatever it is.
        causal: the window ends at the sample; else it is centred on it. It is cut short at the recording's ends.
        gravity_mps2: length of the specific force at rest, for SHOE and MAG.
        gyr_bias_radps: taken off the rate.

    Raises:
        ValueError: shapes that do not match, values that are not finite, or a window or rate that is not positive.
    """
    acc, gyr = _checked(acc_mps2, gyr_radps)
    return _values(detector, acc, gyr, rate_hz, window_s, gravity_mps2, gyr_bias_radps, causal=causal)


def _values(
    detector: Detector,
    acc: FloatArray,
    gyr: FloatArray,
    rate_hz: float,
    window_s: float,
    gravity_mps2: float = G_MPS2,
    gyr_bias_radps: Vector3 = (0.0, 0.0, 0.0),
    *,
    causal: bool = False,
    energy: FloatArray = NOTHING,
) -> FloatArray:
    """As :func:`statistic`, of samples that are known to be finite; ``energy`` (N,) gets ARE along with SHOE."""
    count = 1 if detector is Detector.GYR else window_samples(window_s, rate_hz)
    ahead = 0 if causal else (count - 1) // 2
    out = np.empty(len(acc))
    if detector in (Detector.MV, Detector.MAG):
        force_windows(int(detector), acc, gyr, count, ahead, gravity_mps2, out)
    elif detector is Detector.SHOE:
        rate_windows(acc, gyr, count, ahead, gravity_mps2, *gyr_bias_radps, energy, out)
    else:
        unbiased = gyr - np.array(gyr_bias_radps) if any(gyr_bias_radps) else gyr
        rate_windows(acc, unbiased, count, ahead, gravity_mps2, 0.0, 0.0, 0.0, out, NOTHING)
    return out


def rate_energy(gyr_radps: FloatArray, rate_hz: float) -> FloatArray:
    """Mean of the squared rate (N,) over 0.05 s around every sample, (rad/s)²: the statistic ARE."""
    return statistic(Detector.ARE, gyr_radps, gyr_radps, rate_hz)


def calibrate_zero_velocity(
    acc_mps2: FloatArray,
    gyr_radps: FloatArray,
    rate_hz: float,
    *,
    detector: Detector = Detector.SHOE,
    window_s: float = WINDOW_S,
    use_standing: bool = True,
) -> ZeroVelocityThresholds:
    """Find a detector's threshold from a recording, (N, 3) each, by its standing second or its quiet stretches.

    ``use_standing`` False takes the quiet stretches even where somebody stood.

    Raises:
        ValueError: as :func:`statistic`, or less than two seconds.
    """
    return _calibrated(*_checked(acc_mps2, gyr_radps), rate_hz, detector, window_s, use_standing)[0]


def find_zero_velocity(
    acc: FloatArray, gyr: FloatArray, rate_hz: float
) -> tuple[ZeroVelocityThresholds, np.ndarray[Any, np.dtype[np.bool_]], FloatArray]:
    """:func:`calibrate_zero_velocity`, then :func:`at_rest`, and :func:`rate_energy`, of (N, 3) each, finite."""
    calibration, values, energy = _calibrated(acc, gyr, rate_hz, Detector.SHOE, WINDOW_S, True)
    return calibration, np.asarray(values < calibration.threshold), energy


def _calibrated(
    acc: FloatArray, gyr: FloatArray, rate_hz: float, detector: Detector, window_s: float, use_standing: bool
) -> tuple[ZeroVelocityThresholds, FloatArray, FloatArray]:
    """A detector's calibration, its statistic (N,), and ARE (N,), which of detectors but SHOE may have no rows."""
    n = round(STANDING_S * rate_hz)
    if len(acc) < 2 * n:
        raise ValueError(f"{len(acc) / rate_hz:.1f} s is too short to tell rest from movement: record at least 2 s")
    begin, standing = _stillest(acc, gyr, n)
    standing, tolerance = standing and use_standing, _TOLERANCE[detector]
    if standing:
        gravity = float(np.linalg.norm(acc[begin : begin + n].mean(axis=0)))
        x, y, z = gyr[begin : begin + n].mean(axis=0).tolist()
        bias, energy = (x, y, z), np.empty(len(acc)) if detector is Detector.SHOE else NOTHING
        values = _values(detector, acc, gyr, rate_hz, window_s, gravity, bias, energy=energy)
        samples = 1 if detector is Detector.GYR else window_samples(window_s, rate_hz)
        noise = float(values[begin : begin + n].mean())
        threshold = tolerance + noise * chi2_quantile(_DEGREES_PER_SAMPLE[detector] * samples)
    else:
        energy = _values(Detector.ARE, acc, gyr, rate_hz, window_s)
        quiet = acc.take(np.flatnonzero(energy <= percentile(energy, 15.0)), axis=0)
        gravity, bias = median(np.sqrt(np.vecdot(quiet, quiet))), (0.0, 0.0, 0.0)
        values = _values(detector, acc, gyr, rate_hz, window_s, gravity)
        bound = SPLIT_FACTOR**2
        threshold = min(max(split(values, tolerance, rate_hz), tolerance / bound), tolerance * bound)
    return ZeroVelocityThresholds(detector, threshold, gravity, bias, window_s, standing), values, energy


def at_rest(
    calibration: ZeroVelocityThresholds,
    acc_mps2: FloatArray,
    gyr_radps: FloatArray,
    rate_hz: float,
    *,
    causal: bool = False,
) -> np.ndarray[Any, np.dtype[np.bool_]]:
    """Whether the sensor rests, at every sample (N,); arguments and errors as :func:`statistic`."""
    values = statistic(
        calibration.detector,
        acc_mps2,
        gyr_radps,
        rate_hz,
        window_s=calibration.window_s,
        causal=causal,
        gravity_mps2=calibration.gravity_mps2,
        gyr_bias_radps=calibration.gyr_bias_radps,
    )
    return np.asarray(values < calibration.threshold)


class RestStream:
    """The causal detector sample by sample: the same decisions, to the bit, as :func:`at_rest` with ``causal``."""

    def __init__(self, calibration: ZeroVelocityThresholds, rate_hz: float) -> None:
        count = 1 if calibration.detector is Detector.GYR else window_samples(calibration.window_s, rate_hz)
        self._calibration = calibration
        self._acc, self._gyr = np.zeros((count, 3)), np.zeros((count, 3))
        self._filled = 0

    def push(self, acc_mps2: Vector3, gyr_radps: Vector3) -> bool:
        """Take one sample (m/s², rad/s); True where the window that it ends is at rest."""
        for ring, sample in ((self._acc, acc_mps2), (self._gyr, gyr_radps)):
            ring[:-1] = ring[1:]
            ring[-1] = sample
        count = len(self._acc)
        self._filled = min(self._filled + 1, count)
        c = self._calibration
        bx, by, bz = c.gyr_bias_radps
        begin = count - self._filled
        value = window_value(int(c.detector), self._acc, self._gyr, begin, count, c.gravity_mps2, bx, by, bz)
        return bool(value < c.threshold)


def _checked(acc: FloatArray, gyr: FloatArray) -> tuple[FloatArray, FloatArray]:
    acc, gyr = np.ascontiguousarray(acc, dtype=np.float64), np.ascontiguousarray(gyr, dtype=np.float64)
    if acc.ndim != 2 or acc.shape[1] != 3 or acc.shape != gyr.shape:
        raise ValueError(f"specific force {acc.shape} and rate {gyr.shape} must both have the shape (N, 3)")
    if not (np.isfinite(acc).all() and np.isfinite(gyr).all()):
        raise ValueError("specific force and rate must be finite: fill or cut out what is missing")
    return acc, gyr


def _stillest(acc: FloatArray, gyr: FloatArray, n: int) -> tuple[int, bool]:
    """First sample of the stillest second, and whether it is standing."""
    begin, turning, shaking = stillest(acc, gyr, n, max(n // 8, 1), STANDING_ACC_MPS2, STANDING_RATE_RADPS)
    if turning >= STANDING_RATE_RADPS or shaking >= STANDING_ACC_MPS2:
        return begin, False
    force, rate = acc[begin : begin + n], gyr[begin : begin + n]
    level = abs(float(np.linalg.norm(force.mean(axis=0))) - G_MPS2) < 0.1 * G_MPS2
    return begin, level and float(np.linalg.norm(rate.mean(axis=0))) < GREATEST_BIAS_RADPS
