"""What one stride shows of toe and heel, compiled; :mod:`fes.estimation.foot_geometry` says what and why."""

from __future__ import annotations

import math
from typing import Any

from fes.estimation.clearance_kernel import index_at, reach
from fes.estimation.compiled import inlined, jit_ieee
from fes.estimation.rotation import to_world
from fes.estimation.stride_time import UNSEEN_NS

BALL_PITCH_RAD = (-0.09, -0.38)  # the heel has risen, and the foot still turns about the ball
LEAST_TOE_TILT = 0.3  # sine of the angle at foot off, and …
LEAST_HEEL_TILT = 0.14  # … at contact, below which an arm does not show
LEAST_HEEL_TURN = 0.1  # change of that sine from which the centre's height shows
HEEL_WINDOW_NS = (5_000_000, 60_000_000)  # after contact is known
SIGNS = 6
BALL, OVER_HEEL, TOE, HEEL = 0, 1, 2, 4  # the last two: at no height, and per metre of the sensor's height


@inlined
def _rise(quaternion: Any, forward: Any, i: int) -> float:
    """Sine of the pitch: it tells which of two pitches is the higher, and costs less."""
    return min(max(reach(quaternion, forward, i), -1.0), 1.0)


@inlined
def _pointing(quaternion: Any, axis: Any, i: int) -> tuple[float, float, float]:
    """An axis of the sensor in the world."""
    return to_world(
        quaternion[i, 0], quaternion[i, 1], quaternion[i, 2], quaternion[i, 3], axis[0], axis[1], axis[2]
    )  # fmt: skip


@jit_ieee
def _products(
    position: Any, quaternion: Any, forward: Any, up: Any, begin: int, end: int
) -> tuple[float, float, float, float, float]:
    """Sums over ``begin`` … ``end - 1`` and the world's three axes of products of forward f, up u and place p.

    In the order ff, fu, uu, fp, up; of each its mean over the samples is taken off first.
    """
    f_x, f_y, f_z = _pointing(quaternion, forward, begin)
    u_x, u_y, u_z = _pointing(quaternion, up, begin)
    p_x, p_y, p_z = position[begin, 0], position[begin, 1], position[begin, 2]
    ff = fu = uu = fp = up_p = fx = fy = fz = ux = uy = uz = px = py = pz = 0.0
    for i in range(begin + 1, end):  # counted from the first sample, so that little is lost when the means go
        f0, f1, f2 = _pointing(quaternion, forward, i)
        u0, u1, u2 = _pointing(quaternion, up, i)
        f0, f1, f2, u0, u1, u2 = f0 - f_x, f1 - f_y, f2 - f_z, u0 - u_x, u1 - u_y, u2 - u_z
        p0, p1, p2 = position[i, 0] - p_x, position[i, 1] - p_y, position[i, 2] - p_z
        fx, fy, fz, ux, uy, uz, px, py, pz = (
            fx + f0, fy + f1, fz + f2, ux + u0, uy + u1, uz + u2, px + p0, py + p1, pz + p2
        )  # fmt: skip
        ff += f0 * f0 + f1 * f1 + f2 * f2
        fu += f0 * u0 + f1 * u1 + f2 * u2
        uu += u0 * u0 + u1 * u1 + u2 * u2
        fp += f0 * p0 + f1 * p1 + f2 * p2
        up_p += u0 * p0 + u1 * p1 + u2 * p2
    per = 1.0 / (end - begin)
    return (
        ff - per * (fx * fx + fy * fy + fz * fz),
        fu - per * (fx * ux + fy * uy + fz * uz),
        uu - per * (ux * ux + uy * uy + uz * uz),
        fp - per * (fx * px + fy * py + fz * pz),
        up_p - per * (ux * px + uy * py + uz * pz),
    )


@inlined
def _height(products: tuple[float, float, float, float, float]) -> float:
    """Height of the sensor over a point that stands still, from these products: least squares for its arm."""
    ff, fu, uu, fp, up = products
    determinant = ff * uu - fu * fu
    return (ff * up - fu * fp) / determinant if determinant > 0.0 else math.nan


@jit_ieee
def signs_of(
    t_ns: Any, position: Any, quaternion: Any, forward: Any, up: Any, off_ns: int, contact_ns: int, out: Any
) -> None:
    """Fill ``out`` (6,) from a stride's path, NaN for what it does not show; ``forward``, ``up`` (3,) in the sensor.

    Height of the sensor over the ball while the heel rises, and over the heel after its strike; the toe's distance
    forward if the sensor were at no height, and what a metre of height adds; the same of the heel.
    """
    out[:] = math.nan
    n = t_ns.shape[0]
    if off_ns != UNSEEN_NS:
        # the fastest turn toe-down up to foot off: a session may place foot off later than that
        end = index_at(t_ns, off_ns) + 1
        if end > 3:
            off, fastest, sine = 0, math.inf, _rise(quaternion, forward, 0)
            cosine = math.sqrt(1.0 - sine * sine)
            for i in range(1, min(end + 1, n)):
                before, level = sine, cosine
                sine = _rise(quaternion, forward, i)
                cosine = math.sqrt(1.0 - sine * sine)
                turned = sine * level - cosine * before  # the sine of the turn between two samples
                if turned < fastest:
                    off, fastest = i - 1, turned
            _ball(position, quaternion, forward, up, off, out)
            ahead = reach(quaternion, forward, off) - reach(quaternion, forward, 0)
            above = reach(quaternion, up, off) - reach(quaternion, up, 0)
            if ahead <= -LEAST_TOE_TILT:
                out[TOE], out[TOE + 1] = -position[off, 2] / ahead, above / ahead
    if contact_ns != UNSEEN_NS:
        begin = index_at(t_ns, contact_ns + HEEL_WINDOW_NS[0])
        end = index_at(t_ns, contact_ns + HEEL_WINDOW_NS[1])
        # angles count from the stance that follows: it is nearer, and on stairs
        lifted = reach(quaternion, forward, begin) - reach(quaternion, forward, n - 1)
        if lifted >= LEAST_HEEL_TILT and end - begin >= 3:
            _struck(position, quaternion, forward, up, begin, end, out)


@jit_ieee
def all_signs(
    t_ns: Any, position: Any, quaternion: Any, forward: Any, up: Any, spans: Any, swings: Any, out: Any
) -> None:
    """As :func:`signs_of` of every stride: rows ``spans`` (K, 2), swings (K, 2); ``out`` (K, 6)."""
    for k in range(spans.shape[0]):
        a, b = spans[k, 0], spans[k, 1]
        signs_of(t_ns[a:b], position[a:b], quaternion[a:b], forward, up, swings[k, 0], swings[k, 1], out[k])


@jit_ieee
def _ball(position: Any, quaternion: Any, forward: Any, up: Any, off: int, out: Any) -> None:
    """While the heel rises, up to foot off."""
    level = math.asin(_rise(quaternion, forward, 0))
    first, last = math.sin(level + BALL_PITCH_RAD[0]), math.sin(max(level + BALL_PITCH_RAD[1], -0.5 * math.pi))
    begin = off
    while begin > 0 and _rise(quaternion, forward, begin) <= first:
        begin -= 1
    end = begin
    least = most = rise = _rise(quaternion, forward, begin)
    while end <= off and rise >= last:
        least, most = min(least, rise), max(most, rise)
        end += 1
        rise = _rise(quaternion, forward, min(end, off))
    turned = math.asin(most) - math.asin(least)
    if end - begin >= 4 and turned >= 0.5 * (BALL_PITCH_RAD[0] - BALL_PITCH_RAD[1]):
        out[BALL] = _height(_products(position, quaternion, forward, up, begin, end))


@jit_ieee
def _struck(position: Any, quaternion: Any, forward: Any, up: Any, begin: int, end: int, out: Any) -> None:
    """After a heel strike: a point of the sole is on the ground, and still."""
    last = position.shape[0] - 1
    least = most = reach(quaternion, forward, begin)
    for i in range(begin, end):
        rise = reach(quaternion, forward, i)
        least, most = min(least, rise), max(most, rise)
    products = _products(position, quaternion, forward, up, begin, end)
    if most - least >= LEAST_HEEL_TURN:
        out[OVER_HEEL] = _height(products)
    ff, fu, _, fp, _ = products
    ahead, above = reach(quaternion, forward, last), reach(quaternion, up, last)
    for i in range(begin, end):
        f = reach(quaternion, forward, i) - ahead
        ff += f * f
        fp += f * (position[i, 2] - position[last, 2])
        fu += f * (reach(quaternion, up, i) - above)
    out[HEEL], out[HEEL + 1] = -fp / ff, fu / ff
