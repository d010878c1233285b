"""What a campaign found: attempts, rows, verdicts, and the table for people and for programs. Pure."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from typing import Any

import numpy as np

from fes.hil.baseline import Lateness
from fes.hil.scenarios import Scenario


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
        lines = []
        if self.unasked:
            lines.append(f"Off {len(self.unasked)} times without a fault: {_distinct(self.unasked)}.")
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
            "last pulse (worst) | in time | named | verdict |",
            "|---|---|---|---|---|---|---|---|",
        ]
        for notice in reversed(self.notices):
            lines[1:1] = ["", notice]
        return "\n".join([*lines, *(_line(row, self.baseline.p999_ms) for row in self.rows), ""])


def measured_times(row: Row) -> str:
    """Measured times in a few words."""
    times_ms = row.times_ms()
    if row.skipped:
        return "–"
    if not times_ms:
        return next((attempt.notice for attempt in row.attempts if attempt.notice), "–")
    return f"{_ms(float(np.median(times_ms)))} / {_ms(max(times_ms))}"


def failure_reason(row: Row) -> str:
    """What was wrong, or why it was not run; "" when all is well."""
    away = ["this machine was away in every try"] if any(attempt.away for attempt in row.attempts) else []
    return row.skipped or _distinct([*away, *(fault for attempt in row.attempts for fault in attempt.faults)])


def _ms(value: float) -> str:
    return "still on" if math.isinf(value) else f"{value:.1f} ms"


def _row(row: Row, machine_ms: float) -> dict[str, Any]:
    scenario = row.scenario
    finite = [time_ms for time_ms in row.times_ms() if math.isfinite(time_ms)]
    names = ("p50_ms", "p90_ms", "p99_ms", "most_ms")
    spread = np.percentile(finite, [50, 90, 99, 100]).round(3).tolist() if finite else [None] * len(names)
    return {
        "name": scenario.name,
        "fault": scenario.fault,
        "response": scenario.response,
        "deadline_ms": scenario.deadline_ms,
        "away": row.away,
        "attempts": [_attempt(attempt) for attempt in row.attempts],
        "in_time": row.within(),
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
        "named": attempt.named,
        "faults": list(attempt.faults),
        "remark": attempt.notice,
        "value": attempt.value,
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
    cells = (scenario.fault, scenario.response, deadline, measured_times(row), last, in_time, named)
    return _cells([*cells, f"{verdict}: {failure_reason(row)}" if failure_reason(row) else verdict])


def _cells(cells: Iterable[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "/").replace("\n", " ") for cell in cells) + " |"
