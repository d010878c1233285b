"""The gait parameters of single strides: a table of each foot, a row a valid stride.

A stride runs from mid-stance to mid-stance and holds one swing. Times of contact belong to the stride that they end:
its stride time, stance and double support are those between the contact before and its own.
"""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from fes.analysis.parameters.contacts import Swings
from fes.analysis.parameters.definitions import DEFINITIONS, STRIDE_KEYS
from fes.analysis.parameters.motion import MOTION_KEYS, motions, variations
from fes.analysis.parameters.steps import LONGEST_STANCE_S, MOST_TURN_RAD, Steps, seconds_between
from fes.analysis.tables import Table
from fes.estimation.clearance.clearance import FootPaths
from fes.estimation.strides.boundaries import UNSEEN_NS
from fes.estimation.strides.schema import Column
from fes.signals import NS_PER_S, FloatArray, IntArray

STEADY_SHARE = 0.3
STEADY = "within 30 % of the median stride's length, and turning by no more than 20°; only such count in means"
PARAMETER_COLUMNS = (
    Column("foot", str, "", "the sensor that it is from"),
    Column("number", int, "", "the stride's, counted from 1"),
    Column("t_start_s", float, "s", "the mid-stance where it begins"),
    Column("t_foot_off_s", float, "s", "foot off (FO), empty where it was not seen"),
    Column("t_contact_s", float, "s", "initial contact (IC), likewise"),
    Column("t_end_s", float, "s", "the mid-stance where it ends"),
    Column("steady", bool, "", STEADY),
    Column("stride_length_m", float, "m", "as measured, before it is scaled to stride_length_common_m"),
    *(Column(key, float, DEFINITIONS[key].unit, DEFINITIONS[key].text, DEFINITIONS[key].source) for key in STRIDE_KEYS),
)
_KEPT = ("toe_clearance_m", "heel_clearance_m", "height_gained_m", "turn_rad")


def stride_parameters(
    strides: Table,
    motion: Mapping[str, FloatArray],
    swings: Swings,
    steps: Steps,
    step_lengths_m: FloatArray | None = None,
    scale: float = 1.0,
) -> Table:
    """The parameters of one foot's S valid strides by time, SI units, NaN where not known: :data:`PARAMETER_COLUMNS`.

    ``strides`` are as of ``tables.by_column``, ``motion`` is what the trajectories show, by key; ``swings``, ``steps``
    and ``step_lengths_m`` (S,) are theirs. ``scale`` is of the stride lengths
    (:func:`fes.analysis.parameters.steps.equalise_sides`).
    """
    names = ("stride_length_m", "clearance_m", *_KEPT)
    found: dict[str, Any] = {name: strides[name] for name in names} | dict(motion)
    length_m, seen = found["stride_length_m"], swings.seen
    usual = float(np.nanmedian(length_m)) if np.isfinite(length_m).any() else math.nan
    steady = (np.abs(length_m - usual) <= STEADY_SHARE * usual) & (np.abs(found["turn_rad"]) <= MOST_TURN_RAD)
    swing_s = np.where(seen, (swings.contact_ns - swings.foot_off_ns) / NS_PER_S, math.nan)
    found |= {"foot": strides["foot"], "number": strides["number"], "steady": steady}
    times = (strides["t_start_ns"], swings.foot_off_ns, swings.contact_ns, strides["t_end_ns"])
    for name, t_ns in zip(("t_start_s", "t_foot_off_s", "t_contact_s", "t_end_s"), times, strict=True):
        found[name] = np.where(t_ns == UNSEEN_NS, math.nan, 1e-9 * t_ns)
    found |= steps._asdict() | {
        "lift_m": found.pop("clearance_m"),
        "stride_length_common_m": scale * length_m,
        "step_length_m": np.full(len(strides), math.nan) if step_lengths_m is None else step_lengths_m,
        "swing_s": swing_s,
        "loading_response_s": seconds_between(swings.contact_ns, swings.foot_flat_ns),
        "pre_swing_s": seconds_between(swings.heel_rise_ns, swings.foot_off_ns),
        "speed_mps": scale * length_m / steps.stride_time_s,
    }
    for name in ("swing", "stance", "double_support"):
        found[f"{name}_share"] = found[f"{name}_s"] / steps.stride_time_s
    return Table(PARAMETER_COLUMNS, found)


def neighbours(strides: Table) -> IntArray:
    """Of a foot's strides by time, the places (P, 2) of each two that follow on each other."""
    near = np.diff(strides["number"]) == 1
    near &= strides["t_start_ns"][1:] - strides["t_end_ns"][:-1] < LONGEST_STANCE_S * NS_PER_S
    after = np.flatnonzero(near) + 1
    return np.column_stack((after - 1, after))


def motion_of(strides: Table, paths: FootPaths, pitch_rad: FloatArray, swings: Swings) -> dict[str, FloatArray]:
    """What the trajectories of one foot's valid strides show (S,), by key; ``paths`` and ``swings`` are theirs."""
    side = strides["foot"][0].removesuffix("_foot") if len(strides) else ""
    found = np.full((len(MOTION_KEYS), len(strides)), math.nan)
    found[:5] = motions(paths, pitch_rad, swings.foot_off_ns, swings.contact_ns, side).T
    pairs = neighbours(strides)
    found[5:, pairs[:, 1]] = variations(paths, pairs).T
    return dict(zip(MOTION_KEYS, found, strict=True))
