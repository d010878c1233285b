"""Clearance of sensor, toe and heel: the height of a point of the foot above where it stood, through its lever arm.

A point that sits ``arm`` away from the sensor (forward, left, up with the foot flat) is ``(R(t) - R(0)) arm`` higher
than the sensor's own way says. That takes the whole orientation, roll too: a sensor on the side of the shoe rises and
falls by centimetres when the foot tips sideways, though toe and heel do not.

Definitions. *Minimum toe clearance*: the lowest point between the toe's first peak after foot off and its last before
contact (Winter 1992, Phys. Ther. 72:45-53; Mariani et al. 2012, IEEE Trans. Biomed. Eng. 59:3162-3168, who name the
peaks maximal toe clearance 1 and 2). A foot that does not dip, as many paretic ones do not, has no such point; then the
toe's height at its greatest horizontal speed is given, which is where Winter finds the minimum. *Maximal heel
clearance*: the heel's greatest height (Mariani et al.). Heights count from the starting stance.

Double integration leaves millimetres to a centimetre of slow height error in each stride. But at foot off the toe is on
the ground, and at contact the lowest point of the foot is: :class:`ContactLevels` says where a recording sees them then
on the whole, and each stride is shifted to agree, in proportion to time between contacts and stances.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fes.config import FootGeometry
from fes.estimation.rotation import rotate_all
from fes.signals import FloatArray, IntArray, StrideResult, Vector3

LEAST_DIP_M = 0.001  # shallower than that is no minimum between two peaks
CONTACT_SPREAD_M = 0.003  # how much the true contact heights differ between strides (markers: 2.6 to 3.3 mm)
MOST_DRIFT_M = 0.05  # what differs by more was no drift: a stumble, a kerb, another kind of step
LEVEL_GROUND_M = 0.01  # ground that rises by less per stride, on the whole, is taken for level
LEAST_STRIDES = 5  # for levels
TRIM = 0.1  # share of the strides left out at either end when levels are averaged


@dataclass(frozen=True, slots=True)
class FootPath:
    """One stride's way at its own samples.

    ``position_m`` (N, 3): the sensor, z up, origin at the start, where the foot is flat; ``axes`` (N, 3, 3): columns
    are the foot's forward, left and up in the world; ``foot_off_ns`` and ``contact_ns``: the swing, None if unseen.
    """

    number: int
    t_ns: IntArray
    position_m: FloatArray
    axes: FloatArray
    foot_off_ns: int | None
    contact_ns: int | None

    @property
    def tilt(self) -> FloatArray:
        """How much higher the tips of the foot's unit axes are than at the start (N, 3)."""
        return np.asarray(self.axes[:, 2, :] - self.axes[0, 2, :])

    def index(self, t_ns: int) -> int:
        """The sample at or after a time, within the stride."""
        return min(int(np.searchsorted(self.t_ns, t_ns)), len(self.t_ns) - 1)


def foot_path(
    number: int,
    t_ns: IntArray,
    quaternion: FloatArray,
    position_m: FloatArray,
    forward: FloatArray,
    up: FloatArray,
    foot_off_ns: int | None,
    contact_ns: int | None,
) -> FootPath:
    """A path from orientations (N, 4), sensor to world, and the foot's ``forward`` and ``up`` (3,) in the sensor."""
    (fx, fy, fz), (ux, uy, uz) = forward.tolist(), up.tolist()
    left = np.array((uy * fz - uz * fy, uz * fx - ux * fz, ux * fy - uy * fx))
    axes = np.empty((len(quaternion), 3, 3))
    for k, axis in enumerate((forward, left, up)):
        axes[:, :, k] = rotate_all(quaternion, axis)
    # the tracker's buffer of times is used again: a path must keep its own
    return FootPath(number, t_ns.copy(), position_m.copy(), axes, foot_off_ns, contact_ns)


@dataclass(frozen=True, slots=True)
class FootArms:
    """Toe and heel seen from the sensor with the foot flat: forward, left, up (m)."""

    toe_m: Vector3
    heel_m: Vector3


def arms_of(geometry: FootGeometry) -> FootArms:
    """The arms of a session's geometry."""
    return FootArms(
        (geometry.toe_forward_m, geometry.toe_left_m, geometry.toe_up_m),
        (geometry.heel_forward_m, geometry.heel_left_m, geometry.heel_up_m),
    )


def rise(path: FootPath, arm_m: Vector3) -> FloatArray:
    """Height (N,) in m of the point at ``arm_m`` above its own start."""
    return np.asarray(path.position_m[:, 2] + path.tilt @ np.array(arm_m))


@dataclass(frozen=True, slots=True)
class ContactLevels:
    """Where a recording sees the toe at foot off and the foot's lowest point at contact, and how much it rises (m).

    Each against the stance that is nearer; ``rise_m`` is from one stance to the next. The weights (0 to 1) say how far
    to trust each: they are the share of the spread between strides that is error rather than gait.
    """

    foot_off_m: float
    contact_m: float
    rise_m: float
    foot_off_weight: float
    contact_weight: float
    rise_weight: float

    def correction(self, path: FootPath, toe_m: FloatArray, heel_m: FloatArray) -> FloatArray:
        """What to add to the heights of a stride (N,), given those of its toe and heel."""
        seen = _contacts(path, toe_m, heel_m)
        if seen is None or path.foot_off_ns is None or path.contact_ns is None:
            return np.zeros(len(path.t_ns))
        times = [path.t_ns[0], path.foot_off_ns, path.contact_ns, path.t_ns[-1]]
        levels = np.array([self.foot_off_m, self.contact_m, self.rise_m])
        weights = np.array([self.foot_off_weight, self.contact_weight, self.rise_weight])
        drift = levels - np.array(seen)
        off, contact, end = np.where(np.abs(drift) <= MOST_DRIFT_M, weights * drift, 0.0).tolist()
        seconds = [1e-9 * float(t - path.t_ns[0]) for t in times]
        return np.asarray(np.interp(1e-9 * (path.t_ns - path.t_ns[0]), seconds, [0.0, off, contact + end, end]))


def contact_levels(paths: Sequence[FootPath], arms: FootArms) -> ContactLevels | None:
    """Levels of one foot's recording, from all its strides; None if fewer than five show both contacts."""
    each = [_contacts(path, rise(path, arms.toe_m), rise(path, arms.heel_m)) for path in paths]
    seen = np.array([heights for heights in each if heights is not None]).reshape(-1, 3)
    if len(seen) < LEAST_STRIDES:
        return None
    cut = int(
        TRIM * len(seen)
    )  # a stumble or a turn must not shift the rest, and half the strides is too much to waste
    level = np.sort(seen, axis=0)[cut : len(seen) - cut].mean(axis=0)
    spread = 1.4826 * np.median(np.abs(seen - np.median(seen, axis=0)), axis=0)
    weight = 1.0 - np.minimum(CONTACT_SPREAD_M / np.maximum(spread, 1e-9), 1.0) ** 2
    off, contact, rises = level.tolist()
    return ContactLevels(off, contact, rises if abs(rises) > LEVEL_GROUND_M else 0.0, *weight.tolist())


def _contacts(path: FootPath, toe_m: FloatArray, heel_m: FloatArray) -> tuple[float, float, float] | None:
    """Height of the toe at foot off over the stance before, of the lower of toe and heel at contact over the next (m).

    And of the foot in the stance after over that before. So steps up and down do not make the first two differ.
    """
    if path.foot_off_ns is None or path.contact_ns is None:
        return None
    off, contact = path.index(path.foot_off_ns), path.index(path.contact_ns)
    if not 0 < off < contact:
        return None
    lowest = float(min(toe_m[contact] - toe_m[-1], heel_m[contact] - heel_m[-1]))
    return float(toe_m[off]), lowest, float(0.5 * (toe_m[-1] + heel_m[-1]))


@dataclass(frozen=True, slots=True)
class Clearance:
    """Heights above the starting stance (m); the toe's are NaN without foot off or contact.

    ``toe_m`` is the minimum toe clearance; where ``dips`` is False the toe has no minimum between two peaks, and this
    is its height at its greatest horizontal speed. ``toe_first_peak_m`` and ``toe_last_peak_m`` are the greatest
    heights before and after it, ``heel_m`` and ``sensor_m`` the greatest of the stride.
    """

    toe_m: float
    toe_first_peak_m: float
    toe_last_peak_m: float
    heel_m: float
    sensor_m: float
    dips: bool


def clearance(path: FootPath, arms: FootArms, levels: ContactLevels | None = None) -> Clearance:
    """The clearances of one stride, shifted to the recording's contact levels if those are given."""
    toe, heel, sensor = rise(path, arms.toe_m), rise(path, arms.heel_m), path.position_m[:, 2]
    if levels is not None:
        shift = levels.correction(path, toe, heel)
        toe, heel, sensor = toe + shift, heel + shift, sensor + shift
    highest = float(heel.max()), float(sensor.max())
    if path.foot_off_ns is None or path.contact_ns is None:
        return Clearance(math.nan, math.nan, math.nan, *highest, False)
    begin, end = path.index(path.foot_off_ns), path.index(path.contact_ns) + 1
    if end - begin < 3:
        return Clearance(math.nan, math.nan, math.nan, *highest, False)
    point = path.position_m[begin:end, :2] + path.axes[begin:end, :2, :] @ np.array(arms.toe_m)
    swing = toe[begin:end]
    lowest, dips = mid_swing(path.t_ns[begin:end], swing, point)
    first, last = float(swing[: lowest + 1].max()), float(swing[lowest:].max())
    return Clearance(float(swing[lowest]), first, last, *highest, dips)


def mid_swing(t_ns: IntArray, height_m: FloatArray, level_m: FloatArray) -> tuple[int, bool]:
    """The sample of the minimum toe clearance within a swing of at least 3 samples, and whether the toe dips there.

    ``height_m`` (N,) and ``level_m`` (N, 2) are the toe's height and horizontal place. The minimum is the sample that
    lies deepest below the lower of the peaks before and after it; without one, that of the greatest horizontal speed.
    """
    before = np.maximum.accumulate(height_m)
    after = np.maximum.accumulate(height_m[::-1])[::-1]
    depth = np.minimum(before, after) - height_m
    deepest = int(np.argmax(depth))
    if depth[deepest] >= LEAST_DIP_M:
        return deepest, True
    speed = np.linalg.norm(np.gradient(level_m, 1e-9 * (t_ns - t_ns[0]), axis=0), axis=1)
    return int(np.argmax(speed)), False


def with_clearance(
    strides: Sequence[StrideResult], paths: Sequence[FootPath], arms: FootArms, levels: ContactLevels | None
) -> list[StrideResult]:
    """The strides of one foot's recording with toe and heel clearance from their paths, shifted to ``levels`` if given.

    A stride without a path of the same number is passed on as it is.
    """
    found = {path.number: clearance(path, arms, levels) for path in paths}
    return [
        replace(stride, toe_clearance_m=found[stride.number].toe_m, heel_clearance_m=found[stride.number].heel_m)
        if stride.number in found
        else stride
        for stride in strides
    ]
