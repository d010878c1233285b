"""Orientation of a whole recording with the future's help: the causal filter forwards, backwards, and forwards again.

Each pass starts where the last one ended, so the later two know the gyroscope's bias from their first sample. At every
sample the upward directions of the last two are averaged by their information: one knows the past, the other the
future (Fraser and Potter 1969, two-filter smoothing; the little that they share, the bias, is neglected). The heading
is that of the last forward pass.
"""

from __future__ import annotations

import numpy as np

from fes.estimation.compiled import jit
from fes.estimation.orientation_body import BoolArray, OrientationPath, as_blocks, full_scales, run, sample_time_s
from fes.estimation.orientation_settings import BodySettings, new_state
from fes.estimation.rotation import from_gravity, to_sensor, to_world
from fes.signals import FloatArray, Vector3

START_TILT_RAD = 0.05  # how well a pass knows where the last one ended, …
START_BIAS_RADPS = 0.002  # … and the bias


def smooth_orientation(
    acc_mps2: FloatArray,
    gyr_radps: FloatArray,
    rate_hz: float,
    *,
    at_rest: BoolArray | None = None,
    acc_range_mps2: float | None = None,
    gyr_range_radps: float | None = None,
    settings: BodySettings | None = None,
) -> OrientationPath:
    """Orientation at every sample from all samples; arguments and errors as :class:`OrientationTracker`.

    Raises:
        ValueError: also for a recording without samples.
    """
    acc, gyr, rest = as_blocks(acc_mps2, gyr_radps, at_rest)
    if len(acc) == 0:
        raise ValueError("there is no sample to smooth")
    dt_s, ranges = sample_time_s(rate_hz), full_scales(acc_range_mps2, gyr_range_radps)
    first = settings or BodySettings()
    later = first._replace(start_tilt_rad=START_TILT_RAD, start_bias_radps=START_BIAS_RADPS)
    # the rate of sample k leads from k - 1 to k; backwards it leads from k to k - 1
    gyr_back = -np.roll(gyr, -1, axis=0)[::-1]

    path = run(new_state(first), acc, gyr, rest, dt_s, ranges, first)
    state = new_state(later, _reversed(path.gyr_bias_radps), path.quaternion[-1])
    back = run(state, acc[::-1], gyr_back, rest[::-1], dt_s, ranges, later)
    state = new_state(later, _reversed(back.gyr_bias_radps), back.quaternion[-1])
    path = run(state, acc, gyr, rest, dt_s, ranges, later)
    variance = _average(path.quaternion, back.quaternion[::-1], path.tilt_sd_rad**2, back.tilt_sd_rad[::-1] ** 2)
    return OrientationPath(path.quaternion, np.sqrt(variance), path.gyr_bias_radps)


def _reversed(bias_radps: FloatArray) -> Vector3:
    """Backwards in time every rate changes its sign, the bias with it."""
    return -float(bias_radps[0]), -float(bias_radps[1]), -float(bias_radps[2])


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
