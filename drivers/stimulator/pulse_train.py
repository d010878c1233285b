"""When a command becomes a pulse, for devices that deliver one pulse for each command and none by themselves."""

from __future__ import annotations

from fes.signals import NS_PER_S


class PulseTrain:
    """One channel's turn. Told of every command of the channel, by the command's own time; reads no clock.

    On average no more than ``frequency_hz`` pulses a second come out, and no two closer than half a period (nor than
    ``least_ns``): a command a quarter of a period early is taken, so that jitter does not halve the rate, and the
    next pulse is then due by the old grid. Commands that come less often than the frequency give a pulse each.
    """

    def __init__(self, least_ns: int = 0) -> None:
        self._least_ns = least_ns
        self._next_ns: int | None = None
        self._last_ns: int | None = None

    def due(self, t_ns: int, frequency_hz: float) -> bool:
        """Whether this on command is a pulse; remembers it if so. Not above 0 Hz: never."""
        if not frequency_hz > 0:
            return False
        period_ns = int(NS_PER_S / frequency_hz)
        if self._last_ns is not None and t_ns - self._last_ns < max(period_ns // 2, self._least_ns):
            return False
        if self._next_ns is None:
            self._next_ns = t_ns
        if t_ns < self._next_ns - period_ns // 4:
            return False
        # on the grid while commands keep up with it; missed pulses are not made up for
        self._next_ns = (self._next_ns if t_ns < self._next_ns + period_ns // 2 else t_ns) + period_ns
        self._last_ns = t_ns
        return True

    def off(self) -> None:
        """The burst is over; the next one begins with a pulse of its own."""
        self._next_ns = None
