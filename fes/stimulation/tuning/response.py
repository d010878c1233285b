"""How this foot answers to stimulation, learnt from its own strides: level against drive.

The drive is the stimulation relative to the session's (1 is what the session says), the level the place in the target
band (:mod:`fes.stimulation.tuning.targets`). Between patients the slope differs tenfold, so it is estimated: a ridge
regression over recent strides towards a prior, which is the Bayesian estimate for a normal prior and noise (Hoerl &
Kennard 1970, Technometrics 12:55-67), kept within bounds. With it, strides walked under other settings still tell the
level under the present ones, so that the median does not lag behind the changes.
"""

from __future__ import annotations

import math
from collections import deque
from itertools import pairwise
from statistics import median
from typing import Final

REMEMBERED: Final = 12
SLOPE: Final = 2.0  # of the level by the drive, before anything is known: the whole range moves the foot two bands
SLOPE_SD: Final = 2.0
SLOPE_BOUNDS: Final = (1.0, 12.0)
NOISE: Final = 0.20  # of a stride's level, before anything is known
NOISE_AT_CONTACT: Final = 0.045  # so of the foot's pitch at contact
BELIEVED: Final = 4  # strides' worth of trust in it
MOST_SURPRISE: Final = 3.0  # times the usual noise: one stumble says little about the others
NOISE_BOUNDS: Final = (0.04, 0.60)
NEAR: Final = 0.05  # of drive: strides this near the present one need no trust in the slope
LAST: Final = 3
FADE: Final = 0.85  # weight of a stride against the one after it


class Response:
    """Recent strides' drives and levels; oldest first. ``usual_noise`` is what is believed before any are known."""

    def __init__(self, usual_noise: float = NOISE) -> None:
        self._usual_noise = usual_noise
        self._strides: deque[tuple[float, float]] = deque(maxlen=REMEMBERED)
        self._surprises: deque[float] = deque(maxlen=REMEMBERED)

    def add(self, drive: float, level: float) -> None:
        """A valid stride."""
        if len(self._strides) >= LAST:
            most = MOST_SURPRISE * self._usual_noise
            self._surprises.append(min(max(level - self.level_at(drive), -most), most))
        self._strides.append((drive, level))

    def forget(self) -> None:
        """What was learnt no longer holds."""
        self._strides.clear()
        self._surprises.clear()

    @property
    def count(self) -> int:
        """Strides remembered."""
        return len(self._strides)

    @property
    def slope(self) -> float:
        """Level per drive, within ``SLOPE_BOUNDS``."""
        weights = [FADE**age for age in range(len(self._strides) - 1, -1, -1)]
        total = sum(weights)
        if not total:
            return SLOPE
        mean_u = sum(w * u for w, (u, _) in zip(weights, self._strides, strict=True)) / total
        mean_z = sum(w * z for w, (_, z) in zip(weights, self._strides, strict=True)) / total
        ridge = (NOISE / SLOPE_SD) ** 2
        uz = sum(w * (u - mean_u) * (z - mean_z) for w, (u, z) in zip(weights, self._strides, strict=True))
        uu = sum(w * (u - mean_u) ** 2 for w, (u, _) in zip(weights, self._strides, strict=True))
        return min(max((SLOPE * ridge + uz) / (ridge + uu), SLOPE_BOUNDS[0]), SLOPE_BOUNDS[1])

    def level_at(self, drive: float) -> float:
        """The level to expect under this drive: median of the last strides, moved there along the slope."""
        slope = self.slope
        moved = [(abs(u - drive), z + slope * (drive - u)) for u, z in self._strides]
        newest = [z for _, z in moved[-LAST:]]
        if all(z < 0.0 for z in newest) or all(z > 1.0 for z in newest):
            return median(newest)  # all agree that the band is left: older strides would only slow it down
        near = [z for i, (far, z) in enumerate(moved[-7:]) if far < NEAR or i >= len(moved[-7:]) - LAST]
        return median(near)

    @property
    def noise(self) -> float:
        """Standard deviation of a stride's level about its neighbour's, robustly, within ``NOISE_BOUNDS``."""
        if len(self._strides) < 4:
            return self._usual_noise
        slope = self.slope
        free = [z - slope * u for u, z in self._strides]
        steps = [abs(b - a) for a, b in pairwise(free)]  # differences: a slow drift is no noise
        return min(max(1.4826 * median(steps) / math.sqrt(2.0), NOISE_BOUNDS[0]), NOISE_BOUNDS[1])

    @property
    def surprise(self) -> float:
        """Standard deviation of a stride's level about the expected one, within ``NOISE_BOUNDS``.

        Greater than the noise by what comes in waves of several strides and by what is wrong with the expectation. From
        the strides' own surprises and from what is usual, each by the number of strides that speak for it.
        """
        total = BELIEVED * self._usual_noise**2 + sum(off * off for off in self._surprises)
        found = math.sqrt(total / (BELIEVED + len(self._surprises)))
        return min(max(found, NOISE_BOUNDS[0]), NOISE_BOUNDS[1])

    def last_levels(self, n: int) -> list[float]:
        """Levels of the last ``n`` strides, oldest first."""
        return [z for _, z in list(self._strides)[-n:]]
