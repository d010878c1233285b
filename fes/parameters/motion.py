"""What one stride's path shows: rotation about the axis across the foot, sideways excursion, lift.

Source: Wang et al. (2013), section 4.2, in the stride's own frame: origin and orientation of its first sample, which is
a mid-stance. Their MLR is written as rotation about the vertical; the heel's lift is a rotation about the mediolateral
axis, and that is what is taken here.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

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
        way = self.position_m[-1, :2] - self.position_m[0, :2]
        length = float(np.hypot(*way))
        if length < 0.05:
            way, length = self.axes[0, :2, 0], float(np.hypot(*self.axes[0, :2, 0]))
        x, y = way / max(length, 1e-9)
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
