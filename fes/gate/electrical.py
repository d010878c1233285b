"""What one request may ask for electrically, whatever came before it: a table of caps."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, TypeAlias

from fes import limits
from fes.config import ChannelLimits
from fes.signals import StimRequest, StimStatus

NUMBER_BOUND: Final = 1e9  # nothing in a request is anywhere near it


@dataclass(frozen=True, slots=True)
class Cap:
    """One quantity of a pulse, its absolute limit and the channel's own; the smaller counts.

    ``value`` computes it from a pulse train's current (mA), width (µs) and rate (Hz), and the electrodes' area (cm²).
    """

    what: str
    unit: str
    absolute: float
    own: Callable[[ChannelLimits], float]
    value: Callable[[float, float, float, float], float]


Caps: TypeAlias = tuple[tuple[Cap, float], ...]  # each with what it may be at most in one channel

CAPS: Final = (
    Cap("current", "mA", limits.MAX_CURRENT_MA, lambda own: own.max_current_ma, lambda ma, us, hz, cm2: ma),
    Cap("pulse width", "µs", limits.MAX_PULSE_WIDTH_US, lambda own: own.max_pulse_width_us, lambda ma, us, hz, cm2: us),
    Cap("frequency", "Hz", limits.MAX_FREQUENCY_HZ, lambda own: own.max_frequency_hz, lambda ma, us, hz, cm2: hz),
    Cap(
        "charge per phase",
        "µC",
        limits.MAX_CHARGE_PER_PHASE_UC,
        lambda own: own.max_charge_per_phase_uc,
        lambda ma, us, hz, cm2: limits.charge_per_phase_uc(ma, us),
    ),
    Cap(
        "current density",
        "mA/cm² r.m.s.",
        limits.MAX_CURRENT_DENSITY_MA_PER_CM2,
        lambda own: own.max_current_density_ma_per_cm2,
        limits.current_density_ma_per_cm2,
    ),
    Cap(
        "pulse energy",
        "mJ",
        limits.MAX_PULSE_ENERGY_MJ,
        lambda own: limits.MAX_PULSE_ENERGY_MJ,  # a session states none of its own
        lambda ma, us, hz, cm2: limits.pulse_energy_mj(ma, us),
    ),
)


def no_number(request: StimRequest) -> str:
    """Which of the three numbers is none, or not above 0; "" when all are."""
    current_ma, width_us, frequency_hz = request.current_ma, request.pulse_width_us, request.frequency_hz
    for what, value in (("current", current_ma), ("pulse width", width_us), ("frequency", frequency_hz)):
        if not is_number(value) or value <= 0:
            return f"{what} is {shown(value)}, must be a number above 0"
    return ""


def caps_of(own: ChannelLimits, most: limits.SensorClass = limits.CABLE) -> Caps:
    """The caps of a channel: of the absolute limit, its sensor's class and its own the smallest."""
    by_class = {"current": most.max_current_ma, "charge per phase": most.max_charge_per_phase_uc}
    own_caps = ((cap, min(cap.absolute, cap.own(own))) for cap in CAPS)
    return tuple((cap, min(value, by_class.get(cap.what, math.inf))) for cap, value in own_caps)


def wrongly_delivered(status: StimStatus, area_cm2: float, caps: Caps) -> str:
    """What no device should deliver; "" when all is well."""
    if min(status.current_ma, status.pulse_width_us, status.frequency_hz) < 0:
        return "a pulse of negative size"
    return over_a_cap(status, area_cm2, caps)


def over_a_cap(pulse: StimRequest | StimStatus, area_cm2: float, caps: Caps) -> str:
    """The first cap that a pulse of no negative size exceeds, with number and limit; "" when none is."""
    current_ma, width_us, frequency_hz = pulse.current_ma, pulse.pulse_width_us, pulse.frequency_hz
    for cap, most in caps:
        value = cap.value(current_ma, width_us, frequency_hz, area_cm2)
        if not value <= most:  # so that not-a-number is over every cap
            return f"{cap.what} {value:.4g} {cap.unit}, limit {most:.4g} {cap.unit}"
    return ""


def shown(value: object) -> str:
    """Any value in a few characters; Python refuses to print an integer of thousands of digits."""
    huge = isinstance(value, int) and abs(value) > NUMBER_BOUND
    return "a huge number" if huge else f"{value!r:.40}"


def is_number(value: object) -> bool:
    """Whether it is a finite number of sane size; true and false are none."""
    return isinstance(value, (float, int)) and not isinstance(value, bool) and abs(value) <= NUMBER_BOUND
