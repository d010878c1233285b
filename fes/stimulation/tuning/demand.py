"""What each measure asks for, by the identified response: where its level should lie, and the drive that it takes.

The less the strides differ, the nearer the aim lies to the low end of the band, for what is not needed is charge and
fatigue. The measure whose drive is the greatest leads.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from fes.stimulation.tuning.response import ResponseModel
from fes.stimulation.tuning.targets import ROLL, Measure, Reading

SAFE_SDS: Final = 2.8  # of a stride's noise between the aim and the low end
LEAST_AIM: Final = 0.42  # a toe's height is known to some millimetres only, …
LEAST_AIM_AT_CONTACT: Final = 0.06  # … the foot's pitch to a degree or two; …
LEAST_AIM_ROLL: Final = 0.35  # … and of roll either side is as wrong
GREATEST_AIM: Final = 0.60
DEAD: Final = 0.05  # of the band: nearer to the aim nothing moves
DEAD_ABOVE: Final = 0.03  # above it, where more is only charge


@dataclass(frozen=True, slots=True)
class Demand:
    """One measure's: its newest value, the level to expect under the drive it has seen, and what is missing.

    ``error`` is in bands, > 0 when more stimulation is needed, < 0 when less will do, 0 when it is near enough;
    ``aim`` and ``noise`` (of a stride about what was expected) in bands. ``drive`` is what the measure has seen,
    ``wanted`` the least that takes it to the aim, ``most`` the greatest that most likely keeps it in the band.
    """

    measure: Measure
    usual: float
    error: float
    aim: float
    noise: float
    drive: float
    wanted: float
    most: float

    @property
    def step(self) -> float:
        """What is missing in drive: what all measures can be compared by."""
        return self.wanted - self.drive if self.error else 0.0


def demands_of(model: ResponseModel, reading: Reading, drives: Mapping[str, float]) -> tuple[Demand, ...]:
    """Of the reading's measures, the one that asks for most first; the model must have taken them in."""
    demands = []
    for measure in reading.measures:
        name, drive = measure.name, drives[measure.name]
        noise, usual = model.noise(name), model.expected(name, drive).value
        least = LEAST_AIM_AT_CONTACT if measure.at_contact else LEAST_AIM
        if name == ROLL:
            least = LEAST_AIM_ROLL
        aim = min(max(SAFE_SDS * noise, least), GREATEST_AIM)
        error = aim - usual
        if -DEAD_ABOVE <= error <= DEAD:
            error = 0.0
        most = model.least_drive(name, 1.0 - SAFE_SDS * noise) if usual < 1.0 - SAFE_SDS * noise else drive
        demands.append(Demand(measure, usual, error, aim, noise, drive, model.least_drive(name, aim), most))
    return tuple(sorted(demands, key=lambda demand: -demand.step))


def in_mid_swing(demands: tuple[Demand, ...]) -> Demand:
    """Of what is measured in mid-swing; where nothing is, the one that asks for most."""
    return next((demand for demand in demands if not demand.measure.at_contact), demands[0])


def late_demand(demands: tuple[Demand, ...]) -> Demand | None:
    """Of what is measured at contact; None where nothing is."""
    return next((demand for demand in demands if demand.measure.at_contact), None)


def at_contact(demands: tuple[Demand, ...]) -> tuple[float | None, float]:
    """Of what is measured at contact the lower of usual and newest level, None where nothing is; and what is missing
    of anything."""
    late, missing = late_demand(demands), max(demand.error for demand in demands)
    return (None if late is None else min(late.usual, late.measure.level)), missing


def leading(demands: tuple[Demand, ...]) -> Demand:
    """The demand that a change is for: the greatest, or, where nothing is missing, the greatest excess."""
    return demands[0] if demands[0].error > 0.0 else min(demands, key=lambda demand: demand.step)


def room(demands: tuple[Demand, ...]) -> float:
    """The greatest drive at which no other measure than the first most likely leaves its band at the high end."""
    return min((max(demand.most, demand.drive) for demand in demands[1:]), default=math.inf)
