"""Orientation of any body that carries an inertial sensor, sample by sample or in blocks.

The world's z axis points up; the heading starts at zero turn from the sensor's own and then follows the gyroscope
alone. :mod:`fes.estimation.orientation.filter` says what the filter assumes and where it is from.

With the future's help (:func:`smooth_orientation`) the causal filter runs forwards, backwards, and forwards again. Each
pass starts where the last one ended, so the later two know the gyroscope's bias from their first sample. At every
sample the tilts and level velocities of the last two are averaged by their information: one knows the past, the other
the future (Fraser and Potter 1969, two-filter smoothing; the little that they share, the biases, is neglected). Both
belong to it: only where their velocities agree, too, has the movement's acceleration been averaged twice. The
heading is that of the last forward pass.
"""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fes.estimation.numerics.jit import jit
from fes.estimation.numerics.rotation import quaternion_step, to_sensor, to_world
from fes.estimation.orientation.filter import NO_RANGE, BodySettings, State, advance, new_state
from fes.signals import FloatArray

BoolArray = npt.NDArray[np.bool_]
START_TILT_RAD = 0.05  # how well a pass knows where the last one ended, …
START_BIAS_RADPS = 0.002  # … and the bias


@dataclass(frozen=True)
class OrientationPath:
    """Orientation over time.

    Attributes:
        quaternion: (N, 4) w, x, y, z, sensor to world.
        tilt_sd_rad: (N,) standard deviation of the inclination about one level axis, in the filter's own opinion.
        gyr_bias_radps: (3,) at the end.
    """

    quaternion: FloatArray
    tilt_sd_rad: FloatArray
    gyr_bias_radps: FloatArray


def track_orientation(
    acc_mps2: npt.ArrayLike, gyr_radps: npt.ArrayLike, rate_hz: float, *, zero_velocity: npt.ArrayLike | None = None,
    acc_range_mps2: float | None = None, gyr_range_radps: float | None = None, settings: BodySettings | None = None,
) -> OrientationPath:  # fmt: skip
    """The causal filter over a whole recording; values that are not finite are lost samples.

    Args:
        acc_mps2: specific force (N, 3).
        gyr_radps: angular rate (N, 3).
        rate_hz: sampling rate.
        zero_velocity: (N,) where the body is known to stand still, as a foot in stance. None: not known.
        acc_range_mps2: the accelerometer's full scale; readings there are not believed. None: it never clips.
        gyr_range_radps: the same of the gyroscope.
        settings: noise.

    Raises:
        ValueError: shapes that do not fit, a rate or range that is not a positive number.
    """
    chosen = settings or BodySettings()
    samples = _checked(acc_mps2, gyr_radps, rate_hz, zero_velocity, acc_range_mps2, gyr_range_radps)
    return run(new_state(chosen), *samples, chosen)


def smooth_orientation(
    acc_mps2: npt.ArrayLike, gyr_radps: npt.ArrayLike, rate_hz: float, *, zero_velocity: npt.ArrayLike | None = None,
    acc_range_mps2: float | None = None, gyr_range_radps: float | None = None, settings: BodySettings | None = None,
) -> OrientationPath:  # fmt: skip
    """Orientation at every sample from all samples; arguments and errors as :func:`track_orientation`.

    Raises:
        ValueError: also for a recording without samples.
    """
    acc, gyr, still, dt_s, ranges = _checked(
        acc_mps2, gyr_radps, rate_hz, zero_velocity, acc_range_mps2, gyr_range_radps
    )
    if len(acc) == 0:
        raise ValueError("there is no sample to smooth")
    first = settings or BodySettings()
    later = first._replace(start_tilt_rad=START_TILT_RAD, start_bias_radps=START_BIAS_RADPS)
    # the rate of sample k leads from k - 1 to k; backwards it leads from k to k - 1
    gyr_back = -np.roll(gyr, -1, axis=0)[::-1]

    def again(path: OrientationPath) -> State:
        """Where a pass in the other direction sets out: there every rate changes its sign, the bias with it."""
        return new_state(later, -path.gyr_bias_radps, path.quaternion[-1], state.force_bias)

    state = new_state(first)
    path = run(state, acc, gyr, still, dt_s, ranges, first)
    level = [(np.empty((len(acc), 2)), np.empty((len(acc), 4, 4))) for _ in range(2)]
    state = again(path)
    back = run(state, acc[::-1], gyr_back, still[::-1], dt_s, ranges, later, level[0])
    path = run(again(back), acc, gyr, still, dt_s, ranges, later, level[1])
    variance = _average(path.quaternion, back.quaternion[::-1], *level[1], *(x[::-1] for x in level[0]))
    return OrientationPath(path.quaternion, np.sqrt(variance), path.gyr_bias_radps)


def run(
    state: State, acc: FloatArray, gyr: FloatArray, still: BoolArray, dt_s: float, ranges: FloatArray,
    settings: BodySettings, level: tuple[FloatArray, FloatArray] | None = None,
) -> OrientationPath:  # fmt: skip
    """Carry ``state`` over samples (N, 3), (N, 3), (N,); a block gives bit for bit what its samples give one by one.

    ``ranges`` (2,) of force and rate.
    """
    out, tilt = np.empty((len(acc), 4)), np.empty(len(acc))
    speed, spread = level or (np.empty((0, 2)), np.empty((0, 4, 4)))
    advance(state, acc, gyr, still, dt_s, ranges, settings, out, tilt, speed, spread)
    return OrientationPath(out, np.sqrt(tilt), state.bias.copy())


def _checked(
    acc_mps2: npt.ArrayLike, gyr_radps: npt.ArrayLike, rate_hz: float, zero_velocity: npt.ArrayLike | None,
    acc_range_mps2: float | None, gyr_range_radps: float | None,
) -> tuple[FloatArray, FloatArray, BoolArray, float, FloatArray]:  # fmt: skip
    """For :func:`run`: force (N, 3), rate (N, 3), zero velocity (N,), seconds from sample to sample, ranges (2,).

    A range that is not known is never reached.
    """
    acc, gyr = (np.ascontiguousarray(np.atleast_2d(np.asarray(x, dtype=np.float64))) for x in (acc_mps2, gyr_radps))
    if acc.ndim != 2 or acc.shape[1] != 3 or acc.shape != gyr.shape:
        raise ValueError(f"specific force {acc.shape} and rate {gyr.shape} must both have the shape (N, 3)")
    still = np.zeros(len(acc), dtype=np.bool_)
    if zero_velocity is not None:
        given = np.atleast_1d(np.asarray(zero_velocity))
        if given.shape != still.shape or given.dtype != np.bool_:
            raise ValueError(f"zero_velocity is {given.dtype} {given.shape}: give one bool per sample, {still.shape}")
        still[:] = given
    if not (math.isfinite(rate_hz) and rate_hz > 0.0):
        raise ValueError(f"rate_hz is {rate_hz}: give the sampling rate in Hz, above 0")
    for name, value in (("acc_range_mps2", acc_range_mps2), ("gyr_range_radps", gyr_range_radps)):
        if value is not None and not (math.isfinite(value) and value > 0.0):
            raise ValueError(f"{name} is {value}: give the full scale, above 0, or None where it is not known")
    return acc, gyr, still, 1.0 / rate_hz, np.array([acc_range_mps2 or NO_RANGE, gyr_range_radps or NO_RANGE])


@jit
def _average(
    quaternion: FloatArray, back: FloatArray, speed: FloatArray, spread: FloatArray, back_speed: FloatArray,
    back_spread: FloatArray,
) -> FloatArray:  # fmt: skip
    """Tilt each ``quaternion`` (N, 4), in place, to where both directions' tilt and velocity agree best.

    Returns the tilt's variance (N,). Backwards the velocity has the other sign, and the world another heading.
    """
    out = np.empty(len(quaternion))
    a, x = np.empty((4, 4)), np.empty((4, 3))  # a sum of covariances; its inverse times what concerns us
    for k in range(len(quaternion)):
        q, b, p, r = quaternion[k], back[k], spread[k], back_spread[k]
        w = q[0] * b[0] + q[1] * b[1] + q[2] * b[2] + q[3] * b[3]
        z = q[3] * b[0] + q[2] * b[1] - q[1] * b[2] - q[0] * b[3]
        n = w * w + z * z
        c, s = (w * w - z * z) / n, 2.0 * w * z / n
        for i in range(0, 4, 2):
            for j in range(0, 4, 2):
                sign = 1.0 if i == j else -1.0
                r0, r1 = c * r[i, j] - s * r[i + 1, j], c * r[i, j + 1] - s * r[i + 1, j + 1]
                r2, r3 = s * r[i, j] + c * r[i + 1, j], s * r[i, j + 1] + c * r[i + 1, j + 1]
                a[i, j], a[i, j + 1] = p[i, j] + sign * (c * r0 - s * r1), p[i, j + 1] + sign * (s * r0 + c * r1)
                a[i + 1, j] = p[i + 1, j] + sign * (c * r2 - s * r3)
                a[i + 1, j + 1] = p[i + 1, j + 1] + sign * (s * r2 + c * r3)
        ux, uy, uz = to_sensor(b[0], b[1], b[2], b[3], 0.0, 0.0, 1.0)
        dx, dy, _ = to_world(q[0], q[1], q[2], q[3], ux, uy, uz)
        vx, vy = back_speed[k, 0], back_speed[k, 1]
        x[0, 2], x[1, 2] = -dy, dx
        x[2, 2], x[3, 2] = speed[k, 0] + c * vx - s * vy, speed[k, 1] + s * vx + c * vy
        for i in range(4):
            x[i, 0], x[i, 1] = p[i, 0], p[i, 1]
        for m in range(4):  # Gauss's elimination; a covariance needs no pivots
            for i in range(m + 1, 4):
                f = a[i, m] / a[m, m]
                for j in range(m + 1, 4):
                    a[i, j] -= f * a[m, j]
                for j in range(3):
                    x[i, j] -= f * x[m, j]
        for m in range(3, -1, -1):
            for j in range(3):
                for i in range(m + 1, 4):
                    x[m, j] -= a[m, i] * x[i, j]
                x[m, j] /= a[m, m]
        left, tx, ty = p[0, 0] + p[1, 1], 0.0, 0.0
        for i in range(4):
            left -= p[i, 0] * x[i, 0] + p[i, 1] * x[i, 1]
            tx, ty = tx - p[i, 0] * x[i, 2], ty - p[i, 1] * x[i, 2]
        rx, ry, rz = to_sensor(q[0], q[1], q[2], q[3], tx, ty, 0.0)
        q[0], q[1], q[2], q[3] = quaternion_step(q[0], q[1], q[2], q[3], rx, ry, rz)
        out[k] = 0.5 * left
    return out
