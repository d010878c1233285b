"""Feet of whose strides few could be measured, in words."""

from __future__ import annotations

from collections.abc import Mapping

DOUBTFUL_SHARE, FEWEST_STRIDES = 0.7, 5


def doubts(strides: Mapping[str, tuple[int, int]]) -> list[str]:
    """What the sidecar says of these sensors may be wrong; by sensor how many strides there are, and how many valid."""
    return [
        f"! {sensor}: only {valid} of {count} strides could be measured. Does this sensor sit on "
        f"the {sensor.replace('_', ' ')}, not on another part of the leg, and are units and rate in the "
        f"sidecar right?"
        for sensor, (count, valid) in strides.items()
        if count >= FEWEST_STRIDES and valid < DOUBTFUL_SHARE * count
    ]
