"""Off-line analysis: the same core as live, advanced in one block; no stimulation, no clock, no devices."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import repeat
from operator import attrgetter
from typing import Any

import numpy as np

from fes import __version__
from fes.calibrations import Found, calibrate_all, calibrate_sensors, labelled
from fes.config import Session
from fes.driving import Calibration, driving, stride_settings
from fes.estimation.ankle_calibration import ShankCalibration
from fes.estimation.calibration import FootCalibration
from fes.estimation.clearance import FootPath
from fes.estimation.events_offline import GaitEvents, find_events
from fes.estimation.foot import FootTracker
from fes.estimation.foot_strike import foot_strike_angles
from fes.estimation.foot_way import foot_samples
from fes.estimation.shank import shank_tracker
from fes.estimation.stride_fusion import fuse
from fes.estimation.stride_solution import SOLVED
from fes.estimation.strides import StrideMaker
from fes.estimation.tracker import Outcome, SampleCounts
from fes.estimation.walked import Walked
from fes.ground_path import GroundPath, ground_path, together
from fes.journal import Note, SampleArrays, SessionRecord
from fes.recording import Recording
from fes.recording.tracks import UNLABELLED_FEET
from fes.replay import LOG_FORMAT, newer_samples, session_for
from fes.signals import FOOT_SENSORS, IntArray, StrideResult
from fes.toe_and_heel import ToeAndHeel, point_heights
from statemachine.phases import PhaseChange

PLACE = ("x_m", "y_m", "z_m", "heading_rad")


@dataclass(frozen=True)
class Analysis:
    """What a recording shows: phase changes and strides of all feet by time, and what became of the samples.

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
    walked: dict[str, Walked] = field(default_factory=dict)
    outcomes: dict[str, list[Outcome]] = field(default_factory=dict)

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
        return [row for path in self.paths.values() for row in path.rows()]

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
            for fo_ns, mid_ns, ic_ns, angle in zip(
                events.fo_ns, events.mid_swing_ns, events.ic_ns, angles, strict=True
            ):
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


def analyse(recording: Recording, calibrations: Mapping[str, Calibration], *, level: bool = True) -> Analysis:
    """Track every foot through the whole recording, by its own sensor or else its side's shank.

    ``level``: every stride ends at the height at which it began; not on stairs and slopes, where the height gained is
    measured instead.
    """
    session: Session = session_for(recording, None)
    result = Analysis(recording, dict(calibrations), level=level)
    for sensor in driving(calibrations).values():
        if isinstance(calibrations[sensor], ShankCalibration):
            _analyse_shank(result, sensor)
        else:
            _analyse_foot(result, sensor, session)
    if set(FOOT_SENSORS) <= set(result.paths):
        left, right = (result.paths[foot] for foot in FOOT_SENSORS)
        result.paths.update(zip(FOOT_SENSORS, together(left, right), strict=True))
    return result


def _analyse_shank(result: Analysis, sensor: str) -> None:
    calibration, track = result.calibrations[sensor], result.recording.tracks[sensor]
    assert isinstance(calibration, ShankCalibration)
    tracker = shank_tracker(calibration, equal_height=None if result.level else False)
    result.outcomes[sensor] = tracker.advance(track.t_sensor_ns, track.acc_mps2, track.gyr_radps)
    result.counts[sensor] = tracker.counts
    result.no_path[sensor] = f"{sensor}: a path needs a sensor that rests at every step, as on the foot"


def _analyse_foot(result: Analysis, sensor: str, session: Session) -> None:
    calibration, track, level = result.calibrations[sensor], result.recording.tracks[sensor], result.level
    assert isinstance(calibration, FootCalibration)
    tracker = _foot_tracker(session, calibration, level=level)
    walked = tracker.walk(track.t_sensor_ns, track.acc_mps2, track.gyr_radps)
    rows, shapes, paths = walked.rows, walked.shapes, walked.paths()
    try:
        ranges = (track.acc_range_mps2, track.gyr_range_radps)
        foot = foot_samples(track.t_sensor_ns, track.acc_mps2, track.gyr_radps, *ranges)
        fuse(rows, shapes, foot)
        result.paths[sensor] = ground_path(track, calibration, level=level, foot=foot)
    except ValueError as error:
        result.no_path[sensor] = f"{sensor}: {error}"
    given = next((value for name, value in session.geometry.items() if name == sensor), None)
    heights, result.points[sensor] = point_heights(paths, given, level=level)
    if heights is not None:
        valid = rows["outcome"] == SOLVED
        rows["toe_m"][valid], rows["heel_m"][valid] = heights.T
    result.walked[sensor] = walked
    result.counts[sensor] = tracker.counts
    result.events[sensor] = find_events(*newer_samples(track), calibration)


def _foot_tracker(session: Session, calibration: FootCalibration, *, level: bool) -> FootTracker:
    settings = replace(stride_settings(session, calibration), equal_height=level)
    return FootTracker(calibration, StrideMaker(calibration.sensor, settings))


def uneven_strides(recording: Recording, calibrations: Mapping[str, Calibration]) -> dict[str, list[StrideResult]]:
    """Every foot's strides, free to end higher or lower than they began: for who wants to know where there are stairs.

    Calibrations may be from level walking or not: their accelerometer bias across gravity is not used.
    """
    session, found = session_for(recording, None), {}
    for sensor in driving(calibrations).values():
        calibration, track = calibrations[sensor], recording.tracks[sensor]
        if isinstance(calibration, FootCalibration):
            tracker = _foot_tracker(session, _along_gravity_foot(calibration), level=False)
            outcomes = tracker.advance(track.t_sensor_ns, track.acc_mps2, track.gyr_radps)
            found[sensor] = [outcome for outcome in outcomes if isinstance(outcome, StrideResult)]
    return found


def calibrations_of(recording: Recording, *, level: bool = True) -> tuple[Recording, Found]:
    """Calibrations from the recording itself, of the sensors that tell the feet's phases, and the recording relabelled
    where its feet were not labelled.

    On uneven ground the accelerometer's bias across gravity is left at zero: calibration would find it from strides
    that end as high as they began, and the climb would pass for a bias.

    Raises:
        CalibrationError: no sensor could be calibrated, or which unlabelled foot is which is not clear.
    """
    unlabelled = any(name in UNLABELLED_FEET for name in recording.tracks)
    if unlabelled:
        found = calibrate_all(recording, level=level)
        recording = labelled(recording, found.sides)
    else:
        found = calibrate_sensors(recording, driving(recording.tracks).values(), level=level)
    if level:
        return recording, found
    kept = {sensor: _along_gravity(calibration) for sensor, calibration in found.calibrations.items()}
    return recording, replace(found, calibrations=kept)


def _along_gravity(calibration: Calibration) -> Calibration:
    return calibration if isinstance(calibration, ShankCalibration) else _along_gravity_foot(calibration)


def _along_gravity_foot(calibration: FootCalibration) -> FootCalibration:
    up, bias = np.array(calibration.up), np.array(calibration.acc_bias_mps2)
    x, y, z = (float(v) for v in up * (up @ bias))
    return replace(calibration, acc_bias_mps2=(x, y, z))


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
