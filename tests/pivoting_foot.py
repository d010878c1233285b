"""A made-up foot that turns about its toe and its heel exactly, for tests of lever arms."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from benchmarks.lib.foot_paths import FootPath, join_paths
from fes.estimation.clearance.clearance import FootArms
from fes.estimation.clearance.geometry import EstimatedGeometry, estimate_geometry
from fes.signals import FloatArray

RATE_HZ = 200.0
HEEL_RISES_S, FOOT_OFF_S, CONTACT_S, FLAT_S, END_S = 0.2, 0.5, 0.9, 1.0, 1.2
TURN_OFF_RAD = math.radians(-60.0)


def rotation(pitch: FloatArray, roll: FloatArray, yaw: FloatArray) -> FloatArray:
    """Foot axes (forward, left, up as columns) in the world; pitch toe-up positive."""
    c, s, zero, one = np.cos, np.sin, np.zeros_like(pitch), np.ones_like(pitch)
    y = np.stack([c(pitch), zero, -s(pitch), zero, one, zero, s(pitch), zero, c(pitch)], 1).reshape(-1, 3, 3)
    x = np.stack([one, zero, zero, zero, c(roll), -s(roll), zero, s(roll), c(roll)], 1).reshape(-1, 3, 3)
    z = np.stack([c(yaw), -s(yaw), zero, s(yaw), c(yaw), zero, zero, zero, one], 1).reshape(-1, 3, 3)
    return np.asarray(z @ y @ x)


def stride(arms: FootArms, *, landing_rad: float = 0.4, lift_m: float = 0.03, number: int = 1) -> FootPath:
    """A foot that turns about its toe until foot off, swings, lands on its heel and turns about that until flat."""
    t = np.arange(round(END_S * RATE_HZ) + 1) / RATE_HZ
    # the greatest rate falls on foot off, as in people
    pitch = np.interp(t, [HEEL_RISES_S, FOOT_OFF_S, FOOT_OFF_S + 0.3, CONTACT_S, FLAT_S], [0, 1, 0, 0, 0])
    pitch = TURN_OFF_RAD * pitch**2 + landing_rad * np.interp(t, [FOOT_OFF_S + 0.1, CONTACT_S, FLAT_S], [0, 1, 0])
    axes = rotation(pitch, np.zeros_like(t), np.zeros_like(t))
    toe, heel = np.array(arms.toe_m), np.array(arms.heel_m)
    on_toe, on_heel = toe - axes @ toe, np.array([1.2, 0.0, 0.0]) + heel - axes @ heel
    share = np.clip((t - FOOT_OFF_S) / (CONTACT_S - FOOT_OFF_S), 0.0, 1.0)
    blend = (share**2 * (3.0 - 2.0 * share))[:, None]
    position = (1.0 - blend) * on_toe + blend * on_heel
    position[:, 2] += lift_m * np.sin(math.pi * share) ** 2
    stamps = np.round(1e9 * t).astype(np.int64)
    return FootPath(number, stamps, position, axes, round(1e9 * FOOT_OFF_S), round(1e9 * CONTACT_S))


def arms(forward_m: float, sole_m: float, height_m: float) -> FootArms:
    return FootArms((forward_m, 0.0, -height_m), (forward_m - sole_m, 0.0, -height_m))


ARMS = arms(0.12, 0.21, 0.06)


def upstairs(path: FootPath, step_m: float) -> FootPath:
    share = np.interp(1e-9 * path.t_ns, [FOOT_OFF_S, CONTACT_S], [0.0, step_m])
    return replace(path, position_m=path.position_m + np.column_stack([0 * share, 0 * share, share]))


def geometry_of(paths: list[FootPath]) -> EstimatedGeometry:
    return estimate_geometry(join_paths(paths))
