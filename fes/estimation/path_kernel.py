"""Compiled paths over the ground, from a foot's way and bent by a turn that grows; :mod:`fes.ground_path` says why."""

from __future__ import annotations

import math
from typing import Any

from fes.estimation.compiled import inlined, jit_fused
from fes.estimation.rotation import to_world

AHEAD_M = 2.0
TURN_RAD = 2.0 * math.pi


@inlined
def angle_of(sine: float, cosine: float) -> float:
    """The angle from its sine and cosine times whatever length: ``atan2``, sooner where it is small."""
    if abs(sine) < 0.125 * cosine:  # there the series lacks less than the last bit
        x = sine / cosine
        y = x * x
        z = y * y
        low, high = (1 / 3 - 1 / 5 * y) + z * (1 / 7 - 1 / 9 * y), (1 / 11 - 1 / 13 * y) + z * (1 / 15 - 1 / 17 * y)
        return x - x * y * (low + z * z * high)
    return math.atan2(sine, cosine)


@jit_fused
def headings(q: Any, axis: Any, out: Any) -> None:
    """Fill ``out`` (K,) with where an ``axis`` (3,) of the sensor points, from x towards y, by orientations (K, 4).

    In rad, without whole turns between neighbours.
    """
    x, y, z, heading, ahead, left = axis[0], axis[1], axis[2], 0.0, 1.0, 0.0
    for i in range(q.shape[0]):
        now_ahead, now_left, _ = to_world(q[i, 0], q[i, 1], q[i, 2], q[i, 3], x, y, z)
        sine, cosine = ahead * now_left - left * now_ahead, ahead * now_ahead + left * now_left
        if sine != 0.0 or cosine != 0.0:  # else it points straight up or down, and has no heading
            heading += angle_of(sine, cosine)
            ahead, left = now_ahead, now_left
        out[i] = heading


@jit_fused
def without_turns(t_ns: Any, heading: Any, stance_ns: Any, off: Any) -> None:
    """Take false whole turns out of headings (K,): a toe that points straight down between stances has none.

    ``off`` (M,) is room, one for each stance.
    """
    count, last = stance_ns.shape[0], t_ns.shape[0] - 1
    k, before, turned = 0, 0.0, 0.0
    for j in range(count):
        while k < last - 1 and t_ns[k + 1] <= stance_ns[j]:
            k += 1
        share = min(max((stance_ns[j] - t_ns[k]) / (t_ns[k + 1] - t_ns[k]), 0.0), 1.0)
        now = heading[k] + share * (heading[k + 1] - heading[k])
        if j > 0:
            turned -= TURN_RAD * math.floor((now - before) / TURN_RAD + 0.5)
        before, off[j] = now, turned
    j = 0
    for i in range(last + 1):
        while j < count - 1 and (stance_ns[j] + stance_ns[j + 1]) // 2 <= t_ns[i]:
            j += 1
        heading[i] += off[j]


@jit_fused
def keep(
    t_ns: Any, place: Any, velocity: Any, facing: Any, kept_ns: Any, position: Any, heading: Any
) -> None:  # fmt: skip
    """Fill the last two, (M, 3) and (M,), at instants (M,) that rise, as ``path_at``; the heading is linear between."""
    i, last = 0, t_ns.shape[0] - 1
    for k in range(last):
        per_ns, span_s = 1.0 / (t_ns[k + 1] - t_ns[k]), 1e-9 * (t_ns[k + 1] - t_ns[k])
        turn = facing[k + 1] - facing[k]
        x, y, z = place[k, 0], place[k, 1], place[k, 2]
        dx, dy, dz = place[k + 1, 0] - x, place[k + 1, 1] - y, place[k + 1, 2] - z
        ax, ay, az = span_s * velocity[k, 0], span_s * velocity[k, 1], span_s * velocity[k, 2]
        bx, by, bz = span_s * velocity[k + 1, 0], span_s * velocity[k + 1, 1], span_s * velocity[k + 1, 2]
        while i < kept_ns.shape[0] and (kept_ns[i] <= t_ns[k + 1] or k == last - 1):
            u = min(max((kept_ns[i] - t_ns[k]) * per_ns, 0.0), 1.0)
            share, begin, end = u * u * (3.0 - 2.0 * u), u * (1.0 - u) * (1.0 - u), u * u * (1.0 - u)
            position[i, 0] = x + share * dx + begin * ax - end * bx
            position[i, 1] = y + share * dy + begin * ay - end * by
            position[i, 2] = z + share * dz + begin * az - end * bz
            heading[i] = facing[k] + u * turn
            i += 1


@jit_fused
def first_beyond(position: Any, far2: float) -> int:
    """The first of the places (K, 3) that is so far away, squared (m²); -1 where none is."""
    for i in range(position.shape[0]):
        if position[i, 0] * position[i, 0] + position[i, 1] * position[i, 1] >= far2:
            return i
    return -1


@jit_fused
def look_ahead(position: Any, heading: Any) -> None:
    """Turn a path (K, 3), (K,) so that x points to where it first is 2 m away (at most as far as it goes)."""
    at, most2 = first_beyond(position, AHEAD_M * AHEAD_M), 0.0
    if at < 0:
        for i in range(position.shape[0]):
            most2 = max(most2, position[i, 0] * position[i, 0] + position[i, 1] * position[i, 1])
        at = max(first_beyond(position, 0.999 * 0.999 * most2), 0)
    angle = math.atan2(position[at, 1], position[at, 0])
    c, s = math.cos(angle), math.sin(angle)
    angle += TURN_RAD * math.floor((heading[0] - angle) / TURN_RAD + 0.5)
    for i in range(position.shape[0]):
        x, y = position[i, 0], position[i, 1]
        position[i, 0], position[i, 1] = c * x + s * y, c * y - s * x
        heading[i] -= angle


@jit_fused
def over_ground(
    t_ns: Any, place: Any, velocity: Any, q: Any, axis: Any, stance_ns: Any, kept_ns: Any, facing: Any, off: Any,
    position: Any, heading: Any,
) -> None:  # fmt: skip
    """Fill the last two, (M, 3) and (M,), with place and heading at the instants ``kept_ns`` (M,) of a foot's way (K,).

    x points to where the foot first is 2 m away. ``facing`` (K,) and ``off``, one for each stance, are room.
    """
    headings(q, axis, facing)
    without_turns(t_ns, facing, stance_ns, off)
    keep(t_ns, place, velocity, facing, kept_ns, position, heading)
    look_ahead(position, heading)


@jit_fused
def slopes(values: Any, places: Any, least: int, out: Any) -> None:
    """Fill ``out`` with the slopes between all pairs of N rising ``places`` at least so many places apart."""
    k, n = 0, values.shape[0]
    for i in range(n - least):
        for j in range(i + least, n):
            out[k] = (values[j] - values[i]) / (places[j] - places[i])
            k += 1


@inlined
def small_turn(angle: float) -> tuple[float, float]:
    """Cosine and sine of an angle, sooner where it is small."""
    x = angle * angle
    if x < 1e-4:  # there the series lack less than the last bit
        return 1.0 - x * (1 / 2 - x * (1 / 24 - 1 / 720 * x)), angle * (1.0 - x * (1 / 6 - 1 / 120 * x))
    return math.cos(angle), math.sin(angle)


@jit_fused
def bend(
    t_ns: Any, stance_ns: Any, per_stride_rad: float, position: Any, heading: Any, place: Any, turned: Any
) -> None:  # fmt: skip
    """Bend a path by an angle that grows by so much from stance to stance, linearly in time in between.

    ``t_ns`` (K,) and ``stance_ns`` (M,) rise; ``position`` (K, 3) and ``heading`` (K,) are the path, ``place`` and
    ``turned`` the same to be filled. Each piece of the path turns by the mean of the angles at its ends.
    """
    k, last, per_ns = -1, stance_ns.shape[0] - 1, 0.0
    c, s, middle, before = 1.0, 0.0, 0.0, 0.0
    x, y, from_x, from_y = position[0, 0], position[0, 1], position[0, 0], position[0, 1]
    for i in range(t_ns.shape[0]):
        while k < 0 or (k < last - 1 and stance_ns[k + 1] <= t_ns[i]):
            k += 1
            per_ns = 1.0 / (stance_ns[k + 1] - stance_ns[k]) if last > 0 else 0.0
        angle = per_stride_rad * (k + min(max((t_ns[i] - stance_ns[k]) * per_ns, 0.0), 1.0))
        turn = 0.5 * (before + angle)
        more = turn - middle  # hardly anything, so that its series are short
        before, middle = angle, turn
        cosine, sine = small_turn(more)
        c, s = c * cosine - s * sine, s * cosine + c * sine
        to_x, to_y = position[i, 0], position[i, 1]
        dx, dy = to_x - from_x, to_y - from_y
        from_x, from_y = to_x, to_y
        x += c * dx - s * dy
        y += s * dx + c * dy
        place[i, 0], place[i, 1], place[i, 2] = x, y, position[i, 2]
        turned[i] = heading[i] + angle


@jit_fused
def bend_ahead(
    t_ns: Any, stance_ns: Any, per_stride_rad: float, position: Any, heading: Any, place: Any, turned: Any
) -> None:  # fmt: skip
    """As :func:`bend`, and turned so that x points to where the path first is 2 m away."""
    bend(t_ns, stance_ns, per_stride_rad, position, heading, place, turned)
    look_ahead(place, turned)
