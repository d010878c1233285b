"""What a worn sensor delivers of an ideal signal that is known as a whole: low-passed, sampled, distorted, lost."""

from __future__ import annotations

import math

import numpy as np

from fes.recording import Track
from fes.signals import G_MPS2, NS_PER_S, FloatArray, IntArray
from fes.simulation.sensor import ImuModel, draw_sensitivity


def ideal_signals(
    acceleration_mps2: FloatArray,
    rotation: FloatArray,
    rate_foot_radps: FloatArray,
    mounting: FloatArray,
    up: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Specific force ``f = Rᵀ (a + g)`` and angular rate in sensor axes, (N, 3) each.

    Args:
        acceleration_mps2: (N, 3) acceleration of the sensor in an inertial frame.
        rotation: (N, 3, 3) world from the segment's frame.
        rate_foot_radps: (N, 3) angular rate in the segment's axes.
        mounting: (3, 3) segment from sensor.
        up: (3,) unit vector against gravity in that frame.
    """
    force = acceleration_mps2 + G_MPS2 * up
    in_segment = np.einsum("nji,nj->ni", rotation, force)
    return in_segment @ mounting, rate_foot_radps @ mounting


def measure(
    rng: np.random.Generator,
    model: ImuModel,
    sensor: str,
    rate_hz: float,
    fine_t_s: FloatArray,
    force_mps2: FloatArray,
    rate_radps: FloatArray,
) -> Track:
    """What ``model`` delivers at ``rate_hz`` for ideal signals (M, 3) given on the uniform grid ``fine_t_s`` (M,).

    Raises:
        ValueError: quantisation without a range, or a fine grid slower than twice the sampling rate.
    """
    fine_hz = 1.0 / (fine_t_s[1] - fine_t_s[0])
    if fine_hz < 2.0 * rate_hz:
        raise ValueError(f"the fine grid ({fine_hz:.0f} Hz) must be at least twice the sampling rate ({rate_hz:g} Hz)")
    if model.bandwidth > 0.0:
        force_mps2 = low_pass(force_mps2, model.bandwidth * rate_hz / fine_hz)
        rate_radps = low_pass(rate_radps, model.bandwidth * rate_hz / fine_hz)
    count = int((fine_t_s[-1] - fine_t_s[0]) * rate_hz) + 1
    t_s = fine_t_s[0] + np.arange(count) / rate_hz
    if model.jitter_s > 0.0:
        # bounded well below half an interval, so that the order of samples stays
        t_s = t_s + np.clip(rng.normal(0.0, model.jitter_s, count), -0.3 / rate_hz, 0.3 / rate_hz)
        t_s = np.clip(t_s, fine_t_s[0], fine_t_s[-1])
    acc = distort(rng, resample(fine_t_s, force_mps2, t_s), rate_hz, model, accelerometer=True)
    gyr = distort(rng, resample(fine_t_s, rate_radps, t_s), rate_hz, model, accelerometer=False)
    keep = delivered(rng, count, model.lost, model.doubled)
    stamps = np.round(t_s * NS_PER_S).astype(np.int64)[keep]
    return Track(sensor, rate_hz, stamps, stamps, acc[keep], gyr[keep], model.acc_range_mps2, model.gyr_range_radps)


def distort(
    rng: np.random.Generator, true: FloatArray, rate_hz: float, model: ImuModel, *, accelerometer: bool
) -> FloatArray:
    """Misalignment, scale, bias, noise, range and quantisation of one sensor triad, (N, 3) → (N, 3)."""
    if accelerometer:
        noise, bias, walk, full = (
            model.acc_noise_mps2_rthz, model.acc_bias_mps2, model.acc_walk_mps2_rts, model.acc_range_mps2,
        )  # fmt: skip
    else:
        noise, bias, walk, full = (
            model.gyr_noise_radps_rthz, model.gyr_bias_radps, model.gyr_walk_radps_rts, model.gyr_range_radps,
        )  # fmt: skip
    out = true @ draw_sensitivity(rng, model).T + bias * rng.uniform(-1.0, 1.0, 3)
    if walk > 0.0:
        out = out + np.cumsum(rng.normal(0.0, walk / math.sqrt(rate_hz), out.shape), axis=0)
    if noise > 0.0:
        out = out + rng.normal(0.0, noise * math.sqrt(0.5 * rate_hz), out.shape)
    if full is not None:
        out = np.clip(out, -full, full)
    if model.bits:
        if full is None:
            raise ValueError("quantisation needs a range: give acc_range_mps2 and gyr_range_radps, or bits = 0")
        lsb = full / 2 ** (model.bits - 1)
        out = np.clip(np.round(out / lsb), -(2 ** (model.bits - 1)), 2 ** (model.bits - 1) - 1) * lsb
    return np.ascontiguousarray(out)


def low_pass(signal: FloatArray, cut_off: float, half_length: float = 2.0) -> FloatArray:
    """Windowed-sinc low-pass without delay; ``cut_off`` in cycles per sample; (N, 3) → (N, 3)."""
    reach = math.ceil(half_length / cut_off)
    k = np.arange(-reach, reach + 1)
    taps = np.sinc(2.0 * cut_off * k) * np.hanning(2 * reach + 3)[1:-1]
    taps /= taps.sum()
    padded = np.pad(signal, ((reach, reach), (0, 0)), mode="edge")
    return np.column_stack([np.convolve(padded[:, axis], taps, mode="valid") for axis in range(signal.shape[1])])


def resample(grid_s: FloatArray, signal: FloatArray, t_s: FloatArray) -> FloatArray:
    """Cubic (Catmull-Rom) interpolation of (M, 3) on a uniform grid at the instants ``t_s`` within it."""
    position = (t_s - grid_s[0]) / (grid_s[1] - grid_s[0])
    cell = np.clip(np.floor(position + 1e-9).astype(np.int64), 0, len(grid_s) - 2)
    u = (position - cell)[:, None]
    last = len(grid_s) - 1
    p0, p1, p2, p3 = (signal[np.clip(cell + k, 0, last)] for k in (-1, 0, 1, 2))
    inner: FloatArray = p1 + 0.5 * u * (
        p2 - p0 + u * (2.0 * p0 - 5.0 * p1 + 4.0 * p2 - p3 + u * (3.0 * (p1 - p2) + p3 - p0))
    )
    return inner


def delivered(rng: np.random.Generator, count: int, lost: float, doubled: float) -> IntArray:
    """Which samples arrive, in order: indices 0 … count-1, the lost ones left out, the doubled ones twice."""
    chance = rng.uniform(size=count)
    times = np.where(chance < lost, 0, np.where(chance > 1.0 - doubled, 2, 1))
    times[0] = times[-1] = 1
    return np.repeat(np.arange(count, dtype=np.int64), times)
