"""What a stride measured, held against the target bands, and the drive under which it was walked.

Every measure is put on one scale: 0 is the low end of its band, 1 the high end. A stride is as good as its least
satisfied measure, so that one number says whether more stimulation is needed.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import fmean
from typing import NamedTuple

import numpy as np

from fes.config import Band, Channel, Tuning
from fes.signals import FloatArray, StrideResult
from fes.stimulation.envelope import BurstParameters
from fes.stimulation.tuning.settings import RuleSettings

PITCH = "foot pitch at contact"
ROLL = "eversion at contact"


@dataclass(frozen=True, slots=True)
class Measure:
    """One measured value with its band; ``scale`` and ``unit`` are for people (m → mm)."""

    name: str
    value: float
    band: Band
    scale: float
    unit: str

    @property
    def at_contact(self) -> bool:
        """Whether it is measured at initial contact rather than in mid-swing."""
        return self.name in (PITCH, ROLL)

    @property
    def level(self) -> float:
        """Place in the band: 0 low end, 1 high end."""
        return (self.value - self.band.low) / (self.band.high - self.band.low)

    def format_level(self, level: float) -> str:
        """A level as people read the value."""
        return f"{(self.band.low + level * (self.band.high - self.band.low)) * self.scale:.0f} {self.unit}"

    def text(self) -> str:
        """The value and its target, in words."""
        low, high = self.band.low * self.scale, self.band.high * self.scale
        return f"{self.name} {self.value * self.scale:.0f} {self.unit} (target {low:.0f}–{high:.0f})"


@dataclass(frozen=True, slots=True)
class Reading:
    """A stride's measures, the least satisfied first."""

    measures: tuple[Measure, ...]

    @property
    def level(self) -> float:
        """Of the least satisfied measure."""
        return self.measures[0].level


def read_stride(stride: StrideResult, tuning: Tuning) -> Reading | str:
    """The stride's measures; where none can be had, why, in words."""
    measures: list[Measure] = []
    missing: list[str] = []
    toe, sensor, pitch = tuning.toe_clearance_m, tuning.sensor_clearance_m, tuning.pitch_at_contact_deg
    eversion = tuning.eversion_at_contact_deg
    if toe is not None and math.isfinite(stride.toe_clearance_m):
        measures.append(Measure("toe clearance", stride.toe_clearance_m, toe, 1e3, "mm"))
    elif sensor is not None and math.isfinite(stride.clearance_m):
        measures.append(Measure("sensor lift", stride.clearance_m, sensor, 1e3, "mm"))
    elif toe is not None or sensor is not None:
        missing.append(
            "the clearance could not be measured (toe clearance needs [geometry] in the session, or set "
            "sensor_clearance_m as well)"
        )
    if pitch is not None:
        angle = pitch_at_contact_rad(stride)
        if math.isfinite(angle):
            measures.append(Measure(PITCH, math.degrees(angle), pitch, 1.0, "°"))
        else:
            missing.append("initial contact was not seen")
    if eversion is not None:
        angle = -roll_at_contact_rad(stride)
        if math.isfinite(angle):
            measures.append(Measure(ROLL, math.degrees(angle), eversion, 1.0, "°"))
        else:
            missing.append("the foot's roll at initial contact was not seen")
    if not measures:
        return "; ".join(missing)
    return Reading(tuple(sorted(measures, key=lambda measure: measure.level)))


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


class Drives(NamedTuple):
    """Of the burst's *front*, which carries the toe through mid-swing, and of its *tail*, which holds the foot."""

    front: float
    tail: float


def drives_of(burst: BurstParameters, channel: Channel) -> Drives:
    """Of what the channel's method moves: the current, and how much of its width is left at the end, or the width."""
    tuning, first, last = channel.tuning, burst.widths_us[0], burst.widths_us[-1]
    if tuning is None or tuning.bounds is None:
        return Drives(1.0, 1.0)
    if tuning.method == "learning":
        return Drives(first / tuning.bounds.pulse_width_us.high, last / tuning.bounds.pulse_width_us.high)
    front = burst.current_ma / tuning.bounds.current_ma.high
    return Drives(front, front * last / channel.pulse_width_us)


def bands_per_drive(seen: Sequence[tuple[float, float]], own: RuleSettings) -> float:
    """By how many bands all of the drive would lift: by these (drive, level), or as most feet do."""
    drive, level = fmean(d for d, _ in seen), fmean(at for _, at in seen)
    spread = sum((d - drive) ** 2 for d, _ in seen)
    lifted = sum((d - drive) * (at - level) for d, at in seen)
    slope = (lifted + own.believed / own.drive_per_band) / (spread + own.believed)
    return min(max(slope, own.flattest), own.steepest)
