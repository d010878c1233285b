"""Wire truth: what was commanded, held against what the stimulator says it delivered. Plain values, no I/O."""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

from fes.signals import StimCommand, StimStatus

DIFFERENCES_LISTED: Final = 20
COUNTERS: Final = 128  # values of the wire's command counter
_TOLERANCE: Final = 1e-6  # both sides are whole steps of the wire; this only absorbs float arithmetic


@dataclass(frozen=True, slots=True)
class Difference:
    """One command and the answer that does not fit it; ``what`` says in words how."""

    command: StimCommand
    counter: int
    status: StimStatus
    what: str


@dataclass(frozen=True, slots=True)
class Delivered:
    """Outcome of :func:`compare_delivered`.

    ``matched`` commands got an answer that fits, ``different`` one that does not (``differences``: the first 20),
    ``missing`` none at all. ``unasked`` answers belong to no command, such as the end of a lease. ``pulses`` and
    ``charge_uc`` (one phase) are sums of all answers, by channel.
    """

    commands: int
    matched: int
    missing: int
    different: int
    unasked: int
    differences: tuple[Difference, ...] = ()
    pulses: dict[int, int] = field(default_factory=dict)
    charge_uc: dict[int, float] = field(default_factory=dict)

    @property
    def ok(self) -> bool:
        """Every command was answered, and every answer says what was commanded."""
        return self.missing == 0 and self.different == 0 and self.matched == self.commands

    def to_dict(self) -> dict[str, Any]:
        """For the session log: counts, and by channel pulses and charge (µC)."""
        counts = {name: getattr(self, name) for name in ("commands", "matched", "missing", "different", "unasked")}
        charge_uc = {str(channel): round(charge, 3) for channel, charge in self.charge_uc.items()}
        return counts | {"pulses": {str(channel): n for channel, n in self.pulses.items()}, "charge_uc": charge_uc}


def compare_delivered(sent: Sequence[tuple[StimCommand, int]], statuses: Iterable[StimStatus]) -> Delivered:
    """Pair commands of all channels, as they read on the wire, with the stimulator's answers, both by time.

    Per channel, an answer belongs to the newest not yet answered command with its counter that was sent no later
    than the answer came; commands passed over by that stay unanswered. That is unique as long as fewer commands are
    on their way than the counter has values (128).
    """
    answers: dict[int, list[StimStatus]] = defaultdict(list)
    for status in statuses:
        answers[status.channel].append(status)

    matched = unasked = 0
    differences: list[Difference] = []
    for channel, received in answers.items():
        asked = [(command, counter) for command, counter in sent if command.channel == channel]
        for position, status in _pairs(asked, received):
            if position is None:
                unasked += 1
                continue
            command, counter = asked[position]
            what = _difference(command, status)
            if what:
                differences.append(Difference(command, counter, status, what))
            else:
                matched += 1
    return Delivered(
        commands=len(sent),
        matched=matched,
        missing=len(sent) - matched - len(differences),
        different=len(differences),
        unasked=unasked,
        differences=tuple(differences[:DIFFERENCES_LISTED]),
        pulses={channel: sum(status.pulses for status in answers[channel]) for channel in sorted(answers)},
        charge_uc={channel: sum(status.charge_uc for status in answers[channel]) for channel in sorted(answers)},
    )


def _pairs(asked: list[tuple[StimCommand, int]], received: list[StimStatus]) -> Iterable[tuple[int | None, StimStatus]]:
    """Each answer with the position of its command, None when it answers none."""
    first = until = 0  # commands before `first` are settled, those before `until` were sent when the answer came
    for status in received:
        while until < len(asked) and asked[until][0].t_ns <= status.t_ns:
            until += 1
        for position in range(until - 1, max(first, until - COUNTERS) - 1, -1):
            if asked[position][1] == status.counter:
                first = position + 1
                yield position, status
                break
        else:
            yield None, status


def _difference(command: StimCommand, status: StimStatus) -> str:
    if status.fault:
        return status.fault
    if status.on != command.on:
        return "commanded {}, delivered {}".format(*("on" if on else "off" for on in (command.on, status.on)))
    if not command.on:
        return ""
    pairs = (
        ("current", command.current_ma, status.current_ma, "mA"),
        ("pulse width", command.pulse_width_us, status.pulse_width_us, "µs"),
        ("frequency", command.frequency_hz, status.frequency_hz, "Hz"),
    )
    return ", ".join(
        f"{name} commanded {wanted:g} {unit}, delivered {got:g} {unit}"
        for name, wanted, got, unit in pairs
        if abs(wanted - got) > _TOLERANCE
    )
