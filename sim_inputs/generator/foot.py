"""A rigid foot whose curved sole rolls on the ground without slipping, and where it and its sensor are.

Foot frame: x forward, y left, z up, origin on the sole below the ankle; ``pitch`` is rotation about +y, toe-down
positive. The sole is a convex curve given by its radius of curvature over the tangent's angle: a small heel arc, an
almost flat middle, a toe arc. For pitch ``p`` the contact point is ``c(p) = ∫ rho(p) (cos p, sin p) dp``, the origin's
height ``h = cx sin p - cz cos p``, and rolling without slip moves the origin forward by ``dx = h dp`` (the contact is
the instantaneous centre), so a foot in contact can neither sink into the ground nor slide, whatever its pitch does.

The walking frame (belt frame) has x forward, y left, z up and moves with the belt; the world stands still. For
channels pitch ``p``, roll ``r``, yaw ``w`` and a point ``b`` of the foot, with travel ``X`` and height ``H`` of the
rocker, yaw and roll turn the foot about its ball on the ground, not about the ankle::

    position = [along, across, lift] + Rz(w) (Rx(r) ([X, 0, H] + Ry(p) b) - ball) + ball
    R_world_from_foot = Rz(w) Rx(r) Ry(p)
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from fes.signals import FloatArray, IntArray, Vector3
from fes.simulation.sensor import rotation
from sim_inputs.generator.motion import Block, Jet, cos, evaluate, sin

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


CHANNELS: Final = (
    "pitch",  # rad, toe-down positive
    "roll",  # rad, about the forward axis
    "yaw",  # rad, about the vertical, to the left positive
    "along",  # m, forward in the walking frame, rolling taken apart
    "across",  # m, to the left
    "lift",  # m, least height of the sole's lowest point
    "air",  # 0 on the ground, 1 free: see sim_inputs.generator.foot.Rocker
    "shear",  # m, sensor forward against the sole: shoe and soft tissue
    "bounce",  # m, sensor up against the sole: ringing after contact, shaking of the belt
    "nod",  # rad, sensor pitch against the sole: ringing after contact
)
JetVector = tuple[Jet, Jet, Jet]


@dataclass(slots=True)
class FootMotion:
    """All that one foot does: the blocks of each channel, filled by gait and activities."""

    channels: dict[str, list[Block]] = field(default_factory=lambda: {name: [] for name in CHANNELS})

    def add(self, channel: str, *blocks: Block) -> None:
        """Add blocks to a channel of :data:`CHANNELS`."""
        self.channels[channel].extend(blocks)

    def at(self, t_s: FloatArray) -> FootPath:
        """The foot at the ascending instants ``t_s`` (N,) in seconds."""
        return FootPath({name: evaluate(blocks, t_s) for name, blocks in self.channels.items()})


@dataclass(frozen=True, slots=True)
class FootPath:
    """The channels of one foot over N instants."""

    channels: dict[str, Jet]

    def point(self, rocker: Rocker, body_m: Vector3) -> JetVector:
        """A point fixed to the sole's frame, in the walking frame (m)."""
        return self._place(rocker, body_m, self.channels["pitch"])

    def sensor(self, rocker: Rocker, body_m: Vector3) -> JetVector:
        """The sensor's position in the walking frame (m): a point of the foot plus shear, bounce and nod."""
        c = self.channels
        x, y, z = self._place(rocker, body_m, c["pitch"] + c["nod"])
        return x + c["shear"], y, z + c["bounce"]

    def sensor_rotation(self) -> FloatArray:
        """(N, 3, 3) rotation world from foot at the sensor, nod included."""
        c = self.channels
        return rotation(c["pitch"].value + c["nod"].value, c["roll"].value, c["yaw"].value)

    def sensor_rate(self) -> FloatArray:
        """(N, 3) angular rate at the sensor in foot axes, rad/s."""
        c = self.channels
        pitch, roll, yaw = c["pitch"] + c["nod"], c["roll"], c["yaw"]
        sp, cp = np.sin(pitch.value), np.cos(pitch.value)
        sr, cr = np.sin(roll.value), np.cos(roll.value)
        across = pitch.rate + yaw.rate * sr
        return np.column_stack([roll.rate * cp - yaw.rate * cr * sp, across, roll.rate * sp + yaw.rate * cr * cp])

    def _place(self, rocker: Rocker, body_m: Vector3, pitch: Jet) -> JetVector:
        c = self.channels
        x, y, z = body_m
        travel, height = rocker.roll(c["pitch"], c["air"])
        sp, cp = sin(pitch), cos(pitch)
        forward = travel + cp * x + sp * z - rocker.sole.ball_m
        above = height - sp * x + cp * z
        sr, cr = sin(c["roll"]), cos(c["roll"])
        left = cr * y - sr * above
        up = cr * above + sr * y
        sw, cw = sin(c["yaw"]), cos(c["yaw"])
        return (
            c["along"] + cw * forward - sw * left + rocker.sole.ball_m,
            c["across"] + sw * forward + cw * left,
            c["lift"] + up,
        )


def stack(vector: JetVector) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Position, velocity and acceleration, each (N, 3), of a vector of Jets."""
    x, y, z = vector
    return (
        np.column_stack([x.value, y.value, z.value]),
        np.column_stack([x.rate, y.rate, z.rate]),
        np.column_stack([x.acceleration, y.acceleration, z.acceleration]),
    )
