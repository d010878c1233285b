"""Thresholds of the zero-velocity detectors, found from the recording itself: the part that Kumar et al. leave open.

Zero velocity means that the sensor moves slower than 0.1 m/s. As stance begins and ends the foot turns about heel or
ball, 0.13 m away from an instep, and takes 0.15 s to come to speed (the constants of
:mod:`fes.estimation.zupt.detectors`). That bounds the rate by ``tol_w = v/r`` and the force by ``tol_a = v/t``; the
sensor's noise comes on top:

- somebody stood still for a second: ``tolerance² + q·E0``, where ``E0`` is the statistic's mean in that second and
  ``q`` the 99.9 % quantile of chi²/dof, so that noise alone hardly ever breaks a stance;
- nobody did: midway, in logarithms, between the medians of what lies below and what lies above the threshold, the
  fixed point of Ridler and Calvard (1978). Long stillness is left out, or it would stand for the stance of walking; the
  result stays within a factor of two of the tolerance.
"""

import math
from dataclasses import dataclass

import numpy as np

from fes.estimation.numerics.filters import greatest_at_each, likeness, runs
from fes.estimation.zupt.detectors import (
    ACC_TOLERANCE_MPS2,
    RATE_TOLERANCE_RADPS,
    WINDOW_S,
    Detector,
    rate_energy,
    squared_lengths,
    statistic,
    window_samples,
    window_variances,
)
from fes.signals import G_MPS2, BoolArray, FloatArray, IntArray, Vector3

START_S = 0.1  # of zero velocity, before a filter begins
STRIDE_BOUNDS_S = (0.5, 3.0)
SHORTEST_MOVE_S = 0.15
LEAST_REPETITION = 0.3  # of the rate, from one stride to the next, to speak of walking


def first_stance(zero_velocity: BoolArray, rate_hz: float) -> int:
    """Where the filter begins: zero velocity (N,) has lasted ``START_S`` for the first time, or else at the start.

    Never with the last sample: nothing would follow.
    """
    rests, count = runs(zero_velocity[:-1]), round(START_S * rate_hz) + 1
    long = rests[np.diff(rests)[:, 0] >= count, 0]
    return int(long[0]) + count - 1 if len(long) else 0


def stride_time_s(gyr_radps: FloatArray, rate_hz: float) -> float:
    """Typical time of one stride (s): the first strong peak of the rate's autocorrelation; 0 where nothing repeats."""
    step = max(round(rate_hz / 50.0), 1)  # 50 Hz are plenty
    count = len(gyr_radps) // step
    shortest, longest = (round(s * rate_hz / step) for s in STRIDE_BOUNDS_S)
    if shortest < 1 or count < 2 * longest:
        return 0.0
    lengths = np.sqrt(squared_lengths(gyr_radps))[: count * step]
    size = np.mean([lengths[i::step] for i in range(step)], axis=0)
    size -= size[0]  # so that of lengths that are all the same nothing is left, not even rounding
    size -= size.mean()
    whole = float((size * size).sum())
    if whole == 0.0:
        return 0.0
    lags, alike = np.arange(shortest - 1, longest + 2), np.empty(longest + 3 - shortest)
    likeness(size, shortest - 1, alike)
    alike /= whole * (1.0 - lags / count)
    inner = alike[1:-1]
    top = (inner >= alike[:-2]) & (inner >= alike[2:])
    greatest = inner[top].max(initial=0.0)
    if greatest < LEAST_REPETITION:
        return 0.0
    return float(lags[1:-1][top & (inner >= 0.8 * greatest)][0] * step / rate_hz)


def with_missed_stances(
    zero_velocity: BoolArray, gyr_radps: FloatArray, rate_hz: float, energy: FloatArray
) -> BoolArray:
    """Add the quietest instant of a movement too long to be one swing: a fast foot stands less than any threshold says.

    ``zero_velocity`` (N,), ``gyr_radps`` (N, 3), ``energy`` (N,) its mean square over 0.05 s. What lasts longer than a
    stride holds a stance that the detector missed; it is sought where the energy is least, away from the ends, and
    counts as 0.02 s of zero velocity. How much that is worth the measurement's noise says, which grows with the rate.
    """
    out = zero_velocity.copy()
    longest = 1.1 * stride_time_s(gyr_radps, rate_hz) * rate_hz
    half, margin = max(round(0.01 * rate_hz), 1), round(0.32 * longest)
    movements = runs(~zero_velocity).tolist() if longest else []
    while movements:
        begin, end = movements.pop()
        if end - begin > longest:
            quiet = begin + margin + int(np.argmin(energy[begin + margin : end - margin]))
            out[quiet - half : quiet + half + 1] = True
            movements += [(begin, quiet - half), (quiet + half + 1, end)]  # either half may be too long still
    return out


def stance_instants(zero_velocity: BoolArray, energy: FloatArray, rate_hz: float) -> IntArray:
    """Sample numbers (M,) of the quietest instant of every stance, for strides between them.

    ``zero_velocity`` (N,), ``energy`` (N,) of the rate over 0.05 s, which is least at that instant. Stances less than
    ``SHORTEST_MOVE_S`` apart count as one.
    """
    begins, ends = runs(zero_velocity).T
    apart = begins[1:] - ends[:-1] >= SHORTEST_MOVE_S * rate_hz
    first, last = np.append(True, apart)[: len(begins)], np.append(apart, True)[: len(ends)]
    return greatest_at_each(-energy, begins[first], ends[last])


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
        standing: a second of standing was found.
    """

    detector: Detector
    threshold: float
    gravity_mps2: float
    gyr_bias_radps: Vector3
    standing: bool


def find_zero_velocity(
    acc: FloatArray, gyr: FloatArray, rate_hz: float, detector: Detector = Detector.SHOE, *, use_standing: bool = True,
    causal: bool = False,
) -> tuple[ZeroVelocityThresholds, BoolArray, FloatArray]:  # fmt: skip
    """Thresholds of a recording, (N, 3) each and finite; zero velocity (N,) by them, and :func:`rate_energy` (N,).

    The threshold is found by the standing second, or by the quiet stretches, as always where ``use_standing`` is False.
    ``causal``: zero velocity is told by windows that end at each sample; the thresholds stay those of centred ones.

    Raises:
        ValueError: as :func:`statistic`, or less than two seconds.
    """
    n = round(STANDING_S * rate_hz)
    if len(acc) < 2 * n:
        raise ValueError(f"{len(acc) / rate_hz:.1f} s is too short to tell rest from movement: record at least 2 s")
    begin, standing = _stillest(acc, gyr, n)
    standing, tolerance = standing and use_standing, _TOLERANCE[detector]
    energy = rate_energy(gyr, rate_hz)
    if standing:
        gravity = float(np.linalg.norm(acc[begin : begin + n].mean(axis=0)))
        x, y, z = gyr[begin : begin + n].mean(axis=0).tolist()
        bias = x, y, z
    else:
        quiet = acc[energy <= np.percentile(energy, 15.0)]
        gravity, bias = float(np.median(np.sqrt(squared_lengths(quiet)))), (0.0, 0.0, 0.0)
    values = statistic(detector, acc, gyr, rate_hz, gravity_mps2=gravity, gyr_bias_radps=bias)
    if standing:
        samples = 1 if detector is Detector.GYR else window_samples(WINDOW_S, rate_hz)
        noise = float(values[begin : begin + n].mean())
        threshold = tolerance + noise * chi2_quantile(_DEGREES_PER_SAMPLE[detector] * samples)
    else:
        bound = SPLIT_FACTOR**2
        threshold = min(max(split_threshold(values, tolerance, rate_hz), tolerance / bound), tolerance * bound)
    if causal:
        values = statistic(detector, acc, gyr, rate_hz, causal=True, gravity_mps2=gravity, gyr_bias_radps=bias)
    thresholds = ZeroVelocityThresholds(detector, threshold, gravity, bias, standing)
    return thresholds, np.asarray(values < threshold), energy


def _stillest(acc: FloatArray, gyr: FloatArray, n: int) -> tuple[int, bool]:
    """First sample of the stillest second, and whether it is standing."""
    step = max(n // 8, 1)
    turning, shaking = (np.sqrt(window_variances(np.ascontiguousarray(x), n, step).sum(axis=1)) for x in (gyr, acc))
    at = int(np.argmin(turning / STANDING_RATE_RADPS + shaking / STANDING_ACC_MPS2))
    begin = step * at
    if turning[at] >= STANDING_RATE_RADPS or shaking[at] >= STANDING_ACC_MPS2:
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
    stills = runs(values < start)
    long = stills[np.diff(stills)[:, 0] >= LONG_STILL_S * rate_hz]
    parts, after = list[FloatArray](), 0
    for begin, end in long.tolist():
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
