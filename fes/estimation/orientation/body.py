"""Orientation of any body that carries an inertial sensor, sample by sample or in blocks.

The world's z axis points up; the heading starts at zero turn from the sensor's own and then follows the gyroscope
alone. :mod:`fes.estimation.orientation.filter` says what the filter assumes and where it is from.

With the future's help (:func:`smooth_orientation`) the causal filter runs forwards, backwards, and forwards again. Each
pass starts where the last one ended, so the later two know the gyroscope's bias from their first sample. At every
sample the upward directions of the last two are averaged by their information: one knows the past, the other the
future (Fraser and Potter 1969, two-filter smoothing; the little that they share, the bias, is neglected). The heading
is that of the last forward pass.
"""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fes.estimation.numerics.jit import jit
from fes.estimation.numerics.rotation import from_gravity, to_sensor, to_world
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
        return new_state(later, -path.gyr_bias_radps, path.quaternion[-1])

    path = run(new_state(first), acc, gyr, still, dt_s, ranges, first)
    back = run(again(path), acc[::-1], gyr_back, still[::-1], dt_s, ranges, later)
    path = run(again(back), acc, gyr, still, dt_s, ranges, later)
    variance = _average(path.quaternion, back.quaternion[::-1], path.tilt_sd_rad**2, back.tilt_sd_rad[::-1] ** 2)
    return OrientationPath(path.quaternion, np.sqrt(variance), path.gyr_bias_radps)


def run(
    state: State, acc: FloatArray, gyr: FloatArray, still: BoolArray, dt_s: float, ranges: FloatArray,
    settings: BodySettings,
) -> OrientationPath:  # fmt: skip
    """Carry ``state`` over samples (N, 3), (N, 3), (N,); a block gives bit for bit what its samples give one by one.

    ``ranges`` (2,) of force and rate.
    """
    out, tilt = np.empty((len(acc), 4)), np.empty(len(acc))
    advance(state, acc, gyr, still, dt_s, ranges, settings, out, tilt)
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
def _average(quaternion: FloatArray, back: FloatArray, variance: FloatArray, back_variance: FloatArray) -> FloatArray:
    """Tilt each ``quaternion`` (N, 4) to the mean upward direction, in place; returns the mean's variance (N,)."""
    out = np.empty(len(variance))
    for k in range(len(variance)):
        q, b = quaternion[k], back[k]
        w, v = 1.0 / variance[k], 1.0 / back_variance[k]
        ax, ay, az = to_sensor(q[0], q[1], q[2], q[3], 0.0, 0.0, w / (w + v))
        bx, by, bz = to_sensor(b[0], b[1], b[2], b[3], 0.0, 0.0, v / (w + v))
        ux, uy, uz = to_world(q[0], q[1], q[2], q[3], ax + bx, ay + by, az + bz)
        t = from_gravity(ux, uy, uz)
        w0 = t[0] * q[0] - t[1] * q[1] - t[2] * q[2] - t[3] * q[3]
        x0 = t[0] * q[1] + t[1] * q[0] + t[2] * q[3] - t[3] * q[2]
        y0 = t[0] * q[2] - t[1] * q[3] + t[2] * q[0] + t[3] * q[1]
        z0 = t[0] * q[3] + t[1] * q[2] - t[2] * q[1] + t[3] * q[0]
        q[0], q[1], q[2], q[3] = w0, x0, y0, z0
        out[k] = 1.0 / (w + v)
    return out
