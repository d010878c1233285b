"""A stride's whole solution in one compiled call: its ends, its orientation, its trajectory, and their numbers."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from fes.estimation.numerics.jit import inlined, jit_fused
from fes.estimation.numerics.rotation import to_world
from fes.estimation.strides.boundaries import NO_REST_RADPS, REST_RADPS, around_ends, mean_and_variance
from fes.estimation.strides.constrained import integrate, orient
from fes.estimation.strides.maximum_likelihood import (
    HeightNoise,
    StrideNoise,
    end_variances,
    maximum_likelihood,
    settle_height,
)

SHORTEST_M = 0.05  # a stride shorter than that has no direction but the foot's


@jit_fused
def height_and_turn(quaternion: Any, position: Any, fx: float, fy: float, fz: float) -> tuple[float, float]:
    """The greatest height of a stride in m, and by how much the foot turned in rad, left positive, within half a turn.

    Args:
        quaternion: (N, 4) orientations, sensor to world.
        position: (N, 3) in m from the start.
        fx: unit vector towards the toe in the sensor frame, with ``fy`` and ``fz``.
        fy: see ``fx``.
        fz: see ``fx``.
    """
    peak_height = -math.inf
    for i in range(position.shape[0]):
        peak_height = max(peak_height, position[i, 2])
    ahead, left, _ = _pointing(quaternion, 0, fx, fy, fz)
    turn = -math.atan2(left, ahead)
    ahead, left, _ = _pointing(quaternion, position.shape[0] - 1, fx, fy, fz)
    turn += math.atan2(left, ahead)
    return peak_height, (turn + math.pi) % (2.0 * math.pi) - math.pi


@jit_fused
def stride_shape(t_ns: Any, quaternion: Any, position: Any, fx: float, fy: float, fz: float, out: Any) -> None:
    """Fill ``out`` (K, 4): ahead, left and up (m) in the direction of the stride, and pitch (rad) since its start.

    ``t_ns`` (N,) are the time stamps; the K rows of ``out`` are evenly spaced from the first to the last, linear in
    between. The others are as for :func:`height_and_turn`.
    """
    n, count = t_ns.shape[0], out.shape[0]
    pitch = np.empty(n)
    for i in range(n):
        _, _, up = _pointing(quaternion, i, fx, fy, fz)
        pitch[i] = math.asin(min(max(up, -1.0), 1.0))
    dx, dy = position[n - 1, 0], position[n - 1, 1]
    length = math.sqrt(dx * dx + dy * dy)
    if length <= SHORTEST_M:
        dx, dy, _ = _pointing(quaternion, 0, fx, fy, fz)
        length = math.sqrt(dx * dx + dy * dy)
    dx, dy = (dx / length, dy / length) if length > 0.0 else (1.0, 0.0)
    i, step = 0, (t_ns[n - 1] - t_ns[0]) / (count - 1)
    for k in range(count):
        at = k * step  # ns since the start
        while i < n - 2 and t_ns[i + 1] - t_ns[0] <= at:
            i += 1
        share = min((at - (t_ns[i] - t_ns[0])) / (t_ns[i + 1] - t_ns[i]), 1.0)
        x = position[i, 0] + share * (position[i + 1, 0] - position[i, 0])
        y = position[i, 1] + share * (position[i + 1, 1] - position[i, 1])
        out[k, 0] = x * dx + y * dy
        out[k, 1] = y * dx - x * dy
        out[k, 2] = position[i, 2] + share * (position[i + 1, 2] - position[i, 2])
        out[k, 3] = pitch[i] + share * (pitch[i + 1] - pitch[i]) - pitch[0]


@jit_fused
def stride_shapes(
    firsts: Any, counts: Any, t_ns: Any, quaternion: Any, position: Any, fx: float, fy: float, fz: float, out: Any
) -> None:
    """As :func:`stride_shape` of S strides, of each ``counts`` rows from ``firsts`` on, (S,); ``out`` (S, K, 4)."""
    for k in range(firsts.shape[0]):
        a, b = firsts[k], firsts[k] + counts[k]
        if b > a:
            stride_shape(t_ns[a:b], quaternion[a:b], position[a:b], fx, fy, fz, out[k])


@inlined
def _pointing(quaternion: Any, i: int, x: float, y: float, z: float) -> tuple[float, float, float]:
    """An axis of the sensor in the world at sample ``i``."""
    return to_world(quaternion[i, 0], quaternion[i, 1], quaternion[i, 2], quaternion[i, 3], x, y, z)


NOISE, HEIGHT_NOISE = StrideNoise(), HeightNoise()
# forward, of an instep in mid-stance beyond w × r: shoe and skin give way, as optical systems see too. The constrained
# method, which cannot tell a velocity from an acceleration error, needs more of it on the same recordings.
DRIFT_SPEED_MPS = {"maximum_likelihood": 0.002, "constrained": 0.005}
_DRIFT_SPEED_MPS, _DRIFT_SPEED_CONSTRAINED_MPS = DRIFT_SPEED_MPS["maximum_likelihood"], DRIFT_SPEED_MPS["constrained"]
END_TILT_GAIN = 0.15
MOST_TILT_RAD = math.radians(30)
LONGEST_STRIDE_M = 3.0
SOLVED, NO_SOLUTION, TILTED, NO_LENGTH, NO_REST = range(5)  # what came of it
TILT, RESIDUAL_RATE, LENGTH, PEAK_HEIGHT, TURN, HEIGHT_CHANGE, NUMBERS = range(7)  # where the numbers are


@jit_fused
def end_velocity(
    qw: float, qx: float, qy: float, qz: float, wx: float, wy: float, wz: float,
    fx: float, fy: float, fz: float, height_m: float, drift_speed_mps: float, row: int, out: Any,
) -> None:  # fmt: skip
    """``w × r`` in the world of a foot that turns about the ground below its sensor, and its drift forward (m/s).

    ``w`` is the rate and ``f`` the unit vector towards the toe, in the sensor frame; fills ``row`` of ``out`` (2, 3).
    """
    wx, wy, _ = to_world(qw, qx, qy, qz, wx, wy, wz)
    fx, fy, _ = to_world(qw, qx, qy, qz, fx, fy, fz)
    drift_speed_mps /= max(math.sqrt(fx * fx + fy * fy), 1e-9)
    out[row, 0], out[row, 1], out[row, 2] = (
        wy * height_m + drift_speed_mps * fx,
        drift_speed_mps * fy - wx * height_m,
        0.0,
    )


@jit_fused
def solve_span(
    t_ns: Any,
    acc: Any,
    gyr: Any,
    first: int,
    last: int,
    start: Any,
    fx: float,
    fy: float,
    fz: float,
    height_m: float,
    constrained: bool,
    equal_height: bool,
    quaternion: Any,
    position: Any,
    numbers: Any,
) -> int:
    """Solve the rows ``first`` … ``last`` (n of them) of a history.

    Args:
        t_ns: (N,) time stamps.
        acc: (N, 3) specific force in m/s², free of bias.
        gyr: (N, 3) rad/s, free of bias.
        first: row.
        last: row.
        start: (4,) orientation at ``first``.
        fx: unit vector towards the toe in the sensor frame, with ``fy`` and ``fz``.
        fy: see ``fx``.
        fz: see ``fx``.
        height_m: of the sensor above the ground contact.
        constrained: not the most likely errors, but Negård et al.'s constraints; these also where there is no rest.
        equal_height: the end is as high as the start.
        quaternion: (n, 4) to be filled.
        position: (n, 3) to be filled, m from the start.
        numbers: (6,) to be filled: tilt found at the end (rad), the faster end's rate (rad/s), length, greatest height
            (m), turn (rad), height gained (m).

    Returns:
        ``SOLVED``, or why the stride cannot be used.
    """
    n = last + 1 - first
    t, f, w = t_ns[first : last + 1], acc[first : last + 1], gyr[first : last + 1]
    around = around_ends(t_ns, first, last)
    rates, forces, variances = np.empty((2, 3)), np.empty((2, 3)), np.empty((2, 2))
    residual_rate = 0.0
    for e in range(2):
        k = last if e else first
        begin, end = max(k - around, 0), min(k + around + 1, t_ns.shape[0])
        r0, r1, r2, s0, s1, s2 = mean_and_variance(gyr, begin, end)
        f0, f1, f2, p0, p1, p2 = mean_and_variance(acc, begin, end)
        rates[e, 0], rates[e, 1], rates[e, 2] = r0, r1, r2
        forces[e, 0], forces[e, 1], forces[e, 2] = f0, f1, f2
        rate = math.sqrt(r0 * r0 + r1 * r1 + r2 * r2)
        spread = math.sqrt(max(p0, p1, p2))
        variances[e, 0], variances[e, 1] = end_variances(rate, math.sqrt(s0 + s1 + s2), spread, NOISE)
        residual_rate = max(residual_rate, rate)
    constrained = constrained or residual_rate > REST_RADPS
    gain = END_TILT_GAIN if constrained else 0.0
    tilt = orient(t, w, start, forces[1, 0], forces[1, 1], forces[1, 2], gain, quaternion)
    drift_speed_mps = _DRIFT_SPEED_CONSTRAINED_MPS if constrained else _DRIFT_SPEED_MPS
    ends = np.empty((2, 3))
    for e in range(2):
        k = n - 1 if e else 0
        end_velocity(
            quaternion[k, 0], quaternion[k, 1], quaternion[k, 2], quaternion[k, 3],
            rates[e, 0], rates[e, 1], rates[e, 2], fx, fy, fz, height_m, drift_speed_mps, e, ends,
        )  # fmt: skip
    velocity = np.empty((n, 3))
    if constrained:
        gamma = np.empty((2, 3))
        solved = integrate(t, f, quaternion, ends[0], ends[1], equal_height, velocity, position, gamma)
    else:
        solved = maximum_likelihood(
            t, f, w, start, ends, forces, variances, equal_height, NOISE, quaternion, velocity, position, True
        )  # fmt: skip
        if solved and equal_height:
            vertical = np.empty((n, 2))
            solved = settle_height(t, f, quaternion, ends[:, 2], variances[:, 0], HEIGHT_NOISE, vertical)
            for i in range(n):
                position[i, 2] = vertical[i, 1]
    numbers[TILT], numbers[RESIDUAL_RATE] = tilt, residual_rate
    if not solved:
        return NO_SOLUTION
    length = math.hypot(position[n - 1, 0], position[n - 1, 1])
    numbers[LENGTH] = length
    if tilt > MOST_TILT_RAD:
        return TILTED
    if not length <= LONGEST_STRIDE_M:
        return NO_LENGTH
    if residual_rate > NO_REST_RADPS:
        return NO_REST
    numbers[PEAK_HEIGHT], numbers[TURN] = height_and_turn(quaternion, position, fx, fy, fz)
    numbers[HEIGHT_CHANGE] = position[n - 1, 2]
    return SOLVED
