"""What was estimated, in the form that is held against a reference: from an analysis, or from a session log."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from fes.signals import FloatArray, StrideResult
from statemachine.phases import PhaseChange, Transition

if TYPE_CHECKING:
    from fes.analysis import Analysis
    from fes.journal import SessionRecord


@dataclass(frozen=True, eq=False)
class Estimate:
    """Strides of both feet, and per foot the times (s) of IC and FO, and angles (rad) at some of the ICs.

    Feet are named left_foot and right_foot whatever sensor told them. ``begin_s`` and ``end_s`` are the recording's.
    ``ends``: by foot, how far from its start and how much higher (m) its path ended. ``level``: no stairs, no slope.
    """

    source: str
    how: str
    begin_s: float
    end_s: float
    strides: tuple[StrideResult, ...]
    events: Mapping[str, Mapping[str, FloatArray]]
    strike_rad: Mapping[str, tuple[FloatArray, FloatArray]]
    ends: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    level: bool = True

    @property
    def feet(self) -> tuple[str, ...]:
        """The feet of which anything is known."""
        return tuple(sorted({foot_of(stride.foot) for stride in self.strides} | set(self.events)))

    def of(self, foot: str) -> list[StrideResult]:
        """One foot's strides by time, valid or not."""
        return [stride for stride in self.strides if foot_of(stride.foot) == foot]


def foot_of(sensor: str) -> str:
    """The foot that a sensor tells of."""
    return sensor.replace("_shank", "_foot")


def from_analysis(analysis: Analysis) -> Estimate:
    """Off-line: strides with the whole recording, IC and FO found backwards and forwards."""
    events: dict[str, dict[str, FloatArray]] = {}
    strike: dict[str, tuple[FloatArray, FloatArray]] = {}
    rows = analysis.event_rows()
    for foot, found in analysis.events.items():
        events[foot] = {"IC": 1e-9 * found.ic_ns.astype(float), "FO": 1e-9 * found.fo_ns.astype(float)}
        mine = [row for row in rows if row["foot"] == foot]
        strike[foot] = (
            np.array([row["t_initial_contact_s"] for row in mine], dtype=float),
            np.array([row["foot_strike_angle_rad"] for row in mine], dtype=float),
        )
    sensors = {change.foot for change in analysis.phases} - set(analysis.events)
    for sensor in sensors:
        events[foot_of(sensor)] = _of_phases(analysis.phases, sensor)
    tracks = list(analysis.recording.tracks.values())
    return Estimate(
        str(analysis.recording.path or analysis.recording.name),
        "off-line",
        1e-9 * min(int(track.t_sensor_ns[0]) for track in tracks),
        1e-9 * max(int(track.t_sensor_ns[-1]) for track in tracks),
        tuple(analysis.strides),
        events,
        strike,
        {foot: (path.closure_m, path.height_gained_m) for foot, path in analysis.paths.items()},
        analysis.level,
    )


def from_session(record: SessionRecord, source: str) -> Estimate:
    """As it was decided in a session, causally: IC is T3 (T6 where no contact was seen), FO is T2."""
    sensors = sorted({change.foot for change in record.phases})
    times = [1e-9 * int(part.t_ns[k]) for part in record.samples.values() if len(part.t_ns) for k in (0, -1)]
    times = times or [1e-9 * change.t_ns for change in record.phases] or [0.0]
    return Estimate(
        source,
        "as decided in the session",
        min(times),
        max(times),
        tuple(record.strides),
        {foot_of(sensor): _of_phases(record.phases, sensor) for sensor in sensors},
        {},
    )


def _of_phases(phases: Iterable[PhaseChange], sensor: str) -> dict[str, FloatArray]:
    which = {"IC": (Transition.T3, Transition.T6), "FO": (Transition.T2,)}
    mine = [change for change in phases if change.foot == sensor]
    return {
        what: np.array([1e-9 * change.t_ns for change in mine if change.transition in transitions])
        for what, transitions in which.items()
    }
