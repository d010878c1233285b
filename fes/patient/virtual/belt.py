"""How far the belt still goes: where to set a foot down when it stops."""

from __future__ import annotations

import math
from typing import Any

from fes.patient.virtual.integrate import BELT_RADPS


def to_rest_m(belt: Any) -> float:
    """How far a braking belt (record of ``layout.BELT``, goal 0) goes on until it rests.

    ``v'' + 2 w v' + w² v = 0`` integrated once, from now to for ever.
    """
    return float(belt["a"] + 2.0 * BELT_RADPS * belt["v"]) / BELT_RADPS**2


def travel_m(belt: Any, seconds: float) -> float:
    """How far a braking belt goes in this time."""
    gone = math.exp(-BELT_RADPS * seconds)
    slope = float(belt["a"] + BELT_RADPS * belt["v"])
    v = (float(belt["v"]) + slope * seconds) * gone
    a = slope * gone - BELT_RADPS * v
    return to_rest_m(belt) - (a + 2.0 * BELT_RADPS * v) / BELT_RADPS**2
