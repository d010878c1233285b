"""A recording's samples: those that are newer than all before, and those of some sensors in order of arrival."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from fes.recording.tracks import Recording, Track
from fes.signals import Event, FloatArray, ImuSample, IntArray


def increasing(track: Track) -> npt.NDArray[np.bool_]:
    """Which samples (N,) are newer than all before them: what is left without doubled and backward stamps."""
    before = np.maximum.accumulate(track.t_sensor_ns)[:-1]
    return np.concatenate(([True], track.t_sensor_ns[1:] > before))


def newer_samples(track: Track) -> tuple[IntArray, FloatArray, FloatArray]:
    """Stamps (N,), specific force and rate (N, 3) of the samples that are newer than all before them."""
    if (track.t_sensor_ns[1:] > track.t_sensor_ns[:-1]).all():  # the usual case; nothing to copy
        return track.t_sensor_ns, track.acc_mps2, track.gyr_radps
    newer = increasing(track)
    return track.t_sensor_ns[newer], track.acc_mps2[newer], track.gyr_radps[newer]


def samples_of(recording: Recording, sensors: set[str]) -> Iterator[Event]:
    """The recording's samples of these sensors, in order of arrival."""
    sample: ImuSample
    for sample in recording.samples():
        if sample.sensor in sensors:
            yield sample
