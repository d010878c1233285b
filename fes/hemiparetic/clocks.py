"""A recording whose feet were recorded apart, brought onto one clock."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from fes.driving import Calibration
from fes.estimation.calibration import FootCalibration
from fes.estimation.events_offline import find_events
from fes.hemiparetic.sync import Offset, Samples, offset
from fes.recording import Recording, Track
from fes.replay import increasing
from fes.signals import FOOT_SENSORS, NS_PER_S


def synchronised(recording: Recording, calibrations: Mapping[str, Calibration]) -> tuple[Recording, Offset]:
    """The recording with all sensors of the right leg set to the left foot's clock, and how far they were set forward.

    All times move together so that none is negative.

    Raises:
        ValueError: not both feet are there, or neither walk nor knocks show how their clocks lie.
    """
    samples = []
    for foot in FOOT_SENSORS:
        calibration = calibrations.get(foot)
        if foot not in recording.tracks or not isinstance(calibration, FootCalibration):
            raise ValueError(f"{recording.name}: {foot} is missing; it takes both feet to bring them together")
        track = recording.tracks[foot]
        newer = increasing(track)
        t_ns, acc, gyr = track.t_sensor_ns[newer], track.acc_mps2[newer], track.gyr_radps[newer]
        samples.append(Samples(t_ns, acc, find_events(t_ns, acc, gyr, calibration)))
    found = offset(samples[0], samples[1])
    forward = round(found.offset_s * NS_PER_S)
    shifts = {name: forward if name.startswith("right") else 0 for name in recording.tracks}
    earliest = min(int(track.t_ns[0]) + shifts[name] for name, track in recording.tracks.items())
    shifts = {name: shift - min(earliest, 0) for name, shift in shifts.items()}
    return replace(recording, tracks={n: _later(t, shifts[n]) for n, t in recording.tracks.items()}), found


def _later(track: Track, by_ns: int) -> Track:
    return replace(track, t_ns=track.t_ns + by_ns, t_sensor_ns=track.t_sensor_ns + by_ns)
