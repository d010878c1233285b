"""Can these numbers come from this sensor, on this foot, mounted as it was? Axes, units, range, mounting.

Every bound was held against real recordings (docs/safety.md): gait never comes near them.
``benchmarks/safety/wrong_unit.py`` shows how soon a wrong unit or exchanged axes are found, and on how many real
recordings they are found wrongly.
"""

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import permutations, product
from typing import Final, TypeAlias

from fes.config import ImuDevice
from fes.gate.coherence import Coherence
from fes.signals import G_MPS2, SHANK_SENSORS, ImuSample, Vector3

SUSTAINED_MS: Final = 80  # what one knock, one clipped heel strike or one free fall of the foot never lasts
SUSTAINED_NS: Final = SUSTAINED_MS * 1_000_000

# with the first three of them 1.38 times as wide no real walk would be taken for an exchange yet
LEAST_JUMP: Final = 0.7  # of force and rate together, each squared and against its own size
SMOOTH: Final = 0.13  # of the jump: the steps before and after it are smaller
EXPLAINED: Final = 0.09  # of the jump: what an exchange of axes leaves of it
AGAINST: Final = 0.02  # of the rate's square: an exchange may miss the new rate by so much more than the old rate does
LEAST_FORCE_MPS2: Final = 4.0  # smaller forces and rates are not taken as larger jumps for their size
LEAST_RATE_RADPS: Final = 1.0
STEPS_AFTER: Final = 2  # that have to be smooth
MOST_APART_NS: Final = 12_500_000  # by the sensor's own clock, between two samples; in a longer time all may change
_LEAST_FORCE2: Final = LEAST_FORCE_MPS2**2
_LEAST_RATE2: Final = LEAST_RATE_RADPS**2

# a box turned, never mirrored: (order, signs); a mirrored force alone is what many a hard heel strike looks like
_TURNS = tuple(
    (order, signs)
    for order in permutations(range(3))
    for signs in product((1.0, -1.0), repeat=3)
    if math.prod(signs) * (1.0 if order in ((0, 1, 2), (1, 2, 0), (2, 0, 1)) else -1.0) > 0.0
)


@dataclass(slots=True)
class _Jump:
    """One that exchanged axes explain, and what has to follow it."""

    force: float  # the square that a step of the force is measured by
    rate: float  # likewise for the rate
    smooth: float  # what a step after it may measure
    steps: int  # so many are still to come
    before: ImuSample
    exchanged: tuple[Vector3, Vector3]  # the force and the rate before it, by the axes after it

    def stays(self, sample: ImuSample) -> bool:
        """Whether this sample is nearer to what exchanged axes make of the one before than to that one itself."""
        to_exchanged, to_before = (
            _square_apart(sample.acc_mps2, acc) / self.force + _square_apart(sample.gyr_radps, gyr) / self.rate
            for acc, gyr in (self.exchanged, (self.before.acc_mps2, self.before.gyr_radps))
        )
        return to_exchanged <= to_before


class Axes:
    """Finds that one sensor's axes changed between two samples: one jump that exchanged axes explain and gait does not.

    Real force and rate jump too, at heel strikes, but neither before nor after such a jump are they smooth, and no
    exchange of axes leads from the one sample to the other in both at once. Under a heel the force may turn right
    around and stay so for two samples; but the rate goes on as it was, and so speaks against an exchange. A foot that
    is pulled off the ground is jolted too, and two samples later the force is on its way back.
    """

    def __init__(self) -> None:
        self._before: ImuSample | None = None
        self._step: tuple[float, float] | None = None  # the last one's square, of force and of rate
        self._jump: _Jump | None = None

    def fault(self, sample: ImuSample) -> str:
        """Take in a finite sample; in words that the axes changed two samples ago, "" when they did not."""
        before, last, jump = self._before, self._step, self._jump
        self._before = sample
        if before is None or not 0 < sample.t_sensor_ns - before.t_sensor_ns <= MOST_APART_NS:
            self._step = self._jump = None
            return ""
        (x, y, z), (a, b, c) = sample.acc_mps2, before.acc_mps2
        x, y, z = x - a, y - b, z - c
        force = x * x + y * y + z * z
        (x, y, z), (a, b, c) = sample.gyr_radps, before.gyr_radps
        x, y, z = x - a, y - b, z - c
        rate = x * x + y * y + z * z
        self._step = (force, rate)
        if jump is None:
            # most steps are too small already if held against the least sizes, and against any other they are smaller
            if last and force / _LEAST_FORCE2 + rate / _LEAST_RATE2 >= LEAST_JUMP:
                self._jump = _jump(before, sample, last, self._step)
            return ""
        jump.steps -= 1
        smooth = force / jump.force + rate / jump.rate <= jump.smooth
        if smooth and jump.steps:
            return ""
        self._jump = None
        if smooth and jump.stays(sample):
            return f"the axes of {sample.sensor} changed from one sample to the next: remounted?"
        return ""


def _jump(before: ImuSample, after: ImuSample, last: tuple[float, float], step: tuple[float, float]) -> _Jump | None:
    acc, gyr, acc_before, gyr_before = after.acc_mps2, after.gyr_radps, before.acc_mps2, before.gyr_radps
    force = max(_square(acc), _square(acc_before), _LEAST_FORCE2)
    rate = max(_square(gyr), _square(gyr_before), _LEAST_RATE2)
    size = step[0] / force + step[1] / rate
    smooth = SMOOTH * size
    if size < LEAST_JUMP or last[0] / force + last[1] / rate > smooth:
        return None
    most, rate_most = EXPLAINED * size, step[1] / rate + AGAINST
    for order, signs in _TURNS:
        exchanged = _exchanged(acc_before, order, signs), _exchanged(gyr_before, order, signs)
        rate_left = _square_apart(gyr, exchanged[1]) / rate
        left = rate_left + _square_apart(acc, exchanged[0]) / force
        if rate_left <= rate_most and left <= most:
            return _Jump(force, rate, smooth, STEPS_AFTER, before, exchanged)
    return None


def _square(a: Vector3) -> float:
    return a[0] * a[0] + a[1] * a[1] + a[2] * a[2]


def _square_apart(a: Vector3, b: Vector3) -> float:
    x, y, z = a[0] - b[0], a[1] - b[1], a[2] - b[2]
    return x * x + y * y + z * z


def _exchanged(a: Vector3, order: tuple[int, ...], signs: tuple[float, ...]) -> Vector3:
    return (signs[0] * a[order[0]], signs[1] * a[order[1]], signs[2] * a[order[2]])


MOSTLY: Final = (3, 4)  # of the samples of a span: in g too a swing has its spikes
STEP: Final = 4.0  # from one sample to the next; real ones that last reach 2.4 down and 3.0 up
SMOOTH_BEFORE_MPS2: Final = 8.0  # the change just before such a step; a foot that strikes the ground shakes by more
MOST_GAP_NS: Final = 25_000_000  # likewise, in the span after a step: from fewer samples nobody can tell that it lasts
BEYOND: Final = 1.05  # of an axis' range: what calibrating makes of a sample at its end stays below
MOST_SAMPLES: Final = 1000  # kept of a span; a sensor that sends more is judged by fewer

WEAK, LOW, USUAL, HIGH, STRONG = range(5)


@dataclass(frozen=True, slots=True)
class Bounds:
    """Of the force, in m/s², increasing; what lies mostly beyond one for a span is in a wrong unit."""

    weak: float  # below it, whatever was before
    low: float  # below it, after a step down
    high: float  # above it, after a step up
    strong: float  # above it, whatever was before


FOOT: Final = Bounds(weak=2.5, low=7.0, high=60.0, strong=80.0)
SHANK: Final = Bounds(weak=2.5, low=7.0, high=45.0, strong=60.0)  # it is shaken less


# one sample: when, the level of its force, whether a step led to it (-1 down, 1 up), whether a gap did, and whether an
# axis shows more than the sensor could in g
Seen: TypeAlias = tuple[int, int, int, bool, bool]


class Force:
    """Finds that one sensor's force is in a wrong unit: by its level, and by a step in it that lasts.

    A force in g for m/s² is 9.8 times too small. Where that takes it below what any swing shows, its level tells; in a
    brisk swing it does not, but then the change itself does: no foot's force falls to less than a quarter from one
    sample to the next and then stays low. The same the other way round for a force scaled once more, or in mg.
    A heel that lands, bounces and slaps down comes nearest; but that shakes just before the step too, and mostly shows
    more than the sensor's range in g, or than any sensor's.

    Args:
        sensor: its name, for its place on the leg.
        range_g: of each of its axes; without it what it could show in g is not known.
    """

    def __init__(self, sensor: str, range_g: float = math.inf) -> None:
        self._bounds = SHANK if sensor in SHANK_SENSORS else FOOT
        self._seen: deque[Seen] = deque()
        self._counts = [0, 0, 0, 0, 0]
        self._gaps = self._beyond = 0
        self._most_in_g = BEYOND * range_g
        self._before_mps2 = 0.0
        self._before_ns = 0
        self._two_before: tuple[Vector3, Vector3] | None = None  # the last two samples' forces

    def fault(self, sample: ImuSample, force_mps2: float, most_mps2: float) -> str:
        """Take in a sample, the size of its force and its largest axis; what is wrong with the unit, or ""."""
        t_ns, seen = sample.t_ns, self._seen
        if seen and not 0 <= t_ns - seen[-1][0] <= SUSTAINED_NS:  # reported elsewhere; nothing from before counts
            while seen:
                self._forget_oldest()
        bounds, before_mps2 = self._bounds, self._before_mps2
        level = USUAL
        if force_mps2 < bounds.low:
            level = WEAK if force_mps2 < bounds.weak else LOW
        elif force_mps2 > bounds.high:
            level = STRONG if force_mps2 > bounds.strong else HIGH
        apart_ns = sample.t_sensor_ns - self._before_ns
        step = 0
        if seen and 0 < apart_ns <= MOST_APART_NS:
            step = (force_mps2 > before_mps2 * STEP) - (force_mps2 * STEP < before_mps2)
        acc, two = sample.acc_mps2, self._two_before
        if step and two is not None and _square_apart(*two) > SMOOTH_BEFORE_MPS2**2:
            step = 0
        self._two_before = (acc, acc) if two is None else (two[1], acc)
        self._before_mps2, self._before_ns = force_mps2, sample.t_sensor_ns
        gap, beyond = apart_ns > MOST_GAP_NS, most_mps2 > self._most_in_g
        seen.append((t_ns, level, step, gap, beyond))
        self._counts[level] += 1
        self._gaps += gap
        self._beyond += beyond
        fault = ""
        while t_ns - seen[0][0] >= SUSTAINED_NS:
            fault = fault or self._judge_span(sample.sensor, force_mps2)
            self._forget_oldest()
        if len(seen) > MOST_SAMPLES:
            self._forget_oldest()
        return fault

    def _judge_span(self, sensor: str, force_mps2: float) -> str:
        """What is wrong with the unit, by the span from the oldest sample to the newest."""
        weak, low, _, high, strong = self._counts
        share, whole = MOSTLY
        most = share * len(self._seen)
        possible_in_g = not (self._beyond or high or strong)
        if whole * (weak + low) >= most and (whole * weak >= most or (self._step() < 0 and possible_in_g)):
            return f"{sensor} shows {force_mps2:.2g} m/s² and less than gravity for {SUSTAINED_MS} ms: is its unit g?"
        if whole * (strong + high) >= most and (whole * strong >= most or self._step() > 0):
            shows = f"{force_mps2:.0f} m/s² and more than a foot can take"
            return f"{sensor} shows {shows} for {SUSTAINED_MS} ms: wrong unit?"
        return ""

    def _step(self) -> int:
        """The step that led to the oldest sample; 0 where a later one comes after a gap."""
        _, _, step, gap, _ = self._seen[0]
        return step if self._gaps == gap else 0

    def _forget_oldest(self) -> None:
        _, level, _, gap, beyond = self._seen.popleft()
        self._counts[level] -= 1
        self._gaps -= gap
        self._beyond -= beyond


MOST_RATE_RADPS: Final = 40.0  # in any one sample: degrees taken for radians; real feet turn at 13, shanks at 20
FAST_RADPS: Final = 15.0  # about one axis for 80 ms: a turn in 0.4 s; real feet never are, shanks for one sample
AT_RANGE: Final = 0.995  # of the range that the session states
REST_RATE_RADPS: Final = 0.5
REST_FORCE_MPS2: Final = 1.5  # of gravity
MOST_TILT_RAD: Final = math.radians(65)  # at rest, from where it was at calibration; real feet reach 23°, shanks 30°
MEAN_NS: Final = 300_000_000  # gravity shows through a walk: the mean force of real legs tilts by 53° at most …
# … a sample's counting as this at most: a stumble shakes a foot by ten times gravity
MOST_IN_MEAN_MPS2: Final = 2.0 * G_MPS2
MOST_STEP_NS: Final = 40_000_000  # one sample after a silence does not stand for all of it
_TILT: Final = f"{math.degrees(MOST_TILT_RAD):.0f}°"
_UPRIGHT: Final = math.cos(MOST_TILT_RAD)


@dataclass(slots=True)
class _Lasting:
    """How long something has been so."""

    since_ns: int | None = None

    def lasts(self, t_ns: int, is_so: bool) -> bool:
        """Whether it has now been so for long enough."""
        if not is_so:
            self.since_ns = None
            return False
        if self.since_ns is None:
            self.since_ns = t_ns
        return t_ns - self.since_ns >= SUSTAINED_NS


class Plausibility:
    """One sensor's samples against what is possible.

    Args:
        sensor: its name.
        device: its settings, for its ranges; without them saturation cannot be told.
        up: the upward direction in the sensor's frame when it was calibrated; without it the mounting is not judged.
    """

    def __init__(self, sensor: str, device: ImuDevice | None, up: Vector3 | None) -> None:
        self._acc_range_mps2 = AT_RANGE * device.acc_range_g * G_MPS2 if device else math.inf
        self._gyr_range_radps = AT_RANGE * math.radians(device.gyr_range_dps) if device else math.inf
        self._up = up
        self.not_ready = ""  # no fault by itself: a foot may rest so, but not one that walks
        self._force = Force(sensor, device.acc_range_g if device else math.inf)
        self._axes, self._coherence = Axes(), Coherence(sensor)
        self._fast, self._saturated = _Lasting(), _Lasting()
        self._rests, self._moves = _Lasting(), _Lasting()  # turned, both
        self._mean_mps2 = self._upright()
        self._mean_ns: int | None = None

    def fault(self, sample: ImuSample) -> str:
        """Take in a finite sample; what cannot be, in words, "" when all can."""
        t_ns, name = sample.t_ns, sample.sensor
        x, y, z = sample.acc_mps2
        force_mps2 = math.sqrt(x * x + y * y + z * z)
        most_mps2, rate_radps = _largest(sample.acc_mps2), _largest(sample.gyr_radps)
        at_range = rate_radps >= self._gyr_range_radps or most_mps2 >= self._acc_range_mps2
        wrong_unit, exchanged = self._force.fault(sample, force_mps2, most_mps2), self._axes.fault(sample)
        incoherent = self._coherence.fault(sample)
        fast = self._fast.lasts(t_ns, rate_radps > FAST_RADPS)
        saturated = self._saturated.lasts(t_ns, at_range)
        rests = self._rests.lasts(t_ns, self._rests_tilted(x, y, z, force_mps2, rate_radps))
        moves = self._moves.lasts(t_ns, self._moves_tilted(x, y, z, force_mps2, t_ns))
        does = "rests" if rests else "moves" if moves else ""
        self.not_ready = f"{name} {does} turned by more than {_TILT} from its calibration: remounted?" if does else ""
        self.not_ready = self.not_ready or self._coherence.not_ready
        if rate_radps > MOST_RATE_RADPS:
            return f"{name} turns at {rate_radps:.0f} rad/s, which no foot does: is its unit °/s?"
        if wrong_unit:
            return wrong_unit
        if exchanged:
            return exchanged
        if saturated:
            return f"{name} is saturated: at the end of its range for {SUSTAINED_MS} ms"
        if fast:
            return f"{name} turns at more than {FAST_RADPS:.0f} rad/s for {SUSTAINED_MS} ms: is its unit °/s?"
        return incoherent

    def _rests_tilted(self, x: float, y: float, z: float, force_mps2: float, rate_radps: float) -> bool:
        if self._up is None or rate_radps > REST_RATE_RADPS or abs(force_mps2 - G_MPS2) > REST_FORCE_MPS2:
            return False
        ux, uy, uz = self._up
        return x * ux + y * uy + z * uz < force_mps2 * _UPRIGHT

    def _moves_tilted(self, x: float, y: float, z: float, force_mps2: float, t_ns: int) -> bool:
        """Whether the force, averaged over about 0.3 s, comes from elsewhere than gravity does in anybody's gait.

        A stance need not hold a rest: of stroke survivors' shanks, most do not. A foot that stumbles can show so too,
        but not for long.
        """
        if self._up is None:
            return False
        before_ns, self._mean_ns = self._mean_ns, t_ns
        step_ns = t_ns - before_ns if before_ns is not None else 0
        if step_ns > MOST_STEP_NS:
            step_ns = MOST_STEP_NS
        elif step_ns < 0:
            step_ns = 0
        share = step_ns / MEAN_NS
        if force_mps2 > MOST_IN_MEAN_MPS2:
            most = MOST_IN_MEAN_MPS2 / force_mps2
            x, y, z = most * x, most * y, most * z
        (mx, my, mz), (ux, uy, uz) = self._mean_mps2, self._up
        mx, my, mz = mx + share * (x - mx), my + share * (y - my), mz + share * (z - mz)
        size = math.sqrt(mx * mx + my * my + mz * mz)
        if not size < math.inf:  # a fault of its own; a mean would never forget it
            self._mean_mps2 = self._upright()
            return False
        self._mean_mps2 = (mx, my, mz)
        return mx * ux + my * uy + mz * uz < size * _UPRIGHT

    def _upright(self) -> Vector3:
        x, y, z = self._up or (0.0, 0.0, 0.0)
        return (G_MPS2 * x, G_MPS2 * y, G_MPS2 * z)


class Plausible:
    """All sensors' plausibility.

    Args:
        devices: the session's sensors; one that is not among them is judged without ranges.
        up: the calibrated upward directions by sensor.
    """

    def __init__(self, devices: tuple[ImuDevice, ...], up: Mapping[str, Vector3]) -> None:
        self._devices = {str(device.sensor): device for device in devices}
        self._up = dict(up)
        self._sensors: dict[str, Plausibility] = {}

    def fault(self, sample: ImuSample) -> str:
        """Take in a sample; see :meth:`Plausibility.fault`."""
        known = self._sensors.get(sample.sensor)
        if known is None:
            known = Plausibility(sample.sensor, self._devices.get(sample.sensor), self._up.get(sample.sensor))
            self._sensors[sample.sensor] = known
        return known.fault(sample)

    def reason_not_ready(self, sensor: str) -> str:
        """Why this sensor's data are no ground for stimulating now; "" when they are."""
        known = self._sensors.get(sensor)
        return known.not_ready if known else ""


def _largest(a: Vector3) -> float:
    """Of the three sizes; as ``max``, which takes three times as long."""
    x, y, z = a
    most, y, z = abs(x), abs(y), abs(z)
    if y > most:
        most = y
    return z if z > most else most
