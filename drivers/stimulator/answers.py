"""Which answers a device still owes, and which of them are wrong or late. No I/O, no clock."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Final

ANSWER_WITHIN_NS: Final = 100_000_000  # ScienceMode2: answers within 100 ms, on average under 20
MAX_PER_CHANNEL: Final = 2  # unanswered pulses of one channel; a third would wait in the device's queue
MAX_IN_ALL: Final = 8  # the device's queue holds ten
FORGOTTEN_AFTER_NS: Final = 1_000_000_000  # what was not answered for so long is in no queue any more


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
        """Messages not answered in time, each told once; an answer that still comes will be to no command."""
        late: list[Awaited] = []
        while self._awaited and t_ns - self._awaited[0].t_ns > ANSWER_WITHIN_NS:
            late.append(self._awaited.popleft())
        self._overdue += late
        return late
