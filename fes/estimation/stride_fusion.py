"""Stride lengths from two solutions of the same recording, for analysis after the fact.

A stride solved by itself (``fes.estimation.likely``) asks what its own two ends say, and forgets all that was before.
The smoothed ZUPT filter (``fes.estimation.zupt``) knows the whole recording: its biases and tilt are those that suit
all strides, but one end that is worse than it looks spoils neighbours too. They use the same samples, yet err for
different reasons (their errors correlate by 0.5 to 0.7), so their mean errs less than either. Equal weights: a weight
found from recordings would be a constant more, and errs itself (Clemen 1989, "Combining forecasts: a review and
annotated bibliography").

Where the two are far apart one of them is wrong, and no mean helps: then the stride's own solution stays.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fes.estimation.foot_way import FootSamples, foot_samples
from fes.estimation.stride_solution import SOLVED
from fes.estimation.strides import Rows
from fes.estimation.zupt_kernel import ZuptSettings
from fes.signals import NS_PER_S, FloatArray, IntArray, StrideResult

# A path that is to close its loops trusts its rests less. The creep is chosen for the mean: 2 mm/s there and 8 mm/s
# here make the 5 mm/s by which an instep creeps.
SETTINGS = ZuptSettings(creep_mps=0.008, rest_speed_mps=0.005, rest_correlation_s=0.05)
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
        way = foot.way(SETTINGS, level=False)
        asked = np.concatenate((begin[inside], end[inside]))
        order = np.argsort(asked, kind="stable")
        places = np.empty((len(asked), 3))
        places[order] = way.at(asked[order])
        count = int(np.count_nonzero(inside))
        lengths[inside] = np.hypot(*(places[count:] - places[:count])[:, :2].T)
    return lengths


def fused(
    strides: Sequence[StrideResult],
    t_ns: IntArray,
    acc_mps2: FloatArray,
    gyr_radps: FloatArray,
    acc_range_mps2: float | None = None,
    gyr_range_radps: float | None = None,
) -> list[StrideResult]:
    """The same strides of one foot, with length, speed and the way ahead from both solutions.

    Everything else is the stride's own, as are strides that are not valid, and those whose two lengths are farther
    apart than a tenth and 5 cm. Arguments as for :func:`path_lengths`.
    """
    if not strides:
        return []
    lengths = path_lengths(*_ends(strides), t_ns, acc_mps2, gyr_radps, acc_range_mps2, gyr_range_radps)
    return [_mean(stride, length) for stride, length in zip(strides, lengths.tolist(), strict=True)]


def fuse(rows: Rows, shapes: FloatArray, foot: FootSamples) -> None:
    """As :func:`fused`, in place, of strides (K,) as the compiled core leaves them; see ``fes.estimation.strides``."""
    own_m, path_m = rows["length_m"], lengths_along(foot, rows["t_start_ns"], rows["t_end_ns"])
    with np.errstate(invalid="ignore"):  # where one of them is not known
        near = np.abs(path_m - own_m) <= np.maximum(FAR_APART * own_m, FAR_APART_M)
    k = np.flatnonzero(near & (rows["outcome"] == SOLVED) & (own_m > 0.0))
    own_m, length_m = own_m[k], 0.5 * (own_m[k] + path_m[k])
    rows["speed_mps"][k] = rows["speed_mps"][k] * length_m / own_m
    rows["length_m"][k] = length_m
    shapes[k, :, 0] *= (length_m / own_m)[:, None]


def _ends(strides: Sequence[StrideResult]) -> tuple[IntArray, IntArray]:
    """Where the strides begin and end (M,)."""
    return (
        np.array([stride.t_start_ns for stride in strides], dtype=np.int64),
        np.array([stride.t_end_ns for stride in strides], dtype=np.int64),
    )


def _mean(stride: StrideResult, path_m: float) -> StrideResult:
    own_m = stride.stride_length_m
    allowed_m = max(FAR_APART * own_m, FAR_APART_M)
    if not (stride.valid and abs(path_m - own_m) <= allowed_m):  # also where one of them is not known
        return stride
    length_m = 0.5 * (own_m + path_m)
    stretched = np.array([length_m / own_m, 1.0, 1.0]) if own_m > 0.0 else 1.0
    return replace(
        stride,
        stride_length_m=length_m,
        speed_mps=stride.speed_mps * length_m / own_m if own_m > 0.0 else stride.speed_mps,
        trajectory_m=stride.trajectory_m * stretched,
    )
