"""What people did in a session: armed, stopped, asked for bursts, set marks. It is listed as it was and is no fault."""

import re
from bisect import bisect_right
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

from fes.report.strides import StrideRow
from fes.report.text import count_of
from fes.signals import NS_PER_S, OperatorAction
from fes.stimulation.plan import BY_HAND_NS
from fes.walk_record import MARK, WalkRecord

STOP: Final = "emergency stop"
WORDS: Final = {
    OperatorAction.ARM: "armed",
    OperatorAction.DISARM: "disarmed",
    OperatorAction.EMERGENCY_STOP: STOP,
    OperatorAction.TEST_BURST: "test burst",
    OperatorAction.TRIGGER: "manual burst",
    OperatorAction.SET_INTENSITY: "intensity",
    OperatorAction.FREEZE_TUNING: "tuning frozen",
    OperatorAction.RESUME_TUNING: "tuning told to go on",
    OperatorAction.ACCEPT_SUGGESTION: "suggestion accepted",
    OperatorAction.ROLL_BACK: "settings rolled back",
}
LOWERED: Final = ", less than the session's"
HARDLY: Final = 1e-6
STEPS_NS: Final = 2 * NS_PER_S  # key presses that follow each other sooner are one act
NOBODYS: Final = ("(button lost)", "(the keyboard is gone")  # stops that the session makes by itself
CAUSE: Final = re.compile(r"state .* \((.*)\)")


@dataclass(frozen=True)
class HandRow:
    """One thing that a person did; ``channel`` of a burst, else −1."""

    time_s: float
    action: str
    channel: int
    text: str


@dataclass(frozen=True)
class MarkRow:
    """A mark that a person set; ``strides``: how many valid ones began from then until the next mark."""

    time_s: float
    text: str
    strides: int = 0


def with_marks(
    record: WalkRecord, rows: Sequence[StrideRow], origin_ns: int
) -> tuple[tuple[MarkRow, ...], tuple[StrideRow, ...]]:
    """The marks by time, and the strides, each with the last mark before it began."""
    marks = sorted((note.t_ns, note.text) for note in record.notes if note.source == MARK)
    times_s = [(t_ns - origin_ns) / NS_PER_S for t_ns, _ in marks]
    of_row = [bisect_right(times_s, row.start_s) - 1 for row in rows]
    counted = Counter(at for at, row in zip(of_row, rows, strict=True) if row.valid)
    told = tuple(MarkRow(times_s[at], text, counted[at]) for at, (_, text) in enumerate(marks))
    marked = (replace(row, mark=marks[at][1]) if at >= 0 else row for at, row in zip(of_row, rows, strict=True))
    return told, tuple(marked)


def hand_rows(record: WalkRecord, origin_ns: int, usual_intensity: float = 1.0) -> tuple[HandRow, ...]:
    """By time; a stop pressed again before the next arming belongs to the first, and of an intensity that is set in
    steps the last one counts; below ``usual_intensity`` (0 … 1), the session's, it says so."""
    said: dict[int, list[str]] = {}
    for note in record.notes:
        if note.source == "session":
            said.setdefault(note.t_ns, []).append(note.text)
    rows: list[HandRow] = []
    stopped = False
    for act in sorted(record.acts, key=lambda act: act.t_ns):
        stops = act.action is OperatorAction.EMERGENCY_STOP
        of_itself = act.action is OperatorAction.FREEZE_TUNING and act.why
        begins = act.action is OperatorAction.SET_INTENSITY and not act.value > 0.0  # as every arming does
        if act.action not in WORDS or (stops and stopped) or of_itself or begins:
            continue
        stopped = stops or (stopped and act.action is not OperatorAction.ARM)
        channel = int(act.value) if act.action in BY_HAND_NS else -1
        text = WORDS[act.action] if channel >= 0 else _as_said(act.action, said.get(act.t_ns, []))
        if act.action is OperatorAction.SET_INTENSITY:
            text = f"{text} {min(act.value, 1.0):.0%}" + (LOWERED if act.value < usual_intensity - HARDLY else "")
            if rows and rows[-1].action == act.action and act.t_ns - origin_ns < STEPS_NS + NS_PER_S * rows[-1].time_s:
                rows.pop()
        rows.append(HandRow((act.t_ns - origin_ns) / NS_PER_S, str(act.action), channel, text))
    return tuple(rows)


def _as_said(action: OperatorAction, said: Sequence[str]) -> str:
    """As the session put it at that moment, where it did: who stopped, disarmed or paused, why it could not arm."""
    if action is OperatorAction.EMERGENCY_STOP:
        return next((text for text in said if text.startswith(STOP)), STOP)
    refused = next((text for text in said if text.startswith("cannot")), "")
    return refused or next((found[1] for text in said if (found := CAUSE.match(text))), WORDS[action])


def is_stop_note(source: str, text: str) -> bool:
    """Whether a note is of a stop that a person made, or of the gate's latch that came of any stop."""
    if source == "gate":
        return text.endswith(f": {STOP}")
    return source == "session" and text.startswith(STOP) and not any(origin in text for origin in NOBODYS)


def summed_up(rows: Sequence[HandRow]) -> str:
    """Bursts, stops, and an intensity that was left below the session's; "" for none of these."""
    left = [row for row in rows if row.action == OperatorAction.SET_INTENSITY][-1:]
    lowered = [f"{row.text} from {row.time_s:.1f} s on" for row in left if row.text.endswith(LOWERED)]
    bursts = Counter(row.text for row in rows if row.channel >= 0)
    stops = [f"{row.text} at {row.time_s:.1f} s" for row in rows if row.action == OperatorAction.EMERGENCY_STOP]
    return ", ".join([*(count_of(count, what) for what, count in bursts.items()), *stops, *lowered])
