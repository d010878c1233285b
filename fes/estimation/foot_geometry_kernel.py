"""What one stride shows of toe and heel, compiled; :mod:`fes.estimation.foot_geometry` says what and why."""

from __future__ import annotations

import math
from typing import Any

from fes.estimation.clearance_kernel import index_at
from fes.estimation.compiled import jit
from fes.estimation.stride_time import UNSEEN_NS

BALL_PITCH_RAD = (-0.09, -0.38)  # the heel has risen, and the foot still turns about the ball
LEAST_TOE_TILT = 0.3  # sine of the angle at foot off, and …
LEAST_HEEL_TILT = 0.14  # … at contact, below which an arm does not show
LEAST_HEEL_TURN = 0.1  # change of that sine from which the centre's height shows
HEEL_WINDOW_NS = (5_000_000, 60_000_000)  # after contact is known
SIGNS = 6
BALL, OVER_HEEL, TOE, HEEL = 0, 1, 2, 4  # the last two: at no height, and per metre of the sensor's height


@jit
def _pitch(axes: Any, i: int) -> float:
    return math.asin(min(max(axes[i, 2, 0], -1.0), 1.0))


@jit
def _height(position: Any, axes: Any, begin: int, end: int) -> float:
    """Height of the sensor over the point that stands still in ``begin`` … ``end - 1``: least squares for its arm."""
    ff = fu = uu = fm = um = 0.0
    n = end - begin
    for j in range(3):
        f_mean = u_mean = p_mean = 0.0
        for i in range(begin, end):
            f_mean += axes[i, j, 0] / n
            u_mean += axes[i, j, 2] / n
            p_mean += position[i, j] / n
        for i in range(begin, end):
            f, u, m = axes[i, j, 0] - f_mean, axes[i, j, 2] - u_mean, position[i, j] - p_mean
            ff += f * f
            fu += f * u
            uu += u * u
            fm -= f * m
            um -= u * m
    determinant = ff * uu - fu * fu
    return -(ff * um - fu * fm) / determinant if determinant > 0.0 else math.nan


@jit
def signs_of(t_ns: Any, position: Any, axes: Any, off_ns: int, contact_ns: int, out: Any) -> None:
    """Fill ``out`` (6,) from a stride's path, NaN for what it does not show.

    Height of the sensor over the ball while the heel rises, and over the heel after its strike; the toe's distance
    forward if the sensor were at no height, and what a metre of height adds; the same of the heel.
    """
    out[:] = math.nan
    n = t_ns.shape[0]
    if off_ns != UNSEEN_NS:
        # the fastest turn toe-down up to foot off: a session may place foot off later than that
        end = index_at(t_ns, off_ns) + 1
        if end > 3:
            off, fastest, before = 0, math.inf, _pitch(axes, 0)
            for i in range(1, min(end + 1, n)):
                pitch = _pitch(axes, i)
                if pitch - before < fastest:
                    off, fastest = i - 1, pitch - before
                before = pitch
            _ball(position, axes, off, out)
            forward, up = axes[off, 2, 0] - axes[0, 2, 0], axes[off, 2, 2] - axes[0, 2, 2]
            if forward <= -LEAST_TOE_TILT:
                out[TOE], out[TOE + 1] = -position[off, 2] / forward, up / forward
    if contact_ns != UNSEEN_NS:
        begin = index_at(t_ns, contact_ns + HEEL_WINDOW_NS[0])
        end = index_at(t_ns, contact_ns + HEEL_WINDOW_NS[1])
        # angles count from the stance that follows: it is nearer, and on stairs
        if axes[begin, 2, 0] - axes[n - 1, 2, 0] >= LEAST_HEEL_TILT and end - begin >= 3:
            _struck(position, axes, begin, end, out)


@jit
def all_signs(t_ns: Any, position: Any, axes: Any, spans: Any, swings: Any, out: Any) -> None:
    """As :func:`signs_of` of every stride: rows ``spans`` (K, 2), swings (K, 2); ``out`` (K, 6)."""
    for k in range(spans.shape[0]):
        a, b = spans[k, 0], spans[k, 1]
        signs_of(t_ns[a:b], position[a:b], axes[a:b], swings[k, 0], swings[k, 1], out[k])


@jit
def _ball(position: Any, axes: Any, off: int, out: Any) -> None:
    """While the heel rises, up to foot off."""
    level = _pitch(axes, 0)
    begin = off
    while begin > 0 and _pitch(axes, begin) - level <= BALL_PITCH_RAD[0]:
        begin -= 1
    end = begin
    least = most = _pitch(axes, begin)
    while end <= off and _pitch(axes, end) - level >= BALL_PITCH_RAD[1]:
        least, most = min(least, _pitch(axes, end)), max(most, _pitch(axes, end))
        end += 1
    if end - begin >= 4 and most - least >= 0.5 * (BALL_PITCH_RAD[0] - BALL_PITCH_RAD[1]):
        out[BALL] = _height(position, axes, begin, end)


@jit
def _struck(position: Any, axes: Any, begin: int, end: int, out: Any) -> None:
    """After a heel strike: a point of the sole is on the ground, and still."""
    n, last = end - begin, position.shape[0] - 1
    least = most = axes[begin, 2, 0]
    for i in range(begin, end):
        least, most = min(least, axes[i, 2, 0]), max(most, axes[i, 2, 0])
    if most - least >= LEAST_HEEL_TURN:
        out[OVER_HEEL] = _height(position, axes, begin, end)
    rows = at_none = per_metre = 0.0
    for j in range(3):
        f_mean = u_mean = p_mean = 0.0
        for i in range(begin, end):
            f_mean += axes[i, j, 0] / n
            u_mean += axes[i, j, 2] / n
            p_mean += position[i, j] / n
        for i in range(begin, end):
            f = axes[i, j, 0] - f_mean
            rows += f * f
            at_none -= f * (position[i, j] - p_mean)
            per_metre += f * (axes[i, j, 2] - u_mean)
    for i in range(begin, end):
        f = axes[i, 2, 0] - axes[last, 2, 0]
        rows += f * f
        at_none -= f * (position[i, 2] - position[last, 2])
        per_metre += f * (axes[i, 2, 2] - axes[last, 2, 2])
    out[HEEL], out[HEEL + 1] = at_none / rows, per_metre / rows
