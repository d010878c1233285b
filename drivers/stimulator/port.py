"""What the runner asks of every stimulator's port, and what ports share: owed answers, one pulse for each command.

A port has ``send(command)``, which encodes and writes at once and returns what went out, stamped with the command's
time (StimulatorLost: the line did not take it; ValueError: this line cannot express it); ``poll(t_ns)``, which returns
whatever has arrived since the last call, stamped ``t_ns`` (StimulatorLost: the line broke); and ``close()``, which may
be called twice and sends nothing. None waits, none reads a clock, none repeats a command by itself.
"""

from collections import deque
from dataclasses import dataclass
from enum import IntEnum
from typing import Final, Self

from fes.signals import NS_PER_S

ANSWER_WITHIN_NS: Final = 100_000_000  # ScienceMode2: answers within 100 ms, on average under 20
MAX_PER_CHANNEL: Final = 2  # unanswered pulses of one channel; a third would wait in the device's queue
MAX_IN_ALL: Final = 8  # the device's queue holds ten
FORGOTTEN_AFTER_NS: Final = 1_000_000_000  # what was not answered for so long is in no queue any more


class WordedEnum(IntEnum):
    """Numbers that a device sends, each with what it says ("" when nothing is wrong)."""

    words: str

    def __new__(cls, value: int, words: str = "") -> Self:
        """A member of this number and these words."""
        member = int.__new__(cls, value)
        member._value_, member.words = value, words
        return member


class StimulatorLost(RuntimeError):
    """The stimulator cannot be reached (any more): nothing was sent, or nothing can be heard.

    What it was doing ends by itself when the last command's validity runs out.
    """


class SessionUsed(StimulatorLost):
    """The device opens no session under this identifier, for it has carried commands before; another one it may."""


@dataclass(frozen=True, slots=True)
class Pulse:
    """What an answer will confirm: one channel's levels, and the counter of the command that asked for them."""

    channel: int
    counter: int
    on: bool
    current_ma: float = 0.0
    pulse_width_us: float = 0.0
    frequency_hz: float = 0.0


@dataclass(frozen=True, slots=True)
class Awaited:
    """One message that must be answered."""

    number: int
    answer: int
    t_ns: int
    pulses: tuple[Pulse, ...] = ()


class Answers:
    """Messages on their way, oldest first. Devices answer in order: an answer out of turn is a fault.

    What is overdue may still wait in the device's queue: it takes up room there until it is answered after all, or for
    a second.
    """

    def __init__(self) -> None:
        self._awaited: deque[Awaited] = deque()
        self._overdue: list[Awaited] = []

    def __len__(self) -> int:
        return len(self._awaited)

    def expect(self, awaited: Awaited) -> None:
        """A message went out."""
        self._awaited.append(awaited)

    def room(self, channel: int, t_ns: int) -> str:
        """ "" when another pulse of this channel may go out at ``t_ns``, else why not."""
        self._overdue = [awaited for awaited in self._overdue if t_ns - awaited.t_ns < FORGOTTEN_AFTER_NS]
        waiting = [*self._overdue, *self._awaited]
        own = sum(pulse.channel == channel for awaited in waiting for pulse in awaited.pulses)
        if own >= MAX_PER_CHANNEL:
            return f"{own} pulses are unanswered; none was added to the stimulator's queue"
        if len(waiting) >= MAX_IN_ALL:
            return f"{len(waiting)} commands are unanswered; none was added to the stimulator's queue"
        return ""

    def settle(self, number: int, answer: int) -> tuple[Awaited | None, str]:
        """The message that this answers, and what is wrong with that ("": nothing).

        None when nobody asked. An answer out of turn settles its own message alone.
        """
        for position, awaited in enumerate(self._awaited):
            if (awaited.number, awaited.answer) == (number, answer):
                del self._awaited[position]
                fault = f"answered out of turn, {position} older commands are unanswered" if position else ""
                return awaited, fault
        self._overdue = [late for late in self._overdue if (late.number, late.answer) != (number, answer)]
        return None, f"answer {answer} number {number} to no command of ours: late, repeated or foreign"

    def overdue(self, t_ns: int) -> list[Awaited]:
        """Messages not answered in time, each returned once; an answer that still comes will be to no command."""
        late: list[Awaited] = []
        while self._awaited and t_ns - self._awaited[0].t_ns > ANSWER_WITHIN_NS:
            late.append(self._awaited.popleft())
        self._overdue += late
        return late


@dataclass(slots=True)
class PulseTrain:
    """One channel's turn. It is given every command of the channel, by the command's own time.

    On average no more than ``frequency_hz`` pulses a second come out, and no two closer than half a period (nor than
    ``least_ns``): a command a quarter of a period early is taken, so that jitter does not halve the rate, and the
    next pulse is then due by the old grid. Commands that come less often than the frequency give a pulse each.
    """

    least_ns: int = 0
    _next_ns: int | None = None
    _last_ns: int | None = None

    def due(self, t_ns: int, frequency_hz: float) -> bool:
        """Whether this on command is a pulse; remembers it if so. Not above 0 Hz: never."""
        if not frequency_hz > 0:
            return False
        period_ns = int(NS_PER_S / frequency_hz)
        if self._last_ns is not None and t_ns - self._last_ns < max(period_ns // 2, self.least_ns):
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
