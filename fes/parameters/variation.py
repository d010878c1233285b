"""How much neighbouring strides differ: position and orientation variation after dynamic time warping.

Source: Wang et al. (2013), section 4.2: two neighbouring strides of the same side are stretched onto each other by
dynamic time warping of their way along the walk, normalised to 0 … 1 (Sakoe & Chiba 1978 for the warping), and PV and
OV are the root mean square distances of position and orientation along the common, stretched time. Orientation is a
rotation vector here, so that the result depends on no order of angles.
"""

from __future__ import annotations

import numpy as np

from fes.estimation.compiled import jit
from fes.parameters.motion import Motion
from fes.signals import FloatArray, IntArray

POINTS = 101


def variation(one: Motion, other: Motion) -> tuple[float, float]:
    """PV (m) and OV (rad) of two neighbouring strides of one side."""
    ways = [_resampled(stride.t_ns, stride.own_frame_m()) for stride in (one, other)]
    turns = [_resampled(stride.t_ns, stride.orientation_rad()) for stride in (one, other)]
    i, j = warped(_unit(ways[0][:, 0]), _unit(ways[1][:, 0]))
    position, orientation = (float(np.sqrt(np.mean(np.sum((b[j] - a[i]) ** 2, axis=1)))) for a, b in (ways, turns))
    return position, orientation


def _resampled(t_ns: IntArray, values: FloatArray) -> FloatArray:
    """The same (POINTS, 3) at equal steps of time."""
    t = (t_ns - t_ns[0]).astype(np.float64)
    at = np.linspace(0.0, t[-1], POINTS)
    return np.column_stack([np.interp(at, t, column) for column in values.T])


def _unit(values: FloatArray) -> FloatArray:
    low, high = float(values.min()), float(values.max())
    return np.asarray((values - low) / max(high - low, 1e-9))


def warped(one: FloatArray, other: FloatArray) -> tuple[IntArray, IntArray]:
    """Which sample of each goes with which of the other, (L,) and (L,), from first to last.

    Args:
        one: (N,) a waveform.
        other: (M,) another.
    """
    way = _warp(np.ascontiguousarray(one, np.float64), np.ascontiguousarray(other, np.float64))
    return way[:, 0], way[:, 1]


@jit
def _warp(one: FloatArray, other: FloatArray) -> IntArray:
    n, m = len(one), len(other)
    cost = np.empty((n, m))
    for i in range(n):
        for j in range(m):
            here = abs(one[i] - other[j])
            if i == 0 and j == 0:
                cost[i, j] = here
            elif i == 0:
                cost[i, j] = here + cost[i, j - 1]
            elif j == 0:
                cost[i, j] = here + cost[i - 1, j]
            else:
                cost[i, j] = here + min(cost[i - 1, j - 1], cost[i - 1, j], cost[i, j - 1])
    way = np.empty((n + m, 2), np.int64)
    i, j, k = n - 1, m - 1, n + m - 1
    while True:
        way[k, 0], way[k, 1] = i, j
        if i == 0 and j == 0:
            break
        k -= 1
        if i == 0:
            j -= 1
        elif j == 0:
            i -= 1
        elif cost[i - 1, j - 1] <= cost[i - 1, j] and cost[i - 1, j - 1] <= cost[i, j - 1]:
            i, j = i - 1, j - 1
        elif cost[i - 1, j] <= cost[i, j - 1]:
            i -= 1
        else:
            j -= 1
    return way[k:]
