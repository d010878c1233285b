"""All gait parameters of an analysed recording: of strides, of sides, of the walk; as rows and as plain values."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from fes.analysis import Analysis
from fes.estimation.clearance import FootArms, arms_of
from fes.parameters.common_way import common_way
from fes.parameters.contacts import Swing, swing_of
from fes.parameters.definitions import DEFINITIONS
from fes.parameters.steps import Step, step_lengths, steps_by_number
from fes.parameters.strides import StrideParameters, stride_parameters
from fes.parameters.summary import Statistic, Symmetry, Walk, statistics_of, symmetry, walk_of
from fes.signals import FOOT_SENSORS, StrideResult


@dataclass(frozen=True)
class GaitParameters:
    """Of a whole recording.

    Attributes:
        strides: by foot, valid strides by time.
        feet: by foot, mean, SD and CV of every stride parameter over the steady strides.
        sides: by parameter, the two sides compared; empty with one foot.
        walk: speed, cadence, walk ratio.
        afflicted: the side that ``sides`` counts from: "left", "right", or None where nobody named one.
        no_step_lengths: why there are none, else "".
    """

    strides: dict[str, list[StrideParameters]]
    feet: dict[str, dict[str, Statistic]]
    sides: dict[str, Symmetry]
    walk: Walk
    afflicted: str | None
    no_step_lengths: str

    def rows(self) -> list[dict[str, Any]]:
        """One flat row per stride, by time."""
        every = [stride.row() for strides in self.strides.values() for stride in strides]
        return sorted(every, key=lambda row: (row["t_start_s"], row["foot"]))

    def summary_rows(self) -> list[dict[str, Any]]:
        """One flat row per foot and parameter, then one per parameter with the sides compared, then the walk's.

        ``value`` is the mean for a foot, the symmetry ratio for both; units stand in ``unit``.
        """
        rows: list[dict[str, Any]] = []
        blank = {"sd": math.nan, "cv": math.nan, "n": 0, "symmetry_index_percent": math.nan}
        for foot, found in self.feet.items():
            for key, value in found.items():
                of = {"value": value.mean, "sd": value.sd, "cv": value.cv, "n": value.n}
                rows.append({**_head(foot, key, DEFINITIONS[key].unit), **blank, **of})
        for key, both in self.sides.items():
            ends = {"value": both.ratio, "symmetry_index_percent": both.index_percent}
            rows.append({**_head(f"{both.first}/{both.second}", key, "1"), **blank, **ends})
        for key, number in asdict(self.walk).items():
            rows.append({**_head("walk", key, DEFINITIONS[key].unit), **blank, "value": number})
        return rows

    def to_json(self) -> dict[str, Any]:
        """Plain values, null for what is not known."""
        return {
            "walk": _plain(asdict(self.walk)),
            "feet": {
                foot: {key: _plain(asdict(value)) for key, value in found.items()} for foot, found in self.feet.items()
            },
            "sides": {key: _plain(asdict(both)) for key, both in self.sides.items()},
            "afflicted": self.afflicted,
            "no_step_lengths": self.no_step_lengths,
        }


def gait_parameters(analysis: Analysis, *, afflicted: str | None = None) -> GaitParameters:
    """The parameters of all feet with their own sensor.

    Args:
        analysis: from :func:`fes.analysis.analyse`.
        afflicted: "left" or "right", for the comparison of the sides; None where nobody knows.
    """
    feet = [foot for foot in FOOT_SENSORS if foot in analysis.events]
    swings = {foot: _swings(analysis, foot) for foot in feet}
    every = common_way({foot: [s for s in analysis.strides if s.foot == foot] for foot in feet})
    numbered = {foot: [s for s in own if s.valid] for foot, own in every.items()}
    steps = {foot: _steps(foot, swings, numbered[foot]) for foot in feet}
    lengths, why = _lengths(analysis, every, swings)
    strides = {
        foot: stride_parameters(
            numbered[foot],
            {path.number: path for path in analysis.stride_paths.get(foot, [])},
            swings[foot],
            steps[foot],
            lengths.get(foot, {}),
        )
        for foot in feet
    }
    found = {foot: statistics_of(rows) for foot, rows in strides.items()}
    walk = walk_of(strides, analysis.recording.belt_speed_mps)
    return GaitParameters(strides, found, symmetry(found, afflicted), walk, afflicted, why)


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
    analysis: Analysis, strides: Mapping[str, Sequence[StrideResult]], swings: Mapping[str, Mapping[int, Swing]]
) -> tuple[dict[str, dict[int, float]], str]:
    tracks = [analysis.recording.tracks[foot] for foot in strides]
    if not tracks:
        return {}, "no foot sensor"
    span = max(int(track.t_sensor_ns[0]) for track in tracks), min(int(track.t_sensor_ns[-1]) for track in tracks)
    return step_lengths(strides, swings, span)


def _head(of: str, key: str, unit: str) -> dict[str, Any]:
    return {"of": of, "parameter": key, "unit": unit}


def _plain(values: Mapping[str, Any]) -> dict[str, Any]:
    return {key: None if isinstance(v, float) and not math.isfinite(v) else v for key, v in values.items()}
