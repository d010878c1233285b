"""A foot switch as the trigger's fallback: it times bursts while the sensor's side shows no steps. Pure, causal.

The switch opens when the foot is lifted and closes when it lands. Once it has gone through two cycles of walking while
the sensor showed no swing, its changes stand for the phases; the sensor's first swing takes over again, and a switch
that falls silent ends what it began. The gate judges as ever: without fresh data from the sensor there is no current,
whatever the switch says.
"""

from __future__ import annotations

from typing import Final

from fes.signals import NS_PER_S, Event, FootSwitchEvent
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
            if event.pressed is None:
                return self._silent(t_ns)
            changes += self._landed(t_ns) if event.pressed else self._released(t_ns)
        return changes if self.active else []

    def _silent(self, t_ns: int) -> list[PhaseChange]:
        """Nobody knows when the foot lands; the sensor may have taken over long ago."""
        lost = [self._change(t_ns, Transition.NONE, Phase.STANCE, Phase.STANCE)] if self.active else []
        self._released_ns, self._landed_ns, self._cycles = None, None, 0
        return lost

    def _released(self, t_ns: int) -> list[PhaseChange]:
        before_ns, self._released_ns = self._released_ns, t_ns
        if before_ns is not None:
            self._cycles = self._cycles + 1 if t_ns - before_ns >= SHORTEST_CYCLE_NS else 0
        return [
            self._change(t_ns, Transition.T1, Phase.STANCE, Phase.PRE_SWING),
            self._change(t_ns, Transition.T2, Phase.PRE_SWING, Phase.SWING),
        ]

    def _landed(self, t_ns: int) -> list[PhaseChange]:
        self._landed_ns = t_ns
        return [self._change(t_ns, Transition.T3, Phase.SWING, Phase.LOADING_RESPONSE)]

    def _change(self, t_ns: int, transition: Transition, source: Phase, destination: Phase) -> PhaseChange:
        return PhaseChange(t_ns, self.foot, transition, source, destination)
