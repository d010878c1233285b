"""Rows of the report's gait parameters: numbers as people read them, and which strides in them want care."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from fes.analysis.parameters.definitions import DEFINITIONS, STRIDE_KEYS
from fes.analysis.parameters.gait import GaitParameters, Statistic
from fes.report.glossary import NORMS, SPEED_CLASSES_SOURCE, speed_class
from fes.report.quality import CLIPPED_ACC, CLIPPED_GYR, LOST, UNSURE, Flag, describe_flags
from fes.report.text import DIGITS, number, readable

_TIMES: Final = (
    *("stride_time_s", "swing_s", "stance_s", "swing_share", "stance_share", "step_time_s"),
    *("double_support_s", "double_support_share"),
)
_ANGLES: Final = ("heel_rotation_rad", "angle_contact_rad", "angle_off_rad", "orientation_variation_rad", "turn_rad")
_MIXED: Final = ("speed_mps", "step_length_m", "angle_contact_rad", "angle_off_rad")  # need a contact, too


@dataclass(frozen=True, slots=True)
class SideCell:
    """One side's numbers as text; ``flagged`` of the ``n`` strides carry a flag that touches this parameter."""

    foot: str
    mean: str
    sd: str
    cv: str
    n: int
    flagged: int
    why: str


@dataclass(frozen=True, slots=True)
class ParameterRow:
    """One parameter: of a stride on both sides, or of the whole walk (then ``sides`` is one cell)."""

    key: str
    name: str
    unit: str
    sides: tuple[SideCell, ...]
    ratio: str
    index: str


@dataclass(frozen=True, slots=True)
class WalkRow:
    """One number of the whole walk; ``norm`` is what is usual and ``norm_detail`` says of whom, "" without a source."""

    key: str
    name: str
    value: str
    norm: str = ""
    norm_detail: str = ""


def flags_touching(key: str) -> frozenset[str]:
    """The kinds of flags that a stride parameter may be wrong by."""
    if key in _TIMES:
        return frozenset((LOST, UNSURE))
    kinds = {LOST, CLIPPED_GYR}
    kinds |= {UNSURE} if key in _MIXED else set()
    kinds |= set() if key in _ANGLES else {CLIPPED_ACC}
    return frozenset(kinds)


def scales_in_words(gait: GaitParameters) -> str:
    """By how much each foot's stride lengths were scaled so that both feet go equally far; "" where none was."""
    scaled = {foot: 100.0 * (scale - 1.0) for foot, scale in gait.common_scales.items() if scale != 1.0}
    return ", ".join(f"{readable(foot)} by {percent:+.2f} %" for foot, percent in scaled.items())


def parameter_rows(gait: GaitParameters, flags: Mapping[tuple[str, int], Sequence[Flag]]) -> list[ParameterRow]:
    """A row for every parameter of which anything is known."""
    rows = []
    for key in STRIDE_KEYS:
        if not any(found[key].n for found in gait.feet.values()):
            continue
        known, both = DEFINITIONS[key], gait.sides.get(key)
        cells = tuple(_cell(gait, foot, key, flags) for foot in gait.feet)
        ratio, index = (math.nan, math.nan) if both is None else (both.ratio, both.index_percent)
        rows.append(ParameterRow(key, known.name, known.shown, cells, number(ratio, 2), number(index, 1)))
    return rows


def walk_rows(gait: GaitParameters) -> list[WalkRow]:
    """Speed, cadence, walk ratio, speed over belt and temporal symmetry, those that are known."""
    walk, rows = gait.walk, []
    if math.isfinite(walk.walking_speed_mps):
        norm, kind = NORMS["walking_speed_mps"], speed_class(walk.walking_speed_mps)
        shown = f"{number(walk.walking_speed_mps, 2)} m/s"
        rows.append(WalkRow("walking_speed_mps", "walking speed", shown, norm.text, norm.hover()))
        rows.append(WalkRow("speed_class", "speed class after stroke", kind, "Perry et al. 1995", SPEED_CLASSES_SOURCE))
    for key, digits in (("cadence_per_min", 1), ("walk_ratio_m_min", 1), ("belt_ratio", 3)):
        known, value = DEFINITIONS[key], getattr(walk, key)
        if math.isfinite(value):
            rows.append(WalkRow(key, known.name, f"{number(known.factor * value, digits)} {known.shown}".strip()))
    ratio = temporal_symmetry(gait)
    if math.isfinite(ratio):
        norm = NORMS["temporal_symmetry"]
        rows.append(WalkRow("temporal_symmetry", "temporal symmetry", number(ratio, 2), norm.text, norm.hover()))
    return rows


def temporal_symmetry(gait: GaitParameters) -> float:
    """Patterson et al. (2008): swing over stance time of one side over that of the other; NaN without two feet.

    Paretic over other side, left over right where no side was named.
    """
    if set(gait.feet) != {"left_foot", "right_foot"}:
        return math.nan
    first = "right_foot" if gait.paretic == "right" else "left_foot"
    second = "left_foot" if first == "right_foot" else "right_foot"
    parts = [gait.feet[foot]["swing_s"].mean / gait.feet[foot]["stance_s"].mean for foot in (first, second)]
    return parts[0] / parts[1] if parts[1] > 0 else math.nan


def _cell(gait: GaitParameters, foot: str, key: str, flags: Mapping[tuple[str, int], Sequence[Flag]]) -> SideCell:
    value: Statistic = gait.feet[foot][key]
    known, kinds, rows = DEFINITIONS[key], flags_touching(key), gait.strides[foot]
    digits = DIGITS[known.shown]
    own = [
        [flag for flag in flags.get((foot, number), ()) if flag.kind in kinds]
        for number in rows["number"][rows["steady"] & np.isfinite(rows[key])].tolist()
    ]
    flagged = sum(bool(each) for each in own)
    why = f"{flagged} of these {value.n} strides of the {readable(foot)} may be off: {describe_flags(own)}"
    mean, sd = (number(known.factor * each, digits) for each in (value.mean, value.sd))
    return SideCell(foot, mean, sd, number(100.0 * value.cv, 1), value.n, flagged, why if flagged else "")
