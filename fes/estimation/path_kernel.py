"""Compiled headings along a foot's way, and a path bent by a turn that grows; :mod:`fes.ground_path` says what for."""

from __future__ import annotations

import math
from typing import Any

from fes.estimation.compiled import jit_ieee
from fes.estimation.rotation import half_turn, to_world


@jit_ieee
def headings(q: Any, axis: Any, out: Any) -> None:
    """Fill ``out`` (K,) with where an ``axis`` (3,) of the sensor points, from x towards y, by orientations (K, 4).

    In rad, without whole turns between neighbours.
    """
    x, y, z, turned, before = axis[0], axis[1], axis[2], 0.0, 0.0
    for i in range(q.shape[0]):
        ahead, left, _ = to_world(q[i, 0], q[i, 1], q[i, 2], q[i, 3], x, y, z)
        now = math.atan2(left, ahead)
        if i > 0 and abs(now - before) > math.pi:
            turned += math.copysign(2.0 * math.pi, now - before)
        before = now
        out[i] = now - turned


@jit_ieee
def bend(
    t_ns: Any, stance_ns: Any, per_stride_rad: float, position: Any, heading: Any, place: Any, turned: Any
) -> None:  # fmt: skip
    """Bend a path by an angle that grows by so much from stance to stance, linearly in time in between.

    ``t_ns`` (K,) and ``stance_ns`` (M,) rise; ``position`` (K, 3) and ``heading`` (K,) are the path, ``place`` and
    ``turned`` the same to be filled. Each piece of the path turns by the mean of the angles at its ends.
    """
    k, last = 0, stance_ns.shape[0] - 1
    c, s, middle, before = 1.0, 0.0, 0.0, 0.0
    x, y = position[0, 0], position[0, 1]
    for i in range(t_ns.shape[0]):
        while k < last - 1 and stance_ns[k + 1] <= t_ns[i]:
            k += 1
        angle = 0.0
        if last > 0:
            share = (t_ns[i] - stance_ns[k]) / (stance_ns[k + 1] - stance_ns[k])
            angle = per_stride_rad * (k + min(max(share, 0.0), 1.0))
        if i > 0:
            more = 0.5 * (before + angle) - middle  # hardly anything, so that its series are short
            cosine, sine = half_turn(4.0 * more * more)
            sine *= 2.0 * more
            c, s = c * cosine - s * sine, s * cosine + c * sine
            middle += more
            dx, dy = position[i, 0] - position[i - 1, 0], position[i, 1] - position[i - 1, 1]
            x += c * dx - s * dy
            y += s * dx + c * dy
        before = angle
        place[i, 0], place[i, 1], place[i, 2] = x, y, position[i, 2]
        turned[i] = heading[i] + angle
