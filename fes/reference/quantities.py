"""What can be held against a reference: names, units as people read them, and what each is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True, slots=True)
class Quantity:
    """``factor`` from SI to ``unit``.

    An ``instant`` is a moment, or a single value of a whole walk: its size says nothing, only its error.
    """

    name: str
    label: str
    unit: str
    factor: float
    digits: int
    about: str
    instant: bool = False


_DEG: Final = 57.29577951308232

_TABLE: Final = (
    Quantity("initial_contact_s", "Initial contact", "ms", 1e3, 1, "when the foot touches the ground", True),
    Quantity("foot_off_s", "Foot off", "ms", 1e3, 1, "when the toe leaves the ground", True),
    Quantity("stride_time_s", "Stride time", "ms", 1e3, 1, "initial contact to the next of the same foot"),
    Quantity("stance_time_s", "Stance time", "ms", 1e3, 1, "initial contact to foot off"),
    Quantity("swing_time_s", "Swing time", "ms", 1e3, 1, "foot off to initial contact"),
    Quantity("stride_length_m", "Stride length", "cm", 100.0, 2, "horizontal way of one foot in one stride"),
    Quantity("clearance_m", "Clearance, sensor", "cm", 100.0, 2, "greatest height of the sensor above its start"),
    Quantity("toe_clearance_m", "Clearance, toe", "cm", 100.0, 2, "least height of the toe in mid-swing"),
    Quantity("heel_clearance_m", "Clearance, heel", "cm", 100.0, 2, "greatest height of the heel"),
    Quantity("height_gained_m", "Height gained", "cm", 100.0, 2, "height of the stride's end above its start; stairs"),
    Quantity("foot_strike_rad", "Foot-strike angle", "deg", _DEG, 2, "sole at contact, toe-up positive"),
    Quantity("speed_mps", "Walking speed", "m/s", 1.0, 3, "stride length over stride time"),
    Quantity(
        "end_distance_m", "End from start", "cm", 100.0, 1, "horizontal way from the walk's start to its end", True
    ),
    Quantity("end_height_m", "End above start", "cm", 100.0, 1, "height of the walk's end above its start", True),
    Quantity("inclination_x_rad", "Inclination of x", "deg", _DEG, 2, "angle of the sensor's x axis to the vertical"),
    Quantity("inclination_z_rad", "Inclination of z", "deg", _DEG, 2, "angle of the sensor's z axis to the vertical"),
)
QUANTITIES: Final = {quantity.name: quantity for quantity in _TABLE}
