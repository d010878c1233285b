"""What a virtual patient's walk truly was: events and strides."""

from __future__ import annotations

import math
from dataclasses import dataclass

from fes.signals import FloatArray

EVENTS = ("initial_contact", "foot_flat", "heel_off", "foot_off", "stumble")


@dataclass(frozen=True, slots=True)
class FootEvent:
    """Something true of a foot: ``kind`` is one of :data:`EVENTS`."""

    t_ns: int
    foot: str
    kind: str


@dataclass(frozen=True, slots=True)
class VirtualStride:
    """One stride of one foot, told when its foot lies flat again.

    Attributes:
        foot: sensor name; number: 1, 2, … per foot.
        t_heel_off_ns, t_foot_off_ns, t_contact_ns, t_flat_ns: pre-swing, swing, loading response, stance begin.
        stride_length_m: distance between the places where the foot stood, in the belt's frame.
        speed_mps: the belt's speed at contact.
        toe_clearance_m: least height of toe or ball over 30–80 % of the swing; a dragged toe is at about 0.
        heel_clearance_m: greatest height of the heel.
        pitch_at_contact_rad: sole against the ground, toe-up positive.
        ankle_at_contact_rad: dorsiflexion positive.
        inversion_at_contact_rad: sole turned inward, positive.
        drag_s: how long the forefoot touched the ground in swing.
        dragged: it did so between 25 % and 90 % of the swing, for over 20 ms.
        stumbled: it caught, and the step was cut short.
        charge_uc: charge delivered on the patient's channel since the contact before.
        peak_torque_nm: greatest torque of the stimulated muscle in this swing.
        walking: false for the last step into standing.
    """

    foot: str
    number: int
    t_heel_off_ns: int
    t_foot_off_ns: int
    t_contact_ns: int
    t_flat_ns: int
    stride_length_m: float
    speed_mps: float
    toe_clearance_m: float
    heel_clearance_m: float
    pitch_at_contact_rad: float
    ankle_at_contact_rad: float
    inversion_at_contact_rad: float
    drag_s: float
    dragged: bool
    stumbled: bool
    charge_uc: float
    peak_torque_nm: float
    walking: bool


@dataclass(slots=True)
class OpenStride:
    """A stride under way: what the walker notes of it (s, m, rad), and when the foot is to leave and land next."""

    t_heel_off_s: float = math.nan
    t_foot_off_s: float = math.nan
    t_contact_s: float = math.nan
    from_x: float = 0.0
    stumbled: bool = False
    rows: FloatArray | None = None
    pitch: float = 0.0
    ankle: float = 0.0
    roll: float = 0.0
    speed_mps: float = 0.0
    drag_s: float = 0.0
    due_s: float = math.nan  # when this swing is to end
    next_off_s: float = math.inf
    next_contact_s: float = math.inf
    number: int = 0  # of the next contact
    last_step: bool = False
