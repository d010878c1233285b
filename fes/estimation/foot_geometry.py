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

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from fes.config import FootGeometry
from fes.estimation.clearance import AnyPaths, in_one
from fes.estimation.foot_geometry_kernel import BALL, HEEL, OVER_HEEL, SIGNS, TOE, all_signs
from fes.estimation.ranks import median
from fes.signals import FloatArray

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


def estimate_geometry(paths: AnyPaths) -> EstimatedGeometry:
    """Estimate one foot's geometry from the strides of one recording; the prior where they do not show it.

    Always gives a usable geometry: what lies outside the plausible bounds is dropped, and the reason says so.
    """
    paths = in_one(paths)
    signs = np.empty((SIGNS, len(paths)))
    forward, up = paths.foot[:, 0].copy(), paths.foot[:, 2].copy()
    all_signs(
        paths.t_ns, paths.position_m, paths.quaternion, forward, up, paths.spans, paths.swings_ns,
        np.empty(paths.longest), signs,
    )  # fmt: skip
    ball = _seen("the sensor's height", signs[BALL], MODEL_M[0], PLAUSIBLE_HEIGHT_M)
    over_heel = _seen("", signs[OVER_HEEL], MODEL_M[0], PLAUSIBLE_HEIGHT_M)
    height = ball if ball.missing or over_heel.missing else _mean(ball, over_heel)
    height_m, height_sd_m = _combine(height, *HEIGHT_M)
    toe = _seen("the toe", signs[TOE] + height_m * signs[TOE + 1], MODEL_M[1], PLAUSIBLE_TOE_M)
    heels = signs[HEEL] + height_m * signs[HEEL + 1] - HEEL_BEHIND_M
    heel = _seen("the heel", heels, MODEL_M[2], PLAUSIBLE_HEEL_M)
    if (
        not (toe.missing or heel.missing)
        and not PLAUSIBLE_SOLE_M[0] <= toe.value_m - heel.value_m <= PLAUSIBLE_SOLE_M[1]
    ):
        text = f"toe and heel came out {100.0 * (toe.value_m - heel.value_m):.0f} cm apart"
        toe, heel = _Seen(0.0, math.inf, text), _Seen(0.0, math.inf, text)
    # information about (toe, heel): what was seen of each, the prior of the toe, and the prior of their distance
    sole, toe_prior = SOLE_M[1] ** -2, TOE_M[1] ** -2
    of_toe, of_heel = toe.sd_m**-2 + toe_prior + sole, heel.sd_m**-2 + sole
    toe_total = toe.value_m * toe.sd_m**-2 + TOE_M[0] * toe_prior + SOLE_M[0] * sole
    heel_total = heel.value_m * heel.sd_m**-2 - SOLE_M[0] * sole
    determinant = of_toe * of_heel - sole * sole
    missing = list(dict.fromkeys(part.missing for part in (height, toe, heel) if part.missing))
    return EstimatedGeometry(
        geometry=FootGeometry(
            toe_forward_m=(of_heel * toe_total + sole * heel_total) / determinant,
            toe_up_m=-height_m,
            heel_forward_m=(sole * toe_total + of_toe * heel_total) / determinant,
            heel_up_m=-height_m,
        ),
        toe_forward_sd_m=math.sqrt(of_heel / determinant),
        heel_forward_sd_m=math.sqrt(of_toe / determinant),
        height_sd_m=height_sd_m,
        strides=len(paths),
        observed=not missing,
        reason="; ".join(missing),
    )


def _seen(what: str, each: FloatArray, model_m: float, bounds_m: tuple[float, float]) -> _Seen:
    values = each[np.isfinite(each)]
    if len(values) < LEAST_STRIDES:
        return _Seen(0.0, math.inf, f"{what} shows in {len(values)} strides only, {LEAST_STRIDES} are needed")
    middle = median(values)
    if not bounds_m[0] <= middle <= bounds_m[1]:
        return _Seen(0.0, math.inf, f"{what} came out at {100.0 * middle:.0f} cm, which no foot has")
    spread = 1.4826 * median(np.abs(values - middle))
    return _Seen(middle, math.hypot(1.25 * spread / math.sqrt(len(values)), model_m))


def _mean(one: _Seen, other: _Seen) -> _Seen:
    return _Seen(0.5 * (one.value_m + other.value_m), 0.5 * (one.sd_m + other.sd_m))


def _combine(seen: _Seen, mean_m: float, sd_m: float) -> tuple[float, float]:
    weight = seen.sd_m**-2 + sd_m**-2
    return (seen.value_m * seen.sd_m**-2 + mean_m * sd_m**-2) / weight, weight**-0.5
