"""Level walking, stairs up and stairs down, told apart stride by stride.

Source: Wang et al. (2013), Figure 4: with z against gravity the three are seen to differ in the reconstruction. No
rule is given there. Here it is the height gained from stance to stance: half of the lowest usual riser (ISO and
building codes: 15 cm and more) is beyond what a level stride's error amounts to, and a person who sets both feet on
every stair still climbs a whole riser per stride.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import StrEnum

RISER_M = 0.15
LEAST_SLOPE = 0.15  # height over length: a steep ramp is at 0.1, stairs are at 0.5


class Terrain(StrEnum):
    """What a stride went over."""

    LEVEL = "level"
    UP = "up"
    DOWN = "down"
    UNKNOWN = "unknown"


def terrain(height_gained_m: float, length_m: float) -> Terrain:
    """Of one stride, from the height (m) by which it ends higher and its horizontal length (m)."""
    if not (abs(height_gained_m) < 10.0 and length_m >= 0.0):  # also what is no number
        return Terrain.UNKNOWN
    if abs(height_gained_m) < 0.5 * RISER_M or abs(height_gained_m) < LEAST_SLOPE * length_m:
        return Terrain.LEVEL
    return Terrain.UP if height_gained_m > 0.0 else Terrain.DOWN


def terrains(heights_gained_m: Sequence[float], lengths_m: Sequence[float]) -> list[Terrain]:
    """Of the strides of one foot, in order."""
    return [terrain(height, length) for height, length in zip(heights_gained_m, lengths_m, strict=True)]
