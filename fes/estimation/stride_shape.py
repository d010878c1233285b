"""Compiled numbers of a solved stride: its turn and height, and its way at evenly spaced times."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from fes.estimation.compiled import inlined, jit_fused
from fes.estimation.rotation import to_world

SHORTEST_M = 0.05  # a stride shorter than that has no direction but the foot's


@jit_fused
def height_and_turn(quaternion: Any, position: Any, fx: float, fy: float, fz: float) -> tuple[float, float]:
    """The greatest height of a stride in m, and by how much the foot turned in rad, left positive, within half a turn.

    Args:
        quaternion: (N, 4) orientations, sensor to world.
        position: (N, 3) in m from the start.
        fx: unit vector towards the toe in the sensor frame, with ``fy`` and ``fz``.
        fy: see ``fx``.
        fz: see ``fx``.
    """
    highest = -math.inf
    for i in range(position.shape[0]):
        highest = max(highest, position[i, 2])
    ahead, left, _ = _pointing(quaternion, 0, fx, fy, fz)
    turn = -math.atan2(left, ahead)
    ahead, left, _ = _pointing(quaternion, position.shape[0] - 1, fx, fy, fz)
    turn += math.atan2(left, ahead)
    return highest, (turn + math.pi) % (2.0 * math.pi) - math.pi


@jit_fused
def stride_shape(t_ns: Any, quaternion: Any, position: Any, fx: float, fy: float, fz: float, out: Any) -> None:
    """Fill ``out`` (K, 4): ahead, left and up (m) in the direction of the stride, and pitch (rad) since its start.

    ``t_ns`` (N,) are the time stamps; the K rows of ``out`` are evenly spaced from the first to the last, linear in
    between. The others are as for :func:`height_and_turn`.
    """
    n, count = t_ns.shape[0], out.shape[0]
    pitch = np.empty(n)
    for i in range(n):
        _, _, up = _pointing(quaternion, i, fx, fy, fz)
        pitch[i] = math.asin(min(max(up, -1.0), 1.0))
    dx, dy = position[n - 1, 0], position[n - 1, 1]
    length = math.sqrt(dx * dx + dy * dy)
    if length <= SHORTEST_M:
        dx, dy, _ = _pointing(quaternion, 0, fx, fy, fz)
        length = math.sqrt(dx * dx + dy * dy)
    dx, dy = (dx / length, dy / length) if length > 0.0 else (1.0, 0.0)
    i, step = 0, (t_ns[n - 1] - t_ns[0]) / (count - 1)
    for k in range(count):
        at = k * step  # ns since the start
        while i < n - 2 and t_ns[i + 1] - t_ns[0] <= at:
            i += 1
        share = min((at - (t_ns[i] - t_ns[0])) / (t_ns[i + 1] - t_ns[i]), 1.0)
        x = position[i, 0] + share * (position[i + 1, 0] - position[i, 0])
        y = position[i, 1] + share * (position[i + 1, 1] - position[i, 1])
        out[k, 0] = x * dx + y * dy
        out[k, 1] = y * dx - x * dy
        out[k, 2] = position[i, 2] + share * (position[i + 1, 2] - position[i, 2])
        out[k, 3] = pitch[i] + share * (pitch[i + 1] - pitch[i]) - pitch[0]


@jit_fused
def stride_shapes(
    firsts: Any, counts: Any, t_ns: Any, quaternion: Any, position: Any, fx: float, fy: float, fz: float, out: Any
) -> None:
    """As :func:`stride_shape` of S strides, of each ``counts`` rows from ``firsts`` on, (S,); ``out`` (S, K, 4)."""
    for k in range(firsts.shape[0]):
        a, b = firsts[k], firsts[k] + counts[k]
        if b > a:
            stride_shape(t_ns[a:b], quaternion[a:b], position[a:b], fx, fy, fz, out[k])


@inlined
def _pointing(quaternion: Any, i: int, x: float, y: float, z: float) -> tuple[float, float, float]:
    """An axis of the sensor in the world at sample ``i``."""
    return to_world(quaternion[i, 0], quaternion[i, 1], quaternion[i, 2], quaternion[i, 3], x, y, z)
