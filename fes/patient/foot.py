"""A rigid foot whose curved sole rolls on the ground without slipping.

Foot frame: x forward, y left, z up, origin on the sole below the ankle; ``pitch`` is rotation about +y, toe-down
positive. The sole is a convex curve given by its radius of curvature over the tangent's angle: a small heel arc, an
almost flat middle, a toe arc. For pitch ``p`` the contact point is ``c(p) = ∫ rho(p) (cos p, sin p) dp``, the origin's
height ``h = cx sin p - cz cos p``, and rolling without slip moves the origin forward by ``dx = h dp`` (the contact is
the instantaneous centre), so a foot in contact can neither sink into the ground nor slide, whatever its pitch does.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from fes.patient.jets import Jet
from fes.signals import FloatArray, IntArray

AIR_FLAT_RAD = 0.26


@dataclass(frozen=True, slots=True)
class Sole:
    """The rocker of an adult's shoe (m, rad): where heel and ball touch, how round they are, how sharp flat is."""

    heel_m: float = -0.060
    ball_m: float = 0.115
    heel_radius_m: float = 0.030
    toe_radius_m: float = 0.055
    flat_rad: float = 0.0175

    def radius(self, pitch: FloatArray) -> FloatArray:
        """Radius of curvature in m at the point that touches when the foot is pitched by ``pitch`` (N,)."""
        side = np.tanh(pitch / self.flat_rad)
        flat = 0.5 * (self.ball_m - self.heel_m) / self.flat_rad * (1.0 - side * side)
        round_: FloatArray = 0.5 * (self.heel_radius_m * (1.0 - side) + self.toe_radius_m * (1.0 + side))
        return flat + round_


@dataclass(frozen=True, slots=True)
class RollingCurve:
    """A sole's contact point and rolling distance over pitch, tabulated once (4th-order accurate between)."""

    sole: Sole
    step_rad: float = math.radians(0.02)
    low_rad: float = math.radians(-60.0)
    contact_m: FloatArray = field(init=False, repr=False)
    rolled_m: FloatArray = field(init=False, repr=False)

    def __post_init__(self) -> None:
        count = round(math.radians(170.0) / self.step_rad) + 1
        pitch: FloatArray = self.low_rad + self.step_rad * np.arange(count, dtype=np.float64)
        middle = pitch[:-1] + 0.5 * self.step_rad
        speed = np.stack([self._speed(p) for p in (pitch[:-1], middle, pitch[1:])])
        contact = np.vstack([np.zeros(2), np.cumsum(np.tensordot([1, 4, 1], speed, 1), 0) * self.step_rad / 6])
        level = round(-self.low_rad / self.step_rad)
        contact -= contact[level] - [0.5 * (self.sole.heel_m + self.sole.ball_m), 0.0]
        object.__setattr__(self, "contact_m", contact)
        height = _height(pitch, contact)
        # Hermite quadrature: dx/dp = h and dh/dp = h' are both known at the grid points
        slope = np.cos(pitch) * contact[:, 0] + np.sin(pitch) * contact[:, 1]
        rise = self.step_rad * 0.5 * (height[1:] + height[:-1]) + self.step_rad**2 / 12 * (slope[:-1] - slope[1:])
        rolled = np.concatenate([[0.0], np.cumsum(rise)])
        object.__setattr__(self, "rolled_m", rolled - rolled[level])

    def _speed(self, pitch: FloatArray) -> FloatArray:
        radius = self.sole.radius(pitch)
        return np.column_stack([radius * np.cos(pitch), radius * np.sin(pitch)])

    def contact(self, pitch: FloatArray) -> FloatArray:
        """Where the sole touches, in the foot frame: (N, 2) x and z in m."""
        place, u = self._cell(pitch)
        grid: FloatArray = self.low_rad + self.step_rad * place.astype(np.float64)
        here, there = self._speed(grid) * self.step_rad, self._speed(grid + self.step_rad) * self.step_rad
        return _hermite(u[:, None], self.contact_m[place], self.contact_m[place + 1], here, there)

    def roll(self, pitch: Jet) -> tuple[Jet, Jet]:
        """Forward travel and height of the foot's origin in m, touching the ground at that pitch."""
        touch = self.contact(pitch.value)
        height = _height(pitch.value, touch)
        slope = np.cos(pitch.value) * touch[:, 0] + np.sin(pitch.value) * touch[:, 1]
        place, u = self._cell(pitch.value)
        grid: FloatArray = self.low_rad + self.step_rad * place.astype(np.float64)
        here = _height(grid, self.contact_m[place]) * self.step_rad
        there = _height(grid + self.step_rad, self.contact_m[place + 1]) * self.step_rad
        rolled = _hermite(u, self.rolled_m[place], self.rolled_m[place + 1], here, there)
        curvature = self.sole.radius(pitch.value) - height
        return pitch.through(rolled, height, slope), pitch.through(height, slope, curvature)

    def _cell(self, pitch: FloatArray) -> tuple[IntArray, FloatArray]:
        position = (pitch - self.low_rad) / self.step_rad
        place = np.clip(position.astype(np.int64), 0, len(self.contact_m) - 2)
        return place, position - place


@dataclass(frozen=True, slots=True)
class Rocker:
    """The foot's travel and height over pitch, on the ground and in the air.

    A flat sole's lowest point jumps from heel to ball when the foot, in the air, turns through level: fine for what
    touches the ground, but it would jerk the whole leg. In the air the path therefore follows a rounder sole, raised
    until the true one is nowhere below it: the true sole's clearance is then at least the ``lift`` asked for.
    """

    sole: Sole
    ground: RollingCurve = field(init=False, repr=False)
    air: RollingCurve = field(init=False, repr=False)
    raise_m: float = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "ground", RollingCurve(self.sole))
        object.__setattr__(self, "air", RollingCurve(replace(self.sole, flat_rad=AIR_FLAT_RAD)))
        pitch = np.radians(np.linspace(-45.0, 80.0, 500))
        sunk = _height(pitch, self.ground.contact(pitch)) - _height(pitch, self.air.contact(pitch))
        object.__setattr__(self, "raise_m", float(sunk.max()))

    def roll(self, pitch: Jet, air: Jet) -> tuple[Jet, Jet]:
        """Forward travel and height (m) of the foot's origin; ``air`` goes from 0 (on the ground) to 1 (free)."""
        travel, height = self.ground.roll(pitch)
        free_travel, free_height = self.air.roll(pitch)
        return travel + air * (free_travel - travel), height + air * (free_height + self.raise_m - height)


def _height(pitch: FloatArray, touch: FloatArray) -> FloatArray:
    height: FloatArray = np.sin(pitch) * touch[:, 0] - np.cos(pitch) * touch[:, 1]
    return height


def _hermite(u: FloatArray, a: FloatArray, b: FloatArray, slope_a: FloatArray, slope_b: FloatArray) -> FloatArray:
    v = 1.0 - u
    return (1 + 2 * u) * v * v * a + u * u * (3 - 2 * u) * b + u * v * v * slope_a - u * u * v * slope_b
