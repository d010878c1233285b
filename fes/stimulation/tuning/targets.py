"""What a stride measured, held against the target bands.

Every measure is put on one scale: 0 is the low end of its band, 1 the high end. A stride is as good as its least
satisfied measure, so that one number says whether more stimulation is needed.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass

from fes.config import Band, FootGeometry, Tuning
from fes.signals import StrideResult

MID_SWING = (0.25, 0.80)  # of the swing: where the toe passes low, as the stride's own toe clearance has it


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

    def text(self) -> str:
        """The value and its target, in words."""
        low, high = self.band.low * self.scale, self.band.high * self.scale
        return f"{self.name} {self.value * self.scale:.0f} {self.unit} (target {low:.0f}–{high:.0f})"


@dataclass(frozen=True, slots=True)
class Reading:
    """What a stride says: its measures, the least satisfied first."""

    measures: tuple[Measure, ...]
    stand_in: str = ""  # says so where one measure stands in for another

    @property
    def level(self) -> float:
        """Of the least satisfied measure."""
        return self.measures[0].level


def read_stride(stride: StrideResult, tuning: Tuning) -> Reading | str:
    """The stride's measures; where none can be had, why, in words."""
    measures: list[Measure] = []
    missing: list[str] = []
    stand_in = ""
    toe, sensor, pitch = tuning.toe_clearance_m, tuning.sensor_clearance_m, tuning.pitch_at_contact_deg
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
            measures.append(Measure("foot pitch at contact", math.degrees(angle), pitch, 1.0, "°"))
        else:
            missing.append("initial contact was not seen")
    if not measures:
        return "; ".join(missing)
    return Reading(tuple(sorted(measures, key=lambda measure: measure.level)), stand_in)


def reason(reading: Reading, usual: float, error: float, other_way: bool) -> str:
    """Why the intensity changes, in words.

    Args:
        reading: of the newest stride.
        usual: level of the last strides on the whole.
        error: > 0 when more is to be given, < 0 when less.
        other_way: the foot answers the other way round.
    """
    where = "below" if usual < 0.0 else "above" if usual > 1.0 else "within"
    if other_way:
        why = f"the other way made it worse, so {'less' if error < 0.0 else 'more'} is tried"
    elif error < 0.0:
        why = "less will do"
    else:
        why = "more is needed" if usual < 0.0 else "a little more keeps them there safely"
    said = f"{reading.measures[0].text()} in this stride, the last ones lie {where} the target, {why}"
    return f"{said} ({reading.stand_in})" if reading.stand_in else said


def pitch_at_contact_rad(stride: StrideResult) -> float:
    """Foot pitch at initial contact, toe-up positive; NaN where no loading response was seen."""
    contact_ns = stride.t_loading_response_ns
    if contact_ns is None or len(stride.pitch_rad) < 2 or not stride.t_start_ns <= contact_ns <= stride.t_end_ns:
        return math.nan
    return interpolate(contact_ns, _times_ns(stride), [float(pitch) for pitch in stride.pitch_rad])


def interpolate(x: float, xs: Sequence[float], ys: Sequence[float]) -> float:
    """Linear between the points (``xs`` increasing), the end values beyond."""
    k = bisect_right(xs, x)
    if k == 0 or k == len(xs):
        return ys[0] if k == 0 else ys[-1]
    share = (x - xs[k - 1]) / (xs[k] - xs[k - 1])
    return ys[k - 1] + share * (ys[k] - ys[k - 1])


@dataclass(frozen=True, slots=True)
class LevelTrack:
    """The level over the swing: ``t_s`` (M,) since entry into pre-swing, ``level`` (M,); until contact at ``end_s``."""

    t_s: tuple[float, ...]
    level: tuple[float, ...]
    end_s: float


def level_track(stride: StrideResult, reading: Reading, geometry: FootGeometry | None) -> LevelTrack | None:
    """The reading's levels over the swing, None where the stride did not pass its phases or has no track.

    Mid-swing follows the toe's height where the session gives the geometry, ``z + f sin p + u (cos p - 1)`` with the
    toe ``f`` forward and ``u`` up of the sensor, else the stride's one clearance. From there to contact it is the
    pitch's, where that has a target, else the clearance's. A track can only be lower than the stride's own reading
    where the toe is (it is its minimum), so it is lifted to agree with it.
    """
    begin_ns, swing_ns = stride.t_pre_swing_ns, stride.t_swing_ns
    contact_ns = stride.t_loading_response_ns or stride.t_stance_ns
    if begin_ns is None or swing_ns is None or contact_ns is None or not begin_ns <= swing_ns < contact_ns:
        return None
    if len(stride.pitch_rad) < 2 or len(stride.trajectory_m) != len(stride.pitch_rad):
        return None
    by_name = {measure.name: measure for measure in reading.measures}
    pitch = by_name.get("foot pitch at contact")
    clearance = by_name.get("toe clearance") or by_name.get("sensor lift") or reading.measures[0]
    toe = by_name.get("toe clearance")
    swing_ns_long = contact_ns - swing_ns
    shares = [(t_ns, (t_ns - swing_ns) / swing_ns_long) for t_ns in _times_ns(stride)]
    rows = [(k, t_ns, share) for k, (t_ns, share) in enumerate(shares) if MID_SWING[0] <= share <= 1.0]
    if not rows:
        return None
    heights = [_toe_height_m(stride, k, geometry) for k, _, _ in rows] if toe is not None and geometry else []
    lowest_m = min((h for h, row in zip(heights, rows, strict=False) if row[2] < MID_SWING[1]), default=0.0)
    levels = []
    for n, (_, _, share) in enumerate(rows):
        if share >= MID_SWING[1]:  # towards contact the toe rises by itself
            levels.append((pitch or clearance).level)
        elif toe is not None and heights:
            levels.append((toe.value + heights[n] - lowest_m - toe.band.low) / (toe.band.high - toe.band.low))
        else:
            levels.append(clearance.level)
    since_s = tuple(1e-9 * (t_ns - begin_ns) for _, t_ns, _ in rows)
    return LevelTrack(since_s, tuple(levels), 1e-9 * (contact_ns - begin_ns))


def _toe_height_m(stride: StrideResult, k: int, geometry: FootGeometry) -> float:
    pitch = float(stride.pitch_rad[k])
    arm = geometry.toe_forward_m * math.sin(pitch) + geometry.toe_up_m * (math.cos(pitch) - 1.0)
    return float(stride.trajectory_m[k, 2]) + arm


def _times_ns(stride: StrideResult) -> list[float]:
    n = len(stride.pitch_rad)
    step = (stride.t_end_ns - stride.t_start_ns) / (n - 1)
    return [stride.t_start_ns + k * step for k in range(n)]
