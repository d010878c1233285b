"""What each measure asks for: every target has its own response to the drive, and the one that needs most leads.

A measure that varies little can lie near the low end of its band, one that varies much must keep away from it; so each
has its own slope, noise and aim (:mod:`fes.stimulation.tuning.run_to_run`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from fes.stimulation.tuning.response import NOISE, NOISE_AT_CONTACT, Response
from fes.stimulation.tuning.run_to_run import LEAST_AIM, LEAST_AIM_AT_CONTACT, SAFE_SDS, aim_of, drive_error
from fes.stimulation.tuning.targets import Measure, Reading


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
    """Of each measure, by its name."""

    def __init__(self) -> None:
        self._by_name: dict[str, Response] = {}

    def add(self, reading: Reading, drives: Mapping[str, float]) -> None:
        """A valid stride, and the drive that each measure has seen."""
        for measure in reading.measures:
            self._by_name.setdefault(measure.name, Response(NOISE_AT_CONTACT if measure.at_contact else NOISE)).add(
                drives[measure.name], measure.level
            )

    def forget(self) -> None:
        """What was learnt no longer holds."""
        self._by_name.clear()

    def demands(self, reading: Reading, drives: Mapping[str, float]) -> tuple[Demand, ...]:
        """Of the reading's measures, the one that asks for most first; ``reading`` must have been added."""
        found = []
        for measure in reading.measures:
            response, drive = self._by_name[measure.name], drives[measure.name]
            least = LEAST_AIM_AT_CONTACT if measure.at_contact else LEAST_AIM
            error, usual = drive_error(response, drive, least), response.level_at(drive)
            found.append(Demand(measure, usual, error, response.slope, aim_of(response, least), response.surprise))
        return tuple(sorted(found, key=lambda demand: -demand.step))


def leading(demands: tuple[Demand, ...]) -> Demand:
    """The demand that a change is for: the greatest, or, where nothing is missing, the greatest excess."""
    return demands[0] if demands[0].error > 0.0 else min(demands, key=lambda demand: demand.step)


def in_mid_swing(demands: tuple[Demand, ...]) -> Demand:
    """Of what is measured in mid-swing; where nothing is, the one that asks for most."""
    return next((demand for demand in demands if not demand.measure.at_contact), demands[0])


def at_contact(demands: tuple[Demand, ...]) -> tuple[float | None, float]:
    """Of what is measured at contact the lower of usual and newest level, and the error; (None, 0) where nothing is."""
    found = next((demand for demand in demands if demand.measure.at_contact), None)
    return (None, 0.0) if found is None else (min(found.usual, found.measure.level), found.error)


def room(demands: tuple[Demand, ...]) -> float:
    """How much drive may be added before another measure than the leading one leaves its band at the high end."""
    return min(
        (max((1.0 - SAFE_SDS * demand.noise - demand.usual) / demand.slope, 0.0) for demand in demands[1:]),
        default=math.inf,
    )


def reason(demand: Demand, *, other_way: bool = False, stand_in: str = "") -> str:
    """Why the intensity changes, in words: the newest value, the usual one, and what follows."""
    measure, error = demand.measure, demand.error
    span = measure.band.high - measure.band.low

    def value(level: float) -> str:
        return f"{(measure.band.low + level * span) * measure.scale:.0f} {measure.unit}"

    if other_way:
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
    said = f"{measure.text()} in this stride, {why}"
    return f"{said} ({stand_in})" if stand_in else said
