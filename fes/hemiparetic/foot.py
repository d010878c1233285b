"""One foot's samples made ready: orientation, acceleration without gravity, on the time base of both feet."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fes.estimation.calibration import FootCalibration
from fes.estimation.orientation_smooth import smooth_orientation
from fes.estimation.rotation import rotate_all
from fes.recording import Track
from fes.replay import increasing
from fes.signals import G_MPS2, NS_PER_S, FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class Foot:
    """N evenly spaced samples of one foot.

    Attributes:
        name: the sensor's.
        rate_hz: of the samples.
        t_ns: (N,) their times.
        acc_mps2: (N, 3) acceleration without gravity in the world, z up.
        gyr_radps: (N, 3) rate in the sensor frame, without bias.
        toe_down_radps: (N,) rate about the axis across the foot, toe-down positive.
        forward: (N, 3) unit vector towards the toe in the world.
        left: (N, 3) the foot's left in the world.
    """

    name: str
    rate_hz: float
    t_ns: IntArray
    acc_mps2: FloatArray
    gyr_radps: FloatArray
    toe_down_radps: FloatArray
    forward: FloatArray
    left: FloatArray

    def along_mps2(self) -> FloatArray:
        """Acceleration (N,) along where the toe points, level: the paper's y of a walk that goes straight ahead."""
        level = self.forward[:, :2] / np.maximum(np.hypot(self.forward[:, 0], self.forward[:, 1]), 1e-9)[:, None]
        return np.asarray(np.einsum("ij,ij->i", self.acc_mps2[:, :2], level))


def foot_of(track: Track, calibration: FootCalibration, t_ns: IntArray) -> Foot:
    """A track on a common time base, turned into the world.

    The paper takes the orientation that its sensor computes; here it is that of
    :func:`fes.estimation.orientation_smooth.smooth_orientation`, which knows of no zero-velocity window. The
    accelerometer's bias is taken off, for the threshold of 0.025 m²/s⁴ is as small as a bias of 0.16 m/s².

    Args:
        track: the foot's samples.
        calibration: of the same sensor.
        t_ns: (N,) evenly spaced instants within the track.
    """
    newer = increasing(track)
    known = (track.t_sensor_ns[newer] - t_ns[0]).astype(np.float64)
    asked = (t_ns - t_ns[0]).astype(np.float64)
    acc, gyr = (
        np.column_stack([np.interp(asked, known, column) for column in values[newer].T]) - np.array(bias)
        for values, bias in (
            (track.acc_mps2, calibration.acc_bias_mps2),
            (track.gyr_radps, calibration.gyr_bias_radps),
        )
    )
    rate_hz = (len(t_ns) - 1) * NS_PER_S / float(t_ns[-1] - t_ns[0])
    path = smooth_orientation(acc, gyr, rate_hz)
    q = path.quaternion
    world = np.column_stack([np.einsum("ij,ij->i", acc, rotate_all(_inverse(q), axis)) for axis in np.eye(3)])
    world[:, 2] -= G_MPS2
    forward, up = calibration.forward(), np.array(calibration.up)
    return Foot(
        calibration.sensor, rate_hz, t_ns, world, gyr, gyr @ np.array(calibration.toe_down),
        rotate_all(q, forward), rotate_all(q, np.cross(up, forward)),
    )  # fmt: skip


def _inverse(quaternion: FloatArray) -> FloatArray:
    return np.asarray(quaternion * np.array([1.0, -1.0, -1.0, -1.0]))


def common_times(tracks: list[Track]) -> IntArray:
    """Evenly spaced instants (N,) that all tracks cover, at the slowest one's rate.

    Raises:
        ValueError: they have less than two seconds in common.
    """
    begin = max(int(track.t_sensor_ns[0]) for track in tracks)
    end = min(int(track.t_sensor_ns[-1]) for track in tracks)
    step = round(NS_PER_S / min(track.rate_hz for track in tracks))
    if end - begin < 2 * NS_PER_S:
        names = " and ".join(track.sensor for track in tracks)
        raise ValueError(f"{names} have {max(end - begin, 0) / NS_PER_S:.1f} s in common: record both feet together")
    return np.arange(begin, end + 1, step, dtype=np.int64)
