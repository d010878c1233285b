"""What a stride measured, held against the target bands.

Every measure is put on one scale: 0 is the low end of its band, 1 the high end. A stride is as good as its least
satisfied measure, so that one number says whether more stimulation is needed.
"""

import math
from bisect import bisect_right
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

from fes.config import Band, Tuning
from fes.signals import MID_SWING_END, FloatArray, StrideResult

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

    def text(self) -> str:
        """The value and its target, in words."""
        low, high = self.band.low * self.scale, self.band.high * self.scale
        return f"{self.name} {self.value * self.scale:.0f} {self.unit} (target {low:.0f}–{high:.0f})"


@dataclass(frozen=True, slots=True)
class Reading:
    """A stride's measures, the least satisfied first."""

    measures: tuple[Measure, ...]
    stand_in: str = ""  # says so where one measure stands in for another

    @property
    def level(self) -> float:
        """Of the least satisfied measure."""
        return self.measures[0].level

    @property
    def levels(self) -> dict[str, float]:
        """By measure."""
        return {measure.name: measure.level for measure in self.measures}

    def without(self, names: Collection[str]) -> "Reading":
        """The same stride without these measures."""
        return replace(self, measures=tuple(measure for measure in self.measures if measure.name not in names))


def read_stride(stride: StrideResult, tuning: Tuning) -> Reading | str:
    """The stride's measures; where none can be had, why, in words."""
    measures: list[Measure] = []
    missing: list[str] = []
    stand_in = ""
    toe, sensor, pitch = tuning.toe_clearance_m, tuning.sensor_clearance_m, tuning.pitch_at_contact_deg
    eversion = tuning.eversion_at_contact_deg
    if toe is not None and math.isfinite(stride.toe_clearance_m):
        measures.append(Measure("toe clearance", stride.toe_clearance_m, toe, 1e3, "mm"))
    elif sensor is not None and math.isfinite(stride.clearance_m):
        measures.append(Measure("sensor lift", stride.clearance_m, sensor, 1e3, "mm"))
        if toe is not None:
            stand_in = "the toe's height is not known (no foot geometry), the sensor's lift stands in for it"
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
    return Reading(tuple(sorted(measures, key=lambda measure: measure.level)), stand_in)


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
    return interpolate(contact_ns, times_ns(stride), angle_rad.tolist())


def interpolate(x: float, xs: Sequence[float], ys: Sequence[float]) -> float:
    """Linear between the points (``xs`` increasing), the end values beyond."""
    k = bisect_right(xs, x)
    if k == 0 or k == len(xs):
        return ys[0] if k == 0 else ys[-1]
    share = (x - xs[k - 1]) / (xs[k] - xs[k - 1])
    return ys[k - 1] + share * (ys[k] - ys[k - 1])


class SwingTimes(NamedTuple):
    """Seconds since entry into pre-swing: foot off, the end of mid-swing, contact."""

    foot_off_s: float
    mid_swing_end_s: float
    contact_s: float

    def share(self, at_s: float) -> float:
        """The share of the swing that is over at a time."""
        return (at_s - self.foot_off_s) / (self.contact_s - self.foot_off_s)


def swing_times(stride: StrideResult) -> SwingTimes | None:
    """When the swing was; None without these phases."""
    begin_ns, swing_ns = stride.t_pre_swing_ns, stride.t_swing_ns
    contact_ns = stride.t_loading_response_ns or stride.t_stance_ns
    if begin_ns is None or swing_ns is None or contact_ns is None or not begin_ns <= swing_ns < contact_ns:
        return None
    end_ns = swing_ns + MID_SWING_END * (contact_ns - swing_ns)
    return SwingTimes(1e-9 * (swing_ns - begin_ns), 1e-9 * (end_ns - begin_ns), 1e-9 * (contact_ns - begin_ns))


def times_ns(stride: StrideResult) -> list[float]:
    """When the stride's trajectory and pitch were."""
    n = len(stride.pitch_rad)
    step = (stride.t_end_ns - stride.t_start_ns) / (n - 1)
    return [stride.t_start_ns + k * step for k in range(n)]
