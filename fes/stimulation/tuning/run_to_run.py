"""Run-to-run control of the intensity: one step of drive a stride, towards the aim within the band.

``u[k+1] = sat(u[k] + gamma (aim - measured[k]))`` with ``gamma = gain / slope``: normalised by the slope that the foot
itself shows, so that one gain does for strong and weak responders. The aim is no fixed point: the less strides differ,
the nearer it lies to the low end of the band, for what is not needed is charge and fatigue.
"""

from __future__ import annotations

from typing import Final

from fes.stimulation.tuning.response import Response

SAFE_SDS: Final = 2.5  # of a stride's noise between the aim and the low end: 0.6 % of strides below
AIM_BOUNDS: Final = (0.38, 0.52)
DEAD: Final = 0.08  # of the band: nearer to the aim nothing moves
DEAD_ABOVE: Final = 0.20  # above it, where more is only charge, wider


def aim_of(response: Response) -> float:
    """Where in the band strides should lie, 0–1."""
    return min(max(SAFE_SDS * response.noise, AIM_BOUNDS[0]), AIM_BOUNDS[1])


def drive_error(response: Response, drive: float) -> float:
    """How much level is missing (> 0) or too much (< 0) under this drive; 0 when it is near enough to the aim."""
    error = aim_of(response) - response.level_at(drive)
    return 0.0 if -DEAD_ABOVE <= error <= DEAD else error


def next_drive(response: Response, drive: float, gain: float) -> float:
    """The next stride's drive, before any limit or bound; ``gain`` 0–1 is the share of the error to take away at once.

    Needs at least one stride.
    """
    return drive + gain * drive_error(response, drive) / response.slope
