"""Start and end of the burst that follow the walking speed.

A trapezoid that rises while the heel does must have the foot up as the toe begins to pass low, a quarter of the swing
after foot off, and its current up at foot off at the latest; a quick swing needs it earlier, for the muscle does not
hurry. Past contact it must let the foot down, which takes as long as the loading response does. All last a share of the
stride that hardly differs from stride to stride, while the stride's duration follows the speed: so the next stride's
are the usual shares of the newest duration.
"""

from __future__ import annotations

from collections import deque
from statistics import median
from typing import Final

from fes.signals import NS_PER_S, StrideResult

REMEMBERED: Final = 6
NEEDED: Final = 3
FORCE_S: Final = 0.15  # from the end of the rise until the foot is up: delay, activation, and the foot's own inertia
LOW_FROM: Final = 0.25  # of the swing: from there on the toe passes low
SPREADS: Final = 1.5  # strides whose foot leaves early must find the current up as well


class SpeedTiming:
    """Shares of recent strides, and what follows from them."""

    def __init__(self) -> None:
        self._shares: deque[tuple[float, float, float]] = deque(maxlen=REMEMBERED)
        self._duration_s = 0.0
        self._speed_mps = 0.0

    def add(self, stride: StrideResult) -> None:
        """A valid stride; one that did not pass all phases says nothing."""
        pre, swing, loading, stance = (
            stride.t_pre_swing_ns,
            stride.t_swing_ns,
            stride.t_loading_response_ns,
            stride.t_stance_ns,
        )
        duration_s = (stride.t_end_ns - stride.t_start_ns) / NS_PER_S
        if pre is None or swing is None or loading is None or stance is None or duration_s <= 0.0:
            return
        self._duration_s, self._speed_mps = duration_s, stride.speed_mps
        spans_ns = (swing - pre, loading - swing, stance - loading)
        pre_share, swing_share, loading_share = (span / NS_PER_S / duration_s for span in spans_ns)
        self._shares.append((pre_share, swing_share, loading_share))

    @property
    def known(self) -> bool:
        """Whether enough strides have been seen."""
        return len(self._shares) >= NEEDED

    def wanted(self, start_phase: str, rise_s: float, fall_s: float) -> tuple[float, float]:
        """Start delay after the entry into the start phase and extension past contact that suit the next stride, s."""
        pre = [share for share, _, _ in self._shares]
        usual = median(pre)
        spread = 1.4826 * median(abs(share - usual) for share in pre)
        pre_swing_s = max(usual - SPREADS * spread, 0.0) * self._duration_s
        swing_s = median(share for _, share, _ in self._shares) * self._duration_s
        up_s = pre_swing_s + min(LOW_FROM * swing_s - FORCE_S, 0.0)
        delay_s = max(up_s - rise_s, 0.0) if start_phase == "pre_swing" else 0.0
        loading_s = median(share for _, _, share in self._shares) * self._duration_s
        return delay_s, max(loading_s - fall_s, 0.0)

    def reason(self) -> str:
        """Why, in words."""
        return (
            f"timing follows the speed ({self._speed_mps:.1f} m/s, stride {self._duration_s:.2f} s): current up as the "
            "toe leaves the ground, down as the foot lies flat"
        )
