"""Foot calibrations from a recording's first minute."""

from __future__ import annotations

from fes.estimation.foot.calibration import CalibrationError, FootCalibration, calibrate_foot, stretch_for_calibration
from fes.recording import Recording, Track
from fes.recording.samples import newer_samples
from fes.signals import FOOT_SENSORS


def calibrate(recording: Recording) -> tuple[dict[str, FootCalibration], dict[str, str]]:
    """Calibrate every foot sensor of a recording from its first minute, from all of it where that shows too little.

    Returns the calibrations, and why the other feet could not be.

    Raises:
        CalibrationError: no foot could be calibrated.
    """
    found: dict[str, FootCalibration] = {}
    missing: dict[str, str] = {}
    for sensor in FOOT_SENSORS:
        track = recording.tracks.get(sensor)
        if track is None:
            continue
        try:
            found[sensor] = calibrate_track(track)
        except CalibrationError as error:
            missing[sensor] = str(error)
    if not found:
        reasons = " ".join(missing.values()) or "it holds no foot sensor (left_foot, right_foot)."
        raise CalibrationError(f"{recording.path or recording.name}: {reasons}")
    return found, missing


def calibrate_track(track: Track) -> FootCalibration:
    """Calibrate one foot from its first minute, or from all of the track where that minute shows too little."""
    t_ns, acc, gyr = newer_samples(track)
    n = stretch_for_calibration(t_ns)
    try:
        return calibrate_foot(track.sensor, track.rate_hz, t_ns[:n], acc[:n], gyr[:n])
    except CalibrationError:
        if n == len(t_ns):
            raise
        return calibrate_foot(track.sensor, track.rate_hz, t_ns, acc, gyr)
