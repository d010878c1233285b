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

from fes.estimation.rest import at_rest, calibrate_rest
from fes.estimation.tracker import LARGEST_VALUE
from fes.estimation.zupt import with_quietest, zupt_path
from fes.estimation.zupt_kernel import ZuptSettings
from fes.signals import NS_PER_S, FloatArray, IntArray, StrideResult

STRETCH_S = 60.0  # filtered at a time, so that memory does not grow with the recording …
MARGIN_S = 20.0  # … with this much more on either side, in which the filter settles
# A path that is to close its loops trusts its rests less. The creep is chosen for the mean: 2 mm/s there and 8 mm/s
# here make the 5 mm/s by which an instep creeps.
SETTINGS = ZuptSettings(creep_mps=0.008, rest_speed_mps=0.005, rest_correlation_s=0.05)
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
    begin, end = np.asarray(begin_ns, dtype=np.int64), np.asarray(end_ns, dtype=np.int64)
    lengths = np.full(len(begin), math.nan)
    usable = (np.abs(acc_mps2) < LARGEST_VALUE).all(axis=1) & (np.abs(gyr_radps) < LARGEST_VALUE).all(axis=1)
    t_ns, acc_mps2, gyr_radps = t_ns[usable], acc_mps2[usable], gyr_radps[usable]
    newer = np.ones(len(t_ns), dtype=np.bool_)
    newer[1:] = t_ns[1:] > np.maximum.accumulate(t_ns)[:-1]
    t_ns, acc_mps2, gyr_radps = t_ns[newer], acc_mps2[newer], gyr_radps[newer]
    if not len(begin) or len(t_ns) < 3:
        return lengths
    rate_hz = 1e9 / float(np.median(np.diff(t_ns)))
    try:
        calibration = calibrate_rest(acc_mps2, gyr_radps, rate_hz)
    except ValueError:  # too short to tell rest from movement
        return lengths
    rest = with_quietest(at_rest(calibration, acc_mps2, gyr_radps, rate_hz), gyr_radps, rate_hz)
    stretch, margin = int(STRETCH_S * NS_PER_S), int(MARGIN_S * NS_PER_S)
    inside = (begin >= t_ns[0]) & (end <= t_ns[-1]) & (begin < end) & (end - begin < margin)
    for k in np.unique((begin[inside] - t_ns[0]) // stretch).tolist():
        ours = inside & ((begin - t_ns[0]) // stretch == k)
        first, last = t_ns[0] + k * stretch - margin, t_ns[0] + (k + 1) * stretch + margin
        span = slice(*(int(at) for at in np.searchsorted(t_ns, (first, last))))
        if not rest[span].any() or span.stop - span.start < 3:
            continue
        path = zupt_path(
            t_ns[span],
            acc_mps2[span],
            gyr_radps[span],
            calibration=calibration,
            rest=rest[span],
            acc_range_mps2=acc_range_mps2,
            gyr_range_radps=gyr_range_radps,
            settings=SETTINGS,
        )
        lengths[ours] = path.stride_lengths(begin[ours], end[ours])
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
    begin, end = (np.array([getattr(s, name) for s in strides], dtype=np.int64) for name in ("t_start_ns", "t_end_ns"))
    lengths = path_lengths(begin, end, t_ns, acc_mps2, gyr_radps, acc_range_mps2, gyr_range_radps)
    return [_mean(stride, length) for stride, length in zip(strides, lengths.tolist(), strict=True)]


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
