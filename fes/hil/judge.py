"""What the stimulator's own record says: when it put out current, and how a fault was answered. Pure."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

from drivers.simulated.record import RecordEntry

MS: Final = 1_000_000
PERIOD_NS: Final = 55 * MS  # between pulses of one burst, at most: see Outputs
LATE_NS: Final = 150 * MS  # a pulse so soon after the one before may be of the same burst, held up by a busy machine
LAST_PULSE: Final = "last pulse"
_BEGIN: Final = frozenset(("on", "level"))
_END: Final = frozenset(("off", "lease_expired", "on_time", "fault", "boot", "watchdog", "emergency"))


@dataclass(frozen=True, slots=True)
class Output:
    """One stretch of current: from, until (None: still on), newest pulse, what ended it, charge (of one phase).

    A record of pulses says nothing of an end; there the last pulse is it.
    """

    on_ns: int
    off_ns: int | None
    last_pulse_ns: int
    ended_by: str = ""
    pulses: int = 0
    charge_uc: float = 0.0


class Outputs:
    """The stretches of current of all channels, kept up with a record that grows: each entry is looked at once.

    Where the record is of pulses, a pause longer than the pulse period ends a burst, as it does for the stimulator: the
    campaign's 40 Hz out of commands every 20 ms come 20 or 40 ms apart, and the shortest pause between two bursts
    (``min_off_s`` of 50 ms) makes 70 ms from pulse to pulse. :data:`PERIOD_NS` lies between.
    """

    def __init__(self) -> None:
        self._over: list[Output] = []
        self._open: dict[int, list[RecordEntry]] = {}
        self._trains: dict[int, list[RecordEntry]] = {}

    def add(self, entries: Iterable[RecordEntry]) -> None:
        """The record goes on with these; each device's in order."""
        for entry in entries:
            if entry.event == "pulse":
                train = self._trains.setdefault(entry.channel, [])
                if train and entry.t_ns - train[-1].t_ns > PERIOD_NS:
                    self._over.append(_train(train, train[-1].t_ns))
                    train.clear()
                train.append(entry)
            elif entry.event in _BEGIN and entry.current_ma > 0:
                self._open.setdefault(entry.channel, []).append(entry)
            elif entry.event in _END:
                ended = [entry.channel] if entry.channel >= 0 else list(self._open)
                for channel in ended:
                    if levels := self._open.pop(channel, None):
                        self._over.append(_stretch([*levels, entry], entry.t_ns, entry.event))

    def stretches(self, now_ns: int, since_ns: int = 0) -> list[Output]:
        """The stretches that were on at ``since_ns`` or later, oldest first.

        Args:
            now_ns: the present; a stretch of pulses that are recent enough is still on.
            since_ns: what had ended long before it is left out.
        """
        found = [output for output in self._over if (output.off_ns or output.on_ns) + LATE_NS >= since_ns]
        for train in self._trains.values():
            if train:
                found.append(_train(train, None if now_ns - train[-1].t_ns <= PERIOD_NS else train[-1].t_ns))
        found += [_stretch(levels, None, "") for levels in self._open.values()]
        return sorted(found, key=lambda output: output.on_ns)

    def forget(self, before_ns: int) -> None:
        """Drop what had ended before this moment."""
        self._over = [output for output in self._over if (output.off_ns or output.on_ns) >= before_ns]


def record_outputs(entries: Iterable[RecordEntry], now_ns: int) -> list[Output]:
    """All stretches of current of a whole record, oldest first; ``now_ns`` is the present."""
    found = Outputs()
    found.add(entries)
    return found.stretches(now_ns)


def _train(train: list[RecordEntry], off_ns: int | None) -> Output:
    charge_uc = sum(entry.current_ma * entry.pulse_width_us * 1e-3 for entry in train)
    return Output(train[0].t_ns, off_ns, train[-1].t_ns, LAST_PULSE, len(train), charge_uc)


def _stretch(entries: list[RecordEntry], off_ns: int | None, ended_by: str) -> Output:
    """From its levels and, when it has ended, what ended it."""
    steps = list(pairwise(entries))
    charge_uc = sum(
        max(after.pulses - before.pulses, 0) * before.current_ma * before.pulse_width_us * 1e-3
        for before, after in steps
    )
    newest = entries[-1]
    pulses = max(newest.pulses - entries[0].pulses, 0) + 1  # the first comes with the command, before it is noted
    return Output(entries[0].t_ns, off_ns, newest.last_pulse_ns, ended_by, pulses, charge_uc)


def output_at(stretches: Iterable[Output], t_ns: int) -> Output | None:
    """The stretch of current at a moment; of a train of pulses also shortly after its last, when the next was due."""
    for output in stretches:
        more_ns = PERIOD_NS if output.ended_by == LAST_PULSE else 0
        if output.on_ns <= t_ns and (output.off_ns is None or output.off_ns + more_ns >= t_ns):
            return output
    return None


def off_after_ms(stretches: Iterable[Output], t_ns: int) -> float:
    """How long after a moment the last current ended, in ms: 0 when none flowed any more, infinite when it still does.

    Current that came back counts as never having ended: there is no time within which that would be right.
    """
    ends = [output.off_ns for output in stretches if output.off_ns is None or output.off_ns > t_ns]
    if any(end is None for end in ends):
        return math.inf
    return max(((end - t_ns) / MS for end in ends if end is not None), default=0.0)


def began_after(stretches: Iterable[Output], t_ns: int) -> int:
    """How many stretches of current began after a moment."""
    return sum(output.on_ns > t_ns for output in stretches)


def resumed_after(stretches: Iterable[Output], t_ns: int) -> int:
    """As :func:`began_after`, without late pulses of a burst that was on before: :func:`off_after_ms` counts those."""
    known = list(stretches)
    pulses_ns = [output.last_pulse_ns for output in known if output.ended_by == LAST_PULSE]
    return sum(
        not (output.ended_by == LAST_PULSE and any(0 < output.on_ns - last_ns <= LATE_NS for last_ns in pulses_ns))
        for output in known
        if output.on_ns > t_ns
    )


def with_late_pulses(stretches: Iterable[Output], first: Output) -> list[Output]:
    """A stretch of current and what came so soon after it that it may be its own; what was before it is not."""
    chain = [first]
    for output in sorted(stretches, key=lambda each: each.on_ns):
        late_ns = output.on_ns - chain[-1].last_pulse_ns
        if output.ended_by == first.ended_by == LAST_PULSE and output.on_ns > first.on_ns and late_ns <= LATE_NS:
            chain.append(output)
    return chain


def length_ms(chain: Sequence[Output], now_ns: int) -> float:
    """How long a stretch of current lasted, in ms, with what followed it."""
    return ((now_ns if chain[-1].off_ns is None else chain[-1].off_ns) - chain[0].on_ns) / MS
