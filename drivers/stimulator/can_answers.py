"""Which commands the CAN stimulator has answered, whether each answer says what was asked, and which are overdue."""

from __future__ import annotations

from collections import deque
from typing import Final

from drivers.stimulator.can_messages import Status
from fes.signals import StimCommand

REMEMBERED: Final = 128  # commands: more than are sent until one is overdue, 36 with 8 channels at 100 Hz
ANSWER_WITHIN_MS: Final = 45  # two command periods and some: the next command, 20 ms later, is the one retry
HEARTBEAT_WITHIN_MS: Final = 350  # NODE_ALIVE comes every 100 ms
_HALF_STEPS: Final = (("current_ma", 0.25, "mA"), ("pulse_width_us", 0.5, "µs"), ("frequency_hz", 0.5, "Hz"))


class CommandAnswers:
    """Commands sent and not yet answered. An answer settles its channel's older ones: what they asked for is past.

    Args:
        in_real_time: whether ``t_ns`` is the time on the wall, so that lateness means something. Otherwise nothing
            is ever overdue.
    """

    def __init__(self, *, in_real_time: bool) -> None:
        self._in_real_time = in_real_time
        self._waiting: deque[tuple[int, StimCommand, int]] = deque(maxlen=REMEMBERED)
        self._heard_ns: int | None = None

    def __len__(self) -> int:
        return len(self._waiting)

    def sent(self, counter: int, command: StimCommand, written_ns: int | None = None) -> None:
        """A command went out, at ``written_ns``; None: at its own time.

        The device cannot answer before the bytes are on their way, and a loop that was held up between deciding and
        writing has taken that time itself.
        """
        self._waiting.append((counter, command, command.t_ns if written_ns is None else written_ns))

    def settle(self, status: Status) -> str:
        """Take in an answer; how what is delivered differs from what was commanded, "" when it does not.

        An answer to nothing that waits (the end of a lease, a repetition) is held against nothing.
        """
        for position in range(len(self._waiting) - 1, -1, -1):
            counter, command, _ = self._waiting[position]
            if counter == status.counter and command.channel == status.channel:
                older = list(self._waiting)[: position + 1]
                for entry in older:
                    if entry[1].channel == status.channel:
                        self._waiting.remove(entry)
                return _difference(command, status)
        return ""

    def heard(self, t_ns: int) -> None:
        """The node's heartbeat came."""
        self._heard_ns = t_ns

    def overdue(self, t_ns: int) -> StimCommand | None:
        """The oldest command that waits longer than it may; all that wait are then forgotten, to be told once.

        One lost answer is none yet: the next command, 20 to 30 ms later, is the retry, and its answer settles both.
        """
        if not self._in_real_time or not self._waiting:
            return None
        _, command, written_ns = self._waiting[0]
        if t_ns - written_ns <= ANSWER_WITHIN_MS * 1_000_000:
            return None
        self._waiting.clear()
        return command

    def silent(self, t_ns: int) -> bool:
        """Whether the heartbeat has stopped; told once for every 350 ms of silence."""
        if not self._in_real_time or self._heard_ns is None:
            return False
        if t_ns - self._heard_ns <= HEARTBEAT_WITHIN_MS * 1_000_000:
            return False
        self._heard_ns = t_ns
        return True


def _difference(command: StimCommand, status: Status) -> str:
    if status.result:  # it says itself that it did not do as told, and why
        return ""
    if status.on != command.on:
        return f"commanded {'on' if command.on else 'off'}, delivered {'on' if status.on else 'off'}"
    if not command.on:
        return ""
    wrong = [
        f"{name.rsplit('_', 1)[0].replace('_', ' ')} commanded {wanted:g} {unit}, delivered {got:g} {unit}"
        for name, half_step, unit in _HALF_STEPS
        if abs((got := getattr(status, name)) - (wanted := getattr(command, name))) > half_step + 1e-6
    ]
    return ", ".join(wrong)
