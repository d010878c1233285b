"""Recordings of walks: CSV, Parquet or a CAN log, each with a sidecar that says what is in it."""

from fes.recording.read import read_recording
from fes.recording.template import sidecar_template
from fes.recording.tracks import Recording, RecordingError, SidecarMissingError, Track, TrackQuality
from fes.recording.write import write_recording

__all__ = [
    "Recording",
    "RecordingError",
    "SidecarMissingError",
    "Track",
    "TrackQuality",
    "read_recording",
    "sidecar_template",
    "write_recording",
]
