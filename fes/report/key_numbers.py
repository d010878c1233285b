"""The six numbers of the first page, each with how far it can be relied on."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from statistics import NormalDist
from typing import Final

import numpy as np

from fes.analysis.parameters.definitions import DEFINITIONS
from fes.analysis.parameters.gait import GaitParameters
from fes.evaluation.agreement import CONFIDENCE, Interval, combined, mean_of
from fes.report.glossary import NORMS
from fes.report.summary import SessionSummary
from fes.report.text import DIGITS, capitalised, count_of, number, together
from fes.signals import FloatArray

MOST: Final = 6
_OF_FEET: Final = ("stride_length_common_m", "stance_share", "toe_clearance_m", "lift_m")


@dataclass(frozen=True, slots=True)
class KeyNumber:
    """``term``: its word in the glossary. ``values``: (foot, text), the foot "" for what is of all."""

    term: str
    name: str
    values: tuple[tuple[str, str], ...]
    below: str


def key_numbers(summary: SessionSummary, gait: GaitParameters) -> list[KeyNumber]:
    """The first six that are known, in the order in which they matter to whoever treats the person."""
    return list(_known(summary, gait))[:MOST]


def _known(s: SessionSummary, gait: GaitParameters) -> Iterator[KeyNumber]:
    if s.channels:
        bursts, on_s = sum(channel.bursts for channel in s.channels), sum(channel.on_time_s for channel in s.channels)
        charge_mc = sum(channel.charge_uc for channel in s.channels) / 1e3
        counted = all(channel.charge_counted_by_device for channel in s.channels if channel.bursts)
        how = f"{count_of(bursts, 'burst')}, {on_s:.1f} s on; {'counted by the stimulator' if counted else 'estimated'}"
        how += f"; {len(s.channels)} channels together" if len(s.channels) > 1 else ""
        yield KeyNumber("charge", "Stimulation", (("", f"{charge_mc:.2f} mC"),), how)
    feet = together(list(s.feet))
    if s.exercise is None:
        below = f"usual {NORMS['walking_speed_mps'].text}"
        if s.belt_speed_mps > 0:
            below = f"belt {s.belt_speed_mps:.2f}, ratio {number(s.speed_over_belt, 3)}"
        shown = _shown(_over_feet(gait, "speed_mps", s.walking_speed_mps), 2, "m/s")
        yield KeyNumber("walking speed", "Walking speed", (("", shown),), below)
    for key in _OF_FEET[:2]:
        yield from _of_each_foot(gait, key)
    if np.isfinite(gait.walk.cadence_per_min):
        time = _over_feet(gait, "stride_time_s", 120.0 / gait.walk.cadence_per_min)
        ends = sorted((120.0 / time.low, 120.0 / time.high))
        shown = _shown(Interval(gait.walk.cadence_per_min, *ends), 1, "/min")
        yield KeyNumber("cadence", "Cadence", (("", shown),), "steps")
    lifted = [each for key in _OF_FEET[2:] for each in _of_each_foot(gait, key)]
    yield from lifted[:1]  # the toe's where it is known
    of = len(s.strides) + sum(foot.unexplained for foot in s.feet.values())
    if of:
        four = sum(row.four_phases for row in s.strides)
        low, high = share_between(four, of)
        shown = f"{100 * four / of:.0f} % ({100 * low:.0f} … {100 * high:.0f})"
        yield KeyNumber(
            "four phases", "All four phases", (("", shown),), ", ".join(filter(None, (f"{four} of {of}", feet)))
        )
    valid = sum(row.valid for row in s.strides)
    yield KeyNumber(
        "stride", "Strides", (("", f"{len(s.strides)}"),), ", ".join(filter(None, (f"{valid} valid", feet)))
    )


def share_between(count: int, of: int) -> tuple[float, float]:
    """Confidence interval of a share (Wilson, J Am Stat Assoc 22, 1927)."""
    z, share = NormalDist().inv_cdf(0.5 + 0.5 * CONFIDENCE), count / of
    middle, reach = share + z**2 / (2 * of), z * math.sqrt(share * (1.0 - share) / of + (z / (2 * of)) ** 2)
    low, high = (middle - reach) / (1.0 + z**2 / of), (middle + reach) / (1.0 + z**2 / of)
    return max(low, 0.0), min(high, 1.0)


def _shown(value: Interval, digits: int, unit: str) -> str:
    """``0.41 ± 0.01 m/s``; without an interval ``± –``."""
    return f"{number(value.value, digits)} ± {number(0.5 * (value.high - value.low), digits)} {unit}".rstrip()


def _values(gait: GaitParameters, foot: str, key: str) -> FloatArray:
    rows = gait.strides[foot]
    return np.asarray(rows[key][rows["steady"]], np.float64)


def _over_feet(gait: GaitParameters, key: str, value: float) -> Interval:
    """A number of the walk, with the interval of the mean of the feet's means."""
    feet = [mean_of(_values(gait, foot, key)) for foot in gait.strides]
    feet = [each for each in feet if each.n]
    return combined(value, [(1.0 / len(feet), each.error, each.freedom) for each in feet]) if feet else Interval(value)


def _of_each_foot(gait: GaitParameters, key: str) -> Iterator[KeyNumber]:
    known, means = DEFINITIONS[key], {foot: mean_of(_values(gait, foot, key)) for foot in gait.strides}
    digits = DIGITS[known.shown]
    values = []
    for foot, mean in means.items():
        if mean.n:
            own = combined(known.factor * mean.mean, [(known.factor, mean.error, mean.freedom)])
            values.append((foot, _shown(own, digits, known.shown)))
    if values:
        below = f"of {' and '.join(str(each.n) for each in means.values() if each.n)} strides"
        yield KeyNumber(key, capitalised(known.name), tuple(values), below)
