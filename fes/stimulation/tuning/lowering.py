"""How fast the foot is let down after contact: what the burst's end is for, and what tells whether it may come sooner.

From contact to foot flat the dorsiflexors give way slowly, so that the forefoot does not slap (the first rocker: Perry
& Burnfield, *Gait Analysis*, 2nd ed. 2010). The force outlives the pulses, so these may end before contact; whether too
much was left out is seen in how fast the toe then comes down, against what it did while pulses went on past contact.
"""

from __future__ import annotations

import math
from collections import deque
from itertools import pairwise
from statistics import median
from typing import Final

from fes.signals import StrideResult
from fes.stimulation.tuning.targets import interpolate, times_ns

NEEDED: Final = 3
REMEMBERED: Final = 12
FASTER: Final = 1.25  # than it was: that is too fast …
WELL: Final = 1.15  # … and this still well; strides of one person differ by a tenth
SHORTEST_NS: Final = 4_000_000  # between two readings of the angle


class Lowering:
    """Of one foot, in rad/s."""

    def __init__(self) -> None:
        self._held: deque[float] = deque(maxlen=REMEMBERED)
        self._now: deque[float] = deque(maxlen=NEEDED)

    def add(self, stride: StrideResult, extension_s: float) -> None:
        """A valid stride, and its burst's extension: from 0 on the pulses went on past contact."""
        rate_radps = lowering_radps(stride)
        if math.isfinite(rate_radps):
            (self._held if extension_s >= 0.0 else self._now).append(rate_radps)

    @property
    def too_fast(self) -> bool:
        """Whether the last strides came down faster than they may, or nothing is known to hold them against."""
        return len(self._held) < NEEDED or self._faster > FASTER

    @property
    def well(self) -> bool:
        """Whether the pulses may end sooner still."""
        return len(self._held) >= NEEDED and self._faster < WELL

    @property
    def _faster(self) -> float:
        if not self._now:
            return 1.0
        return median(self._now) / max(median(self._held), 1e-6)


def lowering_radps(stride: StrideResult) -> float:
    """The fastest toe-down rate between contact and foot flat, ≥ 0; NaN where the stride did not pass both."""
    contact_ns, flat_ns = stride.t_loading_response_ns, stride.t_stance_ns
    if contact_ns is None or flat_ns is None or len(stride.pitch_rad) < 2 or flat_ns - contact_ns < SHORTEST_NS:
        return math.nan
    times, pitches = times_ns(stride), [float(pitch) for pitch in stride.pitch_rad]
    between = [time for time in times if contact_ns + SHORTEST_NS <= time <= flat_ns - SHORTEST_NS]
    points = [(time, interpolate(time, times, pitches)) for time in (contact_ns, *between, flat_ns)]
    return max(max(1e9 * (a - b) / (t_b - t_a) for (t_a, a), (t_b, b) in pairwise(points)), 0.0)
