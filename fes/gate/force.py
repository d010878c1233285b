"""Is the force in the unit that it should be in? Told by its level, and by a step in it that lasts.

A force in g for m/s² is 9.8 times too small. Where that takes it below what any swing shows, its level tells; in a
brisk swing it does not, but then the change itself does: no foot's force falls to less than a quarter from one sample
to the next and then stays low. The same the other way round for a force that was scaled once more, or is in mg.
A heel that lands, bounces and slaps down comes nearest; but what that shows is more than the sensor's range in g.
``benchmarks/wrong_unit.py`` shows how near real feet come, and how soon a wrong unit is told.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import Final, TypeAlias

from fes.signals import SHANK_SENSORS, ImuSample

SPAN_MS: Final = 80  # what one knock, one clipped heel strike or one free fall of the foot never lasts
SPAN_NS: Final = SPAN_MS * 1_000_000
MOSTLY: Final = (3, 4)  # of the samples of a span: in g too a swing has its spikes
STEP: Final = 4.0  # from one sample to the next; real ones that last reach 2.4 down and 3.0 up
MOST_APART_NS: Final = 12_500_000  # by the sensor's own clock, for a step: in a longer time force may do anything
MOST_GAP_NS: Final = 25_000_000  # likewise, in the span after a step: from fewer samples nobody can tell that it lasts
BEYOND: Final = 1.05  # of an axis' range: what calibrating makes of a sample at its end stays below
MOST_SAMPLES: Final = 1000  # kept of a span; a sensor that sends more is judged by fewer

WEAK, LOW, USUAL, HIGH, STRONG = range(5)


@dataclass(frozen=True, slots=True)
class Bounds:
    """Of the force, in m/s², increasing; what lies mostly beyond one for a span is in a wrong unit.

    Attributes:
        weak: below it, whatever was before.
        low: below it, after a step down.
        high: above it, after a step up.
        strong: above it, whatever was before.
    """

    weak: float
    low: float
    high: float
    strong: float


FOOT: Final = Bounds(weak=2.5, low=7.0, high=60.0, strong=80.0)
SHANK: Final = Bounds(weak=2.5, low=7.0, high=30.0, strong=60.0)  # it is shaken less


# one sample: when, the level of its force, whether a step led to it (-1 down, 1 up), whether a gap did, and whether an
# axis shows more than the sensor could in g
Seen: TypeAlias = tuple[int, int, int, bool, bool]


class Force:
    """The force of one sensor, sample by sample.

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

    def fault(self, sample: ImuSample, force_mps2: float, most_mps2: float) -> str:
        """Take in a sample, the size of its force and its largest axis; what is wrong with the unit, in words, "" when
        nothing is."""
        t_ns, seen = sample.t_ns, self._seen
        if seen and t_ns < seen[-1][0]:  # told elsewhere; nothing from before counts
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
        self._before_mps2, self._before_ns = force_mps2, sample.t_sensor_ns
        gap, beyond = apart_ns > MOST_GAP_NS, most_mps2 > self._most_in_g
        seen.append((t_ns, level, step, gap, beyond))
        self._counts[level] += 1
        if gap:
            self._gaps += 1
        if beyond:
            self._beyond += 1
        said = ""
        while t_ns - seen[0][0] >= SPAN_NS:
            said = said or self._of_span(sample.sensor, force_mps2)
            self._forget_oldest()
        if len(seen) > MOST_SAMPLES:
            self._forget_oldest()
        return said

    def _of_span(self, sensor: str, force_mps2: float) -> str:
        """What the span from the oldest sample to the newest says."""
        weak, low, _, high, strong = self._counts
        share, of = MOSTLY
        most = share * len(self._seen)
        if of * (weak + low) >= most and (of * weak >= most or (self._step() < 0 and not self._beyond)):
            return f"{sensor} shows {force_mps2:.2g} m/s² and less than gravity for {SPAN_MS} ms: is its unit g?"
        if of * (strong + high) >= most and (of * strong >= most or self._step() > 0):
            return f"{sensor} shows {force_mps2:.0f} m/s² and more than a foot can take for {SPAN_MS} ms: wrong unit?"
        return ""

    def _step(self) -> int:
        """The step that led to the oldest sample; 0 where a later one comes after a gap."""
        _, _, step, gap, _ = self._seen[0]
        return step if self._gaps == gap else 0

    def _forget_oldest(self) -> None:
        _, level, _, gap, beyond = self._seen.popleft()
        self._counts[level] -= 1
        if gap:
            self._gaps -= 1
        if beyond:
            self._beyond -= 1
