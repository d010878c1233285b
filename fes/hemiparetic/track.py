"""Where a foot went between its zero-velocity windows, and the frame in which both feet are looked at.

Source: Wang et al. (2013), sections 3.1 and 3.2: strapdown integration in the world, velocity zero in the windows; in
between, what is left of the velocity at a motion window's end is taken off in proportion to time. The visualization
frame has z against gravity, y along the walk, x across it to the right. *Erratum*: the printed ``x0`` is a cross
product of unit vectors that are not perpendicular unless the walk is level; not normalised, the matrix is no rotation
on stairs.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from fes.hemiparetic.foot import Foot
from fes.hemiparetic.windows import between
from fes.signals import NS_PER_S, FloatArray, IntArray

LEAST_WAY_M = 0.3


@dataclass(frozen=True, slots=True)
class FootTrack:
    """One foot's reconstruction; N samples.

    Attributes:
        name: the sensor's.
        t_ns: (N,).
        position_m: (N, 3).
        axes: (N, 3, 3): columns are the foot's forward, left and up.
        windows: (K, 2) zero-velocity windows: first sample, one past the last.
    """

    name: str
    t_ns: IntArray
    position_m: FloatArray
    axes: FloatArray
    windows: IntArray

    @property
    def centres(self) -> IntArray:
        """(K,) the samples in the middle of the windows: where strides begin and end (section 4.1)."""
        return np.asarray(self.windows.sum(axis=1) // 2, dtype=np.int64)

    def stride_lengths_m(self) -> FloatArray:
        """SL (K − 1,): distances between neighbouring centres, in space."""
        places = self.position_m[self.centres]
        return np.asarray(np.linalg.norm(np.diff(places, axis=0), axis=1))

    def heights_gained_m(self) -> FloatArray:
        """(K − 1,) how much higher each stride ends."""
        return np.asarray(np.diff(self.position_m[self.centres, 2]))

    def swing_s(self) -> FloatArray:
        """SwingT (K − 1,): the motion windows."""
        return self._seconds(between(self.windows))

    def stance_s(self) -> FloatArray:
        """StanceT (K − 2,): the zero-velocity windows without the first and the last."""
        return self._seconds(self.windows[1:-1])

    def walking_speed_mps(self) -> float:
        """WS: straight distance over time from the first to the last centre; NaN with fewer than two windows."""
        if len(self.windows) < 2:
            return float("nan")
        first, last = int(self.centres[0]), int(self.centres[-1])
        way = float(np.linalg.norm(self.position_m[last] - self.position_m[first]))
        return way * NS_PER_S / float(self.t_ns[last] - self.t_ns[first])

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
        gained = np.cumsum(0.5 * (foot.acc_mps2[span][1:] + foot.acc_mps2[span][:-1]) * steps, axis=0)
        share = (t[span][1:] - t[begin]) / (t[end] - t[begin])
        velocity[begin + 1 : end + 1] = gained - share[:, None] * gained[-1]
    position = np.zeros_like(velocity)
    position[1:] = np.cumsum(0.5 * (velocity[1:] + velocity[:-1]) * np.diff(t)[:, None], axis=0)
    axes = np.stack([foot.forward, foot.left, np.cross(foot.forward, foot.left)], axis=2)
    return FootTrack(foot.name, foot.t_ns, position, axes, windows)


def visualization_frame(up: FloatArray, way: FloatArray) -> FloatArray:
    """Rotation (3, 3) from the initialization into the visualization frame: rows are x across, y along, z up.

    Args:
        up: (3,) against gravity, as the accelerometer shows it at rest.
        way: (3,) from the walk's first to its last zero-velocity window.

    Raises:
        ValueError: the walk goes nowhere, or straight up.
    """
    z = up / np.linalg.norm(up)
    across = np.cross(-way, z)
    size = float(np.linalg.norm(across))
    if not size >= LEAST_WAY_M:
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
    return replace(
        track,
        position_m=(track.position_m - places[0]) @ turn.T,
        axes=np.einsum("ij,njk->nik", turn, track.axes),
    )
