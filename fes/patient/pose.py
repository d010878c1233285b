"""Where a foot and its sensor are: ten smooth channels → world pose, angular rate and acceleration.

The walking frame (belt frame) has x forward, y left, z up and moves with the belt; the world stands still. For
channels pitch ``p``, roll ``r``, yaw ``w`` and a point ``b`` of the foot, with travel ``X`` and height ``H`` of the
rocker::

    position = [along, across, lift] + Rz(w) (Rx(r) ([X, 0, H] + Ry(p) b) - ball) + ball
    R_world_from_foot = Rz(w) Rx(r) Ry(p)

so that yaw and roll turn the foot about its ball on the ground, not about the ankle.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

import numpy as np

from fes.patient.foot import Rocker
from fes.patient.jets import Jet, cos, sin
from fes.patient.motion import Block, evaluate
from fes.signals import FloatArray, Vector3

CHANNELS: Final = (
    "pitch",  # rad, toe-down positive
    "roll",  # rad, about the forward axis
    "yaw",  # rad, about the vertical, to the left positive
    "along",  # m, forward in the walking frame, rolling taken apart
    "across",  # m, to the left
    "lift",  # m, least height of the sole's lowest point
    "air",  # 0 on the ground, 1 free: see fes.patient.foot.Rocker
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


def rotation(pitch: FloatArray, roll: FloatArray, yaw: FloatArray) -> FloatArray:
    """(N, 3, 3) ``Rz(yaw) Rx(roll) Ry(pitch)`` from angles (N,) in rad."""
    sp, cp = np.sin(pitch), np.cos(pitch)
    sr, cr = np.sin(roll), np.cos(roll)
    sw, cw = np.sin(yaw), np.cos(yaw)
    rows = [
        [cw * cp - sw * sr * sp, -sw * cr, cw * sp + sw * sr * cp],
        [sw * cp + cw * sr * sp, cw * cr, sw * sp - cw * sr * cp],
        [-cr * sp, sr, cr * cp],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def stack(vector: JetVector) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Position, velocity and acceleration, each (N, 3), of a vector of Jets."""
    x, y, z = vector
    return (
        np.column_stack([x.value, y.value, z.value]),
        np.column_stack([x.rate, y.rate, z.rate]),
        np.column_stack([x.acceleration, y.acceleration, z.acceleration]),
    )
