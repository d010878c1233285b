"""What an analysis found: phase changes, strides, events, paths and where toe and heel are, as objects and as rows."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import repeat
from operator import attrgetter
from typing import Any

import numpy as np

from fes import __version__
from fes.analysis.ground_path import GroundPath
from fes.analysis.toe_and_heel import ToeAndHeel
from fes.control.replay import LOG_FORMAT, session_for
from fes.estimation.clearance.clearance import FootPath
from fes.estimation.events.offline import GaitEvents, foot_strike_angles
from fes.estimation.foot.block_results import TrackedBlock
from fes.estimation.foot.calibration import FootCalibration
from fes.estimation.sensor_choice import Calibration
from fes.estimation.tracking.tracker import Outcome, SampleCounts
from fes.recording import Recording
from fes.recording.chunks import Chunk
from fes.recording.samples import newer_samples
from fes.session_log import Note, SampleArrays, SessionRecord
from fes.signals import IntArray, StrideResult
from statemachine.phases import PhaseChange

PLACE = ("x_m", "y_m", "z_m", "heading_rad")


@dataclass(frozen=True)
class Analysis:
    """What a recording shows: phase changes and strides of all feet by time, and what became of the samples.

    Of a long recording it is one ``piece``: phase changes, strides, rows and counts are that piece's own; the samples,
    events and paths are those around it too, and the paths go on where the piece before ended (they are counted from
    ``path_begins_ns``, where each foot's began).

    Phases and strides carry the name of the sensor that told them: the foot's, or where there is none the shank's, for
    which there are no ``events`` and no path. ``paths`` are the feet's ways over the ground; ``no_path`` says of the
    other sensors why there is none. ``points`` says of each foot where its toe and heel were taken to be. ``level``:
    the ground was taken to be level. ``walked`` is what the feet's trackers found, as arrays, and ``outcomes`` what the
    shanks' found; phase changes, strides and the strides' ways are made from them when they are first asked for.
    """

    recording: Recording
    calibrations: dict[str, Calibration]
    events: dict[str, GaitEvents] = field(default_factory=dict)
    counts: dict[str, SampleCounts] = field(default_factory=dict)
    paths: dict[str, GroundPath] = field(default_factory=dict)
    no_path: dict[str, str] = field(default_factory=dict)
    points: dict[str, ToeAndHeel] = field(default_factory=dict)
    level: bool = True
    walked: dict[str, TrackedBlock] = field(default_factory=dict)
    outcomes: dict[str, list[Outcome]] = field(default_factory=dict)
    piece: Chunk | None = None
    path_begins_ns: dict[str, int] = field(default_factory=dict)

    @cached_property
    def phases(self) -> list[PhaseChange]:
        """All feet's phase changes by time."""
        found = [change for walked in self.walked.values() for change in walked.changes]
        found += [each for own in self.outcomes.values() for each in own if isinstance(each, PhaseChange)]
        return sorted(found, key=attrgetter("t_ns"))

    @cached_property
    def strides(self) -> list[StrideResult]:
        """All feet's strides by their beginnings."""
        found = [stride for walked in self.walked.values() for stride in walked.strides()]
        found += [each for own in self.outcomes.values() for each in own if isinstance(each, StrideResult)]
        return sorted(found, key=attrgetter("t_start_ns"))

    @cached_property
    def stride_paths(self) -> dict[str, list[FootPath]]:
        """Of each foot's valid strides, the way at their own samples."""
        return {foot: walked.paths().each() for foot, walked in self.walked.items()}

    def stride_rows(self) -> list[dict[str, Any]]:
        """One flat row per stride, units in the names; ready for CSV, Parquet and JSON.

        ``x_m``, ``y_m``, ``z_m`` and ``heading_rad`` are where the stride ends on the foot's path, NaN without a path.
        """
        places = {foot: path.at(self._ends_ns(foot)).tolist() for foot, path in self.paths.items()}
        following = {foot: iter(rows) for foot, rows in places.items()}
        unknown = (math.nan,) * len(PLACE)
        return [
            {**_stride_row(stride), **dict(zip(PLACE, next(following.get(stride.foot, repeat(unknown))), strict=True))}
            for stride in self.strides
        ]

    def path_rows(self) -> list[dict[str, Any]]:
        """One flat row per foot and tenth of a second: place (m) and heading (rad) on its path."""
        return [
            row
            for foot, path in self.paths.items()
            for row in self._own(path).rows(origin_ns=self.path_begins_ns.get(foot))
        ]

    def _own(self, path: GroundPath) -> GroundPath:
        """The part of a path that is this piece's own."""
        if self.piece is None or self.piece.whole:
            return path
        begin, end = max(self.piece.begin_ns + 1, int(path.t_ns[0])), min(self.piece.end_ns, int(path.t_ns[-1]))
        inner = path.t_ns[(path.t_ns > begin) & (path.t_ns < end)]
        t_ns = np.concatenate(([begin], inner, [end]))
        rows = path.at(t_ns)
        return replace(path, t_ns=t_ns, position_m=rows[:, :3], heading_rad=rows[:, 3])

    def path_summary(self) -> dict[str, dict[str, float]]:
        """Of every foot: how far it went, how far from its start it ended, and how much higher."""
        return {
            foot: {"way_m": path.way_m, "end_from_start_m": path.closure_m, "height_gained_m": path.height_gained_m}
            for foot, path in self.paths.items()
        }

    def _ends_ns(self, foot: str) -> IntArray:
        """Where this foot's strides end (K,), in their order."""
        return np.array([stride.t_end_ns for stride in self.strides if stride.foot == foot], np.int64)

    def phase_rows(self) -> list[dict[str, Any]]:
        """One flat row per phase change; T2 is foot off (FO), T3 initial contact (IC)."""
        return [
            {
                "foot": change.foot,
                "t_s": 1e-9 * change.t_ns,
                "transition": change.transition.name,
                "from": change.source.name.lower(),
                "to": change.destination.name.lower(),
            }
            for change in self.phases
        ]

    def event_rows(self) -> list[dict[str, Any]]:
        """One flat row per swing, from foot off (FO) to initial contact (IC); found off-line, not causally."""
        rows = []
        for foot, events in self.events.items():
            track = self.recording.tracks[foot]
            calibration = self.calibrations[foot]
            assert isinstance(calibration, FootCalibration)
            t_ns, _, gyr = newer_samples(track)
            angles = foot_strike_angles(t_ns, gyr, events, calibration)
            own = slice(None) if self.piece is None else self.piece.owns(events.mid_swing_ns)
            found = (events.fo_ns, events.mid_swing_ns, events.ic_ns, angles)
            for fo_ns, mid_ns, ic_ns, angle in zip(*(values[own] for values in found), strict=True):
                rows.append(
                    {
                        "foot": foot,
                        "t_foot_off_s": 1e-9 * int(fo_ns),
                        "t_mid_swing_s": 1e-9 * int(mid_ns),
                        "t_initial_contact_s": 1e-9 * int(ic_ns),
                        "foot_strike_angle_rad": float(angle),
                    }
                )
        return sorted(rows, key=lambda row: row["t_foot_off_s"])

    def record(self, created: str) -> SessionRecord:
        """The same as a session's record, for the tables and the report."""
        tracks = self.recording.tracks
        header = {
            "format": LOG_FORMAT,
            "fes_version": __version__,
            "kind": "analysis",
            "created": created,
            "recording": {
                "name": self.recording.name,
                "rates_hz": {sensor: track.rate_hz for sensor, track in self.recording.tracks.items()},
                "belt_speed_mps": self.recording.belt_speed_mps,
                "ranges": {n: {"acc": t.acc_range_mps2, "gyr": t.gyr_range_radps} for n, t in tracks.items()},
            },
            "ground": {"level": self.level},
            "toe_and_heel": {foot: known.to_json() for foot, known in self.points.items()},
            "session": session_for(self.recording, None).model_dump(mode="json"),
            "calibration": {sensor: calibration.to_dict() for sensor, calibration in self.calibrations.items()},
        }
        samples = {
            sensor: SampleArrays(track.t_ns, track.t_sensor_ns, track.acc_mps2, track.gyr_radps)
            for sensor, track in self.recording.tracks.items()
            if sensor in self.calibrations
        }
        notes = [
            Note(
                int(self.recording.tracks[foot].t_ns[0]),
                "info" if known.measured else "warning",
                foot,
                known.words(),
            )
            for foot, known in self.points.items()
        ]
        return SessionRecord(
            header, samples=samples, phases=self.phases, strides=self.strides, notes=notes, complete=True
        )


def _stride_row(stride: StrideResult) -> dict[str, Any]:
    def seconds(t_ns: int | None) -> float | None:
        return None if t_ns is None else 1e-9 * t_ns

    return {
        "foot": stride.foot,
        "number": stride.number,
        "valid": stride.valid,
        "reason": stride.reason,
        "t_start_s": 1e-9 * stride.t_start_ns,
        "t_end_s": 1e-9 * stride.t_end_ns,
        "t_pre_swing_s": seconds(stride.t_pre_swing_ns),
        "t_swing_s": seconds(stride.t_swing_ns),
        "t_loading_response_s": seconds(stride.t_loading_response_ns),
        "t_stance_s": seconds(stride.t_stance_ns),
        "stride_length_m": stride.stride_length_m,
        "speed_mps": stride.speed_mps,
        "clearance_m": stride.clearance_m,
        "toe_clearance_m": stride.toe_clearance_m,
        "heel_clearance_m": stride.heel_clearance_m,
        "height_gained_m": stride.height_gained_m,
        "turn_rad": stride.turn_rad,
    }
