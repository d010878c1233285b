"""The two kinds of curves that plans are made of: Fourier series over the cycle and quintics from one to the next."""

from __future__ import annotations

import math

import numpy as np

from fes.signals import FloatArray


def quintic(at_start: list[float], span_s: float) -> list[float]:
    """Coefficients by ``u = t/span`` of the quintic with this value, rate and acceleration at 0 and none at 1."""
    a, b, c = at_start[0], at_start[1] * span_s, 0.5 * at_start[2] * span_s * span_s
    return [a, b, c, -10 * a - 6 * b - 3 * c, 15 * a + 8 * b + 3 * c, -6 * a - 3 * b - c]


def curve_at(series: FloatArray, phase: FloatArray) -> FloatArray:
    """A Fourier series (see :func:`fes.patient.virtual.normative.harmonics`) at (N,) phases of the cycle."""
    k = np.arange(1, (len(series) - 1) // 2 + 1)
    angle = 2.0 * math.pi * np.outer(phase, k)
    out: FloatArray = series[0] + np.cos(angle) @ series[1::2] + np.sin(angle) @ series[2::2]
    return out
