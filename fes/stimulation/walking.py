"""Is this foot known to be walking? Asked before a burst may start. And a foot switch as the trigger's fallback.

Users of drop-foot stimulators complain most of stimulation when they do not walk: weight shifts, turning on the spot,
sitting down. A heel that rises says nothing yet; strides that have just carried the foot forward do. So a burst may
start only after ``strides_before_start`` strides in a row that were long enough and straight enough. Then it goes on:
through a curve, whose strides turn as far as those on the spot but are at least half as long as usual, and with the
first step after a pause. A stance much longer than those of walking is said to be standing as soon as that is so, not
at the next step; one of more than three seconds is a stop, after which strides are counted anew.

A foot switch times bursts while the sensor's side shows no steps. It opens when the foot is lifted and closes when it
lands. Once it has gone through two cycles of walking while the sensor showed no swing, its changes stand for the
phases; the sensor's first swing takes over again, and a switch that falls silent ends what it began. The gate judges as
ever: without fresh data from the sensor there is no current, whatever the switch says. Pure, causal.
"""

import math
from collections import deque
from statistics import median
from typing import Final

from fes.config import Stimulation
from fes.signals import NS_PER_S, Event, FootSwitchEvent, StrideResult
from fes.stimulation.order import OrderJudge
from statemachine.phases import Phase, PhaseChange, Transition

CYCLES: Final = 2  # of the switch, before it is believed
SHORTEST_CYCLE_NS: Final = NS_PER_S // 2
LONGEST_CYCLE_NS: Final = 3 * NS_PER_S
LOADING_NS: Final = 150_000_000  # how long loading response lasts, as the switch cannot tell its end


class SwitchFallback:
    """One foot's switch."""

    def __init__(self, foot: str) -> None:
        self.foot = foot
        self._released_ns: int | None = None
        self._cycles = 0
        self._landed_ns: int | None = None

    @property
    def active(self) -> bool:
        """Whether the switch times the bursts."""
        return self._cycles >= CYCLES

    def follows_sensor(self, change: PhaseChange) -> bool:
        """The sensor's side changed phase; whether the plan is to follow it."""
        if change.destination is Phase.SWING:
            self._cycles = 0
        return not self.active or change.transition is Transition.NONE

    def changes_at(self, event: Event) -> list[PhaseChange]:
        """What the plan is to follow instead at this event; nothing while the sensor's side shows steps."""
        t_ns = event.t_ns
        changes: list[PhaseChange] = []
        if self._landed_ns is not None and t_ns - self._landed_ns >= LOADING_NS:
            self._landed_ns = None
            changes.append(self._change(t_ns, Transition.T4, Phase.LOADING_RESPONSE, Phase.STANCE))
        if self._released_ns is not None and t_ns - self._released_ns > LONGEST_CYCLE_NS:
            self._released_ns, self._cycles = None, 0  # stands, or the switch is stuck
        if isinstance(event, FootSwitchEvent) and event.foot == self.foot:
            if event.pressed is None:  # nobody knows when the foot lands; the sensor may have taken over long ago
                lost = [self._change(t_ns, Transition.NONE, Phase.STANCE, Phase.STANCE)] if self.active else []
                self._released_ns, self._landed_ns, self._cycles = None, None, 0
                return lost
            if event.pressed:
                self._landed_ns = t_ns
                changes.append(self._change(t_ns, Transition.T3, Phase.SWING, Phase.LOADING_RESPONSE))
            else:
                if self._released_ns is not None:
                    self._cycles = self._cycles + 1 if t_ns - self._released_ns >= SHORTEST_CYCLE_NS else 0
                self._released_ns = t_ns
                changes.append(self._change(t_ns, Transition.T1, Phase.STANCE, Phase.PRE_SWING))
                changes.append(self._change(t_ns, Transition.T2, Phase.PRE_SWING, Phase.SWING))
        return changes if self.active else []

    def _change(self, t_ns: int, transition: Transition, source: Phase, destination: Phase) -> PhaseChange:
        return PhaseChange(t_ns, self.foot, transition, source, destination)


STANCE_FACTOR = 1.8  # a stance this much longer than the usual one is a stop …
STANCE_GRACE_S = 0.2  # … once it is also this much longer
SHORT_STANCE_SHARE = 0.4  # a stance shorter than this share of the usual one is a foot that has not settled yet
REMEMBERED_STANCES = 5
LONGEST_NS = 3 * NS_PER_S  # a stance while none is usual yet, or any other phase: nobody walks so slowly
PAUSE_S = 3.0  # a stance of so long at most is a pause: who walked before it goes on with the first step after it
CURVE_SHARE = 0.5  # of the usual length: a stride that turns as far as on the spot, but so long, is a walk's curve
REMEMBERED_LENGTHS = 5
LOST, LANDED, STANCE = Transition.NONE, (Transition.T4, Transition.T6), Phase.STANCE


class WalkingJudge:
    """Follows one foot's phases and strides and says whether it walks; causal, no clock.

    ``order``: who says whether they are a cycle at all; a foot in disorder is not known to walk.
    """

    def __init__(self, settings: Stimulation) -> None:
        self._enough, self._least_m = settings.strides_before_start, settings.min_stride_length_m
        self._most_rad = math.radians(settings.max_turn_deg)
        self._good_strides = 0
        self._stance_ns: int | None = None
        self._stances_s: deque[float] = deque(maxlen=REMEMBERED_STANCES)
        self._lengths_m: deque[float] = deque(maxlen=REMEMBERED_LENGTHS)  # of good strides, not of curves
        self._short_s: float | None = None  # the stance before this pre-swing, where it seemed too short for one
        self._standing = True  # until a swing; again where a stance, or any other phase, lasts
        self.order = OrderJudge(settings.min_stride_length_m)
        self._begun_ns, self._longest_ns = 0, LONGEST_NS  # of what must end by then, or the foot stands
        self.reason = "no stride yet"

    @property
    def walking(self) -> bool:
        """Whether enough good strides have come one after the other, and the foot has not stopped since."""
        return not self._standing and self._good_strides >= self._enough and self.order.in_order

    def describe(self) -> str:
        """What it holds of this foot, for people."""
        if not self.order.in_order:
            return self.order.describe()
        known = (
            f"{min(self._good_strides, self._enough)} of {self._enough} strides in a row that carry the foot forward"
        )
        if self.walking:
            return f"walks: {known}"
        why = f"; the count began anew because: {self.reason}" if self.reason else ""
        return f"not known to walk{' (it stands)' if self._standing else ''}: {known}{why}"

    def on_time(self, t_ns: int) -> None:
        """Time has come to ``t_ns`` by the foot's own sensor: a stance that lasts ends walking."""
        if not self._standing and t_ns - self._begun_ns > self._longest_ns:
            self._standing = True
            self.reason = f"stands for {(t_ns - self._begun_ns) / NS_PER_S:.1f} s"

    def on_stride(self, stride: StrideResult) -> None:
        """Count a stride for or against walking."""
        self.order.on_stride(stride)
        if not stride.valid:
            self._lapse(f"stride {stride.number} {stride.reason}")
        elif stride.stride_length_m < self._least_m:
            self._lapse(f"stride of {stride.stride_length_m:.2f} m")
        elif abs(stride.turn_rad) <= self._most_rad:
            self._good_strides += 1
            self._lengths_m.append(stride.stride_length_m)
        elif not self._good_strides or stride.stride_length_m < CURVE_SHARE * median(self._lengths_m):
            self._lapse(f"turned by {abs(math.degrees(stride.turn_rad)):.0f}°")

    def on_phase(self, change: PhaseChange) -> bool:
        """Follow a phase change; returns whether a burst that starts with it is permitted."""
        permitted = True
        self.order.on_phase(change)
        if change.transition is LOST:
            self._lapse("data were lost")
            self._stance_ns = change.t_ns
        elif change.transition in LANDED:
            self._stance_ns = change.t_ns
        elif change.source is STANCE and self._stance_ns is not None:
            permitted = self._end_of_stance(1.0 / NS_PER_S * (change.t_ns - self._stance_ns))
        if change.destination is Phase.SWING:
            self._standing = False
            if self._short_s is not None:  # a swing came of it: a stance after all, shorter than those before
                self._stances_s.append(self._short_s)
        if change.source is Phase.PRE_SWING:
            self._short_s = None
        self._begun_ns, self._longest_ns = change.t_ns, LONGEST_NS
        if change.destination is STANCE and self._stance_ns is not None:
            self._begun_ns, self._longest_ns = self._stance_ns, round(NS_PER_S * self._longest_stance_s())
        return permitted and self._good_strides >= self._enough and self.order.in_order

    def _end_of_stance(self, stance_s: float) -> bool:
        """The heel rises after a stance of this length; returns whether that can be walking on."""
        longest_s = self._longest_stance_s()
        if stance_s > max(longest_s, PAUSE_S):
            self._lapse(f"stood for {stance_s:.1f} s")
        elif self._stances_s and stance_s < SHORT_STANCE_SHARE * median(self._stances_s):
            self._short_s = stance_s
            return False  # the foot stirs after it has landed; the real heel rise is still to come
        if self._good_strides and stance_s <= longest_s:
            self._stances_s.append(stance_s)
        return True

    def _longest_stance_s(self) -> float:
        """A stance that lasts longer is none of walking."""
        if not self._stances_s:
            return LONGEST_NS / NS_PER_S
        usual_s = median(self._stances_s)
        return max(STANCE_FACTOR * usual_s, usual_s + STANCE_GRACE_S)

    def _lapse(self, reason: str) -> None:
        self._good_strides = 0
        self._stances_s.clear()
        self.reason = reason
