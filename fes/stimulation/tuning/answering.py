"""Whether the foot answers to stimulation at all: one whose electrode has come off must not be given ever more.

Two things show it. *A climb in vain*: over a run of strides below the target the drive has been raised, to near its
upper bound (a foot whose threshold lies above the session's setting answers to nothing below it), and a straight
line through level against drive rises by less than even a weak foot's would, two standard errors allowed for. *A sudden
loss*: strides that lay well above those without stimulation lie among these, and more drive does not bring them back.
The foot's pitch at contact is the best witness, for a hip that lifts a dragging leg hardly moves it; of several
measures the one that shows it most exactly decides, the others must not contradict it.
"""

import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Final

from fes.stimulation.envelope import BurstParameters
from fes.stimulation.tuning.demand import BELIEVED, NOISE, NOISE_AT_CONTACT, SLOPE_BOUNDS
from fes.stimulation.tuning.guardrails import at_most, drive_of
from fes.stimulation.tuning.targets import Reading

CLIMB: Final = 0.225  # of the drive at the upper bound: that much tried in vain …
SEARCHED: Final = 0.8  # of it: no threshold is looked for above
LEAST_CLIMB: Final = 0.075  # … or this, where the bound leaves no more
STRIDES: Final = 5  # of a run, the first of them before the climb
REMEMBERED: Final = 16
STUMBLE: Final = 0.5  # of the band below the run's median: such a stride says nothing about the others
WEAKEST: Final = SLOPE_BOUNDS[0]  # bands over the bound's whole range: the weakest answer that is believed …
NONE: Final = 0.5 * WEAKEST  # … and what a foot that answers exceeds
SDS: Final = 2.0
BARE: Final = 6  # strides without stimulation that are remembered
HELD: Final = 8
LAST: Final = 3
MORE: Final = 2  # of these have had more than the foot needed: a loose electrode would have been made up for
CLEAR: Final = 5.0  # times a stride's noise: by so much stimulation had lifted the foot
LOST: Final = 0.25  # of that is left at most

NO_ANSWER: Final = "the foot does not answer to stronger stimulation"
LIKE_NONE: Final = "the foot moves as it does without stimulation"


@dataclass(frozen=True, slots=True)
class _SeenStride:
    """A stride: levels by measure, the drive each has seen, and the settings."""

    levels: Mapping[str, float]
    drives: Mapping[str, float]
    parameters: BurstParameters


class AnswerMonitor:
    """Whether one channel's foot answers, stride by stride; ``most`` is the drive at the intensity's upper bound."""

    def __init__(self, most: float) -> None:
        self._most = most
        self._run: deque[_SeenStride] = deque(maxlen=REMEMBERED)  # since all targets were last reached
        self._recent: deque[_SeenStride] = deque(maxlen=HELD + LAST)
        self._bare: deque[Mapping[str, float]] = deque(maxlen=BARE)
        self._contact: set[str] = set()

    def forget(self) -> None:
        """A person is looking after it, or has: what was seen no longer holds, but for strides without stimulation."""
        self._run.clear()
        self._recent.clear()

    def add_bare(self, reading: Reading | str) -> None:
        """A stride in which nothing was delivered; one that could not be read says nothing."""
        if not isinstance(reading, str):
            self._bare.append(reading.levels)

    def stride(self, reading: Reading, drives: Mapping[str, float], parameters: BurstParameters, *, spent: bool) -> str:
        """Take in a valid stride, and the drive that each measure has seen; says so when the foot does not answer.

        ``spent``: whether ``parameters``, under which it was walked, are at the intensity's upper bound.
        """
        self._contact |= {measure.name for measure in reading.measures if measure.at_contact}
        seen = _SeenStride(reading.levels, dict(drives), parameters)
        self._recent.append(seen)
        if reading.level >= 0.0:
            self._run.clear()
            return ""
        self._run.append(seen)
        # below the threshold nothing answers: a session set too low is searched upwards first
        searched = spent or min(drives.values()) >= SEARCHED * self._most
        if searched and self._climbed_in_vain(self._most * (LEAST_CLIMB if spent else CLIMB)):
            return NO_ANSWER
        return LIKE_NONE if self._suddenly_lost() else ""

    def before(self, own: BurstParameters) -> BurstParameters:
        """The settings before the climb, the intensity at most the session's ``own``."""
        weakest = min((seen.parameters for seen in self._run), key=lambda one: drive_of(one, own), default=own)
        return at_most(weakest, own)

    def _climbed_in_vain(self, enough: float) -> bool:
        if len(self._run) < STRIDES:
            return False
        slopes = []
        for name in _common(self._run):
            levels = [seen.levels[name] for seen in self._run]
            drives = [seen.drives[name] for seen in self._run]
            if median(levels) >= 0.0 or drives[-1] - min(drives) < enough:
                return False  # where one target is reached, more or less, the foot is being lifted
            if median(levels) - self._without(name) > CLEAR * self._noise(name):
                return False  # lifted as well, and more does not lift it further
            slope, error = _slope(drives, levels, self._noise(name))
            slopes.append((self._most * slope, self._most * error))
        if not slopes:
            return False
        slope, error = min(slopes, key=lambda each: each[1])
        return slope < error and slope + SDS * error < NONE and all(other < WEAKEST for other, _ in slopes)

    def _suddenly_lost(self) -> bool:
        earlier, last = list(self._recent)[:-LAST], list(self._recent)[-LAST:]
        if len(earlier) < LAST or not self._bare:
            return False
        names = [name for name in _common(self._recent) if all(name in levels for levels in self._bare)]
        if not names or any(median(seen.levels[name] for seen in last) >= 0.0 for name in names):
            return False
        name = next((name for name in names if name in self._contact), names[0])
        bare = self._without(name)
        held = median(seen.levels[name] for seen in earlier) - bare
        left = max(seen.levels[name] for seen in last) - bare
        usual = median(seen.drives[name] for seen in earlier)
        if sum(seen.drives[name] >= usual + CLIMB * self._most for seen in last) < MORE:
            return False
        return held > CLEAR * self._noise(name) and left < LOST * held

    def _without(self, name: str) -> float:
        """The level without stimulation; infinite where none was seen."""
        return median([levels[name] for levels in self._bare if name in levels] or [math.inf])

    def _noise(self, name: str) -> float:
        return NOISE_AT_CONTACT if name in self._contact else NOISE


def _common(strides: Sequence[_SeenStride] | deque[_SeenStride]) -> list[str]:
    """Measures that all of them have, in an order that does not change."""
    return sorted(set.intersection(*(set(seen.levels) for seen in strides)))


def _slope(drives: Sequence[float], levels: Sequence[float], usual_noise: float) -> tuple[float, float]:
    """Of the line of least squares through levels against drives, and its standard error; infinite for too few.

    The noise is that about the line and what is usual, which counts as ``BELIEVED`` strides: few may agree by chance.
    """
    middle = median(levels)
    pairs = [(u, z) for u, z in zip(drives, levels, strict=True) if z >= middle - STUMBLE]
    n = len(pairs)
    if n < STRIDES:
        return 0.0, math.inf
    mean_u, mean_z = sum(u for u, _ in pairs) / n, sum(z for _, z in pairs) / n
    uu = sum((u - mean_u) ** 2 for u, _ in pairs)
    if uu <= 0.0:
        return 0.0, math.inf
    slope = sum((u - mean_u) * (z - mean_z) for u, z in pairs) / uu
    rest = sum((z - mean_z - slope * (u - mean_u)) ** 2 for u, z in pairs)
    return slope, math.sqrt((BELIEVED * usual_noise**2 + rest) / (BELIEVED + n - 2) / uu)
