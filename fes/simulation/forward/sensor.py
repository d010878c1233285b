"""Sensors that deliver as they go: the faults of :class:`fes.simulation.sensor.ImuModel`, sample by sample.

The same numbers come out however the samples are cut into blocks. The low-pass before sampling is causal here and part
of the compiled loop, so the signal is late by about half a sampling interval, as a real sensor's is.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Final

import numpy as np

from fes.estimation.numerics.jit import jit
from fes.signals import SENSORS, FloatArray
from fes.simulation.forward.settings import STEP_NS
from fes.simulation.sensor import ImuModel, Placement, draw_sensitivity, mounting

BUFFER: Final = 512  # rows of random numbers drawn at once


def butterworth(model: ImuModel, rate_hz: float) -> FloatArray:
    """(3,) b0, a1, a2 of the second-order low-pass at ``bandwidth · rate_hz``; wide open where that is 0."""
    internal_hz = 1e9 / STEP_NS
    cut_off_hz = min(model.bandwidth * rate_hz or 0.45 * internal_hz, 0.45 * internal_hz)
    k = math.tan(math.pi * cut_off_hz / internal_hz)
    norm = 1.0 / (1.0 + math.sqrt(2.0) * k + k * k)
    return np.array([k * k * norm, 2.0 * (k * k - 1.0) * norm, (1.0 - math.sqrt(2.0) * k + k * k) * norm])


@jit
def distort(
    ideal: Any, matrix: Any, offset: Any, drift: Any, walk: Any, white: Any, random: Any, full: Any, lsb: Any
) -> None:
    """One sample (6,) of one sensor, in place: axes and scale (2, 3, 3), bias, its walk, noise, range, resolution.

    ``random`` (12,): six numbers for the noise, six for the walk. ``full`` 0 is unlimited, ``lsb`` 0 continuous.
    """
    for part in range(2):
        base = 3 * part
        x, y, z = ideal[base], ideal[base + 1], ideal[base + 2]
        for axis in range(3):
            k = base + axis
            drift[k] += walk[k] * random[6 + k]
            value = x * matrix[part, 0, axis] + y * matrix[part, 1, axis] + z * matrix[part, 2, axis]
            value += offset[k] + drift[k] + white[k] * random[k]
            if full[part] > 0.0:
                value = min(max(value, -full[part]), full[part])
            if lsb[part] > 0.0:
                value = min(max(round(value / lsb[part]) * lsb[part], -full[part]), full[part] - lsb[part])
            ideal[k] = value


@jit
def distort_all(
    rows: Any, first: int, matrix: Any, offset: Any, drift: Any, walk: Any, white: Any, random: Any, full: Any, lsb: Any
) -> None:
    """Samples (N, 4, 6) of four sensors, in place; ``random`` (BUFFER, 4, 12) from row ``first`` on."""
    for number in range(rows.shape[0]):
        for sensor in range(rows.shape[1]):
            distort(
                rows[number, sensor], matrix[sensor], offset[sensor], drift[sensor], walk, white,
                random[first + number, sensor], full, lsb,
            )  # fmt: skip


class SensorBank:
    """The errors of all four sensors; each draws from its own generators, in the order of its samples."""

    def __init__(self, seed: int, model: ImuModel, placements: Mapping[str, Placement], rate_hz: float) -> None:
        self._noise = [np.random.default_rng((seed, 20 + k, 1)) for k in range(len(SENSORS))]
        self._chance = [np.random.default_rng((seed, 20 + k, 2)) for k in range(len(SENSORS))]
        self._matrix = np.empty((4, 2, 3, 3))
        self._offset = np.empty((4, 6))
        for k, name in enumerate(SENSORS):
            rng = np.random.default_rng((seed, 20 + k))
            mount = mounting(*placements[name].angles_deg) if name in placements else np.eye(3)
            for part, bias in enumerate((model.acc_bias_mps2, model.gyr_bias_radps)):
                self._matrix[k, part] = mount @ draw_sensitivity(rng, model).T
                self._offset[k, 3 * part : 3 * part + 3] = bias * rng.uniform(-1.0, 1.0, 3)
        half_band = math.sqrt(0.5 * rate_hz)
        self._white = np.repeat([model.acc_noise_mps2_rthz * half_band, model.gyr_noise_radps_rthz * half_band], 3)
        self._walk = np.repeat([model.acc_walk_mps2_rts, model.gyr_walk_radps_rts], 3) / math.sqrt(rate_hz)
        self._drift = np.zeros((4, 6))
        self._full = np.array([model.acc_range_mps2 or 0.0, model.gyr_range_radps or 0.0])
        self._lsb = self._full / 2.0 ** (model.bits - 1) if model.bits else np.zeros(2)
        self._lost, self._doubled = model.lost, model.doubled
        self._random = np.empty((BUFFER, 4, 12))
        self._arrives = np.ones((BUFFER, 4), np.int64)
        self._row = BUFFER

    def deliver(self, rows: FloatArray) -> list[list[int]] | None:
        """Turn ideal (N, 4, 6) into what is delivered, in place; how often each arrives, None for once each."""
        times: list[list[int]] = []
        done = 0
        while done < len(rows):
            if self._row == BUFFER:
                self._draw()
            count = min(len(rows) - done, BUFFER - self._row)
            distort_all(
                rows[done : done + count], self._row, self._matrix, self._offset, self._drift, self._walk, self._white,
                self._random, self._full, self._lsb,
            )  # fmt: skip
            times += self._arrives[self._row : self._row + count].tolist()
            self._row += count
            done += count
        return times if self._lost or self._doubled else None

    def _draw(self) -> None:
        for k in range(4):
            self._random[:, k] = self._noise[k].normal(size=(BUFFER, 12))
            if self._lost or self._doubled:
                chance = self._chance[k].uniform(size=BUFFER)
                self._arrives[:, k] = np.where(chance < self._lost, 0, np.where(chance > 1.0 - self._doubled, 2, 1))
        self._row = 0
