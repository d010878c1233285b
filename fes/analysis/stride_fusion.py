"""Stride lengths from two solutions of the same recording, for analysis after the fact.

A stride solved by itself (``fes.estimation.strides.maximum_likelihood``) asks what its own two ends say, and forgets
all that was before. The smoothed ZUPT filter (``fes.estimation.zupt.filter``) knows the whole recording: its biases and
tilt are those that suit all strides, but one end that is worse than it looks spoils neighbours too. They use the same
samples, yet err for different reasons (their errors correlate by 0.5 to 0.7), so their mean errs less than either.
Equal weights: a weight found from recordings would be a constant more, and errs itself (Clemen 1989, "Combining
forecasts: a review and annotated bibliography").

Where the two are far apart one of them is wrong, and no mean helps: then the stride's own solution stays.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fes.estimation.strides.integration import SOLVED
from fes.estimation.strides.results import Rows
from fes.estimation.zupt.foot_trajectory import FootSamples, foot_samples
from fes.estimation.zupt.settings import ZuptSettings
from fes.signals import NS_PER_S, FloatArray, IntArray, StrideResult

# A path that is to close its loops trusts its rests less. The creep is chosen for the mean: 2 mm/s there and 8 mm/s
# here make the 5 mm/s by which an instep creeps.
SETTINGS = ZuptSettings(drift_speed_mps=0.008, rest_speed_mps=0.005, rest_correlation_s=0.05)
LONGEST_S = 20.0
FAR_APART = 0.1  # share of the length
FAR_APART_M = 0.05


def path_lengths(
    begin_ns: IntArray,
    end_ns: IntArray,
    t_ns: IntArray,
    acc_mps2: FloatArray,
    gyr_radps: FloatArray,
    acc_range_mps2: float | None = None,
    gyr_range_radps: float | None = None,
) -> FloatArray:
    """Horizontal distances (M,) in m by the smoothed filter; NaN for what lies outside, or where it cannot run.

    Args:
        begin_ns: (M,) where each stride begins.
        end_ns: (M,) where it ends.
        t_ns: (N,) time stamps of the whole recording; samples not newer than all before them are left out, and those
            that are not finite or larger than any sensor's.
        acc_mps2: (N, 3) specific force.
        gyr_radps: (N, 3) angular rate.
        acc_range_mps2: the accelerometer's full scale; found from flat tops if not given.
        gyr_range_radps: the same of the gyroscope.
    """
    try:
        foot = foot_samples(t_ns, acc_mps2, gyr_radps, acc_range_mps2, gyr_range_radps)
    except ValueError:  # too short to tell rest from movement, or no rest
        return np.full(len(begin_ns), math.nan)
    return lengths_along(foot, begin_ns, end_ns)


def lengths_along(foot: FootSamples, begin_ns: IntArray, end_ns: IntArray) -> FloatArray:
    """As :func:`path_lengths`, of samples already prepared."""
    begin, end = np.asarray(begin_ns, dtype=np.int64), np.asarray(end_ns, dtype=np.int64)
    lengths = np.full(len(begin), math.nan)
    inside = (begin >= foot.t_ns[0]) & (end <= foot.t_ns[-1]) & (begin < end) & (end - begin < LONGEST_S * NS_PER_S)
    if inside.any():
        path = foot.trajectory(SETTINGS, level=False)
        x, y, _ = (path.positions_at(end[inside]) - path.positions_at(begin[inside])).T
        lengths[inside] = np.hypot(x, y)
    return lengths


def fused(
    strides: Sequence[StrideResult],
    t_ns: IntArray,
    acc_mps2: FloatArray,
    gyr_radps: FloatArray,
    acc_range_mps2: float | None = None,
    gyr_range_radps: float | None = None,
) -> list[StrideResult]:
    """The same strides of one foot, with length, speed and the trajectory ahead from both solutions.

    Everything else is the stride's own, as are strides that are not valid, and those whose two lengths are farther
    apart than a tenth and 5 cm. Arguments as for :func:`path_lengths`.
    """
    begin = np.array([stride.t_start_ns for stride in strides], np.int64)
    end = np.array([stride.t_end_ns for stride in strides], np.int64)
    path_m = path_lengths(begin, end, t_ns, acc_mps2, gyr_radps, acc_range_mps2, gyr_range_radps)
    own_m = np.array([stride.stride_length_m if stride.valid else math.nan for stride in strides])
    lengths = _means(own_m, path_m).tolist()
    return [_with_length(stride, m) for stride, m in zip(strides, lengths, strict=True)]


def fuse(rows: Rows, foot: FootSamples) -> FloatArray:
    """As :func:`fused`, in place, of strides (K,) as the compiled core leaves them; see
    ``fes.estimation.strides.results``.

    Returns by how much each is longer than by itself (K,), for its trajectory ahead.
    """
    own_m = np.where(rows["outcome"] == SOLVED, rows["stride_length_m"], math.nan)
    lengths = _means(own_m, lengths_along(foot, rows["t_start_ns"], rows["t_end_ns"]))
    longer, k = np.ones(len(rows)), np.flatnonzero(lengths == lengths)
    own_m, lengths = own_m[k], lengths[k]
    longer[k] = lengths / own_m
    rows["speed_mps"][k] = rows["speed_mps"][k] * lengths / own_m
    rows["stride_length_m"][k] = lengths
    return longer


def _means(own_m: FloatArray, path_m: FloatArray) -> FloatArray:
    """Mean of the two lengths (K,); NaN where one is not known, or they are too far apart: the stride's own stays."""
    with np.errstate(invalid="ignore"):  # a comparison with NaN is false
        near = (own_m > 0.0) & (np.abs(path_m - own_m) <= np.maximum(FAR_APART * own_m, FAR_APART_M))
    return np.where(near, 0.5 * (own_m + path_m), math.nan)


def _with_length(stride: StrideResult, length_m: float) -> StrideResult:
    if math.isnan(length_m):
        return stride
    own_m = stride.stride_length_m
    return replace(
        stride,
        stride_length_m=length_m,
        speed_mps=stride.speed_mps * length_m / own_m,
        trajectory_m=stride.trajectory_m * np.array([length_m / own_m, 1.0, 1.0]),
    )
