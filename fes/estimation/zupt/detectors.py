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

from enum import IntEnum

import numpy as np

from fes.estimation.numerics.filters import moving_sums
from fes.estimation.numerics.jit import jit_ieee
from fes.estimation.numerics.records import Mat
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
WINDOW_S = 0.05


def window_samples(window_s: float, rate_hz: float) -> int:
    """Samples in a window of ``window_s``: at least 2, for one sample has no variance."""
    if not (window_s > 0.0 and rate_hz > 0.0):
        raise ValueError(f"window_s {window_s} and rate_hz {rate_hz} must be above 0")
    return max(round(window_s * rate_hz), 2)


def statistic(
    detector: Detector, acc_mps2: FloatArray, gyr_radps: FloatArray, rate_hz: float, *, window_s: float = WINDOW_S,
    causal: bool = False, gravity_mps2: float = G_MPS2, gyr_bias_radps: Vector3 = (0.0, 0.0, 0.0),
) -> FloatArray:  # fmt: skip
    """The detector's statistic at every sample (N,): (m/s²)² for MV and MAG, (rad/s)² for ARE and GYR, 1 for SHOE.

    All are moving means: SHOE's force comes to ``mean(|f|²) - 2 g |m| + g²``, MV to ``mean(|f|²) - |m|²``.

    Args:
        detector: which.
        acc_mps2: (N, 3) specific force, finite.
        gyr_radps: (N, 3) angular rate, finite.
        rate_hz: nominal sampling rate.
        window_s: length of the window; GYR looks at single samples whatever it is.
        causal: the window ends at the sample; else it is centred on it. It is cut short at the recording's ends.
        gravity_mps2: length of the specific force at zero velocity, for SHOE and MAG.
        gyr_bias_radps: taken off the rate.

    Raises:
        ValueError: shapes that do not match, or a window or rate that is not positive.
    """
    if acc_mps2.ndim != 2 or acc_mps2.shape[1] != 3 or acc_mps2.shape != gyr_radps.shape:
        raise ValueError(f"specific force {acc_mps2.shape} and rate {gyr_radps.shape} must both have the shape (N, 3)")
    count = window_samples(window_s, rate_hz)
    ahead = 0 if causal else (count - 1) // 2
    at = np.arange(len(acc_mps2)) + ahead + 1
    per = 1.0 / (np.minimum(at, len(at)) - np.maximum(at - count, 0))

    def mean(x: FloatArray) -> FloatArray:
        out = np.empty(len(x))
        moving_sums(x, count, ahead, 1.0, out)
        out *= per
        return out

    g = gravity_mps2
    rate2 = squared_lengths(gyr_radps - np.array(gyr_bias_radps) if any(gyr_bias_radps) else gyr_radps)
    force2 = squared_lengths(acc_mps2)
    match detector:
        case Detector.GYR:
            return rate2
        case Detector.ARE:
            return mean(rate2)
        case Detector.MAG:
            return mean((np.sqrt(force2) - g) ** 2)
    size2 = sum(mean(np.ascontiguousarray(axis)) ** 2 for axis in acc_mps2.T)
    if detector is Detector.MV:
        return np.asarray(np.maximum(mean(force2) - size2, 0.0))
    force = np.maximum(mean(force2) - 2.0 * g * np.sqrt(size2) + g * g, 0.0)
    return np.asarray(force / ACC_TOLERANCE_MPS2**2 + mean(rate2) / RATE_TOLERANCE_RADPS**2)


def squared_lengths(vectors: FloatArray) -> FloatArray:
    """Squared lengths (N,) of vectors (N, 3)."""
    x, y, z = vectors.T
    return np.asarray(x * x + y * y + z * z)


def rate_energy(gyr_radps: FloatArray, rate_hz: float) -> FloatArray:
    """Mean of the squared rate (N,) over 0.05 s around every sample, (rad/s)²: the statistic ARE."""
    return statistic(Detector.ARE, gyr_radps, gyr_radps, rate_hz)


@jit_ieee
def window_variances(x: Mat, n: int, step: int) -> Mat:
    """Variances (K, 3) of the columns of ``x`` (N, 3) over each window of ``n`` samples, one every ``step``.

    Windows overlap: the sums over each ``step`` samples, less the first sample, are formed once.
    """
    blocks, whole = x.shape[0] // step, n // step
    sums, total = np.zeros((blocks, 6)), np.empty(6)
    out = np.empty((max((x.shape[0] - n) // step + 1, 0), 3))
    for k in range(blocks):
        for i in range(k * step, k * step + step):
            for j in range(3):
                one = x[i, j] - x[0, j]
                sums[k, j] += one
                sums[k, 3 + j] += one * one
    for k in range(out.shape[0]):
        for j in range(6):
            total[j] = 0.0
        for block in range(k, k + whole):
            for j in range(6):
                total[j] += sums[block, j]
        for i in range((k + whole) * step, k * step + n):
            for j in range(3):
                one = x[i, j] - x[0, j]
                total[j] += one
                total[3 + j] += one * one
        for j in range(3):
            out[k, j] = max(total[3 + j] / n - (total[j] / n) ** 2, 0.0)
    return out
