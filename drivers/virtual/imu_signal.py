"""What a simulated inertial sensor feels: a recording's track, or a simulated walker's foot; played round and round."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fes.signals import FloatArray, Vector3


@dataclass(frozen=True, slots=True)
class ImuSignal:
    """Specific force (N, 3) in m/s² and rate (N, 3) in rad/s, ``rate_hz`` samples a second."""

    rate_hz: float
    acc_mps2: FloatArray
    gyr_radps: FloatArray

    @property
    def size(self) -> int:
        """N."""
        return len(self.acc_mps2)

    def at(self, number: int) -> tuple[Vector3, Vector3]:
        """The ``number``-th sample from the start, beginning again at the end."""
        ax, ay, az = self.acc_mps2[number % len(self.acc_mps2)].tolist()
        gx, gy, gz = self.gyr_radps[number % len(self.gyr_radps)].tolist()
        return (ax, ay, az), (gx, gy, gz)


def recorded(path: Path, sensor: str, rate_hz: float) -> ImuSignal:
    """A track of a recording, at ``rate_hz`` by linear interpolation.

    Raises:
        ValueError: no such track, or the recording cannot be used.
    """
    from fes.recording import read_recording

    tracks = read_recording(path).tracks
    if sensor not in tracks:
        raise ValueError(f"{path}: has no {sensor}; it has {', '.join(tracks)}")
    track = tracks[sensor]
    t_s = (track.t_sensor_ns - track.t_sensor_ns[0]) * 1e-9
    grid_s = np.arange(int(float(t_s.max()) * rate_hz) + 1) / rate_hz
    order = np.argsort(t_s, kind="stable")

    def even(values: FloatArray) -> FloatArray:
        return np.stack([np.interp(grid_s, t_s[order], values[order, axis]) for axis in range(3)], axis=1)

    return ImuSignal(rate_hz, even(track.acc_mps2), even(track.gyr_radps))


def walking(sensor: str, rate_hz: float, strides: int = 12, seed: int = 7) -> ImuSignal:
    """Four seconds of standing, ``strides`` strides on a treadmill, standing again; the same for the same seed."""
    from fes.patient.sensor import ImuModel
    from fes.patient.session import Placement, new_session
    from fes.patient.trials import HEALTHY

    foot = sensor.replace("shank", "foot")
    session = new_session("simulated", seed, {foot: Placement((0.070, -0.005, 0.068), (3.0, 21.0, -4.0))})
    session.stand(4.0)
    session.walk({foot: HEALTHY}, strides, 1.0, ramp_s=1.5, early=False)
    session.stand(2.0)
    track = session.recording(rate_hz, ImuModel(), "simulated").tracks[foot]
    return ImuSignal(rate_hz, track.acc_mps2, track.gyr_radps)
