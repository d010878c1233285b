"""Stances in a recording: their quietest instants, and those that a detector missed."""

from __future__ import annotations

from typing import Any

import numpy as np

from fes.estimation.numerics.filters import likeness_of_lengths
from fes.estimation.numerics.jit import jit, jit_fused
from fes.estimation.numerics.records import Vec
from fes.signals import FloatArray, IntArray

BoolArray = np.ndarray[Any, np.dtype[np.bool_]]
START_S = 0.1  # of zero velocity, before a filter begins
STRIDE_BOUNDS_S = (0.5, 3.0)
SHORTEST_MOVE_S = 0.15
LEAST_REPETITION = 0.3  # of the rate, from one stride to the next, to speak of walking


def first_stance(zero_velocity: BoolArray, rate_hz: float) -> int:
    """Where the filter begins: zero velocity (N,) has lasted ``START_S`` for the first time, or else at the start.

    Never with the last sample: nothing would follow.
    """
    return int(first_lasting(zero_velocity[:-1], round(START_S * rate_hz) + 1))


def stride_time_s(gyr_radps: FloatArray, rate_hz: float) -> float:
    """Typical time of one stride (s): the first strong peak of the rate's autocorrelation; 0 where nothing repeats."""
    step = max(round(rate_hz / 50.0), 1)  # 50 Hz are plenty
    count = len(gyr_radps) // step
    shortest, longest = (round(s * rate_hz / step) for s in STRIDE_BOUNDS_S)
    if shortest < 1 or count < 2 * longest:
        return 0.0
    lags, alike = np.arange(shortest - 1, longest + 2), np.empty(longest + 3 - shortest)
    whole = likeness_of_lengths(np.ascontiguousarray(gyr_radps), step, shortest - 1, alike)
    if whole == 0.0:
        return 0.0
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
    if longest == 0.0:
        return out
    half, margin = max(round(0.01 * rate_hz), 1), round(0.32 * longest)
    mark_missed_stances(out, energy, longest, half, margin)
    return out


def stance_instants(zero_velocity: BoolArray, energy: FloatArray, rate_hz: float) -> IntArray:
    """Sample numbers (M,) of the quietest instant of every stance, for strides between them.

    ``zero_velocity`` (N,), ``energy`` (N,) of the rate over 0.05 s, which is least at that instant. Stances less than
    ``SHORTEST_MOVE_S`` apart count as one.
    """
    out = np.empty(len(zero_velocity) // 2 + 1, np.int64)
    return out[: quietest_instants(zero_velocity, energy, SHORTEST_MOVE_S * rate_hz, out)].copy()


@jit
def _argmin(x: Vec, begin: int, end: int) -> int:
    """The first least of ``x[begin:end]``."""
    at, least = begin, x[begin]
    for i in range(begin + 1, end):
        if x[i] < least:
            at, least = i, x[i]
    return at


@jit
def first_lasting(zero_velocity: Vec, count: int) -> int:
    """The first sample with which ``zero_velocity`` (N,) has lasted for ``count`` samples, 0 if there is none."""
    lasted = 0
    for i in range(zero_velocity.shape[0]):
        lasted = lasted + 1 if zero_velocity[i] else 0
        if lasted == count:
            return i
    return 0


@jit
def quietest_instants(zero_velocity: Vec, energy: Vec, apart: float, out: Vec) -> int:
    """Fill ``out`` with where the ``energy`` (N,) is least in each stance; any closer than ``apart`` samples are one.

    How many there are: at most half of the samples and one.
    """
    count, begin, end = 0, -1, -1
    for i in range(zero_velocity.shape[0]):
        if not zero_velocity[i]:
            continue
        if begin < 0:
            begin = i
        elif i > end and i - end >= apart:
            out[count] = _argmin(energy, begin, end)
            count, begin = count + 1, i
        end = i + 1
    if begin >= 0:
        out[count] = _argmin(energy, begin, end)
        count += 1
    return count


@jit
def mark_missed_stances(zero_velocity: Vec, energy: Vec, longest: float, half: int, margin: int) -> None:
    """Mark ``half`` samples around the least ``energy`` of every movement of more than ``longest`` as zero velocity.

    Then the same of its two halves. It is sought ``margin`` samples away from a movement's ends, more than ``half``.
    """
    n, begin, end = zero_velocity.shape[0], 0, 0
    while end <= n:
        if end < n and not zero_velocity[end]:
            end += 1
        elif end - begin > longest:
            quiet = _argmin(energy, begin + margin, end - margin)
            for i in range(quiet - half, min(quiet + half + 1, n)):
                zero_velocity[i] = True
            end = quiet - half  # its first half may be too long still
        else:
            begin, end = end + 1, end + 1


@jit_fused
def mean_in_stance(x: Vec, zero_velocity: Vec, out: Vec) -> bool:
    """Fill ``out`` (3,) with the mean of ``x`` (N, 3) at ``zero_velocity`` (N,); False, and 0, if there is none."""
    count, a, b, c = 0, 0.0, 0.0, 0.0
    for i in range(zero_velocity.shape[0]):
        if zero_velocity[i]:
            count += 1
            a, b, c = a + x[i, 0], b + x[i, 1], c + x[i, 2]
    per = 1.0 / max(count, 1)
    out[0], out[1], out[2] = a * per, b * per, c * per
    return count > 0
