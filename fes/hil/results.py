"""What a campaign found: when the stimulator put out current, attempts, rows, verdicts, the table. Pure."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from itertools import pairwise
from typing import Any, Final

import numpy as np

from drivers.simulated.record import RecordEntry
from fes.hil.baseline import Lateness
from fes.hil.scenarios import Scenario

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
                for channel in [entry.channel] if entry.channel >= 0 else list(self._open):
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


def _train(train: list[RecordEntry], off_ns: int | None) -> Output:
    charge_uc = sum(entry.current_ma * entry.pulse_width_us * 1e-3 for entry in train)
    return Output(train[0].t_ns, off_ns, train[-1].t_ns, LAST_PULSE, len(train), charge_uc)


def _stretch(entries: list[RecordEntry], off_ns: int | None, ended_by: str) -> Output:
    """From its levels and, when it has ended, what ended it."""
    charge_uc = sum(
        max(after.pulses - before.pulses, 0) * before.current_ma * before.pulse_width_us * 1e-3
        for before, after in pairwise(entries)
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


def overlap_ms(stretches: Iterable[Output], spans_ns: Iterable[tuple[int, int]], now_ns: int) -> float:
    """For how long current flowed within these spans, in ms; what is still on flows until now."""
    known = [(output.on_ns, now_ns if output.off_ns is None else output.off_ns) for output in stretches]
    return sum(max(min(to_ns, off) - max(from_ns, on), 0) for from_ns, to_ns in spans_ns for on, off in known) / MS


def length_ms(chain: Sequence[Output], now_ns: int) -> float:
    """How long a stretch of current lasted, in ms, with what followed it."""
    return ((now_ns if chain[-1].off_ns is None else chain[-1].off_ns) - chain[0].on_ns) / MS


class Verdict(StrEnum):
    """How a row came out. ``JITTER``: over the deadline by no more than the p99.9 of an idle loop beside it."""

    MET = "met"
    JITTER = "met but for the machine"
    FAILED = "FAILED"
    SKIPPED = "not run"


@dataclass(frozen=True, slots=True)
class Attempt:
    """One injection.

    Attributes:
        off_ms: from the fault to the end of the stimulator's output; infinite when it never ended; None where nothing
            has to go off.
        last_pulse_ms: from the fault to the last pulse; below 0 when there was none after it.
        named: what the session gave as its reason.
        faults: what was wrong with the answer besides its time.
        notice: anything else worth a line.
        value: what the fault was brought about with, in words.
        wrong_ms: for how long from the fault on current flowed while the foot was in stance, in truth; None: not known.
        away: something else took the session off: this machine lost time, and an idle loop beside it saw that. No
            verdict; it is made again.
    """

    off_ms: float | None = None
    last_pulse_ms: float | None = None
    named: str = ""
    faults: tuple[str, ...] = ()
    notice: str = ""
    value: str = ""
    away: bool = False
    wrong_ms: float | None = None


@dataclass(slots=True)
class Row:
    """One fault's attempts; ``skipped`` says why there are none, ``away`` why some were made again."""

    scenario: Scenario
    attempts: list[Attempt] = field(default_factory=list)
    skipped: str = ""
    away: list[str] = field(default_factory=list)

    def times_ms(self) -> list[float]:
        """Of the attempts in which something had to go off."""
        return [attempt.off_ms for attempt in self.attempts if attempt.off_ms is not None]

    def most_wrong_ms(self) -> float | None:
        """The most current in a true stance of any attempt; None: not known."""
        return max((each.wrong_ms for each in self.attempts if each.wrong_ms is not None), default=None)

    def within(self) -> int:
        """How many of them were in time."""
        deadline_ms = self.scenario.deadline_ms
        return sum(deadline_ms is None or time_ms <= deadline_ms for time_ms in self.times_ms())

    def verdict(self, machine_ms: float) -> Verdict:
        """Given how late the machine was with an idle loop (its p99.9)."""
        if self.skipped:
            return Verdict.SKIPPED
        if not self.attempts or any(attempt.faults or attempt.away for attempt in self.attempts):
            return Verdict.FAILED
        times_ms = self.times_ms()
        if self.within() == len(times_ms):
            return Verdict.MET
        over_ms = max(times_ms) - (self.scenario.deadline_ms or 0.0)
        return Verdict.JITTER if over_ms <= machine_ms else Verdict.FAILED


@dataclass(frozen=True, slots=True)
class Campaign:
    """All rows of one transport."""

    transport: str
    rows: tuple[Row, ...]
    baseline: Lateness
    started: str
    seconds: float
    repeat: int
    unasked: tuple[str, ...] = ()  # reasons for which the session went off when no fault had been injected
    away: tuple[str, ...] = ()  # such reasons where an idle loop shows that this machine lost time just then

    @property
    def notices(self) -> list[str]:
        """What is to be said above the table; "machine away" is no fault of the session's, and no success either."""
        again = [reason for row in self.rows for reason in row.away]
        lines = [f"Off {len(self.unasked)} times without a fault: {_distinct(self.unasked)}."] if self.unasked else []
        if self.away or again:
            lines.append(
                f"Machine away {len(self.away) + len(again)} times, as the idle loop saw as well, {len(again)} of them "
                f"as a fault was injected; such attempts were made again: {_distinct([*self.away, *again])}."
            )
        return lines

    @property
    def failed(self) -> list[Row]:
        """Rows that did not come out as required."""
        return [row for row in self.rows if row.verdict(self.baseline.p999_ms) is Verdict.FAILED]

    def to_dict(self) -> dict[str, Any]:
        """For JSON: no infinities in it."""
        return {
            "transport": self.transport,
            "started": self.started,
            "seconds": round(self.seconds, 1),
            "repeat": self.repeat,
            "unasked": list(self.unasked),
            "away": list(self.away),
            "baseline": asdict(self.baseline),
            "rows": [_row(row, self.baseline.p999_ms) for row in self.rows],
        }

    def to_markdown(self) -> str:
        """The table, with what it was measured beside."""
        lines = [
            f"Transport {self.transport}, {self.started}, {self.seconds / 60:.1f} minutes. {self.baseline}.",
            "",
            "| fault, in swing, current on | required response | deadline | output off after (median / worst) | "
            "last pulse (worst) | current in a true stance (worst) | in time | named | verdict |",
            "|---|---|---|---|---|---|---|---|---|",
        ]
        for notice in reversed(self.notices):
            lines[1:1] = ["", notice]
        return "\n".join([*lines, *(_line(row, self.baseline.p999_ms) for row in self.rows), ""])


def measured_times(row: Row) -> str:
    """Measured times in a few words."""
    if row.skipped:
        return "–"
    if not (times_ms := row.times_ms()):
        return next((attempt.notice for attempt in row.attempts if attempt.notice), "–")
    return f"{_ms(float(np.median(times_ms)))} / {_ms(max(times_ms))}"


def failure_reason(row: Row) -> str:
    """What was wrong, or why it was not run; "" when all is well."""
    away = ["this machine was away in every try"] if any(attempt.away for attempt in row.attempts) else []
    return row.skipped or _distinct([*away, *(fault for attempt in row.attempts for fault in attempt.faults)])


def _ms(value: float) -> str:
    return "still on" if math.isinf(value) else f"{value:.1f} ms"


def _row(row: Row, machine_ms: float) -> dict[str, Any]:
    finite = [time_ms for time_ms in row.times_ms() if math.isfinite(time_ms)]
    names = ("p50_ms", "p90_ms", "p99_ms", "most_ms")
    spread = np.percentile(finite, [50, 90, 99, 100]).round(3).tolist() if finite else [None] * len(names)
    return {
        **{name: getattr(row.scenario, name) for name in ("name", "fault", "response", "deadline_ms")},
        "away": row.away,
        "attempts": [_attempt(attempt) for attempt in row.attempts],
        "in_time": row.within(),
        "most_wrong_ms": row.most_wrong_ms(),
        **dict(zip(names, spread, strict=True)),
        "verdict": str(row.verdict(machine_ms)),
        "failure_reason": failure_reason(row),
    }


def _attempt(attempt: Attempt) -> dict[str, Any]:
    def number(value: float | None) -> float | str | None:
        return value if value is None else "never" if math.isinf(value) else round(value, 3)

    return {
        "off_ms": number(attempt.off_ms),
        "last_pulse_ms": number(attempt.last_pulse_ms),
        "wrong_ms": number(attempt.wrong_ms),
        **{"named": attempt.named, "faults": attempt.faults, "remark": attempt.notice, "value": attempt.value},
    }


def _distinct(reasons: Iterable[str]) -> str:
    return "; ".join(dict.fromkeys(reasons))


def _line(row: Row, machine_ms: float) -> str:
    scenario, times_ms = row.scenario, row.times_ms()
    deadline = "–" if scenario.deadline_ms is None else f"{scenario.deadline_ms:g} ms"
    pulses = [attempt.last_pulse_ms for attempt in row.attempts if attempt.last_pulse_ms is not None]
    last = "–" if not pulses else "none after it" if max(pulses) <= 0 else _ms(max(pulses))
    in_time = f"{row.within()} of {len(times_ms)}" if times_ms else "–"
    named = next((attempt.named for attempt in row.attempts if attempt.named), "–")
    verdict = str(row.verdict(machine_ms))
    outcome = f"{verdict}: {failure_reason(row)}" if failure_reason(row) else verdict
    wrong_ms = row.most_wrong_ms()
    wrong = "–" if wrong_ms is None else _ms(wrong_ms)
    cells = (scenario.fault, scenario.response, deadline, measured_times(row), last, wrong, in_time, named, outcome)
    return "| " + " | ".join(cell.replace("|", "/").replace("\n", " ") for cell in cells) + " |"
