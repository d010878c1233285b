"""The electrical and timing limits that no session can lift; number, unit and source side by side.

The gate's last word. A session states its own, tighter limits (``fes.config.ChannelLimits``); where one is missing
the session is refused.
"""

import math
from dataclasses import dataclass
from typing import Final

MAX_CURRENT_MA: Final = 130.0  # amplitude limit of RehaStim2, RehaMove3 and P24 (vendor protocol documents)
MAX_PULSE_WIDTH_US: Final = 500.0  # RehaStim2's limit (ScienceMode2)
MAX_FREQUENCY_HZ: Final = 100.0  # gait FES uses 20–50 Hz; above 100 Hz contraction is fused, fatigue only grows
MAX_CHARGE_PER_PHASE_UC: Final = 65.0  # MAX_CURRENT_MA · MAX_PULSE_WIDTH_US
MAX_CHARGE_PER_MINUTE_MC: Final = 100.0  # 30 mA, 300 µs, 40 Hz for half of every second is 10.8 mC a minute
MAX_CURRENT_DENSITY_MA_PER_CM2: Final = 2.0  # r.m.s.; IEC 60601-2-10 asks for the user's attention above it
MAX_PULSE_ENERGY_MJ: Final = 300.0  # per pulse into 500 ohm; IEC 60601-2-10
PULSE_ENERGY_LOAD_OHM: Final = 500.0
MAX_ON_S: Final = 3.0  # a swing lasts about 0.5 s; no gait phase needs more
MIN_OFF_S: Final = 0.05  # a burst that ends is over: no chatter
MAX_RISE_MA_PER_S: Final = 2000.0  # 130 mA in 65 ms
MAX_DATA_AGE_MS: Final = 40  # a decision from older samples is a decision about another moment
MAX_VALIDITY_MS: Final = 60  # the device falls silent this long after the last good command


@dataclass(frozen=True, slots=True)
class SensorClass:
    """What a channel may have at most, by how the samples come that it follows."""

    max_data_age_ms: int
    max_validity_ms: int
    max_on_s: float
    max_current_ma: float
    max_charge_per_phase_uc: float
    max_charge_per_minute_mc: float


CABLE: Final = SensorClass(
    MAX_DATA_AGE_MS, MAX_VALIDITY_MS, MAX_ON_S, MAX_CURRENT_MA, MAX_CHARGE_PER_PHASE_UC, MAX_CHARGE_PER_MINUTE_MC
)
RADIO: Final = SensorClass(
    # 10 ms from sample to sample, three moments of a connection of 30 ms (so two of them lost), 20 ms of the clock; a
    # swing lasts 400 ms: decisions are about the same one
    max_data_age_ms=120,
    max_validity_ms=40,  # two commands at 50 Hz: a loop that ends must not add a cable's 60 ms to that age
    max_on_s=1.5,  # heel rise to flat foot of the slowest walk
    max_current_ma=60.0,  # a wrong phase may last three times as long as by cable, so less than half of the current
    max_charge_per_phase_uc=20.0,  # 60 mA in 330 µs
    max_charge_per_minute_mc=30.0,  # 40 mA, 300 µs, 40 Hz for all of the time that a slow walk swings
)


def charge_per_phase_uc(current_ma: float, pulse_width_us: float) -> float:
    """Charge of one phase of a rectangular pulse, in microcoulomb."""
    return current_ma * pulse_width_us * 1e-3


def current_density_ma_per_cm2(
    current_ma: float, pulse_width_us: float, frequency_hz: float, electrode_area_cm2: float
) -> float:
    """R.m.s. current density under the electrode for a biphasic pulse: ``I·sqrt(2·pw·f) / area``."""
    return current_ma * math.sqrt(2.0 * pulse_width_us * 1e-6 * frequency_hz) / electrode_area_cm2


def pulse_energy_mj(current_ma: float, pulse_width_us: float) -> float:
    """Energy of one biphasic pulse into the standard's 500 ohm load, in millijoule."""
    return 2.0 * (current_ma * 1e-3) ** 2 * PULSE_ENERGY_LOAD_OHM * pulse_width_us * 1e-6 * 1e3
