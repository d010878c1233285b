"""What a replay needs of a recording before it begins: its samples, the settings that were asked for, calibrations."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from fes.calibration.recording import SensorCalibrations, calibrate_phase_sensors, stored_calibrations
from fes.config import Session, load_session
from fes.control.replay import refuse_long_silence, session_for
from fes.recording import Recording, read_recording


class Prepared(NamedTuple):
    """A recording with what it is replayed with; ``session`` is None where no settings are asked for or beside it."""

    recording: Recording
    settings: Path | None
    session: Session | None
    found: SensorCalibrations


def prepared(path: Path, settings: Path | None, calibration: Path | None) -> Prepared:
    """Read a recording; ``settings`` are a session's, by default ``session.toml`` beside it.

    Raises:
        RecordingError, ConfigError, CalibrationError: one of the files cannot be used.
    """
    recording = read_recording(path)
    refuse_long_silence(recording)
    beside = path.parent / "session.toml"
    settings = settings or (beside if beside.is_file() else None)
    session = load_session(settings) if settings else None
    if calibration:
        recording, found = stored_calibrations(calibration, recording)
    else:
        found = calibrate_phase_sensors(recording, incline=session_for(recording, session).ground.incline)
    return Prepared(recording, settings, session, found)
