"""Two feet of one person go the same way: what their stride lengths differ by on the whole is error.

In strides of two and three seconds, as in severe hemiparesis, a stride length is some percent off, mostly by the same
amount in all strides of a foot (tilt and bias of its own sensor). Feet alternate, so their mean stride lengths are
the same, and are brought together. A bias or a tilt makes an error that grows with the square of the time for which
the foot moves: that gives the weights. On a curve the outer foot goes farther: nothing is done where the walk turns,
where the feet have different numbers of strides, or where they are too far apart for that to be drift. No paper; that
both sides' stride lengths agree is seen in Wang et al. (2013), Table 2.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fes.signals import NS_PER_S, StrideResult

LEAST_STRIDES = 6  # of either foot
STEADY_SHARE = 0.3  # of the median length
MOST_TURN_RAD = math.radians(3.0)  # per stride, on the whole
MOST_APART = 0.1  # of the length
MOST_EXTRA = 2  # strides of one foot more than of the other


@dataclass(frozen=True, slots=True)
class _Foot:
    length_m: float
    moving_s: float
    strides: int
    turn_rad: float


def common_way(feet: Mapping[str, Sequence[StrideResult]]) -> dict[str, list[StrideResult]]:
    """The same strides, lengths and speeds of each foot scaled so that both feet went equally far.

    With fewer than two feet, on a curve, or where the feet differ by more than a tenth, they are as they were.
    """
    same = {foot: list(strides) for foot, strides in feet.items()}
    if len(feet) != 2:
        return same
    measured = {foot: _measure(strides) for foot, strides in feet.items()}
    known = {foot: one for foot, one in measured.items() if one is not None}
    if len(known) != 2 or any(abs(one.turn_rad) > MOST_TURN_RAD for one in known.values()):
        return same
    weights = {foot: one.moving_s**-4 for foot, one in known.items()}
    common = sum(weights[foot] * one.length_m for foot, one in known.items()) / sum(weights.values())
    one, other = known.values()
    if abs(one.length_m - other.length_m) > MOST_APART * common or abs(one.strides - other.strides) > MOST_EXTRA:
        return same
    return {foot: [_scaled(s, common / known[foot].length_m) for s in strides] for foot, strides in feet.items()}


def _measure(strides: Sequence[StrideResult]) -> _Foot | None:
    lengths = np.array([stride.stride_length_m for stride in strides if stride.valid])
    turns = np.array([stride.turn_rad for stride in strides if stride.valid])
    usual = float(np.median(lengths)) if len(lengths) else 0.0
    steady = np.abs(lengths - usual) <= STEADY_SHARE * usual
    if np.count_nonzero(steady) < LEAST_STRIDES or usual <= 0.0:
        return None
    return _Foot(
        float(lengths[steady].mean()), _moving_s(strides), int(np.count_nonzero(steady)), float(turns[steady].mean())
    )


def _moving_s(strides: Sequence[StrideResult]) -> float:
    """How long the foot moves in a stride (s, median), from heel rise to stance; else the stride's whole time."""
    times = [
        (
            s.t_end_ns - s.t_start_ns
            if s.t_pre_swing_ns is None or s.t_stance_ns is None
            else s.t_stance_ns - s.t_pre_swing_ns
        )
        for s in strides
        if s.valid
    ]
    return max(float(np.median(times)) / NS_PER_S, 0.1)


def _scaled(stride: StrideResult, factor: float) -> StrideResult:
    if not stride.valid:
        return stride
    stretch = np.array([factor, 1.0, 1.0])
    return replace(
        stride,
        stride_length_m=factor * stride.stride_length_m,
        speed_mps=factor * stride.speed_mps,
        trajectory_m=stride.trajectory_m * stretch if len(stride.trajectory_m) else stride.trajectory_m,
    )
