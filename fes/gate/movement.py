"""A coarse check apart from controller and plan: no burst on a foot that rests, none over more swings than one has.

It knows no phase and no calibration, only how fast the sensor that times the channel turns, and it may only forbid. The
constants are its own; ``benchmarks/safety/gate_faults.py`` holds them against every real walk there is
(docs/safety.md).
What a person asks for, a burst by hand or one of an exercise, goes by that person's word and not by the foot: one burst
for each time of asking, and no longer than such a burst lasts.
"""

from typing import Final

from fes.config import PHASE_ORDER, Channel
from fes.signals import NS_PER_S, ImuSample, OperatorAct, OperatorAction

MOVES_RADPS: Final = 0.2  # slower, the foot rests; no burst of a real walk was lost at 0.3 yet
RESTS_NS: Final = NS_PER_S // 2  # as slow as that for so long
SWINGS_RADPS: Final = 0.8  # what every swing reaches, that of a foot dragged along too
SWUNG_NS: Final = 3 * NS_PER_S // 10  # slower for so long, a swing is over
MOST_SWINGS: Final = 2  # in one burst: a heel that rises with a halt counts as a swing by itself
MOST_WITHOUT_NS: Final = 3 * NS_PER_S // 2  # from its beginning, without any swing; real: 1.3 s
STANDS_NS: Final = 3 * NS_PER_S  # a channel that is meant for stance is on while the foot rests, but not in standing
ASKED_NS: Final = NS_PER_S // 2  # a burst asked for by hand begins within this time
LONGEST_NS: Final = {OperatorAction.TEST_BURST: NS_PER_S // 2, OperatorAction.TRIGGER: NS_PER_S}  # until it falls


class Movement:
    """Of one sensor: when it last moved, and how many swings it has begun."""

    def __init__(self) -> None:
        self.moved_ns: int | None = None
        self.swings = 0
        self._fast_ns: int | None = None

    def observe(self, sample: ImuSample) -> None:
        """Take in a sample; what is not a number is no movement."""
        p, q, r = sample.gyr_radps
        square = p * p + q * q + r * r
        if square >= MOVES_RADPS * MOVES_RADPS:
            self.moved_ns = sample.t_ns
        if square >= SWINGS_RADPS * SWINGS_RADPS:
            self.swings += not self.in_swing(sample.t_ns)
            self._fast_ns = sample.t_ns

    def in_swing(self, t_ns: int) -> bool:
        """Whether a swing is under way, or was until just now."""
        return self._fast_ns is not None and t_ns - self._fast_ns < SWUNG_NS


class BurstWatch:
    """One channel's bursts against the movement of the sensor that times them.

    Args:
        channel: its settings, of which only the phases and the time after them count.
        movement: of that sensor; None in exercise, where only what a person asked for is let out.
        exercise_ns: how long a burst of an exercise lasts until it falls.
    """

    def __init__(self, channel: Channel, movement: Movement | None, exercise_ns: int) -> None:
        self._number, self._movement = channel.number, movement
        bounds = channel.tuning.bounds if channel.tuning else None
        extension_s = max(channel.extension_s, bounds.extension_s.high if bounds else 0.0)
        end_ns = round((extension_s + channel.fall_s) * NS_PER_S)
        self._in_stance = _runs_through_stance(channel)
        self._rests_ns = STANDS_NS if self._in_stance else RESTS_NS + end_ns
        self._longest_ns = {action: hold_ns + end_ns for action, hold_ns in LONGEST_NS.items()}
        if movement is None:
            self._longest_ns[OperatorAction.EXERCISE] = exercise_ns + end_ns
        self._asked: tuple[int, int] | None = None  # when, and how long the burst may last
        self._began_ns = self._by_hand_ns = self._swings_before = 0

    def observe(self, act: OperatorAct) -> None:
        """A person asked for a burst of this channel, or for none any more."""
        if act.action in self._longest_ns:
            if act.value == self._number:
                self._asked = act.t_ns, self._longest_ns[act.action]
        elif act.action in (OperatorAction.ARM, OperatorAction.DISARM, OperatorAction.EMERGENCY_STOP):
            self._asked = None

    def forbids(self, t_ns: int, *, begins: bool) -> str:
        """Why there must be no current now; "" when there may. Ask it last: what it lets begin by hand has begun."""
        movement = self._movement
        if begins:
            asked, self._asked = self._asked, None
            self._by_hand_ns = asked[1] if asked and t_ns - asked[0] <= ASKED_NS else 0
            self._began_ns = t_ns
            self._swings_before = movement.swings - movement.in_swing(t_ns) if movement else 0
        lasted_ns = t_ns - self._began_ns
        if self._by_hand_ns and lasted_ns <= self._by_hand_ns:
            return ""
        if movement is None:
            return "longer than a person asked for" if self._by_hand_ns else "nobody asked for a burst"
        if movement.moved_ns is None or t_ns - movement.moved_ns > self._rests_ns:
            return "the foot rests"
        swings = movement.swings - self._swings_before
        if swings > MOST_SWINGS:
            return f"on for more than {MOST_SWINGS} swings of the foot"
        if not swings and not self._in_stance and lasted_ns > MOST_WITHOUT_NS:
            return f"on for {lasted_ns / NS_PER_S:.3g} s without a swing of the foot"
        return ""


def _runs_through_stance(channel: Channel) -> bool:
    """Whether the channel is on in stance itself, not only beyond its beginning."""
    first, last, stance = (PHASE_ORDER.index(phase) for phase in (channel.start_phase, channel.stop_phase, "stance"))
    return (stance - first) % len(PHASE_ORDER) < (last - first) % len(PHASE_ORDER)
