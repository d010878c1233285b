"""Orientation of any body that carries an inertial sensor, sample by sample or in blocks.

The world's z axis points up; the heading starts at zero turn from the sensor's own and then follows the gyroscope
alone. :mod:`fes.estimation.orientation_kernel` says what the filter assumes and where it is from.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fes.estimation.orientation_kernel import advance
from fes.estimation.orientation_settings import NO_RANGE, BodySettings, State, new_state
from fes.signals import FloatArray

BoolArray = npt.NDArray[np.bool_]


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


class OrientationTracker:
    """The causal filter; a block gives bit for bit what its samples give one by one."""

    def __init__(
        self,
        rate_hz: float,
        *,
        acc_range_mps2: float | None = None,
        gyr_range_radps: float | None = None,
        settings: BodySettings | None = None,
    ) -> None:
        """Start a filter that has seen nothing.

        Args:
            rate_hz: sampling rate.
            acc_range_mps2: the accelerometer's full scale; readings there are not believed. None: it never clips.
            gyr_range_radps: the same of the gyroscope.
            settings: noise.

        Raises:
            ValueError: a rate or range that is not a positive number.
        """
        self._settings = settings or BodySettings()
        self._dt_s = sample_time_s(rate_hz)
        self._ranges = full_scales(acc_range_mps2, gyr_range_radps)
        self._state = new_state(self._settings)

    @property
    def quaternion(self) -> FloatArray:
        """(4,) w, x, y, z after the newest sample."""
        return self._state.quaternion.copy()

    @property
    def gyr_bias_radps(self) -> FloatArray:
        """(3,) rad/s after the newest sample."""
        return self._state.bias.copy()

    @property
    def covariance(self) -> FloatArray:
        """(8, 8): orientation error in the world (rad; the third is heading), bias (rad/s), level velocity (m/s)."""
        return self._state.covariance.copy()

    def advance(
        self, acc_mps2: npt.ArrayLike, gyr_radps: npt.ArrayLike, at_rest: npt.ArrayLike | None = None
    ) -> OrientationPath:
        """Take one sample (3,), (3,) or a block (N, 3), (N, 3); values that are not finite are lost samples.

        Args:
            acc_mps2: specific force.
            gyr_radps: angular rate.
            at_rest: (N,) where the body is known to stand still, as a foot in stance. None: nobody knows.

        Raises:
            ValueError: shapes that do not fit.
        """
        acc, gyr, rest = as_blocks(acc_mps2, gyr_radps, at_rest)
        return run(self._state, acc, gyr, rest, self._dt_s, self._ranges, self._settings)


def track_orientation(
    acc_mps2: FloatArray,
    gyr_radps: FloatArray,
    rate_hz: float,
    *,
    at_rest: BoolArray | None = None,
    acc_range_mps2: float | None = None,
    gyr_range_radps: float | None = None,
    settings: BodySettings | None = None,
) -> OrientationPath:
    """The causal filter over a whole recording; arguments and errors as :class:`OrientationTracker`."""
    tracker = OrientationTracker(
        rate_hz, acc_range_mps2=acc_range_mps2, gyr_range_radps=gyr_range_radps, settings=settings
    )
    return tracker.advance(acc_mps2, gyr_radps, at_rest)


def run(
    state: State,
    acc: FloatArray,
    gyr: FloatArray,
    rest: BoolArray,
    dt_s: float,
    ranges: FloatArray,
    settings: BodySettings,
) -> OrientationPath:
    """Carry ``state`` over checked samples, see :func:`as_blocks`; ``ranges`` (2,) of force and rate."""
    out, tilt = np.empty((len(acc), 4)), np.empty(len(acc))
    advance(state, acc, gyr, rest, dt_s, ranges, settings, out, tilt)
    return OrientationPath(out, np.sqrt(tilt), state.bias.copy())


def as_blocks(
    acc_mps2: npt.ArrayLike, gyr_radps: npt.ArrayLike, at_rest: npt.ArrayLike | None
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Force (N, 3), rate (N, 3) and rest (N,) for the compiled code.

    Raises:
        ValueError: shapes that do not fit.
    """
    acc = np.ascontiguousarray(np.atleast_2d(np.asarray(acc_mps2, dtype=np.float64)))
    gyr = np.ascontiguousarray(np.atleast_2d(np.asarray(gyr_radps, dtype=np.float64)))
    if acc.ndim != 2 or acc.shape[1] != 3 or acc.shape != gyr.shape:
        raise ValueError(f"specific force {acc.shape} and rate {gyr.shape} must both have the shape (N, 3)")
    rest = np.zeros(len(acc), dtype=np.bool_)
    if at_rest is not None:
        given = np.atleast_1d(np.asarray(at_rest))
        if given.shape != rest.shape or given.dtype != np.bool_:
            raise ValueError(f"at_rest is {given.dtype} {given.shape}: give one bool per sample, shape {rest.shape}")
        rest[:] = given
    return acc, gyr, rest


def full_scales(acc_range_mps2: float | None, gyr_range_radps: float | None) -> FloatArray:
    """Both ranges (2,) for the compiled code; what is not known is never reached.

    Raises:
        ValueError: a range that is not a positive number.
    """
    for name, value in (("acc_range_mps2", acc_range_mps2), ("gyr_range_radps", gyr_range_radps)):
        if value is not None and not (math.isfinite(value) and value > 0.0):
            raise ValueError(f"{name} is {value}: give the full scale, above 0, or None where it is not known")
    return np.array([acc_range_mps2 or NO_RANGE, gyr_range_radps or NO_RANGE])


def sample_time_s(rate_hz: float) -> float:
    """Seconds from sample to sample.

    Raises:
        ValueError: a rate that is not a positive number.
    """
    if not (math.isfinite(rate_hz) and rate_hz > 0.0):
        raise ValueError(f"rate_hz is {rate_hz}: give the sampling rate in Hz, above 0")
    return 1.0 / rate_hz
