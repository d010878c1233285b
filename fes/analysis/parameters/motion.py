"""What one stride's path shows: rotation about the axis across the foot, sideways excursion, lift.

Source: Wang et al. (2013), section 4.2, in the stride's own frame: origin and orientation of its first sample, which is
a mid-stance. Their MLR is written as rotation about the vertical; the heel's lift is a rotation about the mediolateral
axis, and that is what is taken here.

How much neighbouring strides differ: position and orientation variation after dynamic time warping.

Source: Wang et al. (2013), section 4.2: two neighbouring strides of the same side are stretched onto each other by
dynamic time warping of their path along the walk, normalised to 0 … 1 (Sakoe & Chiba 1978 for the warping), and PV and
OV are the root mean square distances of position and orientation along the common, stretched time. Orientation is a
rotation vector here, so that the result depends on no order of angles.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fes.estimation.numerics.jit import jit
from fes.signals import FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class Motion:
    """One stride: N samples from mid-stance to mid-stance.

    ``t_ns`` (N,); ``position_m`` (N, 3) of the sensor, z up, origin at the start; ``axes`` (N, 3, 3): columns are the
    foot's forward, left and up in the world.
    """

    t_ns: IntArray
    position_m: FloatArray
    axes: FloatArray

    def pitch_rad(self) -> FloatArray:
        """Rotation (N,) about the axis across the foot since the start, toe up positive; beyond a right angle too."""
        forward = self.axes[:, :, 0]
        level = np.hypot(forward[:, 0], forward[:, 1])
        # a foot whose up axis points down has passed the vertical
        angle = np.arctan2(forward[:, 2], np.where(self.axes[:, 2, 2] < 0.0, -level, level))
        return np.asarray(np.unwrap(angle) - angle[0])

    def own_frame_m(self) -> FloatArray:
        """Positions (N, 3): x along the stride, y to the left, z up; where it goes nowhere x is the toe's direction."""
        direction = self.position_m[-1, :2] - self.position_m[0, :2]
        length = float(np.hypot(*direction))
        if length < 0.05:
            direction, length = self.axes[0, :2, 0], float(np.hypot(*self.axes[0, :2, 0]))
        x, y = direction / max(length, 1e-9)
        turned = np.array([[x, y, 0.0], [-y, x, 0.0], [0.0, 0.0, 1.0]])
        return np.asarray((self.position_m - self.position_m[0]) @ turned.T)

    def orientation_rad(self) -> FloatArray:
        """Rotation vectors (N, 3) from the start, along the foot's own forward, left and up of the start."""
        turned = np.einsum("ji,njk->nik", self.axes[0], self.axes)
        return _rotation_vectors(turned)

    def deviation_m(self) -> float:
        """MDD: greatest sideways distance from the straight line of the stride."""
        return float(np.abs(self.own_frame_m()[:, 1]).max())

    def circumduction_m(self, side: str) -> float:
        """Greatest outward distance from that line; ``side`` is "left" or "right"."""
        outward = self.own_frame_m()[:, 1] * (1.0 if side == "left" else -1.0)
        return float(outward.max())

    def lift_m(self) -> float:
        """MLH: greatest height above the start."""
        return float((self.position_m[:, 2] - self.position_m[0, 2]).max())

    def heel_rotation_rad(self) -> float:
        """MLR: greatest toe-down rotation since the start."""
        return float(-self.pitch_rad().min())


def _rotation_vectors(r: FloatArray) -> FloatArray:
    """Axis times angle (N, 3) of rotation matrices (N, 3, 3)."""
    skew = 0.5 * np.stack((r[:, 2, 1] - r[:, 1, 2], r[:, 0, 2] - r[:, 2, 0], r[:, 1, 0] - r[:, 0, 1]), axis=1)
    sine, cosine = np.sqrt((skew * skew).sum(axis=1)), 0.5 * (np.einsum("nii->n", r) - 1.0)
    angle, turned = np.arctan2(sine, cosine), sine > 1e-6
    out = np.asarray(skew * np.where(turned, angle / np.where(turned, sine, 1.0), 1.0)[:, None])
    for k in np.flatnonzero(~turned & (cosine <= 0.0)):  # half a turn: the axis is a column of r + 1
        column = (r[k] + np.eye(3))[:, int(np.argmax(np.diag(r[k])))]
        out[k] = angle[k] * column / np.linalg.norm(column)
    return out


POINTS = 101


def variation(one: Motion, other: Motion) -> tuple[float, float]:
    """PV (m) and OV (rad) of two neighbouring strides of one side."""
    positions = [_resampled(stride.t_ns, stride.own_frame_m()) for stride in (one, other)]
    turns = [_resampled(stride.t_ns, stride.orientation_rad()) for stride in (one, other)]
    i, j = warped(_unit(positions[0][:, 0]), _unit(positions[1][:, 0]))
    position, orientation = (float(np.sqrt(np.mean(np.sum((b[j] - a[i]) ** 2, axis=1)))) for a, b in (positions, turns))
    return position, orientation


def _resampled(t_ns: IntArray, values: FloatArray) -> FloatArray:
    """The same (POINTS, 3) at equal steps of time."""
    t = (t_ns - t_ns[0]).astype(np.float64)
    at = np.linspace(0.0, t[-1], POINTS)
    return np.column_stack([np.interp(at, t, column) for column in values.T])


def _unit(values: FloatArray) -> FloatArray:
    low, high = float(values.min()), float(values.max())
    return np.asarray((values - low) / max(high - low, 1e-9))


def warped(one: FloatArray, other: FloatArray) -> tuple[IntArray, IntArray]:
    """Which sample of each goes with which of the other, (L,) and (L,), from first to last.

    Args:
        one: (N,) a waveform.
        other: (M,) another.
    """
    pairs = _warp(np.ascontiguousarray(one, np.float64), np.ascontiguousarray(other, np.float64))
    return pairs[:, 0], pairs[:, 1]


@jit
def _warp(one: FloatArray, other: FloatArray) -> IntArray:
    n, m = len(one), len(other)
    cost = np.empty((n, m))
    for i in range(n):
        for j in range(m):
            here = abs(one[i] - other[j])
            if i == 0 and j == 0:
                cost[i, j] = here
            elif i == 0:
                cost[i, j] = here + cost[i, j - 1]
            elif j == 0:
                cost[i, j] = here + cost[i - 1, j]
            else:
                cost[i, j] = here + min(cost[i - 1, j - 1], cost[i - 1, j], cost[i, j - 1])
    pairs = np.empty((n + m, 2), np.int64)
    i, j, k = n - 1, m - 1, n + m - 1
    while True:
        pairs[k, 0], pairs[k, 1] = i, j
        if i == 0 and j == 0:
            break
        k -= 1
        if i == 0:
            j -= 1
        elif j == 0:
            i -= 1
        elif cost[i - 1, j - 1] <= cost[i - 1, j] and cost[i - 1, j - 1] <= cost[i, j - 1]:
            i, j = i - 1, j - 1
        elif cost[i - 1, j] <= cost[i, j - 1]:
            i -= 1
        else:
            j -= 1
    return pairs[k:]
