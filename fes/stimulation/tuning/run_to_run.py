"""Run-to-run control of the intensity: one step of drive a stride, towards the aim within the band.

``u[k+1] = sat(u[k] + gamma (aim - measured[k]))`` with ``gamma = gain / slope``: normalised by the slope that the foot
itself shows, so that one gain does for strong and weak responders. The aim is no fixed point: the less strides differ,
the nearer it lies to the low end of the band, for what is not needed is charge and fatigue. With several targets each
has its own error, and the one that needs most is followed (:mod:`fes.stimulation.tuning.demand`).
"""

from __future__ import annotations

from typing import Final

from fes.stimulation.tuning.response import Response

SAFE_SDS: Final = 2.0  # of a stride's noise between the aim and the low end: 2.3 % of strides below
LEAST_AIM: Final = 0.30  # a toe's height is known to some millimetres only, …
LEAST_AIM_AT_CONTACT: Final = 0.06  # … the foot's pitch to a degree or two
GREATEST_AIM: Final = 0.55
DEAD: Final = 0.05  # of the band: nearer to the aim nothing moves
DEAD_ABOVE: Final = 0.03  # above it, where more is only charge


def aim_of(response: Response, least: float = LEAST_AIM) -> float:
    """Where in the band strides should lie, 0–1; not below ``least``."""
    return min(max(SAFE_SDS * response.surprise, least), GREATEST_AIM)


def drive_error(response: Response, drive: float, least: float = LEAST_AIM) -> float:
    """How much level is missing (> 0) or too much (< 0) under this drive; 0 when it is near enough to the aim."""
    error = aim_of(response, least) - response.level_at(drive)
    return 0.0 if -DEAD_ABOVE <= error <= DEAD else error
