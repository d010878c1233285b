"""Quaternions, for compiled code and for arrays: w, x, y, z; ``q`` rotates sensor vectors into the world (z up)."""

import math
from collections.abc import Sequence

import numpy as np

from fes.estimation.numerics.jit import inlined, jit, jit_ieee
from fes.estimation.numerics.records import Mat, Vec
from fes.signals import FloatArray

SMALL_TURN2 = 0.25  # rad²: below, the series of half_turn lack less than the last bit
NEARLY_ONE = 1e-8


@inlined
def half_turn(angle2: float) -> tuple[float, float]:
    """``cos(a/2)`` and ``sin(a/2) / a`` of the squared angle ``a²``; turns between samples are small, and fast here."""
    if angle2 < SMALL_TURN2:
        x = 0.25 * angle2
        y = x * x  # two powers at a time: half as many steps wait for one another
        c = (1.0 - 1 / 2 * x) + y * ((1 / 24 - 1 / 720 * x) + y * ((1 / 40320 - 1 / 3628800 * x) + y * (1 / 479001600)))
        s = (1.0 - 1 / 6 * x) + y * ((1 / 120 - 1 / 5040 * x) + y * (1 / 362880 - 1 / 39916800 * x))
        return c, 0.5 * s
    angle = math.sqrt(angle2)
    return math.cos(0.5 * angle), math.sin(0.5 * angle) / angle


@inlined
def turn_by(
    qw: float, qx: float, qy: float, qz: float, rx: float, ry: float, rz: float
) -> tuple[float, float, float, float]:
    """As :func:`quaternion_step`, not normalised: for so few samples (a stride's) that only last bits add up.

    Each turn waits for the one before, and so less than half as long.
    """
    c, s = half_turn(rx * rx + ry * ry + rz * rz)
    ax, ay, az = s * rx, s * ry, s * rz
    w = qw * c - qx * ax - qy * ay - qz * az
    x = qw * ax + qx * c + qy * az - qz * ay
    y = qw * ay - qx * az + qy * c + qz * ax
    z = qw * az + qx * ay - qy * ax + qz * c
    return w, x, y, z


@inlined
def quaternion_step(
    qw: float, qx: float, qy: float, qz: float, rx: float, ry: float, rz: float
) -> tuple[float, float, float, float]:
    """``q ⊗ exp(r/2)``: turn by the rotation vector ``r`` (rad) given in the sensor frame; normalised."""
    w, x, y, z = turn_by(qw, qx, qy, qz, rx, ry, rz)
    square = w * w + x * x + y * y + z * z
    # what was of length one is so but for rounding, of which one of Newton's steps leaves nothing
    n = 1.5 - 0.5 * square if abs(square - 1.0) < NEARLY_ONE else 1.0 / math.sqrt(square)
    return w * n, x * n, y * n, z * n


@inlined
def to_world(qw: float, qx: float, qy: float, qz: float, vx: float, vy: float, vz: float) -> tuple[float, float, float]:
    """Rotate a sensor vector into the world."""
    tx = 2.0 * (qy * vz - qz * vy)
    ty = 2.0 * (qz * vx - qx * vz)
    tz = 2.0 * (qx * vy - qy * vx)
    return (vx + qw * tx + qy * tz - qz * ty, vy + qw * ty + qz * tx - qx * tz, vz + qw * tz + qx * ty - qy * tx)


@inlined
def to_sensor(
    qw: float, qx: float, qy: float, qz: float, vx: float, vy: float, vz: float
) -> tuple[float, float, float]:
    """Rotate a world vector into the sensor frame."""
    return to_world(qw, -qx, -qy, -qz, vx, vy, vz)


@inlined
def up_in_sensor(w: float, x: float, y: float, z: float) -> tuple[float, float, float]:
    """The world's z axis seen by the sensor: its product with a sensor vector is how high that reaches."""
    return 2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)


@inlined
def axes_in_world(
    w: float, x: float, y: float, z: float
) -> tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]:
    """The sensor's three axes in the world: :func:`to_world` of unit vectors, to the bit."""
    a, b, c = 2.0 * x, 2.0 * y, 2.0 * z
    return (
        (1.0 - y * b - z * c, w * c + x * b, x * c - w * b),
        (y * a - w * c, 1.0 - z * c - x * a, w * a + y * c),
        (w * b + z * a, z * b - w * a, 1.0 - x * a - y * b),
    )


@jit
def from_gravity(fx: float, fy: float, fz: float) -> tuple[float, float, float, float]:
    """The smallest rotation that brings the specific force ``f`` of a resting sensor onto the world's z axis.

    None at all where there is no force: a sensor that has just been switched on may send zeros.
    """
    n = math.sqrt(fx * fx + fy * fy + fz * fz)
    if n < 1e-9:
        return 1.0, 0.0, 0.0, 0.0
    ux, uy, uz = fx / n, fy / n, fz / n
    if uz < -0.999999:
        return 0.0, 1.0, 0.0, 0.0
    w = math.sqrt(0.5 * (1.0 + uz))
    return w, 0.5 * uy / w, -0.5 * ux / w, 0.0


def quaternions_of(axes: FloatArray) -> FloatArray:
    """Quaternions (N, 4) of rotations given as their matrices (N, 3, 3)."""
    (a, b, c), (d, e, f), (g, h, i) = np.moveaxis(axes, 0, 2)
    rows = np.array(
        (
            (1.0 + a + e + i, h - f, c - g, d - b),
            (h - f, 1.0 + a - e - i, b + d, c + g),
            (c - g, b + d, 1.0 - a + e - i, f + h),
            (d - b, c + g, f + h, 1.0 - a - e + i),
        )
    )  # each is the quaternion times four of its own elements; the largest loses least
    largest = np.einsum("jjn->jn", rows).argmax(axis=0)
    found = rows[largest, :, np.arange(len(axes))]
    return np.asarray(found / np.linalg.norm(found, axis=1, keepdims=True))


def cross(a: Sequence[float], b: Sequence[float]) -> FloatArray:
    """The product ``a × b`` of two vectors (3,), for which ``np.cross`` takes ten times as long."""
    (ax, ay, az), (bx, by, bz) = a, b
    return np.array((ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx))


def rotate_all(quaternions: FloatArray, vectors: FloatArray) -> FloatArray:
    """Rotate one sensor vector (3,), or one each (N, 3), by quaternions (N, 4): (N, 3) in the world."""
    (w, x, y, z), (a, b, c) = quaternions.T, vectors.T
    u, v, t = 2.0 * (y * c - z * b), 2.0 * (z * a - x * c), 2.0 * (x * b - y * a)
    return np.column_stack((a + w * u + y * t - z * v, b + w * v + z * u - x * t, c + w * t + x * v - y * u))


@jit_ieee
def without(x: Mat, bias: Vec) -> Mat:
    """Samples (N, 3) less a bias (3,)."""
    out = np.empty(x.shape)
    for i in range(x.shape[0]):
        for j in range(3):
            out[i, j] = x[i, j] - bias[j]
    return out
