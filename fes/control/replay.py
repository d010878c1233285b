"""Preparing a replay: what to calibrate, which settings, which numbers identify it. No devices, no clock."""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fes import __version__
from fes.config import Session, validate_session
from fes.estimation.sensor_choice import Calibration, calibration_from_dict, phase_sensors
from fes.recording import Recording, RecordingError
from fes.signals import NS_PER_S

LOG_FORMAT = 1
LONGEST_SILENCE_S = 600.0  # a longer one is a clock that was set, or two recordings in one file


@dataclass(frozen=True, slots=True)
class Identity:
    """Numbers that a replay derives from its inputs, so that the same inputs give the same bytes."""

    session_id: int
    boot_id: int


def refuse_long_silence(recording: Recording) -> None:
    """Refuse a recording in which nothing came for more than ten minutes: it would be replayed tick by tick.

    Raises:
        RecordingError: names the place.
    """
    t_ns = np.unique(np.concatenate([track.t_ns for track in recording.tracks.values()]))
    silence_ns = np.diff(t_ns)
    longest = int(silence_ns.argmax()) if silence_ns.size else -1
    if longest >= 0 and silence_ns[longest] > LONGEST_SILENCE_S * NS_PER_S:
        before_s, after_s = 1e-9 * t_ns[longest], 1e-9 * t_ns[longest + 1]
        raise RecordingError(
            f"{recording.path or recording.name}: nothing from {before_s:.3f} s to {after_s:.3f} s, a silence of "
            f"{after_s - before_s:.0f} s. Correct the time stamps, or cut the recording there in two."
        )


def digest(path: Path) -> str:
    """SHA-256 of a file, in hex."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def recording_digest(recording: Recording) -> str:
    """SHA-256 of a recording's file, or of its samples where it was made in memory, in hex."""
    if recording.path is not None:
        return digest(recording.path)
    hashed = hashlib.sha256()
    for sensor, track in recording.tracks.items():
        for values in (track.t_ns, track.t_sensor_ns, track.acc_mps2, track.gyr_radps):
            hashed.update(sensor.encode() + values.tobytes())
    return hashed.hexdigest()


def identity(recording_sha256: str, session: Session) -> Identity:
    """Session and boot identifiers (1–65535) of a replay."""
    both = hashlib.sha256((recording_sha256 + session.model_dump_json()).encode()).digest()
    return Identity(int.from_bytes(both[0:2]) % 65535 + 1, int.from_bytes(both[2:4]) % 65535 + 1)


def log_header(
    recording: Recording,
    recording_sha256: str,
    session: Session,
    calibrations: Mapping[str, Calibration],
    session_id: int,
    created: str,
) -> dict[str, Any]:
    """What a session log must hold so that it can be replayed alone."""
    about = {
        "name": recording.name,
        "sha256": recording_sha256,
        "rates_hz": {sensor: track.rate_hz for sensor, track in recording.tracks.items()},
        "belt_speed_mps": recording.belt_speed_mps,
    }
    return header_of("replay", about, session, calibrations, session_id, created)


def header_of(
    kind: str,
    about: Mapping[str, Any],
    session: Session,
    calibrations: Mapping[str, Calibration],
    session_id: int,
    created: str,
) -> dict[str, Any]:
    """A session log's header; ``about``: the recording's name, rates and belt."""
    return {
        "format": LOG_FORMAT,
        "fes_version": __version__,
        "kind": kind,
        "created": created,
        "recording": about,
        "session": session.model_dump(mode="json"),
        "calibration": {sensor: calibration.to_dict() for sensor, calibration in calibrations.items()},
        "stim_session_id": session_id,
    }


def settings_of(header: dict[str, Any], path: Path) -> tuple[Session, dict[str, Calibration], int]:
    """Settings, calibrations and the stimulator's session identifier from a log's header.

    Raises:
        ConfigError: the header's settings are not valid for this version.
        KeyError, TypeError, ValueError, AttributeError: the header is not that of a session log of this format.
    """
    session = validate_session(header["session"], path)
    calibrations = {sensor: calibration_from_dict(data) for sensor, data in header["calibration"].items()}
    session_id = int(header["stim_session_id"])
    if not 1 <= session_id <= 65535:
        raise ValueError(f"stim_session_id = {session_id} is none of a stimulator's session (1 to 65535)")
    return session, calibrations, session_id


def session_for(recording: Recording, session: Session | None) -> Session:
    """The session's settings, completed by what the recording knows (subject, belt, ground, geometry).

    Channels of a foot that no sensor of the recording drives are left out. Without a session nothing is stimulated.
    """
    changes: dict[str, Any] = {}
    base = session or Session(name=recording.name)
    if not base.subject and recording.subject:
        changes["subject"] = recording.subject
    if base.treadmill is None and recording.belt_speed_mps:
        changes["treadmill"] = {"belt_speed_mps": recording.belt_speed_mps}
    if "ground" not in base.model_fields_set:  # a session may say level on purpose
        changes["ground"] = recording.ground.model_dump()
    if not base.geometry and recording.geometry:
        changes["geometry"] = {foot: value.model_dump() for foot, value in recording.geometry.items()}
    driven = phase_sensors(recording.tracks)
    channels = [channel for channel in base.channels if channel.foot in driven]
    kept = {channel.number for channel in channels}
    changes["channels"] = [
        {**channel.model_dump(), "never_with": [number for number in channel.never_with if number in kept]}
        for channel in channels
    ]
    return validate_session({**base.model_dump(), **changes}, recording.path or Path(recording.name))
