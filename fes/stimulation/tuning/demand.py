"""How this foot answers to stimulation, learnt from its own strides, and what each measure asks for.

The drive is the stimulation relative to the session's (1 is what the session says), the level the place in the target
band (:mod:`fes.stimulation.tuning.targets`). Between patients the slope of level against drive differs tenfold, so it
is estimated: a ridge regression over recent strides towards a prior, which is the Bayesian estimate for a normal prior
and noise (Hoerl & Kennard 1970, Technometrics 12:55-67), kept within bounds. With it, strides walked under other
settings still show the level under the present ones, so that the median does not lag behind the changes.

Run-to-run control moves the drive one step a stride: ``u[k+1] = sat(u[k] + gamma (aim - measured[k]))`` with ``gamma =
gain / slope``, so that one gain does for strong and weak responders. The less strides differ, the nearer the aim lies
to the low end of the band, for what is not needed is charge and fatigue. Every measure has its own slope, noise and
aim; the one that needs most leads.
"""

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from statistics import median
from typing import Final

from fes.stimulation.tuning.targets import Measure, Reading

REMEMBERED: Final = 12
SLOPE: Final = 2.7  # bands over the drive's whole range, before anything is known
SLOPE_SD: Final = 2.7
SLOPE_BOUNDS: Final = (1.3, 16.0)
NOISE: Final = 0.20  # of a stride's level, before anything is known
NOISE_AT_CONTACT: Final = 0.045  # so of the foot's pitch at contact
BELIEVED: Final = 4  # strides' worth of trust in it
MOST_SURPRISE: Final = 3.0  # times the usual noise: one stumble says little about the others
NOISE_BOUNDS: Final = (0.04, 0.60)
NEAR: Final = 0.04  # of the drive's whole range: strides this near the present one need no trust in the slope
LAST: Final = 3
FADE: Final = 0.85  # weight of a stride against the one after it

SAFE_SDS: Final = 2.0  # of a stride's noise between the aim and the low end: 2.3 % of strides below
LEAST_AIM: Final = 0.30  # a toe's height is known to some millimetres only, …
LEAST_AIM_AT_CONTACT: Final = 0.06  # … the foot's pitch to a degree or two
GREATEST_AIM: Final = 0.55
SUDDEN_SDS: Final = 2.5  # below what was expected and below the band: acted upon at once, it may be no chance
DEAD: Final = 0.05  # of the band: nearer to the aim nothing moves
DEAD_ABOVE: Final = 0.03  # above it, where more is only charge


class Response:
    """Recent strides' drives and levels; oldest first.

    ``usual_noise`` is what is believed before any are known. ``most`` is the drive at the intensity's upper bound: what
    the whole range does to a foot does not depend on where in it the session begins.
    """

    def __init__(self, usual_noise: float = NOISE, most: float = 1.0) -> None:
        self._usual_noise, self._most = usual_noise, most
        self._strides: deque[tuple[float, float]] = deque(maxlen=REMEMBERED)
        self._surprises: deque[float] = deque(maxlen=REMEMBERED)

    def add(self, drive: float, level: float) -> None:
        """A valid stride."""
        if len(self._strides) >= LAST:
            most = MOST_SURPRISE * self._usual_noise
            self._surprises.append(min(max(level - self.level_at(drive), -most), most))
        self._strides.append((drive, level))

    def forget(self) -> None:
        """What was learnt no longer holds."""
        self._strides.clear()
        self._surprises.clear()

    @property
    def count(self) -> int:
        """Strides remembered."""
        return len(self._strides)

    @property
    def slope(self) -> float:
        """Level per drive, over the whole range within ``SLOPE_BOUNDS``."""
        weights = [FADE**age for age in range(len(self._strides) - 1, -1, -1)]
        total = sum(weights)
        if not total:
            return SLOPE / self._most
        strides = [(w, u / self._most, z) for w, (u, z) in zip(weights, self._strides, strict=True)]
        mean_u, mean_z = sum(w * u for w, u, _ in strides) / total, sum(w * z for w, _, z in strides) / total
        ridge = (NOISE / SLOPE_SD) ** 2
        uz = sum(w * (u - mean_u) * (z - mean_z) for w, u, z in strides)
        uu = sum(w * (u - mean_u) ** 2 for w, u, _ in strides)
        return min(max((SLOPE * ridge + uz) / (ridge + uu), SLOPE_BOUNDS[0]), SLOPE_BOUNDS[1]) / self._most

    def level_at(self, drive: float) -> float:
        """The level to expect under this drive: median of the last strides, moved there along the slope."""
        slope = self.slope
        moved = [(abs(u - drive), z + slope * (drive - u)) for u, z in self._strides]
        newest = [z for _, z in moved[-LAST:]]
        if all(z < 0.0 for z in newest) or all(z > 1.0 for z in newest):
            return median(newest)  # all agree that the band is left: older strides would only slow it down
        return median(
            z for i, (far, z) in enumerate(moved[-7:]) if far < NEAR * self._most or i >= len(moved[-7:]) - LAST
        )

    @property
    def noise(self) -> float:
        """Standard deviation of a stride's level about its neighbour's, robustly, within ``NOISE_BOUNDS``."""
        if len(self._strides) < 4:
            return self._usual_noise
        slope = self.slope
        free = [z - slope * u for u, z in self._strides]
        steps = [abs(b - a) for a, b in pairwise(free)]  # differences: a slow drift is no noise
        return min(max(1.4826 * median(steps) / math.sqrt(2.0), NOISE_BOUNDS[0]), NOISE_BOUNDS[1])

    @property
    def surprise(self) -> float:
        """Standard deviation of a stride's level about the expected one, within ``NOISE_BOUNDS``.

        Greater than the noise by what comes in waves of several strides and by what is wrong with the expectation. From
        the strides' own surprises and from what is usual, each by the number of strides that speak for it.
        """
        total = BELIEVED * self._usual_noise**2 + sum(off * off for off in self._surprises)
        deviation = math.sqrt(total / (BELIEVED + len(self._surprises)))
        return min(max(deviation, NOISE_BOUNDS[0]), NOISE_BOUNDS[1])

    def last_levels(self, n: int) -> list[float]:
        """Levels of the last ``n`` strides, oldest first."""
        return [z for _, z in list(self._strides)[-n:]]


def aim_of(response: Response, least: float = LEAST_AIM) -> float:
    """Where in the band strides should lie, 0–1; not below ``least``."""
    return min(max(SAFE_SDS * response.surprise, least), GREATEST_AIM)


def drive_error(response: Response, drive: float, least: float = LEAST_AIM) -> float:
    """How much level is missing (> 0) or too much (< 0) under this drive; 0 when it is near enough to the aim."""
    error = aim_of(response, least) - response.level_at(drive)
    return 0.0 if -DEAD_ABOVE <= error <= DEAD else error


@dataclass(frozen=True, slots=True)
class Demand:
    """One measure's: the newest value, the level to expect under the present drive, and what is missing.

    ``error`` is in bands, > 0 when more stimulation is needed, < 0 when less will do, 0 when it is near enough;
    ``slope`` in bands per drive, ``aim`` and ``noise`` (of a stride about what was expected) in bands.
    """

    measure: Measure
    usual: float
    error: float
    slope: float
    aim: float
    noise: float

    @property
    def step(self) -> float:
        """The error in drive: what all measures can be compared by."""
        return self.error / self.slope


class Responses:
    """Of each measure, by its name; ``most`` is the drive at the intensity's upper bound."""

    def __init__(self, most: float) -> None:
        self._most = most
        self._by_name: dict[str, Response] = {}

    def add(self, reading: Reading, drives: Mapping[str, float]) -> None:
        """A valid stride, and the drive that each measure has seen."""
        for measure in reading.measures:
            new = Response(NOISE_AT_CONTACT if measure.at_contact else NOISE, self._most)
            self._by_name.setdefault(measure.name, new).add(drives[measure.name], measure.level)

    def forget(self) -> None:
        """What was learnt no longer holds."""
        self._by_name.clear()

    def demands(self, reading: Reading, drives: Mapping[str, float]) -> tuple[Demand, ...]:
        """Of the reading's measures, the one that asks for most first; ``reading`` must have been added."""
        demands = []
        for measure in reading.measures:
            response, drive = self._by_name[measure.name], drives[measure.name]
            least = LEAST_AIM_AT_CONTACT if measure.at_contact else LEAST_AIM
            error, usual = drive_error(response, drive, least), response.level_at(drive)
            if measure.level < min(0.0, usual - SUDDEN_SDS * response.surprise):
                usual = measure.level
                error = aim_of(response, least) - usual
            demands.append(Demand(measure, usual, error, response.slope, aim_of(response, least), response.surprise))
        return tuple(sorted(demands, key=lambda demand: -demand.step))


def leading(demands: tuple[Demand, ...]) -> Demand:
    """The demand that a change is for: the greatest, or, where nothing is missing, the greatest excess."""
    return demands[0] if demands[0].error > 0.0 else min(demands, key=lambda demand: demand.step)


def in_mid_swing(demands: tuple[Demand, ...]) -> Demand:
    """Of what is measured in mid-swing; where nothing is, the one that asks for most."""
    return next((demand for demand in demands if not demand.measure.at_contact), demands[0])


def late_demand(demands: tuple[Demand, ...]) -> Demand | None:
    """Of what is measured at contact; None where nothing is."""
    return next((demand for demand in demands if demand.measure.at_contact), None)


def at_contact(demands: tuple[Demand, ...]) -> tuple[float | None, float]:
    """Of what is measured at contact the lower of usual and newest level, and the error; (None, 0) where nothing is."""
    late = late_demand(demands)
    return (None, 0.0) if late is None else (min(late.usual, late.measure.level), late.error)


def room(demands: tuple[Demand, ...]) -> float:
    """How much drive may be added before another measure than the leading one leaves its band at the high end."""
    return min(
        (max((1.0 - SAFE_SDS * demand.noise - demand.usual) / demand.slope, 0.0) for demand in demands[1:]),
        default=math.inf,
    )


def reason(demand: Demand, *, inverted: bool = False, stand_in: str = "") -> str:
    """Why the intensity changes, in words: the newest value, the usual one, and what follows."""
    measure, error = demand.measure, demand.error
    span = measure.band.high - measure.band.low

    def value(level: float) -> str:
        return f"{(measure.band.low + level * span) * measure.scale:.0f} {measure.unit}"

    if inverted:
        why = f"the other way made it worse, so {'less' if error < 0.0 else 'more'} is tried"
    elif error < 0.0:
        why = f"lately {value(demand.usual)}, {value(demand.aim)} will do"
    elif demand.usual < 0.0:
        why = f"lately {value(demand.usual)}, more is needed"
    else:
        differ = max(demand.noise * span * measure.scale, 1.0)
        why = (
            f"lately {value(demand.usual)}; strides differ by some {differ:.0f} {measure.unit}, so "
            f"{value(demand.aim)} is aimed at"
        )
    text = f"{measure.text()} in this stride, {why}"
    return f"{text} ({stand_in})" if stand_in else text
