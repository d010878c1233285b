"""How much a parameter must change before day-to-day error cannot explain it, where somebody has measured that.

Only what was found in print, each with its people and its setting. Where nothing was found there is no number.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

KESAR: Final = (
    "Kesar et al. 2011, Gait & Posture 33:314–317: 19 people with chronic stroke on a treadmill, two sessions three "
    "weeks apart; 3.2–4.2 % of the gait cycle for temporal variables (the larger is taken), 6.7 cm for paretic step "
    "length"
)
HOSOI: Final = (
    "Hosoi et al. 2023, Frontiers in Neurology 14:1219505: 84 people after stroke, comfortable speed over 10 m; "
    "0.05 m/s below 0.4 m/s, 0.11 m/s up to 0.8 m/s, 0.21 m/s above"
)
_SHARES: Final = ("swing_share", "stance_share", "double_support_share")


@dataclass(frozen=True, slots=True)
class DetectableChange:
    """The least change (SI) beyond day-to-day error, and who found it in whom."""

    value: float
    source: str


def detectable_change(key: str, first_speed_mps: float, *, belt: bool) -> DetectableChange | None:
    """For one parameter, None where no source is known.

    Args:
        key: of :data:`fes.parameters.definitions.DEFINITIONS`.
        first_speed_mps: the walking speed of the session that the others are held against.
        belt: any of the sessions was on a treadmill, whose speed is not the patient's choice.
    """
    if key in _SHARES:
        return DetectableChange(0.042, KESAR)
    if key == "step_length_m":
        return DetectableChange(0.067, KESAR)
    if key == "speed_mps" and not belt and first_speed_mps > 0.0:
        least = 0.05 if first_speed_mps < 0.4 else 0.11 if first_speed_mps <= 0.8 else 0.21
        return DetectableChange(least, HOSOI)
    return None
