"""Which side is paretic, and how sure that is.

Source: Wang et al. (2013), section 3.1: the ratio left over right of the largest power spectral density of the
acceleration along the walk, gravity removed; the paretic leg swings less vigorously. The paper gives neither the
ratio that separates a hemiparetic walk from a balanced one nor an error rate. So the ratio is one of four signs here,
beside three that textbooks of hemiparetic gait agree on (Perry & Burnfield 2010; Olney & Richards 1996): the
paretic side swings longer, rises less steeply on its toes, and lands flatter. Each sign votes with its size; where
they do not agree clearly, no side is told. The score is a measure of agreement, no probability: nobody has counted
how often it errs on patients.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from fes.analysis.hemiparetic.foot import Foot
from fes.analysis.parameters.summary import Statistic
from fes.signals import FloatArray

SEGMENT_S = 4.0  # of the spectrum
BLOCKS = 8  # of the recording, to see how steady the ratio is
SIGNS = ("power", "swing", "push_off", "landing")
FULL_VOTE = (math.log(2.0), math.log(1.25), math.radians(10.0), math.radians(10.0))
MIN_SCORE = 0.3
MIN_AGREEING = 3


@dataclass(frozen=True, slots=True)
class Power:
    """The paper's sign: ``ratio`` left over right of the largest power density; ``steady``, the share of the
    recording's eighths in which the same side is weaker."""

    ratio: float
    steady: float

    @property
    def weaker(self) -> str:
        """The side with the smaller peak: what the paper would call paretic."""
        return "left" if self.ratio < 1.0 else "right"


@dataclass(frozen=True, slots=True)
class PareticSide:
    """The verdict.

    Attributes:
        side: "left", "right", or None: not sure.
        leaning: the side that the votes lean to, however little.
        score: 0–1, size of the mean vote.
        agreeing: how many of the signs lean that way, of ``known``.
        known: how many signs could be measured.
        votes: by sign −1 … 1, left paretic positive; NaN where not measured.
        power: the paper's ratio.
    """

    side: str | None
    leaning: str
    score: float
    agreeing: int
    known: int
    votes: dict[str, float]
    power: Power

    def describe(self) -> str:
        """One sentence for people."""
        of = f"score {self.score:.2f}, {self.agreeing} of {self.known} signs"
        steady = f"power left/right {self.power.ratio:.2f}, the same side weaker in {100 * self.power.steady:.0f} %"
        if self.side is None:
            return f"which side is paretic is not clear (leaning to the {self.leaning}: {of}; {steady})"
        return f"paretic side: {self.side} ({of}; {steady})"


def power(left: Foot, right: Foot, walk_ns: tuple[int, int] | None = None) -> Power:
    """The paper's ratio, over the walk (begin and end in ns; None: the whole recording) and over its eighths."""
    first, last = np.searchsorted(left.t_ns, walk_ns) if walk_ns is not None else (0, len(left.t_ns))
    along = [foot.along_mps2()[first:last] for foot in (left, right)]
    ratio = _ratio(along[0], along[1], left.rate_hz)
    blocks = [np.array_split(values, BLOCKS) for values in along]
    each = [_ratio(a, b, left.rate_hz) for a, b in zip(*blocks, strict=True)]
    same = [(value < 1.0) == (ratio < 1.0) for value in each if math.isfinite(value)]
    return Power(ratio, float(np.mean(same)) if same else 0.0)


def _ratio(left: FloatArray, right: FloatArray, rate_hz: float) -> float:
    peaks = [_peak(values, rate_hz) for values in (left, right)]
    return peaks[0] / peaks[1] if min(peaks) > 0.0 else math.nan


def _peak(values: FloatArray, rate_hz: float) -> float:
    """Largest power spectral density (m²/s⁴/Hz) by Welch's method."""
    from scipy.signal import welch

    if len(values) < rate_hz:
        return math.nan
    _, density = welch(values - values.mean(), rate_hz, nperseg=min(int(SEGMENT_S * rate_hz), len(values)))
    return float(density[1:].max())


def paretic_side(found: Power, feet: Mapping[str, Mapping[str, Statistic]]) -> PareticSide:
    """Weigh the signs.

    Args:
        found: the paper's ratio, see :func:`power`.
        feet: parameters by foot ("left_foot", "right_foot"), see :mod:`fes.analysis.parameters.summary`.
    """
    left, right = (feet.get(f"{side}_foot", {}) for side in ("left", "right"))

    def mean(of: Mapping[str, Statistic], key: str) -> float:
        return of[key].mean if key in of else math.nan

    swing = [mean(of, "swing_s") for of in (left, right)]
    differences = (
        -math.log(found.ratio) if found.ratio > 0.0 else math.nan,
        math.log(swing[0] / swing[1]) if min(swing) > 0.0 else math.nan,
        mean(right, "heel_rotation_rad") - mean(left, "heel_rotation_rad"),
        mean(right, "angle_contact_rad") - mean(left, "angle_contact_rad"),
    )
    votes = {
        sign: min(max(value / full, -1.0), 1.0) if math.isfinite(value) else math.nan
        for sign, value, full in zip(SIGNS, differences, FULL_VOTE, strict=True)
    }
    known = [vote for vote in votes.values() if math.isfinite(vote)]
    total = sum(known) / len(known) if known else 0.0
    leaning = "left" if total >= 0.0 else "right"
    agreeing = sum(vote * total > 0.0 for vote in known)
    sure = abs(total) >= MIN_SCORE and agreeing >= MIN_AGREEING
    return PareticSide(leaning if sure else None, leaning, abs(total), agreeing, len(known), votes, found)
