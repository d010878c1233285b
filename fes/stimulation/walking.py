"""Is this foot known to be walking? The question that is asked before a burst may start.

Users of drop-foot stimulators complain most of stimulation when they do not walk: weight shifts, turning on the spot,
sitting down. A heel that rises says nothing yet; strides that have just carried the foot forward do. So a burst may
start only after ``strides_before_start`` strides in a row that were long enough and straight enough, and only while
the stance since the last one is not much longer than the stances of walking.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Collection

from fes.config import Stimulation
from fes.signals import NS_PER_S, StrideResult
from statemachine.phases import Phase, PhaseChange, Transition

STANCE_FACTOR = 1.8  # a stance this much longer than the usual one is a stop …
STANCE_GRACE_S = 0.2  # … once it is also this much longer
SHORT_STANCE_SHARE = 0.4  # a stance shorter than this share of the usual one is a foot that has not settled yet
REMEMBERED_STANCES = 5
LOST, LANDED, STANCE = Transition.NONE, (Transition.T4, Transition.T6), Phase.STANCE


class WalkingJudge:
    """Follows one foot's phases and strides and says whether it walks; causal, no clock."""

    def __init__(self, settings: Stimulation) -> None:
        self._enough, self._least_m = settings.strides_before_start, settings.min_stride_length_m
        self._most_rad = math.radians(settings.max_turn_deg)
        self._good_strides = 0
        self._stance_ns: int | None = None
        self._stances_s: deque[float] = deque(maxlen=REMEMBERED_STANCES)
        self.reason = "no stride yet"

    def on_stride(self, stride: StrideResult) -> None:
        """Count a stride for or against walking."""
        fault = self._not_walking(stride)
        if fault:
            self._lapse(fault)
        else:
            self._good_strides += 1

    def on_phase(self, change: PhaseChange) -> bool:
        """Follow a phase change; returns whether a burst that starts with it is permitted."""
        if change.transition is LOST:
            self._lapse("data were lost")
            self._stance_ns = change.t_ns
        elif change.transition in LANDED:
            self._stance_ns = change.t_ns
        elif change.source is STANCE and self._stance_ns is not None:
            return self._end_of_stance(1.0 / NS_PER_S * (change.t_ns - self._stance_ns))
        return self.walking

    @property
    def walking(self) -> bool:
        """Whether enough good strides have come one after the other."""
        return self._good_strides >= self._enough

    def _end_of_stance(self, stance_s: float) -> bool:
        """The heel rises after a stance of this length; returns whether that is walking on."""
        if self._stances_s:
            usual_s = _median(self._stances_s)
            if stance_s < SHORT_STANCE_SHARE * usual_s:
                return False  # the foot stirs after it has landed; the real heel rise is still to come
            if stance_s > STANCE_FACTOR * usual_s and stance_s > usual_s + STANCE_GRACE_S:
                self._lapse(f"stood for {stance_s:.1f} s")
        if self._good_strides:
            self._stances_s.append(stance_s)
        return self.walking

    def _not_walking(self, stride: StrideResult) -> str:
        if not stride.valid:
            return f"stride {stride.number} {stride.reason}"
        if stride.stride_length_m < self._least_m:
            return f"stride of {stride.stride_length_m:.2f} m"
        if abs(stride.turn_rad) > self._most_rad:
            return f"turned by {abs(math.degrees(stride.turn_rad)):.0f}°"
        return ""

    def _lapse(self, reason: str) -> None:
        self._good_strides = 0
        self._stances_s.clear()
        self.reason = reason


def _median(values: Collection[float]) -> float:
    """As in ``statistics``, whose code is seldom at hand: once a stride."""
    ordered, half = sorted(values), len(values) // 2
    return ordered[half] if len(values) % 2 else (ordered[half - 1] + ordered[half]) / 2
