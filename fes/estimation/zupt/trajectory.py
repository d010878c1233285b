"""Trajectories: positions between known instants, headings, a path turned, joined and bent over the ground.

What for, :mod:`fes.estimation.zupt.foot_trajectory` and :mod:`fes.analysis.ground_path` say.
"""

import math

from fes.estimation.numerics.jit import inlined, jit_fused
from fes.estimation.numerics.records import Mat, Vec
from fes.estimation.numerics.rotation import to_world

AHEAD_M = 2.0
TURN_RAD = 2.0 * math.pi


@jit_fused
def positions_at(known_ns: Vec, position: Mat, velocity: Mat, asked_ns: Vec, out: Vec) -> None:
    """Fill ``out`` (M, 3) with the place at instants (M,), best in order: cubic between K places and velocities.

    Before the first and after the last the path stands still.
    """
    k, last = 0, known_ns.shape[0] - 1
    for i in range(asked_ns.shape[0]):
        while k > 0 and known_ns[k] >= asked_ns[i]:
            k -= 1
        while k < last - 1 and known_ns[k + 1] < asked_ns[i]:
            k += 1
        span_s = 1e-9 * (known_ns[k + 1] - known_ns[k])
        u = min(max(1e-9 * (asked_ns[i] - known_ns[k]) / span_s, 0.0), 1.0)
        share, begin, end = u * u * (3.0 - 2.0 * u), u * (1.0 - u) * (1.0 - u) * span_s, u * u * (1.0 - u) * span_s
        for j in range(3):
            step = position[k + 1, j] - position[k, j]
            out[i, j] = position[k, j] + share * step + begin * velocity[k, j] - end * velocity[k + 1, j]


@jit_fused
def turn_path(position: Mat, velocity: Mat, quaternions: Mat, turn: float, shift: Vec) -> None:
    """Turn K places, velocities, orientations about the vertical by ``turn`` (rad), then shift the places by (3,)."""
    c, s, w, z = math.cos(turn), math.sin(turn), math.cos(0.5 * turn), math.sin(0.5 * turn)
    for i in range(position.shape[0]):
        x, y = position[i, 0], position[i, 1]
        position[i, 0], position[i, 1] = c * x - s * y + shift[0], s * x + c * y + shift[1]
        position[i, 2] += shift[2]
        x, y = velocity[i, 0], velocity[i, 1]
        velocity[i, 0], velocity[i, 1] = c * x - s * y, s * x + c * y
        q0, q1, q2, q3 = quaternions[i, 0], quaternions[i, 1], quaternions[i, 2], quaternions[i, 3]
        quaternions[i, 0], quaternions[i, 1] = w * q0 - z * q3, w * q1 - z * q2
        quaternions[i, 2], quaternions[i, 3] = w * q2 + z * q1, w * q3 + z * q0


@jit_fused
def over_ground(
    t_ns: Vec, place: Mat, velocity: Mat, q: Mat, axis: Vec, stance_ns: Vec, kept_ns: Vec, facing: Vec, off: Vec,
    position: Mat, heading: Vec,
) -> None:  # fmt: skip
    """Fill the last two, (M, 3) and (M,), with position and heading at instants ``kept_ns`` (M,) of a trajectory (K,).

    x points to where the foot first is 2 m away. ``facing`` (K,) and ``off``, one for each stance, are room.
    """
    headings(q, axis, facing)
    remove_false_turns(t_ns, facing, stance_ns, off)
    resample(t_ns, place, velocity, facing, kept_ns, position, heading)
    point_ahead(position, heading)


@inlined
def headings(q: Mat, axis: Vec, out: Vec) -> None:
    """Fill ``out`` (K,) with where an ``axis`` (3,) of the sensor points, from x towards y, by orientations (K, 4).

    In rad, without whole turns between neighbours.
    """
    x, y, z, heading, ahead, left = axis[0], axis[1], axis[2], 0.0, 1.0, 0.0
    for i in range(q.shape[0]):
        now_ahead, now_left, _ = to_world(q[i, 0], q[i, 1], q[i, 2], q[i, 3], x, y, z)
        sine, cosine = ahead * now_left - left * now_ahead, ahead * now_ahead + left * now_left
        if sine != 0.0 or cosine != 0.0:  # else it points straight up or down, and has no heading
            heading += fast_atan2(sine, cosine)
            ahead, left = now_ahead, now_left
        out[i] = heading


@inlined
def fast_atan2(sine: float, cosine: float) -> float:
    """The angle from its sine and cosine times whatever length: ``atan2``, sooner where it is small."""
    if abs(sine) < 0.125 * cosine:  # there the series lacks less than the last bit
        x = sine / cosine
        y = x * x
        z = y * y
        low, high = (1 / 3 - 1 / 5 * y) + z * (1 / 7 - 1 / 9 * y), (1 / 11 - 1 / 13 * y) + z * (1 / 15 - 1 / 17 * y)
        return x - x * y * (low + z * z * high)
    return math.atan2(sine, cosine)


@inlined
def remove_false_turns(t_ns: Vec, heading: Vec, stance_ns: Vec, off: Vec) -> None:
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


@inlined
def resample(
    t_ns: Vec, place: Mat, velocity: Mat, facing: Vec, kept_ns: Vec, position: Mat, heading: Vec
) -> None:  # fmt: skip
    """Fill the last two, (M, 3) and (M,), at rising instants (M,), as :func:`positions_at`; headings are linear."""
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
def point_ahead(position: Mat, heading: Vec) -> None:
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
def first_beyond(position: Mat, far2: float) -> int:
    """The first of the places (K, 3) that is so far away, squared (m²); -1 where none is."""
    for i in range(position.shape[0]):
        if position[i, 0] * position[i, 0] + position[i, 1] * position[i, 1] >= far2:
            return i
    return -1


@jit_fused
def bend_ahead(
    t_ns: Vec, stance_ns: Vec, per_stride_rad: float, position: Mat, heading: Vec, place: Mat, turned: Vec
) -> None:  # fmt: skip
    """As :func:`bend`, and turned so that x points to where the path first is 2 m away."""
    bend(t_ns, stance_ns, per_stride_rad, position, heading, place, turned)
    point_ahead(place, turned)


@inlined
def bend(
    t_ns: Vec, stance_ns: Vec, per_stride_rad: float, position: Mat, heading: Vec, place: Mat, turned: Vec
) -> None:  # fmt: skip
    """Bend a path by an angle that grows by so much from stance to stance, linearly in time in between.

    ``t_ns`` (K,) and ``stance_ns`` (M,) rise; ``position`` (K, 3) and ``heading`` (K,) are the path, ``place`` and
    ``turned`` the same to be filled. Each part of the path turns by the mean of the angles at its ends.
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
        cosine, sine = cos_sin(more)
        c, s = c * cosine - s * sine, s * cosine + c * sine
        to_x, to_y = position[i, 0], position[i, 1]
        dx, dy = to_x - from_x, to_y - from_y
        from_x, from_y = to_x, to_y
        x += c * dx - s * dy
        y += s * dx + c * dy
        place[i, 0], place[i, 1], place[i, 2] = x, y, position[i, 2]
        turned[i] = heading[i] + angle


@inlined
def cos_sin(angle: float) -> tuple[float, float]:
    """Cosine and sine of an angle, sooner where it is small."""
    x = angle * angle
    if x < 1e-4:  # there the series lack less than the last bit
        return 1.0 - x * (1 / 2 - x * (1 / 24 - 1 / 720 * x)), angle * (1.0 - x * (1 / 6 - 1 / 120 * x))
    return math.cos(angle), math.sin(angle)


@jit_fused
def slopes(values: Vec, places: Vec, least: int, out: Vec) -> None:
    """Fill ``out`` with the slopes between all pairs of N rising ``places`` at least so many places apart."""
    k, n = 0, values.shape[0]
    for i in range(n - least):
        for j in range(i + least, n):
            out[k] = (values[j] - values[i]) / (places[j] - places[i])
            k += 1
