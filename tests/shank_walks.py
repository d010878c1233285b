"""A shank as an inverted pendulum with exact truth: the ankle stands through stance and flies through swing.

The lean and the ankle's path are smooth analytic curves (cubic splines, quintics), so that rates and accelerations are
their derivatives and not differences.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from fes.signals import G_MPS2, FloatArray, IntArray

KNEE_M = 0.42  # above the ankle
PHASES = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.78, 0.86, 0.93)  # of a stride from contact
LEAN_DEG = (-24.0, -15.0, -10.0, -6.5, -1.5, 7.0, 22.0, 38.0, 26.0, -6.0, -22.0)
FOOT_OFF = 0.62


@dataclass(frozen=True)
class ShankWalk:
    """Samples and truth; ``sensor_from_shank`` turns (forward, left, up) of the upright shank into the sensor frame."""

    rate_hz: float
    t_ns: IntArray
    acc: FloatArray
    gyr: FloatArray
    strides: int
    stride_length_m: float
    rise_m: float
    arm_m: FloatArray
    sensor_from_shank: FloatArray


def shank_walk(
    *,
    arm_m: tuple[float, float, float] = (0.02, 0.0, 0.25),
    strides: int = 12,
    stride_s: float = 1.2,
    stride_length_m: float = 1.2,
    rise_m: float = 0.0,
    standing_s: float = 0.0,
    even: bool = False,
    belt_mps: float = 0.0,
    rate_hz: float = 100.0,
    seed: int = 0,
    gyr_bias_radps: float = 0.0,
    noise: float = 0.0,
) -> ShankWalk:
    """A straight walk of one shank; ``belt_mps``: on a belt that starts and stops with the walk.

    ``arm_m`` from the ankle to the sensor (forward, left, up) of the upright shank; ``standing_s`` of standing before
    and after; ``even`` lets the shank turn at a nearly constant rate all through stance, so that nothing can be learnt.
    """
    rng = np.random.default_rng(seed)
    lean = np.array(LEAN_DEG)
    if even:
        middle = np.array(PHASES[:7]) - 0.3
        lean[:7] = 50.0 * middle + 60.0 * middle**3
        lean[7:] = (27.0, 22.0, -4.0, -20.0)
    times, angles = [], []
    if standing_s > 0.0:
        times, angles = list(np.arange(0.0, standing_s, 0.1)), [0.0] * len(np.arange(0.0, standing_s, 0.1))
    begin_s = (times[-1] + 0.3 if times else 0.0) - (0.4 * stride_s if times else 0.0)
    for k in range(strides):
        for phase, angle in zip(PHASES, lean, strict=True):
            at = begin_s + (k + phase) * stride_s
            if not times or at > times[-1] + 0.05:
                times.append(at)
                angles.append(float(angle))
    end_s = begin_s + strides * stride_s
    if standing_s > 0.0:
        tail = np.arange(end_s + 0.3, end_s + 0.3 + standing_s, 0.1)
        times += [end_s, *tail]
        angles += [-6.0, *np.zeros(len(tail))]
    curve = CubicSpline(times, np.radians(angles))
    t = np.arange(0.0, times[-1], 1.0 / rate_hz)
    theta, rate, change = curve(t), curve(t, 1), curve(t, 2)

    ankle, ankle_acc = np.zeros((len(t), 3)), np.zeros((len(t), 3))
    for k in range(strides):
        off_s, span_s = begin_s + (k + FOOT_OFF) * stride_s, (1.0 - FOOT_OFF) * stride_s
        u = np.clip((t - off_s) / span_s, 0.0, 1.0)
        flying = (u > 0.0) & (u < 1.0)
        way, way_acc = u**3 * (10 - 15 * u + 6 * u**2), (60 * u - 180 * u**2 + 120 * u**3) / span_s**2
        bump = 64.0 * u**3 * (1 - u) ** 3
        bump_acc = 64.0 * (6 * u - 36 * u**2 + 60 * u**3 - 30 * u**4) / span_s**2
        ankle[:, 0] += stride_length_m * way
        ankle[:, 2] += rise_m * way + 0.1 * bump
        ankle_acc[:, 0] += np.where(flying, stride_length_m * way_acc, 0.0)
        ankle_acc[:, 2] += np.where(flying, rise_m * way_acc + 0.1 * bump_acc, 0.0)

    for at_s, sign in ((begin_s + 0.3 * stride_s, -1.0), (end_s, 1.0)):
        u = np.clip((t - at_s) / 0.3, 0.0, 1.0)
        ankle_acc[:, 0] += sign * belt_mps * 30.0 * u**2 * (1 - u) ** 2 / 0.3

    world_from_shank = Rotation.from_rotvec(theta[:, None] * np.array([0.0, 1.0, 0.0]))
    w = rate[:, None] * np.array([0.0, 1.0, 0.0])
    alpha = change[:, None] * np.array([0.0, 1.0, 0.0])
    lever = world_from_shank.apply(np.array(arm_m))
    acc_world = ankle_acc + np.cross(alpha, lever) + np.cross(w, np.cross(w, lever)) + np.array([0.0, 0.0, G_MPS2])
    mounting = Rotation.random(random_state=seed)
    acc = mounting.apply(world_from_shank.inv().apply(acc_world))
    gyr = mounting.apply(w) + gyr_bias_radps * np.array([0.6, -0.64, 0.48])
    return ShankWalk(
        rate_hz=rate_hz,
        t_ns=np.round(1e9 * t).astype(np.int64),
        acc=np.ascontiguousarray(acc + noise * rng.standard_normal(acc.shape)),
        gyr=np.ascontiguousarray(gyr + 0.1 * noise * rng.standard_normal(gyr.shape)),
        strides=strides,
        stride_length_m=stride_length_m,
        rise_m=rise_m,
        arm_m=np.array(arm_m),
        sensor_from_shank=mounting.as_matrix(),
    )


def shank_moved(
    lean_rad: FloatArray,
    ankle_m: FloatArray | None = None,
    *,
    arm_m: tuple[float, float, float] = (0.02, 0.0, 0.25),
    rate_hz: float = 100.0,
    seed: int = 0,
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Samples of a shank that leans ``lean_rad`` (N,) while its ankle goes along ``ankle_m`` (N, 3: forward, left, up).

    Without a path the knee stays where it is, as of one who sits. Mounted as :func:`shank_walk` with the same seed.
    Returns t_ns, specific force and rates.
    """
    n = len(lean_rad)
    if ankle_m is None:
        ankle_m = -KNEE_M * np.column_stack((np.sin(lean_rad), np.zeros(n), np.cos(lean_rad)))
    step_s = 1.0 / rate_hz
    rate = np.gradient(lean_rad, step_s)
    world_from_shank = Rotation.from_rotvec(lean_rad[:, None] * np.array([0.0, 1.0, 0.0]))
    path = ankle_m + world_from_shank.apply(np.array(arm_m))
    acc_world = np.gradient(np.gradient(path, step_s, axis=0), step_s, axis=0) + np.array([0.0, 0.0, G_MPS2])
    mounting = Rotation.random(random_state=seed)
    rng = np.random.default_rng(seed)
    acc = mounting.apply(world_from_shank.inv().apply(acc_world)) + 0.03 * rng.standard_normal((n, 3))
    gyr = mounting.apply(rate[:, None] * np.array([0.0, 1.0, 0.0])) + 0.003 * rng.standard_normal((n, 3))
    t_ns = np.round(1e9 * step_s * np.arange(n)).astype(np.int64)
    return t_ns, np.ascontiguousarray(acc), np.ascontiguousarray(gyr)


def eased(times_s: list[float], values: list[float], until_s: float, rate_hz: float = 100.0) -> FloatArray:
    """A curve that goes smoothly from value to value and rests before the first and behind the last, (N,)."""
    t = np.arange(0.0, until_s, 1.0 / rate_hz)
    out = np.full(len(t), values[0])
    for (begin, end), (a, b) in zip(pairwise(times_s), pairwise(values), strict=True):
        u = np.clip((t - begin) / (end - begin), 0.0, 1.0)
        out += (b - a) * u**3 * (10 - 15 * u + 6 * u**2)
    return out
