"""Iterative learning of the pulse-width profile over the burst.

``u[k+1](t) = Q{u[k](t) + L e[k](t + d)}``: ``d`` is about the delay from pulse to movement; the swing's length varies,
so only what the last swing reached is updated (variable pass length); inside the reference band the error is 0. It
converges if ``|Q (1 - L G)| < 1``: with ``L = gain / slope`` and Q an average over neighbours (no greater than 1 at any
frequency), for a true slope G from 0 to ``2 / gain`` times the estimated one. After Seel, Werner, Raisch & Schauer,
*Control Engineering Practice* 48 (2016), with a profile of widths and bands instead of a reference curve: until the end
of mid-swing the error is the clearance's, from there to contact the pitch's. So the part of the burst that holds the
toe up to meet the ground, the calf being stretched by then, can be stronger than the part that carries it over.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import fmean
from typing import Final

from fes.stimulation.parameters import BIN_S
from fes.stimulation.tuning.targets import SwingTimes

DELAY_S: Final = 0.15  # electromechanical delay 20–50 ms, rise of the activation 50 ms, and the foot's own inertia
SIDE: Final = 0.15  # weight of each neighbour in Q
MOST_AT_ONCE: Final = 1.0  # of the band: one bad moment must not move the profile further


@dataclass(frozen=True, slots=True)
class Zones:
    """Bins ``0 … middle`` carry the foot through mid-swing, ``middle … reached`` hold it until contact."""

    middle: int
    reached: int

    def means(self, widths: Sequence[float]) -> tuple[float, float]:
        """Mean width of each, the other's where one has no bins."""
        first, last = widths[: self.middle], widths[self.middle : self.reached]
        return fmean(first or last or widths), fmean(last or first or widths)


def zones_of(times: SwingTimes, burst_s: float, bins: int) -> Zones:
    """Which bins the stride's mid-swing and its end are answerable to; ``burst_s`` is the burst's begin."""
    reached = min(max(int((times.contact_s - burst_s) / BIN_S + 0.5), 0), bins)
    middle = int((times.middle_s - DELAY_S - burst_s) / BIN_S + 0.5)
    return Zones(min(max(middle, 0), reached), reached)


def next_profile(
    widths: Sequence[float], zones: Zones, errors: tuple[float, float], slopes: tuple[float, float],
    base: float, gain: float,
) -> list[float]:  # fmt: skip
    """The next stride's profile in µs, before any limit or bound.

    Args:
        widths: the last stride's.
        zones: of the last stride.
        errors: of each zone, in bands.
        slopes: of each zone, in bands per drive.
        base: the width that counts as drive 1; ``gain / slope`` is the learning gain L.
        gain: share of the error to take away at once.

    The smoothing Q works on the bins reached; beyond them the profile goes on with the width of the last, which the
    next, longer swing will judge.
    """
    n = zones.reached
    raised = list(widths)
    for k in range(n):
        zone = 0 if k < zones.middle else 1
        raised[k] += base * gain / slopes[zone] * min(max(errors[zone], -MOST_AT_ONCE), MOST_AT_ONCE)
    smooth = list(widths)
    for k in range(n):
        before, after = raised[max(k - 1, 0)], raised[min(k + 1, n - 1)]
        smooth[k] = SIDE * before + (1.0 - 2.0 * SIDE) * raised[k] + SIDE * after
    if n:
        smooth[n:] = [smooth[n - 1]] * (len(smooth) - n)
    return smooth
