"""What a stride's angles were at initial contact."""

import math

import numpy as np

from fes.signals import FloatArray, StrideResult


def pitch_at_contact_rad(stride: StrideResult) -> float:
    """Foot pitch at initial contact, toe-up positive; NaN where no loading response was seen."""
    return _at_contact(stride, stride.pitch_rad)


def roll_at_contact_rad(stride: StrideResult) -> float:
    """Foot roll at initial contact, inversion positive; NaN where no loading response or no roll is known."""
    return _at_contact(stride, stride.roll_rad)


def _at_contact(stride: StrideResult, angle_rad: FloatArray) -> float:
    contact_ns = stride.t_loading_response_ns
    if contact_ns is None or len(angle_rad) < 2 or not stride.t_start_ns <= contact_ns <= stride.t_end_ns:
        return math.nan
    return float(np.interp(contact_ns, times_ns(stride), angle_rad))


def times_ns(stride: StrideResult) -> FloatArray:
    """When the stride's trajectory and pitch were."""
    return np.linspace(stride.t_start_ns, stride.t_end_ns, len(stride.pitch_rad))
