"""Feet that step by formula: flat rests, smooth swings, known lengths and heights; for tests of windows and stairs."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from fes.estimation.foot.calibration import FootCalibration
from fes.recording import Track
from fes.signals import G_MPS2, FloatArray


@dataclass(frozen=True)
class Steps:
    """``count`` swings of ``swing_s``, ``length_m`` long and ``rise_m`` higher, with rests of ``rest_s``."""

    count: int = 12
    length_m: float = 0.8
    rise_m: float = 0.0
    swing_s: float = 0.6
    rest_s: float = 0.6
    lift_m: float = 0.12
    pitch_rad: float = 0.8
    start_s: float = 2.0
    rate_hz: float = 100.0


def _smooth(u: FloatArray) -> FloatArray:
    """From 0 to 1 with zero velocity, acceleration and jerk at both ends."""
    u = np.clip(u, 0.0, 1.0)
    return np.asarray(u**4 * (35.0 - 84.0 * u + 70.0 * u**2 - 20.0 * u**3))


def stepping(sensor: str, steps: Steps, delay_s: float = 0.0) -> tuple[Track, FloatArray]:
    """The track and the foot's true places (N, 3); x forward, z up. A sensor that lies level and points ahead."""
    cycle = steps.swing_s + steps.rest_s
    fine = 20
    n = round((2.0 * steps.start_s + steps.count * cycle + 1.0) * steps.rate_hz)
    t = np.arange(-fine, (n + 1) * fine) / (steps.rate_hz * fine)
    x, z, pitch = np.zeros(len(t)), np.zeros(len(t)), np.zeros(len(t))
    for k in range(steps.count):
        u = (t - steps.start_s - delay_s - k * cycle) / steps.swing_s
        inside = np.clip(u, 0.0, 1.0)
        x += steps.length_m * _smooth(u)
        z += steps.rise_m * _smooth(u) + steps.lift_m * np.sin(math.pi * inside) ** 4
        # toe down first (negative), then toe up
        pitch -= steps.pitch_rad * np.sin(2.0 * math.pi * inside) * np.sin(math.pi * inside) ** 2
    dt = t[1] - t[0]
    ax, az = np.gradient(np.gradient(x, dt), dt), np.gradient(np.gradient(z, dt), dt)
    c, s = np.cos(pitch), np.sin(pitch)
    fx, fz = ax, az + G_MPS2
    rows = slice(fine, fine + n * fine, fine)
    acc = np.column_stack([c * fx + s * fz, np.zeros(len(t)), -s * fx + c * fz])[rows]
    gyr = np.column_stack([np.zeros(len(t)), -np.gradient(pitch, dt), np.zeros(len(t))])[rows]
    t_ns = np.round(np.arange(n) * 1e9 / steps.rate_hz).astype(np.int64)
    track = Track(sensor, steps.rate_hz, t_ns, t_ns, np.ascontiguousarray(acc), np.ascontiguousarray(gyr))
    return track, np.column_stack([x, np.zeros(len(t)), z])[rows]


def calibration(sensor: str, rate_hz: float = 100.0) -> FootCalibration:
    """Of such a sensor: y to the left is toe-down."""
    return FootCalibration(
        sensor=sensor, rate_hz=rate_hz, up=(0.0, 0.0, 1.0), toe_down=(0.0, 1.0, 0.0), acc_bias_mps2=(0.0, 0.0, 0.0),
        gyr_bias_radps=(0.0, 0.0, 0.0), push_off_radps=4.0, fall_radps=8.0, stride_s=1.2,
        contact_jerk_mps3=500.0, axis_confidence=1.0, strides=10, standing=True,
    )  # fmt: skip
