"""What a stride measured, held against the target bands, and which strides teach nothing.

Every measure is put on one scale: 0 is the low end of its band, 1 the high end. A stride is as good as its least
satisfied measure, so that one number says whether more stimulation is needed. The tuner must not learn from a stumble,
a turn or a pause.
"""

import math
from bisect import bisect_right
from collections import deque
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from statistics import median
from typing import Final, NamedTuple

from fes.config import Band, Tuning
from fes.signals import NS_PER_S, FloatArray, StrideResult

STOP_S: Final = 0.8  # between the end of a stride and the beginning of the next: a stop
SPEED_CHANGE, LEAST_SPEED_CHANGE_MPS = 0.25, 0.1  # of the usual speed, and at least
CHARGE_SHARE: Final = 0.6  # of the usual charge: the rest of the pulses were refused, or lost
REMEMBERED: Final = 5
SHORTEST_SWING: Final = 0.16  # of the stride; a third is usual, a quarter is a very slow walk's
BELOW_GROUND_M: Final = -0.015  # no toe is there
MOST_RISE_M: Final = 0.05  # of a stride on the ground that the session says
LEAST_STAIR_M: Final = 0.12  # rises by more on any stair, however a sensor scatters
RISES: Final = 20
RISE_SDS: Final = 4.0
UNEVEN_GROUND: Final = "a stair or a slope"
OTHER_SPEED: Final = "the speed changed"
NO_CHARGE: Final = "no stimulation was delivered in it"
PITCH = "foot pitch at contact"
ROLL = "eversion at contact"
MID_SWING_BEGIN = 0.25  # of the swing: from there on the toe passes low …
MID_SWING_END = 0.80  # of the swing: until there the toe passes low, as the stride's own toe clearance has it


def jolted(stride: StrideResult) -> str:
    """Why the stride's contact cannot be true; "" when it can.

    A foot that stimulation jerks up jolts the sensor, which looks like initial contact early in the swing; all that is
    measured from contact on is then wrong.
    """
    swing_ns, contact_ns = stride.t_swing_ns, stride.t_loading_response_ns
    if swing_ns is not None and contact_ns is not None:
        share = (contact_ns - swing_ns) / max(stride.t_end_ns - stride.t_start_ns, 1)
        if share < SHORTEST_SWING:
            return f"contact was seen {1e-6 * (contact_ns - swing_ns):.0f} ms after foot off, too soon to be true"
    if math.isfinite(stride.toe_clearance_m) and stride.toe_clearance_m < BELOW_GROUND_M:
        return f"the toe would have been {-1e3 * stride.toe_clearance_m:.0f} mm below the ground"
    return ""


class GroundWatch:
    """Tells stairs and slopes from the ground that the session says: one foot's strides, in order.

    By what the sensor alone says of each rise, less what the ground rises. That is off by a few centimetres that are
    the sensor's own, and scatters; both are followed over the strides that are found usual, within bounds.
    """

    def __init__(self, *, most_m: float = MOST_RISE_M, free: bool = False) -> None:
        self._most_m, self._free = most_m, free
        self._rises: deque[float] = deque(maxlen=RISES)

    def forget(self, *, free: bool) -> None:
        """Other ground from here on; what was usual before says nothing of it. ``free``: nothing is known of it."""
        self._free = free
        self._rises.clear()

    def unusual(self, stride: StrideResult) -> str:
        """What is unusual about the ground of this valid stride; "" where nothing is."""
        rise_m = stride.height_gained_m
        if math.isfinite(stride.free_rise_m) and not self._free:
            rise_m = stride.free_rise_m - stride.height_gained_m
        usual_m, allowed_m = 0.0, self._most_m
        if len(self._rises) >= REMEMBERED and not self._free:
            usual_m = min(max(median(self._rises), -self._most_m), self._most_m)
            spread_m = 1.4826 * median(abs(rise - usual_m) for rise in self._rises)
            allowed_m = max(self._most_m, min(RISE_SDS * spread_m, LEAST_STAIR_M))
        if abs(rise_m - usual_m) > allowed_m:
            return f"the foot went {100 * (rise_m - usual_m):+.0f} cm up: {UNEVEN_GROUND}"
        self._rises.append(rise_m)
        return ""


class StrideFilter:
    """Judges every stride of one channel's foot, in order."""

    def __init__(self, tuning: Tuning, min_stride_length_m: float, *, free_ground: bool = False) -> None:
        self._tuning = tuning
        self._ground = GroundWatch(most_m=tuning.max_height_gained_m, free=free_ground)
        self._min_length_m = min_stride_length_m
        self._end_ns: int | None = None
        self._changed_ns: int | None = None
        self._ground_changed_ns: int | None = None
        self._speeds: deque[float] = deque(maxlen=REMEMBERED)
        self._other_mps: float | None = None  # of the stride before, where it was walked at another speed
        self._charges: deque[float] = deque(maxlen=REMEMBERED)

    def operator_changed(self, t_ns: int) -> None:
        """A person changed the intensity, or stopped or started stimulation."""
        self._changed_ns = t_ns

    def ground_changed(self, t_ns: int, *, free: bool) -> None:
        """A person said what is walked on from now on."""
        self._ground_changed_ns = t_ns
        self._ground.forget(free=free)

    def why_skip(self, stride: StrideResult, charge_uc: float, drive: float) -> str:
        """Why this newest stride teaches nothing; "" when it does.

        ``charge_uc`` was delivered in it; ``drive``, under which it was walked, scales the charge to be expected.
        """
        end_ns, self._end_ns = self._end_ns, stride.t_end_ns
        if not stride.valid:
            return f"the stride is not usable ({stride.reason})"
        numbers = (stride.speed_mps, stride.stride_length_m, stride.turn_rad, stride.height_gained_m)
        if not all(map(math.isfinite, numbers)):
            return "the stride's own numbers are none"
        if end_ns is not None and stride.t_end_ns <= end_ns:
            return "it is no newer than the stride before"
        usual_mps = median(self._speeds) if self._speeds else stride.speed_mps
        before_mps, self._other_mps = self._other_mps, None
        self._speeds.append(stride.speed_mps)
        if end_ns is None or stride.t_start_ns - end_ns > STOP_S * NS_PER_S:
            self._speeds.clear()
            return "it is the first stride after standing"
        if stride.stride_length_m < self._min_length_m:
            return f"a stride of {100 * stride.stride_length_m:.0f} cm is no walking"
        if abs(stride.turn_rad) > math.radians(self._tuning.max_turn_deg):
            return f"the foot turned by {abs(math.degrees(stride.turn_rad)):.0f}°"
        if self._ground_changed_ns is not None and self._ground_changed_ns >= stride.t_start_ns:
            return "a person changed the ground meanwhile"  # before its rise would count as a stair's, or as usual
        if uneven := self._ground.unusual(stride):
            return uneven
        if self._changed_ns is not None and self._changed_ns >= stride.t_start_ns:
            return "a person changed the stimulation meanwhile"
        if _other_speed(stride.speed_mps, usual_mps):
            if before_mps is None or _other_speed(stride.speed_mps, before_mps):
                self._other_mps = stride.speed_mps
                return f"{OTHER_SPEED} from {usual_mps:.1f} to {stride.speed_mps:.1f} m/s"
            self._speeds.clear()  # two in a row: this is the speed now
            self._speeds.append(stride.speed_mps)
        if charge_uc <= 0.0 or drive <= 0.0:
            return NO_CHARGE
        relative = charge_uc / (drive * ((stride.t_end_ns - stride.t_start_ns) / NS_PER_S))
        usual = median(self._charges) if self._charges else relative
        self._charges.append(relative)
        if relative < CHARGE_SHARE * usual:
            return f"only {relative / usual:.0%} of the usual pulses were delivered"
        return ""


def _other_speed(speed_mps: float, usual_mps: float) -> bool:
    return abs(speed_mps - usual_mps) > max(SPEED_CHANGE * usual_mps, LEAST_SPEED_CHANGE_MPS)


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
    middle_s: float
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
    middle_ns = swing_ns + MID_SWING_END * (contact_ns - swing_ns)
    return SwingTimes(1e-9 * (swing_ns - begin_ns), 1e-9 * (middle_ns - begin_ns), 1e-9 * (contact_ns - begin_ns))


def times_ns(stride: StrideResult) -> list[float]:
    """When the stride's trajectory and pitch were."""
    n = len(stride.pitch_rad)
    step = (stride.t_end_ns - stride.t_start_ns) / (n - 1)
    return [stride.t_start_ns + k * step for k in range(n)]
