"""Thresholds of the zero-velocity detectors, found from the recording itself: the part that Kumar et al. leave open.

Zero velocity means that the sensor moves slower than 0.1 m/s. As stance begins and ends the foot turns about heel or
ball, 0.13 m away from an instep, and takes 0.15 s to come to speed (the constants of
:mod:`fes.estimation.zupt.detectors`). That bounds the rate by ``tol_w = v/r`` and the force by ``tol_a = v/t``; the
sensor's noise comes on top:

- somebody stood still for a second: ``tolerance² + q·E0``, where ``E0`` is the statistic's mean in that second and
  ``q`` the 99.9 % quantile of chi²/dof, so that noise alone hardly ever breaks a stance;
- nobody did: midway, in logarithms, between the medians of what lies below and what lies above the threshold, the
  fixed point of Ridler and Calvard (1978), of the recording itself. Long stillness is left out, or it would stand for
  the stance of walking; the result stays within a factor of two of the tolerance.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from fes.estimation.numerics.ranks import median, percentile
from fes.estimation.zupt.detectors import (
    ACC_TOLERANCE_MPS2,
    NOTHING,
    RATE_TOLERANCE_RADPS,
    WINDOW_S,
    Detector,
    checked_samples,
    detector_values,
    rate_energy,
    statistic,
    stillest,
    window_samples,
)
from fes.estimation.zupt.stances import BoolArray
from fes.signals import G_MPS2, FloatArray, Vector3

STANDING_S = 1.0
STANDING_RATE_RADPS = 0.08  # spread about the mean, and …
STANDING_ACC_MPS2 = 0.3  # … the same of the force, that a second of standing does not exceed
GREATEST_BIAS_RADPS = 0.2
SPLIT_FACTOR = 2.0  # how far, in speed, a split may lie from the tolerance
NOISE_QUANTILE_SIGMAS = 3.09  # 99.9 %
LONG_STILL_S = 1.5  # longer than any stance of walking
LEAST = 1e-12  # so that nothing, too, has a logarithm
_TOLERANCE = {
    Detector.SHOE: 2.0,  # both terms at their limit
    Detector.MV: ACC_TOLERANCE_MPS2**2,
    Detector.MAG: ACC_TOLERANCE_MPS2**2,
    Detector.ARE: RATE_TOLERANCE_RADPS**2,
    Detector.GYR: RATE_TOLERANCE_RADPS**2,
}
_DEGREES_PER_SAMPLE = {Detector.SHOE: 6, Detector.MV: 3, Detector.MAG: 1, Detector.ARE: 3, Detector.GYR: 3}


@dataclass(frozen=True, slots=True)
class ZeroVelocityThresholds:
    """What zero velocity looks like in one sensor.

    Attributes:
        detector: what the threshold belongs to.
        threshold: the statistic is below it at zero velocity; in the statistic's unit (see :func:`statistic`).
        gravity_mps2: length of the specific force then, with the accelerometer's bias in it.
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
    return _calibrated(*checked_samples(acc_mps2, gyr_radps), rate_hz, detector, window_s, use_standing)[0]


def find_zero_velocity(
    acc: FloatArray, gyr: FloatArray, rate_hz: float, detector: Detector = Detector.SHOE
) -> tuple[ZeroVelocityThresholds, BoolArray, FloatArray]:
    """Thresholds, zero velocity (N,) by them, and :func:`rate_energy` (N,), of finite samples (N, 3), (N, 3)."""
    thresholds, values, energy = _calibrated(acc, gyr, rate_hz, detector, WINDOW_S, True)
    return thresholds, np.asarray(values < thresholds.threshold), energy if len(energy) else rate_energy(gyr, rate_hz)


def detect_zero_velocity(
    thresholds: ZeroVelocityThresholds,
    acc_mps2: FloatArray,
    gyr_radps: FloatArray,
    rate_hz: float,
    *,
    causal: bool = False,
) -> BoolArray:
    """Whether the velocity is zero, at every sample (N,); arguments and errors as :func:`statistic`."""
    values = statistic(
        thresholds.detector,
        acc_mps2,
        gyr_radps,
        rate_hz,
        window_s=thresholds.window_s,
        causal=causal,
        gravity_mps2=thresholds.gravity_mps2,
        gyr_bias_radps=thresholds.gyr_bias_radps,
    )
    return np.asarray(values < thresholds.threshold)


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
        values = detector_values(detector, acc, gyr, rate_hz, window_s, gravity, bias, energy=energy)
        samples = 1 if detector is Detector.GYR else window_samples(window_s, rate_hz)
        noise = float(values[begin : begin + n].mean())
        threshold = tolerance + noise * chi2_quantile(_DEGREES_PER_SAMPLE[detector] * samples)
    else:
        energy = detector_values(Detector.ARE, acc, gyr, rate_hz, window_s)
        quiet = acc.take(np.flatnonzero(energy <= percentile(energy, 15.0)), axis=0)
        gravity, bias = median(np.sqrt(np.vecdot(quiet, quiet))), (0.0, 0.0, 0.0)
        values = detector_values(detector, acc, gyr, rate_hz, window_s, gravity)
        bound = SPLIT_FACTOR**2
        threshold = min(max(split_threshold(values, tolerance, rate_hz), tolerance / bound), tolerance * bound)
    return ZeroVelocityThresholds(detector, threshold, gravity, bias, window_s, standing), values, energy


def _stillest(acc: FloatArray, gyr: FloatArray, n: int) -> tuple[int, bool]:
    """First sample of the stillest second, and whether it is standing."""
    begin, turning, shaking = stillest(acc, gyr, n, max(n // 8, 1), STANDING_ACC_MPS2, STANDING_RATE_RADPS)
    if turning >= STANDING_RATE_RADPS or shaking >= STANDING_ACC_MPS2:
        return begin, False
    force, rate = acc[begin : begin + n], gyr[begin : begin + n]
    level = abs(float(np.linalg.norm(force.mean(axis=0))) - G_MPS2) < 0.1 * G_MPS2
    return begin, level and float(np.linalg.norm(rate.mean(axis=0))) < GREATEST_BIAS_RADPS


def chi2_quantile(degrees: int) -> float:
    """99.9 % quantile of chi² over its degrees of freedom, after Wilson and Hilferty (1931)."""
    share = 2.0 / (9.0 * degrees)
    return float((1.0 - share + NOISE_QUANTILE_SIGMAS * math.sqrt(share)) ** 3)


def _middle(rising: FloatArray) -> float:
    """The median of the logarithms of values (N,) in rising order."""
    half = len(rising) // 2
    return 0.5 * (math.log(rising[half] + LEAST) + math.log(rising[(len(rising) - 1) // 2] + LEAST))


def split_threshold(values: FloatArray, start: float, rate_hz: float) -> float:
    """Threshold between a recording's zero velocity and movement (Ridler and Calvard 1978, on medians of logarithms).

    Args:
        values: (N,) a detector's statistic, in its unit.
        start: the tolerance, from which it is sought, and what is returned where there is nothing to learn from.
        rate_hz: nominal sampling rate; what is still for ``LONG_STILL_S`` is left out.
    """
    still = np.concatenate(([False], values < start, [False]))
    edges = np.flatnonzero(still[1:] != still[:-1])
    begins, ends = edges[0::2], edges[1::2]
    long = ends - begins >= LONG_STILL_S * rate_hz
    parts, after = list[FloatArray](), 0
    for begin, end in zip(begins[long].tolist(), ends[long].tolist(), strict=True):
        parts.append(values[after:begin])
        after = end
    rising = np.concatenate((*parts, values[after:]))
    rising.sort()  # in the order of their logarithms, of which only a few are needed
    cut = math.log(start)
    for _ in range(100):
        count = int(np.searchsorted(rising, math.exp(cut) - LEAST))
        if count in (0, len(rising)):
            return start  # all rest or all movement: nothing to learn from
        new = 0.5 * (_middle(rising[:count]) + _middle(rising[count:]))
        if abs(new - cut) < 1e-6:
            break
        cut = new
    return math.exp(cut)
