"""Off-line analysis: the same core as live, advanced in one block; no stimulation, no clock, no devices."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from fes.analysis.examination import key_numbers, without_lies
from fes.analysis.ground_path import GroundPath, continued, fuse, ground_path, without_relative_drift
from fes.analysis.methods import Methods
from fes.analysis.results import Analysis
from fes.analysis.toe_and_heel import ToeAndHeel, point_heights
from fes.calibration.recording import (
    SensorCalibrations,
    calibrate_all,
    calibrate_sensors,
    labelled,
    load,
    stored_calibrations,
)
from fes.config import FootGeometry, Ground
from fes.estimation.events.causal import OnlineEvents, Rule
from fes.estimation.events.offline import find_events
from fes.estimation.foot.calibration import CalibrationError, FootCalibration
from fes.estimation.foot.tracker import FootTracker
from fes.estimation.sensor_choice import Calibration, phase_sensors, shank_incline, stride_settings
from fes.estimation.shank.calibration import ShankCalibration
from fes.estimation.shank.tracker import ShankTracker
from fes.estimation.strides.integration import SOLVED
from fes.estimation.strides.results import StrideMaker
from fes.estimation.tracking.tracker import Tracker
from fes.estimation.zupt.foot_trajectory import foot_samples
from fes.recording import Recording, Track
from fes.recording.chunks import Chunk, at_once
from fes.recording.tracks import UNLABELLED_FEET, newer_samples
from fes.signals import FOOT_SENSORS, FloatArray, IntArray, StrideResult
from fes.witness.frozen import without_frozen

_BY_SENSOR = ("events", "counts", "paths", "no_path", "points", "blocks", "outcomes", "causal_events")  # of Analysis
SURE = 0.95  # a chunk's calibration that is as sure is taken for the whole recording


def analyse(
    recording: Recording,
    calibrations: Mapping[str, Calibration] | None = None,
    *,
    geometry: Mapping[str, FootGeometry] | None = None,
    ground: Ground | None = None,
    methods: Methods | None = None,
    correct: bool = False,
) -> Analysis:
    """Track every foot through the whole recording, by its own sensor or else its side's shank.

    Args:
        recording: its samples.
        calibrations: by sensor; None: from the recording itself (:func:`calibrations_of`).
        geometry: where toe and heel are, by foot; what is not given is the recording's own, or else estimated.
        ground: what is walked on; None: as the recording says. On level ground every stride ends at the height at which
            it began, on an incline as much higher as that rises; else the height gained is measured.
        methods: other methods than those of every report, to replicate a paper.
        correct: where the witness finds that a sensor lies (docs/witness.md), take the recording as a sound one would
            have given it, calibrated anew, and say so among the findings.

    Raises:
        CalibrationError: no sensor could be calibrated.
    """
    incline = (ground or recording.ground).incline
    if calibrations is None:
        recording, found = calibrations_of(recording, incline=incline)
        calibrations = found.calibrations
    asked: dict[str, Any] = {"geometry": geometry, "ground": ground, "methods": methods}
    result = next(analyse_chunks([Chunk(recording)], calibrations, **asked))
    lies = {sensor: told.lies for sensor, told in result.testimonies.items() if told.lies} if correct else {}
    if not lies:
        return result
    sound, found = calibrations_of(without_lies(result.recording, lies), incline=incline)
    mended = next(analyse_chunks([Chunk(sound)], found.calibrations, **asked))
    uncorrected = {sensor: key_numbers(result, sensor) for sensor in lies}
    return replace(mended, corrections=lies, uncorrected=uncorrected, raw=result.raw)


def analyse_chunks(
    chunks: Iterable[Chunk],
    calibrations: Mapping[str, Calibration],
    *,
    geometry: Mapping[str, FootGeometry] | None = None,
    ground: Ground | None = None,
    methods: Methods | None = None,
) -> Iterator[Analysis]:
    """As :func:`analyse`, of a recording's chunks one after the other (:mod:`fes.recording.chunks`).

    Phases and strides run through as if nothing were cut, to the bit; paths go on where they ended. What rest looks
    like, how large steps usually are, and how the paths drift apart is found for each chunk from its own samples, where
    toe and heel are from the first chunk that shows it.
    """
    run = _AnalysisRun(calibrations, geometry or {}, methods or Methods(), ground)
    for chunk in chunks:
        result = run.analyse_chunk(chunk)
        del chunk  # it stays as long as whoever takes the result keeps that
        yield result
        del result


class _AnalysisRun:
    """An analysis under way: what is carried from one chunk to the next."""

    def __init__(
        self,
        calibrations: Mapping[str, Calibration],
        geometry: Mapping[str, FootGeometry],
        methods: Methods,
        ground: Ground | None,
    ) -> None:
        self._calibrations, self._geometry = dict(calibrations), geometry
        self._methods, self._ground = methods, ground
        self._causal: dict[str, dict[Rule, OnlineEvents]] = {}
        self._trackers: dict[str, Tracker] = {}
        self._points: dict[str, ToeAndHeel] = {}
        self._paths: dict[str, GroundPath] = {}
        self._path_begins_ns: dict[str, int] = {}

    def analyse_chunk(self, chunk: Chunk) -> Analysis:
        """Analyse the next chunk: every sensor by itself, then both feet's paths together."""
        raw = chunk.recording.tracks
        tracks = {sensor: without_frozen(track) for sensor, track in raw.items()}
        if any(tracks[sensor] is not raw[sensor] for sensor in raw):
            chunk = replace(chunk, recording=replace(chunk.recording, tracks=tracks))
        ground = self._ground or chunk.recording.ground
        given: dict[str, Any] = {"geometry": self._geometry, "ground": self._ground, "methods": self._methods}

        def new() -> Analysis:
            return Analysis(
                chunk.recording, dict(self._calibrations), ground=ground, chunk=chunk, raw=raw,
                anew=lambda recording: analyse(recording, **given),
            )  # fmt: skip

        def analysed(sensor: str) -> Analysis:
            own, calibration = new(), self._calibrations[sensor]
            if isinstance(calibration, ShankCalibration):
                self._analyse_shank(own, chunk, calibration)
            else:
                self._analyse_foot(own, chunk, calibration)
            return own

        result, worn = new(), phase_sensors(self._calibrations).values()
        for own in at_once(analysed, (sensor for sensor in worn if sensor in chunk.recording.tracks)).values():
            for name in _BY_SENSOR:
                getattr(result, name).update(getattr(own, name))
        if set(FOOT_SENSORS) <= set(result.paths):
            left, right = (result.paths[foot] for foot in FOOT_SENSORS)
            result.paths.update(zip(FOOT_SENSORS, without_relative_drift(left, right), strict=True))
        for foot, path in result.paths.items():
            if foot in self._paths:
                result.paths[foot] = continued(self._paths[foot], path, chunk.begin_ns)
            self._path_begins_ns.setdefault(foot, int(path.t_ns[0]))
        self._paths |= result.paths
        result.path_begins_ns.update(self._path_begins_ns)
        return result

    def _analyse_shank(self, result: Analysis, chunk: Chunk, calibration: ShankCalibration) -> None:
        """Phases and strides of a shank; it never rests, so it has no path."""
        sensor = calibration.sensor
        if sensor not in self._trackers:
            self._trackers[sensor] = ShankTracker(calibration, incline=shank_incline(result.ground))
        tracker = self._trackers[sensor]
        result.outcomes[sensor] = tracker.advance(*_own_samples(chunk, chunk.recording.tracks[sensor]))
        result.counts[sensor] = tracker.counts
        result.no_path[sensor] = f"{sensor}: a path needs a sensor that rests at every step, as on the foot"

    def _analyse_foot(self, result: Analysis, chunk: Chunk, calibration: FootCalibration) -> None:
        """One foot, step by step: phases and strides, their lengths fused with the path's, clearance, events."""
        sensor, track, level = calibration.sensor, chunk.recording.tracks[calibration.sensor], result.ground.level
        methods, geometry = self._methods, self._geometry.get(sensor, chunk.recording.geometry.get(sensor))
        if sensor not in self._trackers:
            self._trackers[sensor] = _foot_tracker(calibration, geometry, result.ground, methods)
        tracker = self._trackers[sensor]
        assert isinstance(tracker, FootTracker)
        block = tracker.track(*_own_samples(chunk, track))
        strides, trajectories = block.rows, block.paths()
        try:
            ranges = (track.acc_range_mps2, track.gyr_range_radps)
            samples = foot_samples(
                track.t_sensor_ns, track.acc_mps2, track.gyr_radps, *ranges,
                detector=methods.detector, per_sample=methods.per_sample,
            )  # fmt: skip
            if methods.stride_method == "maximum_likelihood":
                block.longer = fuse(strides, samples)
            result.paths[sensor] = ground_path(track, calibration, level=level, foot=samples)
        except ValueError as error:
            result.no_path[sensor] = f"{sensor}: {error}"
        before = self._points.get(sensor)
        heights, points = point_heights(trajectories, geometry if before is None else before.geometry, level=level)
        result.points[sensor] = points if before is None else before
        if result.points[sensor].geometry is not None:
            self._points[sensor] = result.points[sensor]
        if heights is not None:
            valid = strides["outcome"] == SOLVED
            strides["toe_clearance_m"][valid], strides["heel_clearance_m"][valid] = heights.T
        result.blocks[sensor], result.counts[sensor] = block, tracker.counts
        result.events[sensor] = find_events(*newer_samples(track), calibration)
        if methods.causal_events:
            causal = self._causal.setdefault(sensor, {rule: OnlineEvents(calibration, rule) for rule in Rule})
            own = _own_samples(chunk, track)
            found = ((rule.name.lower(), events.advance(*own)) for rule, events in causal.items())
            result.causal_events[sensor] = [(rule, decision) for rule, told in found for decision in told]


def _own_samples(chunk: Chunk, track: Track) -> tuple[IntArray, FloatArray, FloatArray]:
    own = chunk.own(track)
    return track.t_sensor_ns[own], track.acc_mps2[own], track.gyr_radps[own]


def _foot_tracker(
    calibration: FootCalibration, geometry: FootGeometry | None, ground: Ground, methods: Methods
) -> FootTracker:
    settings = replace(stride_settings(calibration, geometry, ground), method=methods.stride_method)
    return FootTracker(calibration, StrideMaker(calibration.sensor, settings))


def uneven_strides(recording: Recording, calibrations: Mapping[str, Calibration]) -> dict[str, list[StrideResult]]:
    """Every foot's strides, free to end higher or lower than they began: for who wants to know where there are stairs.

    Calibrations may be from level walking or not: their accelerometer bias across gravity is not used.
    """
    found = {}
    for sensor in phase_sensors(calibrations).values():
        calibration, track = calibrations[sensor], recording.tracks[sensor]
        if isinstance(calibration, FootCalibration):
            geometry = recording.geometry.get(sensor)
            tracker = _foot_tracker(calibration.along_gravity(), geometry, Ground(free=True), Methods())
            found[sensor] = tracker.track(track.t_sensor_ns, track.acc_mps2, track.gyr_radps).strides()
    return found


def calibrations_of(recording: Recording, *, incline: float = 0.0) -> tuple[Recording, SensorCalibrations]:
    """Calibrations from the recording itself, of the sensors that tell the feet's phases, and the recording relabelled
    where its feet were not labelled.

    Raises:
        CalibrationError: no sensor could be calibrated, or which unlabelled foot is which is not clear.
    """
    if any(name in UNLABELLED_FEET for name in recording.tracks):
        found = calibrate_all(recording, incline=incline)
        recording = labelled(recording, found.sides)
    else:
        found = calibrate_sensors(recording, phase_sensors(recording.tracks).values(), incline=incline)
    return recording, found


def _sureness(calibration: Calibration) -> float:
    """0 to 1: how sure the axis is, by strides that are few or many."""
    return calibration.axis_confidence * (1.0 - 1.0 / max(calibration.strides, 1))


def _sure(found: SensorCalibrations) -> bool:
    return not found.missing and min(map(_sureness, found.calibrations.values())) > SURE


def calibrations_of_chunks(
    chunks: Iterable[Chunk], stored: Path | SensorCalibrations | None = None, *, incline: float = 0.0
) -> SensorCalibrations:
    """Calibrations for a recording in chunks, of each sensor from the chunk that shows it best, or well enough.

    Some chunks of a day show a few movements that are hardly a walk. All chunks are taken, so that what is wrong with a
    later part of a file is raised here. ``stored`` are calibrations to use instead, which must fit; ``incline`` as of
    :func:`fes.calibration.recording.calibrate_track`.

    Raises:
        RecordingError: a chunk of the file cannot be used.
        CalibrationError: no chunk showed any sensor.
    """
    found: SensorCalibrations | None = None
    failed: CalibrationError | None = None
    for chunk in chunks:
        if found is not None and (stored is not None or _sure(found)):
            continue
        recording = chunk.recording if found is None else labelled(chunk.recording, found.sides)
        try:
            new = (
                calibrations_of(recording, incline=incline)
                if stored is None
                else stored_calibrations(stored, recording)
            )
        except CalibrationError as error:
            if stored is not None:
                raise
            failed = failed or error
            continue
        if found is None:
            found = new[1]
        else:
            calibrations = {
                sensor: max(
                    (each[sensor] for each in (found.calibrations, new[1].calibrations) if sensor in each),
                    key=_sureness,
                )
                for sensor in {**found.calibrations, **new[1].calibrations}
            }
            missing = {sensor: why for sensor, why in found.missing.items() if sensor not in calibrations}
            found = replace(found, calibrations=calibrations, missing=missing)
    if found is None:
        raise failed or CalibrationError("The recording holds no samples.")
    if stored is None:
        return found
    return replace(found, sides=(stored if isinstance(stored, SensorCalibrations) else load(stored)).sides)
