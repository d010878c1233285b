"""One foot's samples made ready: orientation, acceleration without gravity, on the time base of both feet.

Where a foot went between its zero-velocity windows, and the frame in which both feet are looked at.

Source: Wang et al. (2013), sections 3.1 and 3.2: strapdown integration in the world, velocity zero in the windows; in
between, what is left of the velocity at a motion window's end is taken off in proportion to time. The visualization
frame has z against gravity, y along the walk, x across it to the right. *Erratum*: the printed ``x0`` is a cross
product of unit vectors that are not perpendicular unless the walk is level; not normalised, the matrix is no rotation
on stairs.
"""

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from fes.analysis.hemiparetic.windows import between
from fes.estimation.foot.calibration import FootCalibration
from fes.estimation.numerics.rotation import rotate_all
from fes.estimation.orientation.body import smooth_orientation
from fes.recording import Track
from fes.recording.tracks import increasing
from fes.signals import G_MPS2, NS_PER_S, FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class Foot:
    """N evenly spaced samples of one foot, named after its sensor."""

    name: str
    rate_hz: float
    t_ns: IntArray  # (N,)
    acc_mps2: FloatArray  # (N, 3) acceleration without gravity in the world, z up
    forward: FloatArray  # (N, 3) unit vector towards the toe in the world

    def along_mps2(self) -> FloatArray:
        """Acceleration (N,) along where the toe points, level: the paper's y of a walk that goes straight ahead."""
        level = self.forward[:, :2] / np.maximum(np.hypot(self.forward[:, 0], self.forward[:, 1]), 1e-9)[:, None]
        return np.asarray(np.einsum("ij,ij->i", self.acc_mps2[:, :2], level))


def foot_of(track: Track, calibration: FootCalibration, t_ns: IntArray) -> Foot:
    """A track on a common time base, turned into the world.

    The paper takes the orientation that its sensor computes; here it is that of
    :func:`fes.estimation.orientation.body.smooth_orientation`, which knows of no zero-velocity window. The
    accelerometer's bias is taken off, for the threshold of 0.025 m²/s⁴ is as small as a bias of 0.16 m/s². ``t_ns``
    (N,) are evenly spaced instants within the track.
    """
    newer = increasing(track)
    known = (track.t_sensor_ns[newer] - t_ns[0]).astype(np.float64)
    asked = (t_ns - t_ns[0]).astype(np.float64)
    measured = (track.acc_mps2, calibration.acc_bias_mps2), (track.gyr_radps, calibration.gyr_bias_radps)
    acc, gyr = (
        np.column_stack([np.interp(asked, known, column) for column in values[newer].T]) - np.array(bias)
        for values, bias in measured
    )
    rate_hz = (len(t_ns) - 1) * NS_PER_S / float(t_ns[-1] - t_ns[0])
    q = smooth_orientation(acc, gyr, rate_hz).quaternion
    inverse = np.asarray(q * np.array([1.0, -1.0, -1.0, -1.0]))
    world = np.column_stack([np.einsum("ij,ij->i", acc, rotate_all(inverse, axis)) for axis in np.eye(3)])
    world[:, 2] -= G_MPS2
    return Foot(calibration.sensor, rate_hz, t_ns, world, rotate_all(q, calibration.forward()))


def common_times(tracks: list[Track]) -> IntArray:
    """Evenly spaced instants (N,) that all tracks cover, at the slowest one's rate.

    Raises:
        ValueError: they have less than two seconds in common.
    """
    begin, end = max(int(t.t_sensor_ns[0]) for t in tracks), min(int(t.t_sensor_ns[-1]) for t in tracks)
    step = round(NS_PER_S / min(track.rate_hz for track in tracks))
    if end - begin < 2 * NS_PER_S:
        names = " and ".join(track.sensor for track in tracks)
        raise ValueError(f"{names} have {max(end - begin, 0) / NS_PER_S:.1f} s in common: record both feet together")
    return np.arange(begin, end + 1, step, dtype=np.int64)


LEAST_DISTANCE_M = 0.3


@dataclass(frozen=True, slots=True)
class FootTrack:
    """One foot's reconstruction, named after its sensor; N samples."""

    name: str
    t_ns: IntArray  # (N,)
    position_m: FloatArray  # (N, 3)
    windows: IntArray  # (K, 2) zero-velocity windows: first sample, one past the last

    @property
    def centres(self) -> IntArray:
        """(K,) the samples in the middle of the windows: where strides begin and end (section 4.1)."""
        return np.asarray(self.windows.sum(axis=1) // 2, dtype=np.int64)

    def stride_lengths_m(self) -> FloatArray:
        """SL (K − 1,): distances between neighbouring centres, in space."""
        return np.asarray(np.linalg.norm(np.diff(self.position_m[self.centres], axis=0), axis=1))

    def height_changes_m(self) -> FloatArray:
        """(K − 1,) how much higher each stride ends."""
        return np.asarray(np.diff(self.position_m[self.centres, 2]))

    def swing_s(self) -> FloatArray:
        """SwingT (K − 1,): the motion windows."""
        return self._seconds(between(self.windows))

    def stance_s(self) -> FloatArray:
        """StanceT (K − 2,): the zero-velocity windows without the first and the last."""
        return self._seconds(self.windows[1:-1])

    def _seconds(self, windows: IntArray) -> FloatArray:
        period_s = float(np.median(np.diff(self.t_ns))) / NS_PER_S
        return np.asarray((windows[:, 1] - windows[:, 0]) * period_s)


def tracked(foot: Foot, windows: IntArray) -> FootTrack:
    """Integrate one foot between its zero-velocity windows (K, 2); before the first and after the last it stands still.

    Raises:
        ValueError: no window at all.
    """
    if len(windows) == 0:
        raise ValueError(f"{foot.name}: no zero-velocity window, so nothing can be integrated")
    t = (foot.t_ns - foot.t_ns[0]) / NS_PER_S
    velocity = np.zeros_like(foot.acc_mps2)
    for before, after in pairwise(windows.tolist()):
        begin, end = before[1] - 1, after[0]
        span = slice(begin, end + 1)
        steps = np.diff(t[span])[:, None]
        velocity_change = np.cumsum(0.5 * (foot.acc_mps2[span][1:] + foot.acc_mps2[span][:-1]) * steps, axis=0)
        share = (t[span][1:] - t[begin]) / (t[end] - t[begin])
        velocity[begin + 1 : end + 1] = velocity_change - share[:, None] * velocity_change[-1]
    position = np.zeros_like(velocity)
    position[1:] = np.cumsum(0.5 * (velocity[1:] + velocity[:-1]) * np.diff(t)[:, None], axis=0)
    return FootTrack(foot.name, foot.t_ns, position, windows)


def visualization_frame(up: FloatArray, direction: FloatArray) -> FloatArray:
    """Rotation (3, 3) from the initialization into the visualization frame: rows are x across, y along, z up.

    ``up`` (3,) is against gravity, as the accelerometer shows it at rest, ``direction`` (3,) from the walk's first to
    its last zero-velocity window.

    Raises:
        ValueError: the walk goes nowhere, or straight up.
    """
    z = up / np.linalg.norm(up)
    across = np.cross(-direction, z)
    size = float(np.linalg.norm(across))
    if not size >= LEAST_DISTANCE_M:
        raise ValueError(f"the walk leads only {size:.2f} m away: there is no direction of walking")
    # the paper's minus sign makes x point to the left of the walk; y is along it only with x to the right
    x = -across / size
    return np.array([x, np.cross(z, x), z])


def in_visualization_frame(track: FootTrack) -> FootTrack:
    """The track turned so that x is across the walk, y along it and z up.

    Where a walk ends where it began, the direction is that of its first half.

    Raises:
        ValueError: it leads nowhere.
    """
    centres = track.centres
    places = track.position_m[centres]
    far = np.linalg.norm(places[:, :2] - places[0, :2], axis=1)
    at = -1 if far[-1] >= 0.5 * far.max() else int(np.argmax(far))
    turn = visualization_frame(np.array([0.0, 0.0, 1.0]), places[at] - places[0])
    return replace(track, position_m=(track.position_m - places[0]) @ turn.T)
