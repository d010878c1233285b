"""Start and end of the burst that follow the walking speed.

A trapezoid that rises while the heel does must have the foot up as the toe begins to pass low, a quarter of the swing
after foot off, and its current up at foot off at the latest.

From contact to foot flat the dorsiflexors give way slowly, so that the forefoot does not slap (the first rocker: Perry
& Burnfield, *Gait Analysis*, 2nd ed. 2010). The force outlives the pulses, so these end sooner by that; they end before
contact, step by step, where foot pitch at contact is reached and the toe comes down no faster for it than it did while
pulses went on past contact.

All of these last a share of the stride that hardly differs from stride to stride, while the stride's duration follows
the speed: so the next stride's are the usual shares of the newest durations' median.
"""

import math
from collections import deque
from itertools import pairwise
from statistics import median
from typing import Final

from fes.signals import MID_SWING_BEGIN, NS_PER_S, StrideResult
from fes.stimulation.tuning.targets import interpolate, times_ns

LOWERING_NEEDED: Final = 3
LOWERING_REMEMBERED: Final = 12
FASTER: Final = 1.25  # than it was: that is too fast …
WELL: Final = 1.15  # … and this still well; strides of one person differ by a tenth
SHORTEST_NS: Final = 4_000_000  # between two readings of the angle

REMEMBERED: Final = 6
NEEDED: Final = 3
NEWEST: Final = 3  # strides whose duration is followed
FORCE_S: Final = 0.15  # from the end of the rise until the foot is up: delay, activation, and the foot's own inertia
OUTLIVES_S: Final = 0.13  # force outlives pulses: delay 20–50 ms, then 1.5 times the activation's fall, 60 ms
SOONEST_S: Final = 0.10  # before contact: what falls to nothing until then leaves nine tenths of the force there
PATIENCE: Final = 0.25  # of the way from the one to the other, with one stride
SPREADS: Final = 1.5  # strides whose foot leaves early must find the current up as well


class Lowering:
    """Of one foot, in rad/s."""

    def __init__(self) -> None:
        self._held: deque[float] = deque(maxlen=LOWERING_REMEMBERED)
        self._now: deque[float] = deque(maxlen=LOWERING_NEEDED)

    def add(self, stride: StrideResult, extension_s: float) -> None:
        """A valid stride, and its burst's extension: from 0 on the pulses went on past contact."""
        rate_radps = lowering_radps(stride)
        if math.isfinite(rate_radps):
            (self._held if extension_s >= 0.0 else self._now).append(rate_radps)

    @property
    def too_fast(self) -> bool:
        """Whether the last strides came down faster than they may, or nothing is known to hold them against."""
        return len(self._held) < LOWERING_NEEDED or self._faster > FASTER

    @property
    def well(self) -> bool:
        """Whether the pulses may end sooner still."""
        return len(self._held) >= LOWERING_NEEDED and self._faster < WELL

    @property
    def _faster(self) -> float:
        return median(self._now) / max(median(self._held), 1e-6) if self._now else 1.0


def lowering_radps(stride: StrideResult) -> float:
    """The fastest toe-down rate between contact and foot flat, ≥ 0; NaN where the stride did not pass both."""
    contact_ns, flat_ns = stride.t_loading_response_ns, stride.t_stance_ns
    if contact_ns is None or flat_ns is None or len(stride.pitch_rad) < 2 or flat_ns - contact_ns < SHORTEST_NS:
        return math.nan
    times, pitches = times_ns(stride), [float(pitch) for pitch in stride.pitch_rad]
    between = [time for time in times if contact_ns + SHORTEST_NS <= time <= flat_ns - SHORTEST_NS]
    points = [(time, interpolate(time, times, pitches)) for time in (contact_ns, *between, flat_ns)]
    return max(max(1e9 * (a - b) / (t_b - t_a) for (t_a, a), (t_b, b) in pairwise(points)), 0.0)


class SpeedTiming:
    """Shares of recent strides, and what follows from them."""

    def __init__(self) -> None:
        self._shares: deque[tuple[float, float, float]] = deque(maxlen=REMEMBERED)
        self._durations_s: deque[float] = deque(maxlen=NEWEST)
        self._speed_mps = 0.0
        self._end = ""  # why it is where it is
        self._soon = 0.0  # 0 … 1: how far the end has been brought forward to before contact

    def bring_forward(self, reached: float | None, missing: float, lowering: Lowering, extension_s: float) -> None:
        """Let the end come before contact, or no longer.

        ``reached`` is the level of the foot's pitch at contact, < 0 below its band, None when there is none;
        ``missing`` is > 0 when it asks for more stimulation; ``extension_s`` is in force.
        """
        soon = max(-extension_s / SOONEST_S, 0.0)
        if reached is None or reached < 0.0 or lowering.too_fast:
            self._soon = max(soon - PATIENCE, 0.0)
            slaps = reached is not None and reached >= 0.0
            self._end = f", pulses given back, for the {'toe came down faster' if slaps else 'heel must come first'}"
        elif missing <= 0.0 and lowering.well:
            self._soon = min(soon + PATIENCE, 1.0)
            self._end = ", pulses that hold nothing up until contact left out"

    def add(self, stride: StrideResult) -> None:
        """A valid stride; one that did not pass all phases says nothing."""
        pre, swing = stride.t_pre_swing_ns, stride.t_swing_ns
        loading, stance = stride.t_loading_response_ns, stride.t_stance_ns
        duration_s = (stride.t_end_ns - stride.t_start_ns) / NS_PER_S
        if pre is None or swing is None or loading is None or stance is None or duration_s <= 0.0:
            return
        self._durations_s.append(duration_s)
        self._speed_mps = stride.speed_mps
        pre_s, swing_s, loading_s = ((b - a) / NS_PER_S for a, b in pairwise((pre, swing, loading, stance)))
        self._shares.append((pre_s / duration_s, swing_s / duration_s, loading_s / duration_s))

    @property
    def enough_strides(self) -> bool:
        """Whether enough strides have been seen."""
        return len(self._shares) >= NEEDED

    @property
    def _duration_s(self) -> float:
        """Of the next stride. The newest alone varies far more than pre-swing does, which is what is wanted of it."""
        return median(self._durations_s) if self._durations_s else 0.0

    def wanted(self, start_phase: str, rise_s: float, fall_s: float) -> tuple[float, float]:
        """Start delay after the entry into the start phase and extension past contact that suit the next stride, s.

        The extension is negative where the fall is to begin before contact.
        """
        pre = [share for share, _, _ in self._shares]
        usual = median(pre)
        spread = 1.4826 * median(abs(share - usual) for share in pre)
        pre_swing_s = max(usual - SPREADS * spread, 0.0) * self._duration_s
        swing_s = median(share for _, share, _ in self._shares) * self._duration_s
        up_s = pre_swing_s + min(MID_SWING_BEGIN * swing_s - FORCE_S, 0.0)
        delay_s = max(up_s - rise_s, 0.0) if start_phase == "pre_swing" else 0.0
        loading_s = median(share for _, _, share in self._shares) * self._duration_s
        extension_s = max(loading_s - fall_s - OUTLIVES_S, -SOONEST_S)
        return delay_s, extension_s if extension_s > 0.0 else max(extension_s, -self._soon * SOONEST_S)

    def reason(self, extension_s: float) -> str:
        """Why, in words; ``extension_s`` is what follows."""
        end = self._end if extension_s < 0.0 else ""
        return (
            f"timing follows the speed ({self._speed_mps:.1f} m/s, stride {self._duration_s:.2f} s): current up as the "
            f"toe leaves the ground, force gone as the foot lies flat{end}"
        )
