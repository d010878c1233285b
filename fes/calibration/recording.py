"""Calibrations of a whole recording, feet and shanks: found, named, written, read, and held against another recording.

A calibration says how a sensor sits. From a sensor that has been moved, or runs at another rate, it would be wrong in
silence; so it is checked before it is used.
"""

import json
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from fes.calibration.side_detection import SideVerdict, side_signs, tell_sides
from fes.estimation.foot.calibration import CalibrationError, FootCalibration, calibrate_foot, stretch_for_calibration
from fes.estimation.sensor_choice import Calibration, calibration_from_dict, phase_sensors
from fes.estimation.shank.calibration import ShankCalibration, calibrate_shank
from fes.recording import Recording, Track
from fes.recording.tracks import UNLABELLED_FEET, newer_samples
from fes.signals import FOOT_SENSORS, SENSORS, SHANK_SENSORS

Found = TypeVar("Found", FootCalibration, ShankCalibration)


def _from_first_minute(track: Track, calibrate: Callable[..., Found]) -> Found:
    """A calibration from a track's first minute, or from all of it where that minute shows too little."""
    t_ns, acc, gyr = newer_samples(track)
    rows = stretch_for_calibration(t_ns, gyr)
    try:
        return calibrate(track.sensor, track.rate_hz, t_ns[rows], acc[rows], gyr[rows])
    except CalibrationError:
        if rows == slice(0, len(t_ns)):
            raise
        return calibrate(track.sensor, track.rate_hz, t_ns, acc, gyr)


def calibrate_track(track: Track, *, incline: float = 0.0) -> FootCalibration:
    """Calibrate one foot from its first minute, or from all of the track where that minute shows too little.

    ``incline`` is what the ground rises per horizontal distance, NaN on stairs and unknown slopes.
    """
    return _from_first_minute(track, partial(calibrate_foot, incline=incline))


def calibrate_shank_track(track: Track, *, level: bool = True) -> ShankCalibration:
    """Calibrate one shank likewise; ``level`` False: over stairs or slopes."""
    return _from_first_minute(track, partial(calibrate_shank, level=level))


FORMAT = 1
RATE_TOLERANCE = 0.03  # crystals keep within 0.1 %, rates named by their nominal value within 2 %
MOST_TILT_DEG = 25.0
QUIET_PERCENT = 20


@dataclass(frozen=True, slots=True)
class SensorCalibrations:
    """What a recording's sensors are, and how they sit.

    Attributes:
        calibrations: by sensor.
        missing: why the other sensors could not be calibrated.
        sides: for sensors that were not labelled, which foot each is on.
        verdict: how that, or for labelled feet the label's check, came out; None where two feet did not walk.
        swapped: two labelled feet that clearly move like each other's mirror image.
        serials: by sensor, the serial number of the device there, where it told one: what it is bound to.
    """

    calibrations: dict[str, Calibration]
    missing: dict[str, str] = field(default_factory=dict)
    sides: dict[str, str] = field(default_factory=dict)
    verdict: SideVerdict | None = None
    swapped: bool = False
    serials: Mapping[str, str] = field(default_factory=dict)

    def __repr__(self) -> str:
        failed = f"; not calibrated: {', '.join(self.missing)}" if self.missing else ""
        return f"SensorCalibrations of {', '.join(self.calibrations) or 'no sensor'}{failed}"


def calibrate_sensors(recording: Recording, sensors: Iterable[str], *, incline: float = 0.0) -> SensorCalibrations:
    """Calibrate these of a recording's sensors; ``incline`` as of :func:`calibrate_track`.

    Raises:
        CalibrationError: none of them could be.
    """
    found: dict[str, Calibration] = {}
    missing: dict[str, str] = {}
    for sensor in sensors:
        track = recording.tracks[sensor]
        shank = sensor in SHANK_SENSORS
        try:
            if shank:
                found[sensor] = calibrate_shank_track(track, level=incline == 0.0)
            else:
                found[sensor] = calibrate_track(track, incline=incline)
        except CalibrationError as error:
            missing[sensor] = str(error)
    if not found:
        reasons = " ".join(missing.values()) or f"it holds none of the sensors {', '.join(SENSORS)}."
        raise CalibrationError(f"{recording.path or recording.name}: {reasons}")
    return SensorCalibrations(found, missing)


def calibrate_phase_sensors(recording: Recording, *, incline: float = 0.0) -> SensorCalibrations:
    """Calibrate the sensor that tells each foot's phases: the foot's own, or where there is none the shank's.

    ``incline`` is as of :func:`calibrate_track`.

    Raises:
        CalibrationError: none could be, or the feet are not labelled.
    """
    refuse_unlabelled(recording)
    return calibrate_sensors(recording, phase_sensors(recording.tracks).values(), incline=incline)


def calibrate_all(recording: Recording, *, incline: float = 0.0) -> SensorCalibrations:
    """Calibrate all sensors, and tell left from right: of unlabelled feet to name them, of labelled ones to check.

    Raises:
        CalibrationError: no sensor could be calibrated, or which unlabelled foot is which is not clear.
    """
    found = calibrate_sensors(recording, recording.tracks, incline=incline)
    feet = [name for name in (*FOOT_SENSORS, *UNLABELLED_FEET) if name in found.calibrations]
    open_ = [name for name in recording.tracks if name in UNLABELLED_FEET]
    verdict = _sides(recording, found.calibrations, feet) if len(feet) == 2 else None
    if not open_:
        return replace(found, verdict=verdict, swapped=verdict is not None and verdict.sure and verdict.left == 1)
    if verdict is None or not verdict.sure:
        why = "which foot is which takes two feet with five straight strides each."
        if verdict is not None:
            score = f"{verdict.agreeing} of 4 signs agree, with a score of {verdict.score:.2f} (3 and 0.30 are needed)"
            why = f"which foot is which is not clear: {score}."
        raise CalibrationError(f"{recording.path or recording.name}: {why} {_please_label(open_)}")
    sides = dict(zip(feet, FOOT_SENSORS if verdict.left == 0 else reversed(FOOT_SENSORS), strict=True))
    sides = {name: side for name, side in sides.items() if name in UNLABELLED_FEET}
    named = {sides.get(name, name): replace(c, sensor=sides.get(name, name)) for name, c in found.calibrations.items()}
    return SensorCalibrations(named, found.missing, sides, verdict)


def refuse_unlabelled(recording: Recording) -> None:
    """Refuse a recording whose feet are not labelled. Raises CalibrationError: says how to label them."""
    open_ = [name for name in recording.tracks if name in UNLABELLED_FEET]
    if open_:
        raise CalibrationError(f"{recording.path or recording.name}: {_please_label(open_)}")


def labelled(recording: Recording, sides: Mapping[str, str]) -> Recording:
    """The recording with its unlabelled feet named as a calibration found them.

    Raises:
        CalibrationError: a name would then stand for two sensors.
    """
    tracks: dict[str, Track] = {}
    for name, track in recording.tracks.items():
        side = sides.get(name, name)
        if side in tracks or (side != name and side in recording.tracks):
            raise CalibrationError(f"{recording.path or recording.name}: {name} would be a second {side}. Label both.")
        tracks[side] = replace(track, sensor=side)
    return replace(recording, tracks={name: tracks[name] for name in (*SENSORS, *UNLABELLED_FEET) if name in tracks})


def save(found: SensorCalibrations, path: Path) -> None:
    """Write calibrations as JSON; OSError where that fails."""
    data: dict[str, Any] = {"format": FORMAT, "feet": {}, "shanks": {}, "sides": found.sides}
    if found.serials:
        data["serials"] = dict(found.serials)
    for sensor, calibration in found.calibrations.items():
        data["shanks" if isinstance(calibration, ShankCalibration) else "feet"][sensor] = calibration.to_dict()
    path.write_text(json.dumps(data, indent=1), encoding="utf-8")


def load(path: Path) -> SensorCalibrations:
    """Read what :func:`save` wrote. Raises CalibrationError: missing, not JSON, or not a calibration of this format."""
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        if (form := data["format"]) != FORMAT:
            raise CalibrationError(f"{path}: is of format {form}, this version reads {FORMAT}. Calibrate anew.")
        values = {**data["feet"], **data.get("shanks", {})}
        sides = {str(name): str(side) for name, side in data.get("sides", {}).items()}
        found = {sensor: calibration_from_dict({**each, "sensor": sensor}) for sensor, each in values.items()}
        # a file written by hand may say anything; what the core would choke on is refused here
        if not found:
            raise ValueError("it holds no sensor")
        for name, side in sides.items():
            if name not in UNLABELLED_FEET or side not in FOOT_SENSORS:
                raise ValueError(f"{name!r} cannot be {side!r}")
        serials = {str(name): str(serial) for name, serial in data.get("serials", {}).items()}
        return SensorCalibrations(found, sides=sides, serials=serials)
    except CalibrationError:
        raise
    except OSError as error:
        raise CalibrationError(f"{path}: cannot be read: {error.strerror}. Make one with fes calibrate.") from error
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise CalibrationError(f"{path}: is no calibration ({error}). Make one with fes calibrate.") from error


def refuse_others(stored: SensorCalibrations, serials: Mapping[str, str], path: Path | str) -> None:
    """Refuse a calibration of other devices than those that are there, by their ``serials``.

    Raises:
        CalibrationError: names both, and the place that the one found there belongs to.
    """
    owners = {serial: sensor for sensor, serial in stored.serials.items()}
    for sensor, serial in serials.items():
        bound = stored.serials.get(sensor, serial)
        if serial != bound:
            owner = f"that one is the {owners[serial]}'s" if serial in owners else "that one it does not know"
            raise CalibrationError(
                f"{path}: the {sensor} was calibrated with sensor {bound}, on it is {serial}; {owner}. Put each sensor "
                "on its own place, or calibrate again."
            )


def stored_calibrations(given: Path | SensorCalibrations, recording: Recording) -> tuple[Recording, SensorCalibrations]:
    """A recording, its feet named, with the calibrations of a file (or of what another recording gave) for the sensors
    that tell the phases.

    Raises:
        CalibrationError: the file cannot be used, or does not fit the recording.
    """
    stored = given if isinstance(given, SensorCalibrations) else load(given)
    path = "the calibration given" if isinstance(given, SensorCalibrations) else given
    recording = labelled(recording, stored.sides)
    refuse_unlabelled(recording)
    worn = phase_sensors(recording.tracks).values()
    found = {sensor: stored.calibrations[sensor] for sensor in worn if sensor in stored.calibrations}
    missing = {s: f"{s}: {path} holds no calibration of it." for s in worn if s not in stored.calibrations}
    if not found:
        sensors = f"{recording.path or recording.name}: {', '.join(recording.tracks)}"
        raise CalibrationError(f"{path}: calibrates none of the sensors in {sensors}")
    for sensor, calibration in found.items():
        refuse_misfit(calibration, recording.tracks[sensor], path)
    return recording, SensorCalibrations(found, missing)


def refuse_misfit(calibration: Calibration, track: Track, path: Path | str) -> None:
    """Refuse a calibration of a sensor that runs at another rate or sits otherwise.

    Raises:
        CalibrationError: names both and what to do.
    """
    again = "Calibrate again with the sensors as they are worn now: fes calibrate."
    if abs(track.rate_hz / calibration.rate_hz - 1.0) > RATE_TOLERANCE:
        rates = f"was calibrated at {calibration.rate_hz:g} Hz and runs at {track.rate_hz:g} Hz"
        raise CalibrationError(f"{path}: {track.sensor} {rates}. {again}")
    energy = np.einsum("ij,ij->i", track.gyr_radps, track.gyr_radps)
    force = np.median(track.acc_mps2[energy <= np.percentile(energy, QUIET_PERCENT)], axis=0)
    force = force - np.array(calibration.acc_bias_mps2)
    cosine = float(force @ np.array(calibration.up)) / max(float(np.linalg.norm(force)), 1e-9)
    tilt_deg = math.degrees(math.acos(min(max(cosine, -1.0), 1.0)))
    if tilt_deg > MOST_TILT_DEG:
        raise CalibrationError(
            f"{path}: {track.sensor} sits otherwise than when it was calibrated: gravity comes from {tilt_deg:.0f}° "
            f"elsewhere, at most {MOST_TILT_DEG:.0f}° is allowed. " + again
        )


def _sides(recording: Recording, calibrations: Mapping[str, Calibration], feet: list[str]) -> SideVerdict | None:
    """Compare the two feet, the first as if it were left; None where one of them shows too little."""
    signs = []
    for name in feet:
        track, calibration = recording.tracks[name], calibrations[name]
        assert isinstance(calibration, FootCalibration)
        signs.append(side_signs(*newer_samples(track), calibration))
    one, other = signs
    return None if one is None or other is None else tell_sides(one, other)


def _please_label(names: list[str]) -> str:
    which = ", ".join(f"[sensors.{name}]" for name in names)
    return f"Say in the sidecar which foot is which: rename {which} to [sensors.left_foot] or [sensors.right_foot]."
