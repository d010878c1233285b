"""Means, spreads and symmetry over the steady strides of a walk."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fes.analysis.parameters.definitions import STRIDE_KEYS
from fes.analysis.parameters.strides import NAN, StrideParameters

NO_SIDES = ("height_gained_m", "turn_rad")  # small differences from zero: no symmetry to speak of
NO_CV = (*NO_SIDES, "angle_contact_rad", "angle_off_rad")  # may be about zero, which a spread cannot be a share of


@dataclass(frozen=True, slots=True)
class Statistic:
    """Mean, standard deviation (n − 1) and coefficient of variation (SD over the size of the mean) of ``n`` values."""

    mean: float
    sd: float
    cv: float
    n: int


@dataclass(frozen=True, slots=True)
class Symmetry:
    """One parameter, side against side.

    ``ratio``: Patterson et al. (2010), ``first`` over ``second``; NaN where the second is about zero.
    ``index_percent``: Robinson et al. (1987), difference over the mean of both, in percent.
    """

    first: str
    second: str
    ratio: float
    index_percent: float


@dataclass(frozen=True, slots=True)
class Walk:
    """The whole walk: speed (m/s), cadence (steps/min), walk ratio (m·min), speed over belt (NaN without a belt)."""

    walking_speed_mps: float
    cadence_per_min: float
    walk_ratio_m_min: float
    belt_ratio: float


def statistic(values: Iterable[float]) -> Statistic:
    """Of the finite values; NaN where there are too few."""
    kept = np.array([value for value in values if math.isfinite(value)])
    mean = float(kept.mean()) if kept.size else NAN
    sd = float(kept.std(ddof=1)) if kept.size > 1 else NAN
    return Statistic(mean, sd, sd / abs(mean) if mean else NAN, int(kept.size))


def statistics_of(strides: Sequence[StrideParameters]) -> dict[str, Statistic]:
    """Of every parameter over one foot's steady strides; no coefficient of variation for what may be about zero."""
    steady = [stride for stride in strides if stride.steady]
    found = {key: statistic(stride.values[key] for stride in steady) for key in STRIDE_KEYS}
    return {key: replace(value, cv=NAN) if key in NO_CV else value for key, value in found.items()}


def symmetry(feet: Mapping[str, Mapping[str, Statistic]], paretic: str | None = None) -> dict[str, Symmetry]:
    """Of every parameter, the paretic side over the other; left over right where ``paretic`` is None.

    Empty without two feet. Parameters that may be negative or pass through zero get the index only where both sides
    have the same sign.
    """
    if set(feet) != {"left_foot", "right_foot"}:
        return {}
    first = "right" if paretic == "right" else "left"
    second = "left" if first == "right" else "right"
    found = {}
    for key in STRIDE_KEYS:
        if key in NO_SIDES:
            continue
        a, b = feet[f"{first}_foot"][key].mean, feet[f"{second}_foot"][key].mean
        same = a * b > 0.0
        found[key] = Symmetry(first, second, a / b if same else NAN, 200.0 * (a - b) / (a + b) if same else NAN)
    return found


@dataclass(frozen=True, slots=True)
class Travelled:
    """How far one foot's steady strides led, how long they took, and how many they are."""

    distance_m: float = 0.0
    time_s: float = 0.0
    strides: int = 0

    def __add__(self, other: Travelled) -> Travelled:
        return Travelled(self.distance_m + other.distance_m, self.time_s + other.time_s, self.strides + other.strides)


def travelled(strides: Sequence[StrideParameters]) -> Travelled:
    """Of one foot's steady strides whose time is known."""
    steady = [s for s in strides if s.steady and math.isfinite(s.values["stride_time_s"])]
    time_s = sum(stride.values["stride_time_s"] for stride in steady)
    return Travelled(sum(stride.values["stride_length_common_m"] for stride in steady), time_s, len(steady))


def walk_of(feet: Mapping[str, Sequence[StrideParameters]], belt_mps: float | None) -> Walk:
    """Speed, cadence and walk ratio over the steady strides, mean of the feet."""
    return walk_of_sums([travelled(strides) for strides in feet.values()], belt_mps)


def walk_of_sums(feet: Iterable[Travelled], belt_mps: float | None) -> Walk:
    """As :func:`walk_of`, of what is already added up."""
    went = [foot for foot in feet if foot.strides and foot.time_s > 0.0]
    if not went:
        return Walk(NAN, NAN, NAN, NAN)
    speed = float(np.mean([foot.distance_m / foot.time_s for foot in went]))
    cadence = float(np.mean([120.0 * foot.strides / foot.time_s for foot in went]))
    length = float(np.mean([foot.distance_m / foot.strides for foot in went]))
    return Walk(speed, cadence, 0.5 * length / cadence, speed / belt_mps if belt_mps else NAN)
