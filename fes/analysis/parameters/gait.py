"""All gait parameters of an analysed recording: of strides, of sides, of the walk; as rows and as plain values.

Means, spreads and symmetry are over the steady strides. Also the mean stride of each foot and its spread (Figure 5 of
Wang et al. 2013, from the project's own strides, stretched to the same length in time, each in its own frame: x along
it, y to the left, z up), and the parameters of a recording that was analysed in chunks.

A stride runs from mid-stance to mid-stance and holds one swing. Times of contact belong to the stride that they end:
its stride time, stance and double support are those between the contact before and its own.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from fes.analysis.parameters.contacts import Swings, no_swings, swings_of
from fes.analysis.parameters.definitions import DEFINITIONS, STRIDE_KEYS
from fes.analysis.parameters.motion import MOTION_KEYS, motions, pitches, variations
from fes.analysis.parameters.steps import (
    LONGEST_STANCE_S,
    MOST_TURN_RAD,
    Steps,
    equalise_sides,
    seconds_between,
    step_lengths,
    steps_of,
)
from fes.analysis.results import Analysis
from fes.analysis.tables import Table, join_tables, table_of
from fes.estimation.clearance.clearance import FootArms, FootPaths, arms_of
from fes.estimation.strides.boundaries import UNSEEN_NS
from fes.estimation.strides.schema import Column
from fes.recording.chunks import at_once
from fes.signals import FOOT_SENSORS, NS_PER_S, FloatArray, IntArray, StrideResult
from fes.walk_record import finite_or_none

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


NAN = math.nan

ABOUT_ZERO = ("height_gained_m", "turn_rad")  # small differences: no symmetry to speak of
NO_SIDES = (*ABOUT_ZERO, "stride_length_common_m")  # whose sides were made equal
NO_CV = (*ABOUT_ZERO, "angle_contact_rad", "angle_off_rad")  # may be about zero, which a spread cannot be a share of


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
    every = np.asarray(values, np.float64)
    kept = every[np.isfinite(every)]
    mean = float(kept.mean()) if kept.size else NAN
    sd = float(kept.std(ddof=1)) if kept.size > 1 else NAN
    return Statistic(mean, sd, sd / abs(mean) if mean else NAN, int(kept.size))


def statistics_of(strides: Table) -> dict[str, Statistic]:
    """Of every parameter over one foot's steady strides; no coefficient of variation for what may be about zero."""
    return _without_cv({key: statistic(strides[key][strides["steady"]]) for key in STRIDE_KEYS})


def _without_cv(found: dict[str, Statistic]) -> dict[str, Statistic]:
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


def travelled(strides: Table) -> FloatArray:
    """How far (m) one foot's steady strides whose time is known led, how long they took (s), and how many they are."""
    length_m, time_s = (strides[key][strides["steady"]] for key in ("stride_length_common_m", "stride_time_s"))
    known = np.isfinite(time_s)
    return np.array([length_m[known].sum(), time_s[known].sum(), np.count_nonzero(known)], np.float64)


def walk_of(feet: Iterable[FloatArray], belt_mps: float | None) -> Walk:
    """Speed, cadence and walk ratio of what the feet have :func:`travelled`, mean of the feet."""
    went = [(distance_m, time_s, strides) for distance_m, time_s, strides in feet if strides and time_s > 0.0]
    if not went:
        return Walk(NAN, NAN, NAN, NAN)
    speed = float(np.mean([distance_m / time_s for distance_m, time_s, _ in went]))
    cadence = float(np.mean([120.0 * strides / time_s for _, time_s, strides in went]))
    length = float(np.mean([distance_m / strides for distance_m, _, strides in went]))
    return Walk(speed, cadence, 0.5 * length / cadence, speed / belt_mps if belt_mps else NAN)


LEAST_STRIDES = 2
NO_STRIDES = Table.from_rows(PARAMETER_COLUMNS, [])


@dataclass(frozen=True, slots=True)
class MeanStride:
    """K points of one foot's steady strides: ``mean`` and ``sd`` (K, 4) of x, y, z (m) and pitch (rad), of ``n``."""

    foot: str
    mean: FloatArray
    sd: FloatArray
    n: int

    def rows(self) -> list[dict[str, Any]]:
        """One flat row per point, units in the names."""
        names = ("x_m", "y_m", "z_m", "pitch_rad")
        share = np.linspace(0.0, 100.0, len(self.mean))
        columns = ("foot", "stride_percent", *names, *(f"{name}_sd" for name in names), "strides")
        numbers = np.column_stack((share, self.mean, self.sd)).tolist()
        return [dict(zip(columns, (self.foot, *row, self.n), strict=True)) for row in numbers]


def mean_strides(strides: Sequence[StrideResult], parameters: Mapping[str, Table]) -> list[MeanStride]:
    """Of every foot with at least two steady strides; ``parameters`` say which of all ``strides`` are."""
    out = []
    for foot, rows in parameters.items():
        steady = set(rows["number"][rows["steady"]].tolist())
        own = [s for s in strides if s.foot == foot and s.number in steady and len(s.trajectory_m)]
        if len(own) < LEAST_STRIDES:
            continue
        every = np.dstack((np.array([s.trajectory_m for s in own]), np.array([s.pitch_rad for s in own])))
        out.append(MeanStride(foot, every.mean(axis=0), every.std(axis=0, ddof=1), len(own)))
    return out


@dataclass(frozen=True)
class GaitParameters:
    """Of a whole recording."""

    strides: dict[str, Table]  # by foot, a row a valid stride, by time; fes.analysis.parameters.gait has the columns
    feet: dict[str, dict[str, Statistic]]  # by foot, of every stride parameter over the steady strides
    sides: dict[str, Symmetry]  # by parameter, the two sides compared; empty with one foot
    walk: Walk
    paretic: str | None  # the side that ``sides`` counts from: "left", "right", or None where nobody named one
    no_step_lengths: str  # why there are none, else ""
    # by foot, what its stride lengths were scaled by so that both feet go equally far
    common_scales: Mapping[str, float] = field(default_factory=dict)

    def __repr__(self) -> str:
        feet = "; ".join(
            f"{foot} {len(own)} strides, {int(own['steady'].sum())} steady" for foot, own in self.strides.items()
        )
        return f"GaitParameters: {feet or 'no stride'}; .summary and .table have the numbers"

    @property
    def table(self) -> Table:
        """A row a valid stride, by time."""
        by_foot = (self.strides[foot] for foot in sorted(self.strides))
        return join_tables([NO_STRIDES, *by_foot]).sorted_by("t_start_s")

    @property
    def summary(self) -> Table:
        """Means of each foot, the sides compared, the walk's own: a row a number."""
        return table_of(self.summary_rows())

    def summary_rows(self) -> list[dict[str, Any]]:
        """One flat row per foot and parameter, then one per parameter with the sides compared, then the walk's.

        ``value`` is the mean for a foot, the symmetry ratio for both; units stand in ``unit``.
        """
        rows: list[dict[str, Any]] = []
        for foot, found in self.feet.items():
            for key, value in found.items():
                shown = {"value": value.mean, "sd": value.sd, "cv": value.cv, "n": value.n}
                rows.append(_summary_row(foot, key, DEFINITIONS[key].unit) | shown)
        for key, both in self.sides.items():
            shown = {"value": both.ratio, "symmetry_index_percent": both.index_percent}
            rows.append(_summary_row(f"{both.first}/{both.second}", key, "1") | shown)
        for key, number in asdict(self.walk).items():
            rows.append(_summary_row("walk", key, DEFINITIONS[key].unit) | {"value": number})
        return rows

    def to_json(self) -> dict[str, Any]:
        """Plain values, null for what is not known."""
        feet = {foot: {key: asdict(value) for key, value in found.items()} for foot, found in self.feet.items()}
        return {
            "walk": finite_or_none(asdict(self.walk)),
            "feet": finite_or_none(feet),
            "sides": {key: finite_or_none(asdict(both)) for key, both in self.sides.items()},
            "afflicted": self.paretic,
            "stride_length_common_scale": dict(self.common_scales),
            "no_step_lengths": self.no_step_lengths,
        }


def gait_parameters(analysis: Analysis, *, paretic: str | None = None) -> GaitParameters:
    """The parameters of all feet with their own sensor.

    ``paretic`` is "left" or "right", for the comparison of the sides; None where nobody knows.
    """
    feet = [foot for foot in FOOT_SENSORS if foot in analysis.events]
    found = analysis.stride_columns
    every = {foot: found[found["foot"] == foot] for foot in feet}
    valid = {foot: own[own["valid"]] for foot, own in every.items()}
    scales = equalise_sides(every)

    def seen(foot: str) -> tuple[Swings, Swings, dict[str, FloatArray]]:
        """All its swings, those of its valid strides, and what the paths of these show."""
        paths = analysis.blocks[foot].paths()
        pitch = pitches(paths)
        swings = swings_of(paths, pitch, analysis.events[foot], _arms(analysis, foot))
        places = paths.places(valid[foot]["number"])
        own = Swings(*(times[places] for times in swings))
        return swings, own, motion_of(valid[foot], paths.chosen(places), pitch, own)

    of_feet = at_once(seen, feet)
    own_swings = {foot: own for foot, (_, own, _) in of_feet.items()}
    tracks = [analysis.recording.tracks[foot] for foot in feet]
    lengths, why = dict[str, FloatArray](), "no foot sensor"
    if tracks:
        span = max(int(track.t_sensor_ns[0]) for track in tracks), min(int(track.t_sensor_ns[-1]) for track in tracks)
        lengths, why = step_lengths(every, own_swings, span, scales)
    strides = {}
    for foot in feet:
        _, own, motion = of_feet[foot]
        other = next((of_feet[name][0] for name in feet if name != foot), no_swings(0))
        steps = steps_of(valid[foot], own, other)
        strides[foot] = stride_parameters(valid[foot], motion, own, steps, lengths.get(foot), scales[foot])
    means = {foot: statistics_of(rows) for foot, rows in strides.items()}
    walk = walk_of(map(travelled, strides.values()), analysis.recording.belt_speed_mps)
    return GaitParameters(strides, means, symmetry(means, paretic), walk, paretic, why, scales)


def _arms(analysis: Analysis, foot: str) -> FootArms | None:
    known = analysis.points.get(foot)
    return None if known is None or known.geometry is None else arms_of(known.geometry)


def _summary_row(of: str, key: str, unit: str) -> dict[str, Any]:
    """A row of the summary whose numbers are not known yet."""
    blank = dict.fromkeys(("value", "sd", "cv"), math.nan)
    return {"of": of, "parameter": key, "unit": unit, **blank, "n": 0, "symmetry_index_percent": math.nan}


class ChunkedGait:
    """Adds up the parameters of chunk after chunk; what it keeps does not grow with them.

    Which strides are steady is asked within each chunk.
    """

    def __init__(self, belt_mps: float | None) -> None:
        self._belt_mps = belt_mps
        self._feet: dict[str, dict[str, Statistic]] = {}
        self._travelled: dict[str, FloatArray] = {}
        self._means: dict[str, MeanStride] = {}
        self._no_step_lengths = ""
        self._step_lengths = False

    def add(self, parameters: GaitParameters, strides: Sequence[StrideResult]) -> None:
        """One more chunk: its parameters, and all of its strides."""
        for foot, found in parameters.feet.items():
            known = self._feet.get(foot)
            self._feet[foot] = _without_cv({k: pooled(known[k], found[k]) for k in STRIDE_KEYS}) if known else found
        for foot, rows in parameters.strides.items():
            self._travelled[foot] = self._travelled.get(foot, np.zeros(3)) + travelled(rows)
        for one in mean_strides(strides, parameters.strides):
            before = self._means.get(one.foot)
            self._means[one.foot] = one if before is None else _mean_together(before, one)
        self._step_lengths = self._step_lengths or not parameters.no_step_lengths
        self._no_step_lengths = parameters.no_step_lengths

    def parameters(self) -> GaitParameters:
        """Of all chunks; the strides themselves are not kept."""
        none = dict.fromkeys(self._feet, NO_STRIDES)
        walk = walk_of(self._travelled.values(), self._belt_mps)
        why = "" if self._step_lengths else self._no_step_lengths
        return GaitParameters(none, self._feet, symmetry(self._feet), walk, None, why)

    def mean_strides(self) -> list[MeanStride]:
        """The mean stride of each foot over all chunks."""
        return list(self._means.values())


def pooled(one: Statistic, other: Statistic) -> Statistic:
    """Of two sets of values as if they were one (Chan, Golub and LeVeque 1983)."""
    if not one.n or not other.n:
        return one if one.n else other
    n, difference = one.n + other.n, other.mean - one.mean
    squares = sum((each.n - 1) * each.sd**2 for each in (one, other) if each.n > 1)
    squares += difference**2 * one.n * other.n / n
    mean, sd = one.mean + difference * other.n / n, math.sqrt(squares / (n - 1))
    return Statistic(mean, sd, sd / abs(mean) if mean else NAN, n)


def _mean_together(one: MeanStride, other: MeanStride) -> MeanStride:
    n, difference = one.n + other.n, other.mean - one.mean
    squares = (one.n - 1) * one.sd**2 + (other.n - 1) * other.sd**2 + difference**2 * one.n * other.n / n
    return MeanStride(one.foot, one.mean + difference * other.n / n, np.sqrt(squares / (n - 1)), n)
