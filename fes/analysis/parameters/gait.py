"""All gait parameters of an analysed recording: of strides, of sides, of the walk; as rows and as plain values.

Also the mean stride of each foot and its spread (Figure 5 of Wang et al. 2013, from the project's own strides,
stretched to the same length in time, each in its own frame: x along it, y to the left, z up), and the parameters of a
recording that was analysed in chunks: means and spreads of all, kept as sums.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from fes.analysis.parameters.contacts import Swing, swing_of
from fes.analysis.parameters.definitions import DEFINITIONS, STRIDE_KEYS
from fes.analysis.parameters.steps import Step, equalise_sides, step_lengths, steps_by_number
from fes.analysis.parameters.strides import NAN, StrideParameters, stride_parameters
from fes.analysis.parameters.summary import (
    NO_CV,
    Statistic,
    Symmetry,
    Travelled,
    Walk,
    statistics_of,
    symmetry,
    travelled,
    walk_of,
    walk_of_sums,
)
from fes.analysis.results import Analysis
from fes.analysis.tables import Table, table_of
from fes.estimation.clearance.clearance import FootArms, arms_of
from fes.signals import FOOT_SENSORS, FloatArray, StrideResult

LEAST_STRIDES = 2


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
        return [
            {
                "foot": self.foot,
                "stride_percent": float(at),
                **{name: float(value) for name, value in zip(names, mean, strict=True)},
                **{f"{name}_sd": float(value) for name, value in zip(names, sd, strict=True)},
                "strides": self.n,
            }
            for at, mean, sd in zip(share, self.mean, self.sd, strict=True)
        ]


def mean_strides(
    strides: Sequence[StrideResult], parameters: Mapping[str, Sequence[StrideParameters]]
) -> list[MeanStride]:
    """Of every foot with at least two steady strides.

    Args:
        strides: all strides, of all feet.
        parameters: by foot, which of them are steady.
    """
    out = []
    for foot, rows in parameters.items():
        steady = {row.number for row in rows if row.steady}
        own = [s for s in strides if s.foot == foot and s.number in steady and len(s.trajectory_m)]
        if len(own) < LEAST_STRIDES:
            continue
        every = np.array([np.column_stack((s.trajectory_m, s.pitch_rad)) for s in own])
        out.append(MeanStride(foot, every.mean(axis=0), every.std(axis=0, ddof=1), len(own)))
    return out


@dataclass(frozen=True)
class GaitParameters:
    """Of a whole recording.

    Attributes:
        strides: by foot, valid strides by time.
        feet: by foot, mean, SD and CV of every stride parameter over the steady strides.
        sides: by parameter, the two sides compared; empty with one foot.
        walk: speed, cadence, walk ratio.
        paretic: the side that ``sides`` counts from: "left", "right", or None where nobody named one.
        no_step_lengths: why there are none, else "".
        common_scales: by foot, what its stride lengths were scaled by so that both feet go equally far.
    """

    strides: dict[str, list[StrideParameters]]
    feet: dict[str, dict[str, Statistic]]
    sides: dict[str, Symmetry]
    walk: Walk
    paretic: str | None
    no_step_lengths: str
    common_scales: Mapping[str, float] = field(default_factory=dict)

    @property
    def table(self) -> Table:
        """A row a valid stride, by time."""
        return table_of(self.rows())

    @property
    def summary(self) -> Table:
        """Means of each foot, the sides compared, the walk's own: a row a number."""
        return table_of(self.summary_rows())

    def rows(self) -> list[dict[str, Any]]:
        """One flat row per stride, by time."""
        every = [stride.row() for strides in self.strides.values() for stride in strides]
        return sorted(every, key=lambda row: (row["t_start_s"], row["foot"]))

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
        return {
            "walk": _plain(asdict(self.walk)),
            "feet": {
                foot: {key: _plain(asdict(value)) for key, value in found.items()} for foot, found in self.feet.items()
            },
            "sides": {key: _plain(asdict(both)) for key, both in self.sides.items()},
            "afflicted": self.paretic,
            "stride_length_common_scale": dict(self.common_scales),
            "no_step_lengths": self.no_step_lengths,
        }


def gait_parameters(analysis: Analysis, *, paretic: str | None = None) -> GaitParameters:
    """The parameters of all feet with their own sensor.

    Args:
        analysis: from :func:`fes.analysis.pipeline.analyse`.
        paretic: "left" or "right", for the comparison of the sides; None where nobody knows.
    """
    feet = [foot for foot in FOOT_SENSORS if foot in analysis.events]
    swings = {foot: _swings(analysis, foot) for foot in feet}
    every = {foot: [s for s in analysis.strides if s.foot == foot] for foot in feet}
    scales = equalise_sides(every)
    numbered = {foot: [s for s in own if s.valid] for foot, own in every.items()}
    steps = {foot: _steps(foot, swings, numbered[foot]) for foot in feet}
    lengths, why = _lengths(analysis, every, swings, scales)
    strides = {
        foot: stride_parameters(
            numbered[foot],
            {path.number: path for path in analysis.stride_paths.get(foot, [])},
            swings[foot],
            steps[foot],
            lengths.get(foot, {}),
            scales[foot],
        )
        for foot in feet
    }
    found = {foot: statistics_of(rows) for foot, rows in strides.items()}
    walk = walk_of(strides, analysis.recording.belt_speed_mps)
    return GaitParameters(strides, found, symmetry(found, paretic), walk, paretic, why, scales)


def _swings(analysis: Analysis, foot: str) -> dict[int, Swing]:
    known = analysis.points.get(foot)
    arms: FootArms | None = arms_of(known.geometry) if known is not None and known.geometry is not None else None
    every = {path.number: swing_of(path, analysis.events[foot], arms) for path in analysis.stride_paths.get(foot, [])}
    return {number: swing for number, swing in every.items() if swing is not None}


def _steps(foot: str, swings: Mapping[str, Mapping[int, Swing]], strides: Sequence[StrideResult]) -> dict[int, Step]:
    other = next((name for name in swings if name != foot), None)
    others = list(swings[other].values()) if other is not None else []
    return steps_by_number(strides, swings[foot], others)


def _lengths(
    analysis: Analysis,
    strides: Mapping[str, Sequence[StrideResult]],
    swings: Mapping[str, Mapping[int, Swing]],
    scales: Mapping[str, float],
) -> tuple[dict[str, dict[int, float]], str]:
    tracks = [analysis.recording.tracks[foot] for foot in strides]
    if not tracks:
        return {}, "no foot sensor"
    span = max(int(track.t_sensor_ns[0]) for track in tracks), min(int(track.t_sensor_ns[-1]) for track in tracks)
    return step_lengths(strides, swings, span, scales)


def _summary_row(of: str, key: str, unit: str) -> dict[str, Any]:
    """A row of the summary whose numbers are not known yet."""
    blank = dict.fromkeys(("value", "sd", "cv"), math.nan)
    return {"of": of, "parameter": key, "unit": unit, **blank, "n": 0, "symmetry_index_percent": math.nan}


def _plain(values: Mapping[str, Any]) -> dict[str, Any]:
    return {key: None if isinstance(v, float) and not math.isfinite(v) else v for key, v in values.items()}


class ChunkedGait:
    """Adds up the parameters of chunk after chunk; what it keeps does not grow with them.

    Which strides are steady is asked within each chunk.
    """

    def __init__(self, belt_mps: float | None) -> None:
        self._belt_mps = belt_mps
        self._feet: dict[str, dict[str, Statistic]] = {}
        self._travelled: dict[str, Travelled] = {}
        self._means: dict[str, MeanStride] = {}
        self._no_step_lengths = ""
        self._step_lengths = False

    def add(self, parameters: GaitParameters, strides: Sequence[StrideResult]) -> None:
        """One more chunk: its parameters, and all of its strides."""
        for foot, found in parameters.feet.items():
            known = self._feet.get(foot)
            self._feet[foot] = found if known is None else {k: _cv(k, pooled(known[k], found[k])) for k in STRIDE_KEYS}
        for foot, rows in parameters.strides.items():
            self._travelled[foot] = self._travelled.get(foot, Travelled()) + travelled(rows)
        for one in mean_strides(strides, parameters.strides):
            before = self._means.get(one.foot)
            self._means[one.foot] = one if before is None else _mean_together(before, one)
        self._step_lengths = self._step_lengths or not parameters.no_step_lengths
        self._no_step_lengths = parameters.no_step_lengths

    def parameters(self) -> GaitParameters:
        """Of all chunks; the strides themselves are not kept."""
        none: dict[str, list[StrideParameters]] = {foot: [] for foot in self._feet}
        walk = walk_of_sums(self._travelled.values(), self._belt_mps)
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


def _cv(key: str, value: Statistic) -> Statistic:
    return replace(value, cv=NAN) if key in NO_CV else value


def _mean_together(one: MeanStride, other: MeanStride) -> MeanStride:
    n, difference = one.n + other.n, other.mean - one.mean
    squares = (one.n - 1) * one.sd**2 + (other.n - 1) * other.sd**2 + difference**2 * one.n * other.n / n
    return MeanStride(one.foot, one.mean + difference * other.n / n, np.sqrt(squares / (n - 1)), n)
