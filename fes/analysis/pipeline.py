"""Off-line analysis: the same core as live, advanced in one block; no stimulation, no clock, no devices."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from fes.analysis.ground_path import GroundPath, continued, ground_path, together
from fes.analysis.results import Analysis
from fes.analysis.stride_fusion import fuse
from fes.analysis.toe_and_heel import ToeAndHeel, point_heights
from fes.calibration.recording import Found, calibrate_all, calibrate_sensors, drivers_from, labelled, load
from fes.config import Session
from fes.control.replay import session_for
from fes.estimation.events.offline import find_events
from fes.estimation.foot.calibration import CalibrationError, FootCalibration
from fes.estimation.foot.tracker import FootTracker
from fes.estimation.sensor_choice import Calibration, phase_sensors, stride_settings
from fes.estimation.shank.calibration import ShankCalibration
from fes.estimation.shank.tracker import shank_tracker
from fes.estimation.strides.integration import SOLVED
from fes.estimation.strides.results import StrideMaker
from fes.estimation.tracking.tracker import Tracker
from fes.estimation.zupt.foot_trajectory import foot_samples
from fes.recording import Recording, Track
from fes.recording.chunks import Chunk
from fes.recording.samples import newer_samples
from fes.recording.tracks import UNLABELLED_FEET
from fes.signals import FOOT_SENSORS, FloatArray, IntArray, StrideResult

__all__ = ["Analysis", "analyse", "analyse_chunks", "calibrations_of", "calibrations_of_chunks", "uneven_strides"]


def analyse(recording: Recording, calibrations: Mapping[str, Calibration], *, level: bool = True) -> Analysis:
    """Track every foot through the whole recording, by its own sensor or else its side's shank.

    ``level``: every stride ends at the height at which it began; not on stairs and slopes, where the height gained is
    measured instead.
    """
    return next(analyse_chunks([Chunk(recording)], calibrations, level=level))


def analyse_chunks(
    pieces: Iterable[Chunk], calibrations: Mapping[str, Calibration], *, level: bool = True
) -> Iterator[Analysis]:
    """As :func:`analyse`, of a recording's pieces one after the other (:mod:`fes.recording.chunks`).

    Phases and strides run through as if nothing were cut, to the bit; paths go on where they ended. What rest looks
    like, how large steps usually are, and how the paths drift apart is found for each piece from its own samples, where
    toe and heel are from the first piece that shows it.
    """
    course = _AnalysisRun(calibrations, level=level)
    for piece in pieces:
        result = course.take(piece)
        del piece  # it stays as long as whoever takes the result keeps that
        yield result
        del result


class _AnalysisRun:
    """An analysis under way: what is carried from one piece to the next."""

    def __init__(self, calibrations: Mapping[str, Calibration], *, level: bool) -> None:
        self._calibrations, self._level = dict(calibrations), level
        self._trackers: dict[str, Tracker] = {}
        self._points: dict[str, ToeAndHeel] = {}
        self._paths: dict[str, GroundPath] = {}
        self._path_begins_ns: dict[str, int] = {}

    def take(self, piece: Chunk) -> Analysis:
        """Analyse the next piece."""
        session = session_for(piece.recording, None)
        result = Analysis(piece.recording, dict(self._calibrations), level=self._level, piece=piece)
        for sensor in phase_sensors(self._calibrations).values():
            if sensor not in piece.recording.tracks:
                continue
            if isinstance(self._calibrations[sensor], ShankCalibration):
                self._shank(result, piece, sensor)
            else:
                self._foot(result, piece, sensor, session)
        if set(FOOT_SENSORS) <= set(result.paths):
            left, right = (result.paths[foot] for foot in FOOT_SENSORS)
            result.paths.update(zip(FOOT_SENSORS, together(left, right), strict=True))
        for foot, path in result.paths.items():
            if foot in self._paths:
                result.paths[foot] = continued(self._paths[foot], path, piece.begin_ns)
            self._path_begins_ns.setdefault(foot, int(path.t_ns[0]))
        self._paths |= result.paths
        result.path_begins_ns.update(self._path_begins_ns)
        return result

    def _shank(self, result: Analysis, piece: Chunk, sensor: str) -> None:
        calibration = self._calibrations[sensor]
        assert isinstance(calibration, ShankCalibration)
        if sensor not in self._trackers:
            self._trackers[sensor] = shank_tracker(calibration, equal_height=None if self._level else False)
        tracker = self._trackers[sensor]
        result.outcomes[sensor] = tracker.advance(*_own(piece, piece.recording.tracks[sensor]))
        result.counts[sensor] = tracker.counts
        result.no_path[sensor] = f"{sensor}: a path needs a sensor that rests at every step, as on the foot"

    def _foot(self, result: Analysis, piece: Chunk, sensor: str, session: Session) -> None:
        calibration, track, level = self._calibrations[sensor], piece.recording.tracks[sensor], self._level
        assert isinstance(calibration, FootCalibration)
        tracker = self._trackers.get(sensor) or _foot_tracker(session, calibration, level=level)
        assert isinstance(tracker, FootTracker)
        self._trackers[sensor] = tracker
        walked = tracker.walk(*_own(piece, track))
        rows, paths = walked.rows, walked.paths()
        try:
            ranges = (track.acc_range_mps2, track.gyr_range_radps)
            foot = foot_samples(track.t_sensor_ns, track.acc_mps2, track.gyr_radps, *ranges)
            walked.longer = fuse(rows, foot)
            result.paths[sensor] = ground_path(track, calibration, level=level, foot=foot)
        except ValueError as error:
            result.no_path[sensor] = f"{sensor}: {error}"
        known = self._points.get(sensor)
        given = next((value for name, value in session.geometry.items() if name == sensor), None)
        heights, found = point_heights(paths, given if known is None else known.geometry, level=level)
        result.points[sensor] = found if known is None else known
        if result.points[sensor].geometry is not None:
            self._points[sensor] = result.points[sensor]
        if heights is not None:
            valid = rows["outcome"] == SOLVED
            rows["toe_m"][valid], rows["heel_m"][valid] = heights.T
        result.walked[sensor] = walked
        result.counts[sensor] = tracker.counts
        result.events[sensor] = find_events(*newer_samples(track), calibration)


def _own(piece: Chunk, track: Track) -> tuple[IntArray, FloatArray, FloatArray]:
    own = piece.own(track)
    return track.t_sensor_ns[own], track.acc_mps2[own], track.gyr_radps[own]


def _foot_tracker(session: Session, calibration: FootCalibration, *, level: bool) -> FootTracker:
    settings = replace(stride_settings(session, calibration), equal_height=level)
    return FootTracker(calibration, StrideMaker(calibration.sensor, settings))


def uneven_strides(recording: Recording, calibrations: Mapping[str, Calibration]) -> dict[str, list[StrideResult]]:
    """Every foot's strides, free to end higher or lower than they began: for who wants to know where there are stairs.

    Calibrations may be from level walking or not: their accelerometer bias across gravity is not used.
    """
    session, found = session_for(recording, None), {}
    for sensor in phase_sensors(calibrations).values():
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
        found = calibrate_sensors(recording, phase_sensors(recording.tracks).values(), level=level)
    if level:
        return recording, found
    kept = {sensor: _along_gravity(calibration) for sensor, calibration in found.calibrations.items()}
    return recording, replace(found, calibrations=kept)


def calibrations_of_chunks(pieces: Iterable[Chunk], stored: Path | Found | None = None, *, level: bool = True) -> Found:
    """Calibrations for a recording in pieces, of each sensor from the first piece that shows it.

    Args:
        pieces: all are taken, so that what is wrong with a later part of a file is raised here.
        stored: calibrations to use instead, which must fit.
        level: as of :func:`calibrations_of`.

    Raises:
        RecordingError: a piece of the file cannot be used.
        CalibrationError: no piece showed any sensor.
    """
    found: Found | None = None
    failed: CalibrationError | None = None
    for piece in pieces:
        if found is not None and (stored is not None or not found.missing):
            continue
        recording = piece.recording if found is None else labelled(piece.recording, found.sides)
        try:
            new = calibrations_of(recording, level=level) if stored is None else drivers_from(stored, recording)
        except CalibrationError as error:
            if stored is not None:
                raise
            failed = failed or error
            continue
        found = new[1] if found is None else _both(found, new[1])
    if found is None:
        raise failed or CalibrationError("The recording holds no samples.")
    if stored is None:
        return found
    return replace(found, sides=(stored if isinstance(stored, Found) else load(stored)).sides)


def _both(first: Found, later: Found) -> Found:
    calibrations = {**later.calibrations, **first.calibrations}
    missing = {sensor: why for sensor, why in first.missing.items() if sensor not in calibrations}
    return replace(first, calibrations=calibrations, missing=missing)


def _along_gravity(calibration: Calibration) -> Calibration:
    return calibration if isinstance(calibration, ShankCalibration) else _along_gravity_foot(calibration)


def _along_gravity_foot(calibration: FootCalibration) -> FootCalibration:
    up, bias = np.array(calibration.up), np.array(calibration.acc_bias_mps2)
    x, y, z = (float(v) for v in up * (up @ bias))
    return replace(calibration, acc_bias_mps2=(x, y, z))
