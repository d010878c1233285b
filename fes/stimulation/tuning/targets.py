"""What a stride measured, held against the target bands, and the drive under which it was walked.

Every measure is put on one scale: 0 is the low end of its band, 1 the high end. A stride is as good as its least
satisfied measure, so that one number says whether more stimulation is needed.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import fmean
from typing import NamedTuple

from fes.config import Band, Channel, Tuning
from fes.signals import StrideResult
from fes.stimulation.contact import pitch_at_contact_rad, roll_at_contact_rad
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
    lift = ("toe clearance", stride.toe_clearance_m, tuning.toe_clearance_m)
    if tuning.sensor_clearance_m is not None and not (lift[2] is not None and math.isfinite(lift[1])):
        lift = ("sensor lift", stride.clearance_m, tuning.sensor_clearance_m)
    no_lift = "the clearance could not be measured (it needs [geometry] in the session, or else sensor_clearance_m)"
    pitch_deg, roll_deg = math.degrees(pitch_at_contact_rad(stride)), math.degrees(roll_at_contact_rad(stride))
    asked = (
        (*lift, 1e3, "mm", no_lift),
        (PITCH, pitch_deg, tuning.pitch_at_contact_deg, 1.0, "°", "initial contact was not seen"),
        (ROLL, -roll_deg, tuning.eversion_at_contact_deg, 1.0, "°", "the foot's roll at initial contact was not seen"),
    )
    measures = [
        Measure(name, value, band, scale, unit)
        for name, value, band, scale, unit, _ in asked if band is not None and math.isfinite(value)
    ]  # fmt: skip
    if not measures:
        return "; ".join(why for _, _, band, _, _, why in asked if band is not None)
    return Reading(tuple(sorted(measures, key=lambda measure: measure.level)))


class Drives(NamedTuple):
    """Of the burst's *front*, which carries the toe through mid-swing, and of its *tail*, which holds the foot."""

    front: float
    tail: float

    def behind(self, measure: Measure) -> float:
        """What the measure answers to."""
        return self.tail if measure.name == PITCH else self.front


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
    return (lifted + own.believed / own.drive_per_band) / (spread + own.believed)
