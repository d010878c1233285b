"""Where toe and heel are, seen from the sensor, found from the walking itself when the session does not say.

The idea is Mariani et al.'s (2012): the foot turns about points of the sole that are on the ground, and that shows how
far they are from the sensor. Three things are found in turn, each per stride and then as a median over the recording:

- the sensor's height above the ground: when the heel has just risen the foot turns about the ball, and just after a
  heel strike about the heel. A shoe bends at the ball, so that its centre of rotation lies above the floor; the heel
  gives way, and its centre lies below. The mean of the two is taken (on a stiff foot they agree);
- the toe: at foot off it is the last on the ground, so the sensor's height and the foot's angle give its distance;
- the heel: just after a heel strike it is the only thing on the ground, and the foot turns about it.

What cannot be seen (a foot that lands flat shows no heel) comes from a prior: people's soles are much alike in length.
The points found are on the sole, the heel's 1 cm behind the one that touches the ground first, as heels are round.
Sideways nothing is found (roll is small, and in step with pitch): the sensor is taken to sit over the foot's axis.
"""

import math
from dataclasses import dataclass

import numpy as np

from fes.config import FootGeometry
from fes.estimation.clearance.clearance import FootPaths, reach
from fes.estimation.numerics.jit import inlined, jit_fused
from fes.estimation.numerics.records import Mat, Vec
from fes.estimation.numerics.rotation import to_world
from fes.estimation.strides.boundaries import UNSEEN_NS, index_at
from fes.signals import FloatArray

BALL_PITCH_RAD = (-0.09, -0.38)  # the heel has risen, and the foot still turns about the ball
LEAST_TOE_TILT = 0.3  # sine of the angle at foot off, and …
LEAST_HEEL_TILT = 0.14  # … at contact, below which an arm does not show
LEAST_HEEL_TURN = 0.1  # change of that sine from which the centre's height shows
HEEL_WINDOW_NS = (5_000_000, 60_000_000)  # after contact is known
SIGNS = 6
BALL, OVER_HEEL, TOE, HEEL = 0, 1, 2, 4  # the last two: at no height, and per metre of the sensor's height


@inlined
def _pointing(q: Mat, axis: Vec, i: int) -> tuple[float, float, float]:
    """An axis of the sensor in the world."""
    return to_world(q[i, 0], q[i, 1], q[i, 2], q[i, 3], axis[0], axis[1], axis[2])


@jit_fused
def _products(
    position: Mat, quaternion: Mat, forward: Vec, up: Vec, begin: int, end: int
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


@jit_fused
def all_geometry_signs(
    t_ns: Vec, position: Mat, quaternion: Mat, forward: Vec, up: Vec, spans: Mat, swings: Mat, sines: Vec, out: Vec
) -> None:
    """Fill ``out`` (6, K) from the paths of K strides, rows ``spans``, ``swings`` (K, 2), NaN for what does not show.

    Height of the sensor over the ball while the heel rises, and over the heel after its strike; the toe's distance
    forward if the sensor were at no height, and what a metre of height adds; the same of the heel. ``forward`` and
    ``up`` (3,) are in the sensor's frame, ``sines`` (N,) room for the longest stride.
    """
    for k in range(spans.shape[0]):
        for j in range(SIGNS):
            out[j, k] = math.nan
        begin, last = spans[k, 0], spans[k, 1] - 1
        if swings[k, 0] != UNSEEN_NS:
            off = index_at(t_ns, begin, last, swings[k, 0])
            if off - begin >= 3:
                _rising(position, quaternion, forward, up, begin, min(off + 1, last) + 1 - begin, sines, k, out)
        if swings[k, 1] != UNSEEN_NS:
            first = index_at(t_ns, begin, last, swings[k, 1] + HEEL_WINDOW_NS[0])
            end = index_at(t_ns, first, last, swings[k, 1] + HEEL_WINDOW_NS[1])
            # angles count from the stance that follows: it is nearer, and on stairs
            lifted = reach(quaternion, forward, first) - reach(quaternion, forward, last)
            if lifted >= LEAST_HEEL_TILT and end - first >= 3:
                _struck(position, quaternion, forward, up, first, end, last, k, out)


@inlined
def _rising(
    position: Mat, quaternion: Mat, forward: Vec, up: Vec, begin: int, n: int, sines: Vec, k: int, out: Vec
) -> None:
    """While the heel rises, in the ``n`` samples from ``begin`` up to just after foot off."""
    # the fastest turn toe-down is foot off: a session may place it later than that
    off, steepest, sine, cosine = 0, math.inf, 0.0, 0.0
    for i in range(n):
        before, level = sine, cosine
        sine = min(max(reach(quaternion, forward, begin + i), -1.0), 1.0)
        cosine = math.sqrt(1.0 - sine * sine)
        sines[i] = sine
        turned = sine * level - cosine * before  # the sine of the turn between two samples
        if i > 0 and turned < steepest:
            off, steepest = i - 1, turned
    # sines of pitches: they show which of two is the higher, and cost less
    cosine = math.sqrt(1.0 - sines[0] * sines[0])
    highest = sines[0] * math.cos(BALL_PITCH_RAD[0]) + cosine * math.sin(BALL_PITCH_RAD[0])
    lowest = -1.0  # straight down
    if sines[0] > -math.cos(BALL_PITCH_RAD[1]):
        lowest = sines[0] * math.cos(BALL_PITCH_RAD[1]) + cosine * math.sin(BALL_PITCH_RAD[1])
    first = off
    while first > 0 and sines[first] <= highest:
        first -= 1
    end, least, most = first, sines[first], sines[first]
    while end <= off and sines[end] >= lowest:
        least, most = min(least, sines[end]), max(most, sines[end])
        end += 1
    turned = most * math.sqrt(1.0 - least * least) - least * math.sqrt(1.0 - most * most)
    if end - first >= 4 and turned >= math.sin(0.5 * (BALL_PITCH_RAD[0] - BALL_PITCH_RAD[1])):
        out[BALL, k] = _height(_products(position, quaternion, forward, up, begin + first, begin + end))
    ahead = sines[off] - sines[0]
    if ahead <= -LEAST_TOE_TILT:
        above = reach(quaternion, up, begin + off) - reach(quaternion, up, begin)
        out[TOE, k], out[TOE + 1, k] = -position[begin + off, 2] / ahead, above / ahead


@inlined
def _struck(
    position: Mat, quaternion: Mat, forward: Vec, up: Vec, begin: int, end: int, last: int, k: int, out: Vec
) -> None:
    """After a heel strike: a point of the sole is on the ground, and still."""
    products = _products(position, quaternion, forward, up, begin, end)
    ff, fu, _, fp, _ = products
    ahead, above = reach(quaternion, forward, last), reach(quaternion, up, last)
    least, most = math.inf, -math.inf
    for i in range(begin, end):
        f = reach(quaternion, forward, i) - ahead
        least, most = min(least, f), max(most, f)
        ff += f * f
        fp += f * (position[i, 2] - position[last, 2])
        fu += f * (reach(quaternion, up, i) - above)
    if most - least >= LEAST_HEEL_TURN:
        out[OVER_HEEL, k] = _height(products)
    out[HEEL, k], out[HEEL + 1, k] = -fp / ff, fu / ff


HEIGHT_M = (0.065, 0.03)  # prior mean and SD of an instep or lateral sensor's height
TOE_M = (0.09, 0.05)  # prior of the toe's distance forward
SOLE_M = (0.22, 0.025)  # prior of the distance from the back of the heel to the toe's contact
PLAUSIBLE_HEIGHT_M = (0.015, 0.13)
PLAUSIBLE_TOE_M = (-0.03, 0.28)
PLAUSIBLE_HEEL_M = (-0.28, 0.03)
PLAUSIBLE_SOLE_M = (0.14, 0.32)
MODEL_M = (0.01, 0.01, 0.015)  # height, toe, heel: a shoe bends and is round, however many strides there are
LEAST_STRIDES = 3
HEEL_BEHIND_M = 0.01  # the back of the heel lies this far behind the point that touches the ground first: it is round


@dataclass(frozen=True, slots=True)
class EstimatedGeometry:
    """A geometry and the standard deviation of its parts (m).

    ``observed`` is True if height, toe and heel all came from the recording; otherwise ``reason`` says what did not.
    """

    geometry: FootGeometry
    toe_forward_sd_m: float
    heel_forward_sd_m: float
    height_sd_m: float
    strides: int
    observed: bool
    reason: str


@dataclass(frozen=True, slots=True)
class _Seen:
    """The median over strides and its standard deviation (m), or why there is none."""

    value_m: float
    sd_m: float
    missing: str = ""


def estimate_geometry(paths: FootPaths) -> EstimatedGeometry:
    """Estimate one foot's geometry from the strides of one recording; the prior where they do not show it.

    Always gives a usable geometry: what lies outside the plausible bounds is dropped, and the reason says so.
    """
    signs = np.empty((SIGNS, len(paths)))
    forward, up = paths.foot[:, 0].copy(), paths.foot[:, 2].copy()
    all_geometry_signs(
        paths.t_ns, paths.position_m, paths.quaternion, forward, up, paths.spans, paths.swings_ns,
        np.empty(paths.longest), signs,
    )  # fmt: skip
    ball = _seen("the sensor's height", signs[BALL], MODEL_M[0], PLAUSIBLE_HEIGHT_M)
    over_heel = _seen("", signs[OVER_HEEL], MODEL_M[0], PLAUSIBLE_HEIGHT_M)
    height = ball
    if not (ball.missing or over_heel.missing):
        height = _Seen(0.5 * (ball.value_m + over_heel.value_m), 0.5 * (ball.sd_m + over_heel.sd_m))
    weight = height.sd_m**-2 + HEIGHT_M[1] ** -2
    height_m, height_sd_m = (height.value_m * height.sd_m**-2 + HEIGHT_M[0] * HEIGHT_M[1] ** -2) / weight, weight**-0.5
    toe = _seen("the toe", signs[TOE] + height_m * signs[TOE + 1], MODEL_M[1], PLAUSIBLE_TOE_M)
    heels = signs[HEEL] + height_m * signs[HEEL + 1] - HEEL_BEHIND_M
    heel = _seen("the heel", heels, MODEL_M[2], PLAUSIBLE_HEEL_M)
    apart_m = toe.value_m - heel.value_m
    if not (toe.missing or heel.missing or PLAUSIBLE_SOLE_M[0] <= apart_m <= PLAUSIBLE_SOLE_M[1]):
        toe = heel = _Seen(0.0, math.inf, f"toe and heel came out {100.0 * apart_m:.0f} cm apart")
    # information about (toe, heel): what was seen of each, the prior of the toe, and the prior of their distance
    sole, toe_prior = SOLE_M[1] ** -2, TOE_M[1] ** -2
    of_toe, of_heel = toe.sd_m**-2 + toe_prior + sole, heel.sd_m**-2 + sole
    toe_total = toe.value_m * toe.sd_m**-2 + TOE_M[0] * toe_prior + SOLE_M[0] * sole
    heel_total = heel.value_m * heel.sd_m**-2 - SOLE_M[0] * sole
    determinant = of_toe * of_heel - sole * sole
    missing = list(dict.fromkeys(part.missing for part in (height, toe, heel) if part.missing))
    geometry = FootGeometry(
        toe_forward_m=(of_heel * toe_total + sole * heel_total) / determinant, toe_up_m=-height_m,
        heel_forward_m=(sole * toe_total + of_toe * heel_total) / determinant, heel_up_m=-height_m,
    )  # fmt: skip
    toe_sd_m, heel_sd_m = math.sqrt(of_heel / determinant), math.sqrt(of_toe / determinant)
    return EstimatedGeometry(geometry, toe_sd_m, heel_sd_m, height_sd_m, len(paths), not missing, "; ".join(missing))


def _seen(what: str, each: FloatArray, model_m: float, bounds_m: tuple[float, float]) -> _Seen:
    values = each[np.isfinite(each)]
    if len(values) < LEAST_STRIDES:
        return _Seen(0.0, math.inf, f"{what} shows in {len(values)} strides only, {LEAST_STRIDES} are needed")
    middle = float(np.median(values))
    if not bounds_m[0] <= middle <= bounds_m[1]:
        return _Seen(0.0, math.inf, f"{what} came out at {100.0 * middle:.0f} cm, which no foot has")
    spread = 1.4826 * float(np.median(np.abs(values - middle)))
    return _Seen(middle, math.hypot(1.25 * spread / math.sqrt(len(values)), model_m))
