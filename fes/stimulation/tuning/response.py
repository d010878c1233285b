"""How one channel's foot answers to stimulation, identified from the strides that the person walks anyway.

The drive ``u`` is the stimulation as a share of its upper bound (0 … 1), the level of a measure its place in the target
band (:mod:`fes.stimulation.tuning.targets`). A level is a ramp from a threshold on, the foot of the recruitment curve
(Durfee & MacLean 1989, IEEE Trans. Biomed. Eng. 36:775-781):

    level = bare + slope · max(u - threshold, 0) + noise                                                        (1)

All measures of a channel share the threshold. Given it, (1) is linear in ``bare`` and ``slope``: each of
``THRESHOLDS`` carries a Kalman filter of these two for every measure, and a weight, which is its probability (a bank of
filters: Magill 1965, IEEE Trans. Automat. Contr. 10:434-439). All three may walk from stride to stride, for a muscle
tires and a person lifts a leg less once the foot helps. So each is known with its uncertainty, and where nothing moves
it grows again.
"""

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np

from fes.signals import FloatArray
from fes.stimulation.tuning.targets import Reading

THRESHOLDS: Final[FloatArray] = np.arange(1, 20, dtype=np.float64) * 0.05  # (H,) shares of the bound
BARE, BARE_SD = -0.3, 1.0  # bands, before anything is known; the first stride tells nearly all of it
SLOPE, SLOPE_SD = 2.5, 1.5  # bands over the whole range: feet differ tenfold, a few answer the other way round
SLOPE_WALK: Final = 0.05  # a stride
THRESHOLD_MOVES: Final = 0.02  # probability of a step of 0.05 either way, a stride
ANYWHERE: Final = 1e-4  # and of any other threshold
BELIEVED: Final = 4  # strides' worth of trust in the usual noise
REMEMBERED: Final = 12
MOST_SURPRISE: Final = 2.5  # standard deviations: one stumble says little about the others
OTHERS_MOVE_IT: Final = 3.0  # bands that another channel on the foot may move a level by over its whole range
JUMP_SD: Final = 0.3  # of the bare level, once something has happened to the foot
GRID: Final = np.arange(81) / 80.0  # (U,) drives that are looked at …
GRID_RISEN: Final = np.maximum(GRID[:, None] - THRESHOLDS, 0.0)  # … and by how much each is above each threshold


class Usual(NamedTuple):
    """What is believed of a kind of measure before it is seen: a stride's noise, how the bare level walks; bands."""

    noise: float
    walk: float


IN_SWING: Final = Usual(0.20, 0.06)
AT_CONTACT: Final = Usual(0.045, 0.02)


@dataclass(frozen=True, slots=True)
class Known:
    """A number and its standard deviation."""

    value: float
    sd: float


class _Lines:
    """``bare`` and ``slope`` of one measure given each threshold: means (H, 2), covariances (H, 2, 2)."""

    def __init__(self, usual: Usual) -> None:
        self.usual = usual
        self.mean = np.tile([BARE, SLOPE], (len(THRESHOLDS), 1))
        self.cov = np.tile(np.diag([BARE_SD**2, SLOPE_SD**2]), (len(THRESHOLDS), 1, 1))
        self._surprises: deque[float] = deque(maxlen=REMEMBERED)

    @property
    def noise(self) -> float:
        """Standard deviation of a stride about what was expected: from its surprises, and from what is usual."""
        total = BELIEVED * self.usual.noise**2 + sum(off * off for off in self._surprises)
        return math.sqrt(total / (BELIEVED + len(self._surprises)))

    def predict(self, drive: float) -> tuple[FloatArray, FloatArray]:
        """Mean and variance, without noise, at ``drive`` given each threshold: (H,) both."""
        risen = np.maximum(drive - THRESHOLDS, 0.0)
        mean = self.mean[:, 0] + self.mean[:, 1] * risen
        variance = self.cov[:, 0, 0] + 2.0 * risen * self.cov[:, 0, 1] + risen**2 * self.cov[:, 1, 1]
        return mean, variance

    def add(self, drive: float, level: float, expected: Known, moved: float, *, known: bool) -> FloatArray:
        """Take in a stride; the logarithm of its likelihood under each threshold (H,). ``moved``: bands that something
        else may have moved the bare level by.
        """
        noise, most = self.noise, MOST_SURPRISE * math.hypot(self.noise, expected.sd)
        off = level - expected.value
        level = expected.value + min(max(off, -most), most)
        if known:
            self._surprises.append(min(max(off, -3.0 * self.usual.noise), 3.0 * self.usual.noise))
        self.cov[:, 0, 0] += self.usual.walk**2 + moved**2
        self.cov[:, 1, 1] += SLOPE_WALK**2
        row = np.stack([np.ones_like(THRESHOLDS), np.maximum(drive - THRESHOLDS, 0.0)], axis=1)
        cross = np.einsum("hij,hj->hi", self.cov, row)
        variance = np.einsum("hi,hi->h", cross, row) + noise**2
        innovation = level - np.einsum("hi,hi->h", self.mean, row)
        self.mean += cross * (innovation / variance)[:, None]
        self.cov -= cross[:, :, None] * cross[:, None, :] / variance[:, None, None]
        return np.asarray(-0.5 * (np.log(variance) + innovation**2 / variance))

    def shake(self) -> None:
        """Something happened: level and slope may have jumped."""
        self.cov[:, 0, 0] += JUMP_SD**2
        self.cov[:, 1, 1] += SLOPE_SD**2


class ResponseModel:
    """Of one channel and all its measures."""

    def __init__(self) -> None:
        self._lines: dict[str, _Lines] = {}
        self._weights = np.full(len(THRESHOLDS), 1.0 / len(THRESHOLDS))
        self.strides = 0

    def add(self, reading: Reading, drives: Mapping[str, float], others_changed: float = 0.0) -> None:
        """Take in a valid stride and the drive that each measure has seen.

        ``others_changed``: by how much of their range other channels on this foot have changed since the stride before.
        """
        self.strides += 1
        likely = np.zeros(len(THRESHOLDS))
        for measure in reading.measures:
            lines = self._lines.setdefault(measure.name, _Lines(AT_CONTACT if measure.at_contact else IN_SWING))
            drive = drives[measure.name]
            likely += lines.add(
                drive,
                measure.level,
                self.expected(measure.name, drive),
                OTHERS_MOVE_IT * others_changed,
                known=self.strides > 3,
            )
        weights = self._weights
        moved = (1.0 - 2.0 * THRESHOLD_MOVES) * weights
        moved[1:] += THRESHOLD_MOVES * weights[:-1]
        moved[:-1] += THRESHOLD_MOVES * weights[1:]
        weights = (moved + ANYWHERE) * np.exp(likely - likely.max())
        self._weights = weights / weights.sum()

    def shake(self) -> None:
        """Something happened to the foot that no change explains: what was learnt holds less than it did."""
        for lines in self._lines.values():
            lines.shake()
        self._weights = 0.5 * self._weights + 0.5 / len(THRESHOLDS)

    def knows(self, name: str) -> bool:
        """Whether this measure was ever seen."""
        return name in self._lines

    def noise(self, name: str) -> float:
        """Standard deviation of one stride about what is expected, bands."""
        return self._lines[name].noise

    def expected(self, name: str, drive: float) -> Known:
        """The level to expect under this drive; its standard deviation is without a stride's noise."""
        if name not in self._lines:
            return Known(BARE, BARE_SD)
        return self._mixed(*self._lines[name].predict(drive))

    def gained(self, name: str, drive: float) -> Known:
        """What this drive lifts the level by, against none."""
        lines = self._lines[name]
        risen = np.maximum(drive - THRESHOLDS, 0.0)
        return self._mixed(lines.mean[:, 1] * risen, lines.cov[:, 1, 1] * risen**2)

    def slope(self, name: str) -> Known:
        """Above the threshold, bands over the whole range."""
        lines = self._lines[name]
        return self._mixed(lines.mean[:, 1], lines.cov[:, 1, 1])

    @property
    def threshold(self) -> Known:
        """A share of the upper bound."""
        return self._mixed(THRESHOLDS, np.zeros(len(THRESHOLDS)))

    def _mixed(self, mean: FloatArray, variance: FloatArray) -> Known:
        """Of what is known given each threshold, (H,) both, by their probabilities."""
        middle = float(mean @ self._weights)
        spread = float((variance + (mean - middle) ** 2) @ self._weights)
        return Known(middle, math.sqrt(max(spread, 0.0)))

    def least_drives(self, name: str, levels: FloatArray) -> FloatArray:
        """The least drives from which on these levels (N,) are to be expected, (N,); 1 where none suffices."""
        lines = self._lines[name]
        expected = (lines.mean[:, 0] + lines.mean[:, 1] * GRID_RISEN) @ self._weights
        reached = np.maximum.accumulate(expected)
        return np.asarray(GRID[np.minimum(np.searchsorted(reached, levels), len(GRID) - 1)])

    def least_drive(self, name: str, level: float) -> float:
        """The least drive from which on this level is to be expected; 1 where none suffices."""
        return float(self.least_drives(name, np.array([level]))[0])
