"""Stride lengths from two solutions of the same recording, for analysis after the fact.

A stride solved by itself (``fes.estimation.strides.maximum_likelihood``) forgets all that was before. The smoothed ZUPT
filter (``fes.estimation.zupt.filter``) knows the whole recording: its biases and tilt are those that suit all strides,
but one end that is worse than it looks spoils neighbours too. They use the same samples, yet err for different reasons
(their errors correlate by 0.5 to 0.7), so their mean errs less than either.
Equal weights: a weight found from recordings would be a constant more, and errs itself (Clemen 1989, "Combining
forecasts: a review and annotated bibliography").

Where the two are far apart one of them is wrong, and no mean helps: then the stride's own solution stays.
"""

import math

import numpy as np

from fes.estimation.strides.integration import SOLVED
from fes.estimation.strides.results import Rows
from fes.estimation.zupt.decimation import ZuptSettings
from fes.estimation.zupt.foot_trajectory import FootSamples
from fes.signals import NS_PER_S, FloatArray, IntArray

# A path that is to close its loops trusts its rests less. The creep is chosen for the mean: 2 mm/s there and 8 mm/s
# here make the 5 mm/s by which an instep creeps.
SETTINGS = ZuptSettings(drift_speed_mps=0.008, rest_speed_mps=0.005, rest_correlation_s=0.05)
LONGEST_S = 20.0
FAR_APART = 0.1  # share of the length
FAR_APART_M = 0.05


def lengths_along(foot: FootSamples, begin_ns: IntArray, end_ns: IntArray) -> FloatArray:
    """Horizontal distances (M,) in m from (M,) to (M,) by the smoothed filter; NaN for what lies outside."""
    begin, end = np.asarray(begin_ns, dtype=np.int64), np.asarray(end_ns, dtype=np.int64)
    lengths = np.full(len(begin), math.nan)
    inside = (begin >= foot.t_ns[0]) & (end <= foot.t_ns[-1]) & (begin < end) & (end - begin < LONGEST_S * NS_PER_S)
    if inside.any():
        path = foot.trajectory(SETTINGS, level=False)
        x, y, _ = (path.positions_at(end[inside]) - path.positions_at(begin[inside])).T
        lengths[inside] = np.hypot(x, y)
    return lengths


def fuse(rows: Rows, foot: FootSamples) -> FloatArray:
    """Give strides (K,) of one foot, as the compiled core leaves them, length and speed from both solutions, in place.

    Strides that are not valid stay, and those whose two lengths are farther apart than a tenth and 5 cm. Returns by how
    much each is longer than by itself (K,), for its trajectory ahead; see ``fes.estimation.strides.results``.
    """
    own_m = np.where(rows["outcome"] == SOLVED, rows["stride_length_m"], math.nan)
    lengths = mean_lengths(own_m, lengths_along(foot, rows["t_start_ns"], rows["t_end_ns"]))
    longer, k = np.ones(len(rows)), np.flatnonzero(lengths == lengths)
    own_m, lengths = own_m[k], lengths[k]
    longer[k] = lengths / own_m
    rows["speed_mps"][k] = rows["speed_mps"][k] * lengths / own_m
    rows["stride_length_m"][k] = lengths
    return longer


def mean_lengths(own_m: FloatArray, path_m: FloatArray) -> FloatArray:
    """Mean of the two lengths (K,); NaN where one is not known, or they are too far apart: the stride's own stays."""
    with np.errstate(invalid="ignore"):  # a comparison with NaN is false
        near = (own_m > 0.0) & (np.abs(path_m - own_m) <= np.maximum(FAR_APART * own_m, FAR_APART_M))
    return np.where(near, 0.5 * (own_m + path_m), math.nan)
