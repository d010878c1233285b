"""Stairs and slopes, told from the ground that the session says."""

import math
from collections import deque
from statistics import median
from typing import Final

from fes.signals import StrideResult

KNOWN: Final = 5  # strides
MOST_RISE_M: Final = 0.05  # of a stride on the ground that the session says
LEAST_STAIR_M: Final = 0.12  # rises by more on any stair, however a sensor scatters
RISES: Final = 20
RISE_SDS: Final = 4.0
UNEVEN_GROUND: Final = "a stair or a slope"


class GroundWatch:
    """Tells stairs and slopes from the ground that the session says: one foot's strides, in order.

    By what the sensor alone says of each rise, less what the ground rises. That is off by a few centimetres that are
    the sensor's own, and scatters; both are followed over the strides that are found usual, within bounds.
    """

    def __init__(self, *, most_m: float = MOST_RISE_M, free: bool = False) -> None:
        self._most_m, self._free = most_m, free
        self._rises: deque[float] = deque(maxlen=RISES)

    def forget(self, *, free: bool) -> None:
        """Other ground from here on; what was usual before says nothing of it. ``free``: nothing is known of it."""
        self._free = free
        self._rises.clear()

    def unusual(self, stride: StrideResult) -> str:
        """What is unusual about the ground of this valid stride; "" where nothing is."""
        rise_m = stride.height_gained_m
        if math.isfinite(stride.free_rise_m) and not self._free:
            rise_m = stride.free_rise_m - stride.height_gained_m
        usual_m, allowed_m = 0.0, self._most_m
        if len(self._rises) >= KNOWN and not self._free:
            usual_m = min(max(median(self._rises), -self._most_m), self._most_m)
            spread_m = 1.4826 * median(abs(rise - usual_m) for rise in self._rises)
            allowed_m = max(self._most_m, min(RISE_SDS * spread_m, LEAST_STAIR_M))
        if abs(rise_m - usual_m) > allowed_m:
            return f"the foot went {100 * (rise_m - usual_m):+.0f} cm up: {UNEVEN_GROUND}"
        self._rises.append(rise_m)
        return ""
