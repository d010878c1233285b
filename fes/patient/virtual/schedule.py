"""When the feet land: a rhythm of two legs with variation from stride to stride, drawn as the walk goes on."""

from __future__ import annotations

import numpy as np

from fes.patient.virtual.normative import stride_time_s
from fes.patient.virtual.patterns import Pattern

TIME_SPREAD = 0.022  # of the stride time: Hausdorff, *J NeuroEng Rehab* 2 (2005), healthy 1–3 %, after stroke more
MEMORY = 0.45  # neighbouring strides resemble each other


class Rhythm:
    """Initial contacts of the leading leg as far as they are settled; the other lands in between.

    A contact's time is settled when it is first asked for, with the speed of that moment.
    """

    def __init__(self, rng: np.random.Generator, pattern: Pattern, height_m: float, variability: float) -> None:
        self._rng = rng
        self._pattern = pattern
        self._height_m = height_m
        self._spread = variability * pattern.variation * TIME_SPREAD
        self._error = 0.0
        self._times: list[float] = []

    def start(self, first_s: float) -> None:
        """Begin a walk: the leading leg first lands at ``first_s``."""
        self._times = [first_s]

    def leader(self, number: int, speed_mps: float) -> float:
        """When the leading leg lands for the ``number``-th time, s."""
        while len(self._times) <= number:
            draw = float(np.clip(self._rng.normal(), -2.5, 2.5))
            self._error = MEMORY * self._error + (1.0 - MEMORY**2) ** 0.5 * self._spread * draw
            self._times.append(self._times[-1] + self.cycle_s(speed_mps) * (1.0 + self._error))
        return self._times[number]

    def follower(self, number: int, speed_mps: float) -> float:
        """When the other leg lands for the ``number``-th time."""
        here, there = self.leader(number, speed_mps), self.leader(number + 1, speed_mps)
        draw = float(np.clip(self._rng.normal(), -2.5, 2.5))
        return here + (0.5 + 0.5 * self._spread * draw) * (there - here)

    def cycle_s(self, speed_mps: float) -> float:
        """Mean stride time at a speed."""
        return self._pattern.cycle_factor * stride_time_s(speed_mps, self._height_m)
