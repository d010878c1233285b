"""Paths of markers against estimated strides: Negård et al. (2005), Eq. (22), between the stride's own two ends.

Length is the horizontal distance of the marker between the instants at which the estimate begins and ends the stride:
both then speak of the same stride. A stride counts only where the marker was seen all along, stood still at both ends,
and really went somewhere; where the marker is not at the sensor, only if the foot did not turn.
"""

import math
from typing import Final

import numpy as np

from fes.evaluation.reference.alignment import horizontal_speed
from fes.evaluation.reference.compare import EDGE_S, Comparison, Count, Estimate, Pair, swing_s
from fes.evaluation.reference.table import MarkerPath
from fes.signals import NS_PER_S, FloatArray, StrideResult

AROUND_S: Final = 0.025  # a marker's place is the median over this much before and after
STANDING_MPS: Final = 0.2  # a foot that is faster at a stride's end does not stand
SHORTEST_M: Final = 0.1
STRAIGHT_RAD: Final = math.radians(20.0)
JUMP_MPS: Final = 8.0  # no foot is that fast: the reference jumps
SWING_MPS: Final = 0.3
SWING_SHARE: Final = 0.35  # of the fastest swings: a belt that stands moves a marker in the belt's frame, but slower
SWING_S: Final = 0.15
HOLE_S: Final = 0.1
FEW_HZ: Final = 60.0  # below: the greatest height lies between samples


def compare_path(path: MarkerPath, estimate: Estimate) -> Comparison:
    """Pairs of stride length and clearance, and how many of the marker's swings were found.

    ``path`` is on the recording's clock, in the frame of the ground (or belt).
    """
    ours = estimate.strides_of(path.foot)
    if not ours or len(path.t_s) < 3:
        return Comparison((), ())
    speed = horizontal_speed(path)
    pairs: list[Pair] = []
    left_out = 0
    for stride in ours:
        found = _values(path, stride, speed) if stride.valid else {}
        if estimate.level:
            found.pop("height_gained_m", None)
        inside = path.t_s[0] <= 1e-9 * stride.t_start_ns and 1e-9 * stride.t_end_ns <= path.t_s[-1]
        left_out += inside and not found
        at = 0.5e-9 * (stride.t_start_ns + stride.t_end_ns)
        for name, value in found.items():
            estimated = float(getattr(stride, name))
            if np.isfinite(value) and np.isfinite(estimated):
                pairs.append(Pair(name, path.foot, at, value, estimated))
    swings = marker_swings(path, speed)
    expected = [t for t in swings if estimate.begin_s + EDGE_S < t < estimate.end_s - EDGE_S]
    bounds = [(1e-9 * s.t_start_ns, 1e-9 * s.t_end_ns) for s in ours]
    missed = sum(not any(begin < t < end for begin, end in bounds) for t in expected)
    near = [swing_s(s) for s in ours if s.valid]
    extra = sum(
        path.t_s[0] + EDGE_S < t < path.t_s[-1] - EDGE_S and not any(abs(t - other) < 0.5 for other in swings)
        for t in near
    )
    name = f"swing ({path.point})"
    count = Count(name, path.foot, len(expected), len(expected) - missed + extra, missed, extra, left_out)
    return Comparison(tuple(pairs), (count,))


def marker_swings(path: MarkerPath, speed: FloatArray) -> FloatArray:
    """The middle (s) of every time that the marker moved on for longer than ``SWING_S``."""
    known = speed[np.isfinite(speed)]
    least = max(SWING_MPS, SWING_SHARE * float(np.percentile(known, 99.0))) if len(known) else SWING_MPS
    moving = np.nan_to_num(speed, nan=0.0) > least
    edges = np.flatnonzero(np.diff(np.concatenate([[0], moving.astype(np.int8), [0]])))
    spans = [(float(path.t_s[a]), float(path.t_s[b - 1])) for a, b in zip(edges[::2], edges[1::2], strict=True)]
    joined: list[tuple[float, float]] = []
    for begin, end in spans:
        if joined and begin - joined[-1][1] < HOLE_S:
            joined[-1] = (joined[-1][0], end)
        else:
            joined.append((begin, end))
    return np.array([0.5 * (begin + end) for begin, end in joined if end - begin > SWING_S])


def _values(path: MarkerPath, stride: StrideResult, speed: FloatArray) -> dict[str, float]:
    """What the marker says of a stride; empty where it says nothing that can be used."""
    begin_s, end_s = stride.t_start_ns / NS_PER_S, stride.t_end_ns / NS_PER_S
    first, last = (int(np.argmin(np.abs(path.t_s - t))) for t in (begin_s, end_s))
    interval = 1.0 / path.rate_hz
    if max(abs(path.t_s[first] - begin_s), abs(path.t_s[last] - end_s)) > interval or last - first < 3:
        return {}
    rows, times = path.position_m[first : last + 1], path.t_s[first : last + 1]
    if not np.isfinite(rows).all() or np.diff(times).max() > HOLE_S:
        return {}
    if not (speed[first] < STANDING_MPS and speed[last] < STANDING_MPS):
        return {}
    if np.linalg.norm(np.diff(rows, axis=0), axis=1).max() > JUMP_MPS * interval:
        return {}
    start, end = _place(path, begin_s), _place(path, end_s)
    length = float(np.hypot(*(end - start)[:2]))
    if length < SHORTEST_M or (path.point != "sensor" and abs(stride.turn_rad) > STRAIGHT_RAD):
        return {}
    height = rows[:, 2] - start[2]
    found = {"stride_length_m": length, "height_gained_m": float(end[2] - start[2])}
    if path.point == "toe":
        lowest = _toe_clearance(stride, times, rows, height)
        return found if lowest is None else {**found, "toe_clearance_m": lowest}
    greatest = float(height.max())
    if len(times) >= 4 and (len(times) - 1) / (times[-1] - times[0]) <= FEW_HZ:  # it lies between the samples
        from scipy.interpolate import CubicSpline

        greatest = float(CubicSpline(times, height)(np.linspace(times[0], times[-1], 20 * len(times))).max())
    return {**found, "clearance_m" if path.point == "sensor" else "heel_clearance_m": greatest}


def _place(path: MarkerPath, at_s: float) -> FloatArray:
    """Where the marker stood (3,): median around a moment, of at least three samples."""
    reach = max(AROUND_S, 1.2 / path.rate_hz)
    low, high = np.searchsorted(path.t_s, (at_s - reach, at_s + reach))
    return np.asarray(np.nanmedian(path.position_m[int(low) : max(int(high), int(low) + 1)], axis=0))


def _toe_clearance(stride: StrideResult, times: FloatArray, rows: FloatArray, height: FloatArray) -> float | None:
    """Least height in mid-swing, by the definition of the estimate; None where the stride has no known swing."""
    from fes.estimation.clearance.clearance import mid_swing

    if stride.t_swing_ns is None or stride.t_loading_response_ns is None:
        return None
    low, high = np.searchsorted(times, (stride.t_swing_ns / NS_PER_S, stride.t_loading_response_ns / NS_PER_S))
    swing = slice(int(low), int(high) + 1)
    if len(times[swing]) < 5:
        return None
    t_ns = np.round(times[swing] * NS_PER_S).astype(np.int64)
    lowest, _ = mid_swing(t_ns, height[swing], rows[swing, :2])
    return float(height[swing][lowest])
