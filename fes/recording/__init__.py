"""Recordings of walks: CSV, Parquet or a CAN log, each with a sidecar that says what is in it; or arrays.

``fes.recording(acc=…, gyr=…, rate_hz=…)`` is :func:`recording_from_arrays`: this package can be called.
"""

import sys
from inspect import signature
from types import ModuleType

from fes.recording.arrays import recording_from_arrays
from fes.recording.read import read_recording
from fes.recording.template import sidecar_template
from fes.recording.tracks import Recording, RecordingError, SidecarMissingError, Track, TrackQuality
from fes.recording.write import write_recording

__all__ = [
    "Recording", "RecordingError", "SidecarMissingError", "Track", "TrackQuality", "read_recording",
    "recording_from_arrays", "sidecar_template", "write_recording",
]  # fmt: skip


class _Callable(ModuleType):
    __call__ = staticmethod(recording_from_arrays)
    __signature__ = signature(recording_from_arrays)  # else the first argument would be taken for the module


sys.modules[__name__].__class__ = _Callable  # one name, for the room and for what ``import fes`` offers
