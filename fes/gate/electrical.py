"""What one request may ask for electrically, whatever came before it: a table of caps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, TypeAlias

from fes import limits
from fes.config import Channel, ChannelLimits
from fes.signals import StimRequest, StimStatus

NUMBER_BOUND: Final = 1e9  # nothing in a request is anywhere near it


@dataclass(slots=True)  # frozen it would take six times as long to make, at every request
class Pulse:
    """Amplitude, width and rate of a pulse train under electrodes of one size."""

    current_ma: float
    pulse_width_us: float
    frequency_hz: float
    electrode_area_cm2: float

    @classmethod
    def of(cls, source: StimRequest | StimStatus, channel: Channel) -> Pulse:
        """What is asked of, or delivered by, this channel."""
        return cls(source.current_ma, source.pulse_width_us, source.frequency_hz, channel.electrode_area_cm2)


@dataclass(frozen=True, slots=True)
class Cap:
    """One quantity of a pulse, its absolute limit and the channel's own; the smaller counts."""

    what: str
    unit: str
    absolute: float
    own: Callable[[ChannelLimits], float]
    of: Callable[[Pulse], float]


Caps: TypeAlias = tuple[tuple[Cap, float], ...]  # each with what it may be at most in one channel


def _charge_uc(p: Pulse) -> float:
    return limits.charge_per_phase_uc(p.current_ma, p.pulse_width_us)


def _density_ma_per_cm2(p: Pulse) -> float:
    return limits.current_density_ma_per_cm2(p.current_ma, p.pulse_width_us, p.frequency_hz, p.electrode_area_cm2)


def _energy_mj(p: Pulse) -> float:
    return limits.pulse_energy_mj(p.current_ma, p.pulse_width_us)


CAPS: Final = (
    Cap("current", "mA", limits.MAX_CURRENT_MA, lambda own: own.max_current_ma, lambda p: p.current_ma),
    Cap("pulse width", "µs", limits.MAX_PULSE_WIDTH_US, lambda own: own.max_pulse_width_us, lambda p: p.pulse_width_us),
    Cap("frequency", "Hz", limits.MAX_FREQUENCY_HZ, lambda own: own.max_frequency_hz, lambda p: p.frequency_hz),
    Cap("charge per phase", "µC", limits.MAX_CHARGE_PER_PHASE_UC, lambda own: own.max_charge_per_phase_uc, _charge_uc),
    Cap(
        "current density",
        "mA/cm² r.m.s.",
        limits.MAX_CURRENT_DENSITY_MA_PER_CM2,
        lambda own: own.max_current_density_ma_per_cm2,
        _density_ma_per_cm2,
    ),
    # a session states none of its own
    Cap("pulse energy", "mJ", limits.MAX_PULSE_ENERGY_MJ, lambda own: limits.MAX_PULSE_ENERGY_MJ, _energy_mj),
)


def no_number(request: StimRequest) -> str:
    """Which of the three numbers is none, or not above 0; "" when all are."""
    for what, value in (
        ("current", request.current_ma),
        ("pulse width", request.pulse_width_us),
        ("frequency", request.frequency_hz),
    ):
        if not is_number(value) or value <= 0:
            return f"{what} is {shown(value)}, must be a number above 0"
    return ""


def caps_of(own: ChannelLimits) -> Caps:
    """The caps of a channel: of the absolute limit and its own the smaller."""
    return tuple((cap, min(cap.absolute, cap.own(own))) for cap in CAPS)


def over_a_cap(pulse: Pulse, caps: Caps) -> str:
    """The first cap exceeded, with number and limit; "" when none is."""
    if min(pulse.current_ma, pulse.pulse_width_us, pulse.frequency_hz) < 0:
        return "a pulse of negative size"
    for cap, most in caps:
        value = cap.of(pulse)
        if not value <= most:  # so that not-a-number is over every cap
            return f"{cap.what} {value:.4g} {cap.unit}, limit {most:.4g} {cap.unit}"
    return ""


def shown(value: object) -> str:
    """Any value in a few characters; Python refuses to print an integer of thousands of digits."""
    huge = isinstance(value, int) and abs(value) > NUMBER_BOUND
    return "a huge number" if huge else f"{value!r:.40}"


def is_number(value: object) -> bool:
    """Whether it is a finite number of sane size; true and false are none."""
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) <= NUMBER_BOUND
