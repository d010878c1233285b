"""What a stride's path shows besides its ends: how far the foot swings out, how far its heel turns up, how it varies.

After Wang et al. (2013), section 4.2, in the stride's own frame: origin and orientation of its first sample, which is a
mid-stance; x along the stride, y to the left, z up. Their MLR is written as rotation about the vertical; the heel's
lift is a rotation about the mediolateral axis, and that is what is taken here. Two neighbouring strides of one side are
stretched onto each other by dynamic time warping of their path along the walk, normalised to 0 … 1 (Sakoe & Chiba
1978), and PV and OV are the root mean square distances of position and orientation along the common, stretched time.
Orientation is a rotation vector here, so that the result depends on no order of angles.
"""

import math
from typing import Final

import numpy as np

from fes.estimation.clearance.clearance import FootPaths
from fes.estimation.numerics.jit import jit_ieee
from fes.estimation.numerics.records import Mat, Vec
from fes.estimation.numerics.rotation import to_world
from fes.estimation.strides.boundaries import UNSEEN_NS
from fes.signals import FloatArray, IntArray

POINTS: Final = 101
MOTION_KEYS: Final = (
    *("deviation_m", "circumduction_m", "heel_rotation_rad", "angle_off_rad", "angle_contact_rad"),
    *("position_variation_m", "orientation_variation_rad"),
)
GOES_NOWHERE_M = 0.05  # a shorter stride has no direction of its own: its toe's is taken


def pitches(paths: FootPaths) -> FloatArray:
    """Rotation (R,) about the axis across the foot since its stride's start at every sample, toe up positive; beyond a
    right angle too."""
    out = np.zeros(len(paths.t_ns))
    _pitches(paths.quaternion, paths.spans, paths.foot[:, 0].copy(), paths.foot[:, 2].copy(), out)
    return out


@jit_ieee
def _pitches(quaternion: Mat, spans: Mat, forward: Vec, up: Vec, out: Vec) -> None:
    for k in range(spans.shape[0]):
        turns = first = before = 0.0
        for i in range(spans[k, 0], spans[k, 1]):
            w, a, b, c = quaternion[i, 0], quaternion[i, 1], quaternion[i, 2], quaternion[i, 3]
            x, y, z = to_world(w, a, b, c, forward[0], forward[1], forward[2])
            level = math.sqrt(x * x + y * y)
            # a foot whose up axis points down has passed the vertical
            angle = math.atan2(z, -level if to_world(w, a, b, c, up[0], up[1], up[2])[2] < 0.0 else level)
            if i == spans[k, 0]:
                first = before = angle
            turns += np.rint((before - angle) / (2.0 * math.pi))
            before = angle
            out[i] = angle + 2.0 * math.pi * turns - first


def motions(paths: FootPaths, pitch_rad: FloatArray, off_ns: IntArray, contact_ns: IntArray, side: str) -> FloatArray:
    """Of each of K strides (K, 5) the first of :data:`MOTION_KEYS`; the angles are NaN where the swing was not seen.

    MDD is the greatest sideways distance from the straight line of the stride, circumduction the greatest outward
    distance from it, MLR the greatest toe-down rotation since the start. ``pitch_rad`` (R,) is of :func:`pitches`;
    ``side`` is "left" or "right".
    """
    out = np.full((len(paths), 5), math.nan)
    outward = 1.0 if side == "left" else -1.0
    _motions(paths.t_ns, paths.position_m, *_frames(paths), pitch_rad, paths.spans, off_ns, contact_ns, outward, out)
    return out


def _frames(paths: FootPaths) -> tuple[FloatArray, FloatArray]:
    """Where x of each stride's own frame points in the world: its two level coordinates, (K,) each."""
    first, last = paths.spans[:, 0], paths.spans[:, 1] - 1
    along = paths.position_m[last, :2] - paths.position_m[first, :2]
    length = np.hypot(along[:, 0], along[:, 1])
    for k in np.flatnonzero(length < GOES_NOWHERE_M).tolist():
        along[k] = to_world(*paths.quaternion[first[k]].tolist(), *paths.foot[:, 0].tolist())[:2]
        length[k] = math.hypot(*along[k])
    x, y = (along / np.maximum(length, 1e-9)[:, None]).T
    return np.ascontiguousarray(x), np.ascontiguousarray(y)


@jit_ieee
def _motions(
    t_ns: Vec, position: Mat, ahead_x: Vec, ahead_y: Vec, pitch: Vec, spans: Mat, off_ns: Vec, contact_ns: Vec,
    outward: float, out: Mat,
) -> None:  # fmt: skip
    for k in range(spans.shape[0]):
        begin, end = spans[k, 0], spans[k, 1]
        out[k, 0] = out[k, 1] = out[k, 2] = -math.inf
        for i in range(begin, end):
            x, y = position[i, 0] - position[begin, 0], position[i, 1] - position[begin, 1]
            left = ahead_x[k] * y - ahead_y[k] * x
            out[k, 0] = max(out[k, 0], abs(left))
            out[k, 1] = max(out[k, 1], outward * left)
            out[k, 2] = max(out[k, 2], -pitch[i])
        if off_ns[k] != UNSEEN_NS:
            own = t_ns[begin:end]
            out[k, 3] = _between(own, pitch[begin:end], off_ns[k])
            out[k, 4] = _between(own, pitch[begin:end], contact_ns[k])


@jit_ieee
def _between(t: Vec, x: Vec, at: float) -> float:
    """``x`` at an instant, linear between its samples, and as at the ends beyond them."""
    j = min(max(int(np.searchsorted(t, at)), 1), len(t) - 1)
    here: float = (x[j] - x[j - 1]) / (t[j] - t[j - 1]) * (min(max(at, t[0]), t[-1]) - t[j - 1]) + x[j - 1]
    return here


def variations(paths: FootPaths, pairs: IntArray) -> FloatArray:
    """PV (m) and OV (rad) of P pairs of neighbouring strides of one side: (P, 2), as ``pairs``, their places."""
    return shape_variations(stride_shapes(paths), pairs)


def stride_shapes(paths: FootPaths) -> FloatArray:
    """Of K strides (K, POINTS, 6) the place in the stride's own frame (m) and the rotation vector since its start, in
    the sensor's (rad), at equal steps of time."""
    shapes = np.empty((len(paths), POINTS, 6))
    _shapes(paths.t_ns, paths.position_m, paths.quaternion, *_frames(paths), paths.spans, shapes)
    return shapes


def shape_variations(shapes: FloatArray, pairs: IntArray) -> FloatArray:
    """As :func:`variations`, of shapes (K, N, 6)."""
    out = np.empty((len(pairs), 2))
    _variations(shapes, np.ascontiguousarray(pairs), out)
    return out


@jit_ieee
def _shapes(t_ns: Vec, position: Mat, quaternion: Mat, ahead_x: Vec, ahead_y: Vec, spans: Mat, out: Mat) -> None:
    for k in range(spans.shape[0]):
        begin, n = spans[k, 0], spans[k, 1] - spans[k, 0]
        own = np.empty((6, n))
        a, b, c, d = quaternion[begin, 0], -quaternion[begin, 1], -quaternion[begin, 2], -quaternion[begin, 3]
        for i in range(n):
            j = begin + i
            x, y = position[j, 0] - position[begin, 0], position[j, 1] - position[begin, 1]
            own[0, i], own[1, i] = ahead_x[k] * x + ahead_y[k] * y, ahead_x[k] * y - ahead_y[k] * x
            own[2, i] = position[j, 2] - position[begin, 2]
            p, q, r, s = quaternion[j, 0], quaternion[j, 1], quaternion[j, 2], quaternion[j, 3]
            w = a * p - b * q - c * r - d * s
            u, v, t = a * q + b * p + c * s - d * r, a * r - b * s + c * p + d * q, a * s + b * r - c * q + d * p
            sine = math.sqrt(u * u + v * v + t * t)
            angle = 2.0 * math.atan2(sine, abs(w)) if w >= 0.0 else -2.0 * math.atan2(sine, abs(w))
            size = angle / sine if sine > 0.0 else 2.0  # the shorter way round
            own[3, i], own[4, i], own[5, i] = size * u, size * v, size * t
        step = (t_ns[begin + n - 1] - t_ns[begin]) / (POINTS - 1)
        j = 1
        for m in range(POINTS):
            at = m * step
            while j < n - 1 and t_ns[begin + j] - t_ns[begin] <= at:
                j += 1
            before, lasts = float(t_ns[begin + j - 1] - t_ns[begin]), float(t_ns[begin + j] - t_ns[begin + j - 1])
            for e in range(6):
                out[k, m, e] = (own[e, j] - own[e, j - 1]) / lasts * (at - before) + own[e, j - 1]


@jit_ieee
def _variations(shapes: Mat, pairs: Mat, out: Mat) -> None:
    n = shapes.shape[1]
    cost, way = np.empty((2 * n, n + 2)), np.empty((2 * n, 2), np.int64)
    for k in range(pairs.shape[0]):
        one, other = shapes[pairs[k, 0]], shapes[pairs[k, 1]]
        first = _warp(_unit(one), _unit(other), cost, way)
        place = turn = 0.0
        for m in range(first, len(way)):
            i, j = way[m, 0], way[m, 1]
            for e in range(3):
                place += (other[j, e] - one[i, e]) ** 2
                turn += (other[j, e + 3] - one[i, e + 3]) ** 2
        out[k, 0], out[k, 1] = math.sqrt(place / (len(way) - first)), math.sqrt(turn / (len(way) - first))


@jit_ieee
def _unit(shape: Mat) -> Vec:
    low, high = shape[0, 0], shape[0, 0]
    for m in range(len(shape)):
        low, high = min(low, shape[m, 0]), max(high, shape[m, 0])
    return np.asarray((shape[:, 0] - low) / max(high - low, 1e-9))


@jit_ieee
def _warp(one: Vec, other: Vec, cost: Mat, pairs: Mat) -> int:
    """Fill the last rows of ``pairs`` (N + M, 2) with those of the cheapest warp, and return the first of these rows.

    The cost of a pair is its distance and that of the cheapest way to it. Pairs with the same sum of numbers do not
    wait for one another and are taken together, which is several times as fast: row ``i + j`` of ``cost`` (N + M,
    N + 2), which is room, has that of ``i`` and ``j`` in column ``i + 1``, between two that are beyond the edge.
    """
    n, m, backward = len(one), len(other), other[::-1].copy()
    cost[n + m - 1] = math.inf  # where nothing has been yet
    for s in range(n + m - 1):
        row, last, before = cost[s], cost[s - 1], cost[s - 2]  # of the first two rows the last one is before
        begin, end, shift = max(0, s - m + 1), min(n, s + 1), m - 1 - s
        ours, theirs, found = one[begin:end], backward[begin + shift : end + shift], row[begin + 1 : end + 1]
        both, above, beside = before[begin:end], last[begin:end], last[begin + 1 : end + 1]
        for i in range(len(found)):
            least = both[i] if both[i] < above[i] else above[i]
            found[i] = abs(ours[i] - theirs[i]) + (least if least < beside[i] else beside[i])
        if s == 0:
            row[1] = abs(one[0] - other[0])
        row[begin] = row[end + 1] = math.inf
    i, j, k = n - 1, m - 1, n + m - 1
    pairs[k, 0], pairs[k, 1] = i, j
    while i > 0 or j > 0:
        skip = cost[i + j - 2, i] if i > 0 and j > 0 else math.inf
        up, back = cost[i + j - 1, i], cost[i + j - 1, i + 1]
        if skip <= up and skip <= back:
            i, j = i - 1, j - 1
        elif up <= back:
            i -= 1
        else:
            j -= 1
        k -= 1
        pairs[k, 0], pairs[k, 1] = i, j
    return k
