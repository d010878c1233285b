"""What the tuning did in a session and what charge each electrode was given, from its log."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Final

from fes.config import Session
from fes.signals import NS_PER_S, StimStatus
from fes.stimulation.dose import DoseLedger, ElectrodeDose
from fes.walk_record import Note, WalkRecord

SOURCE: Final = "tuning"
_CHANNEL: Final = re.compile(r"channel (\d+): ")
_KINDS: Final = (  # the first that fits; any other text is a change
    ("skip", " skipped: "),
    ("suggestion", "suggested: "),
    ("roll_back", "rolled back"),
    ("roll_back", "back to the session's settings"),
    ("roll_back", "still going back"),
    ("frozen", "tuning is frozen"),
    ("frozen", "tuning goes on"),
    ("hint", "response per charge"),
    ("hint", "is not reached at the upper bound"),
)


@dataclass(frozen=True)
class TuningRow:
    """One thing the tuning said; ``kind``: change, suggestion, roll_back, frozen, hint, skip."""

    time_s: float
    channel: int
    kind: str
    text: str


@dataclass(frozen=True)
class DoseRow:
    """One channel's electrodes: charge of one phase, as the stimulator counted it (else ``estimated``).

    ``by_minute_mc``: whole minutes of the session, from its begin on.
    """

    channel: int
    name: str
    pulses: int
    steps: int
    median_step_uc: float
    greatest_step_uc: float
    by_minute_mc: tuple[float, ...]
    session_mc: float
    estimated: bool


def tuning_rows(notes: Sequence[Note], origin_ns: int) -> tuple[TuningRow, ...]:
    """What the tuning said, by time."""
    rows = []
    for note in notes:
        if note.source == SOURCE:
            named = _CHANNEL.match(note.text)
            text = note.text[named.end() :] if named else note.text
            kind = next((kind for kind, phrase in _KINDS if phrase in text), "change")
            rows.append(TuningRow((note.t_ns - origin_ns) / NS_PER_S, int(named[1]) if named else -1, kind, text))
    return tuple(rows)


def dose_rows(record: WalkRecord, settings: Session | None, origin_ns: int) -> tuple[DoseRow, ...]:
    """The ledger of every channel that was given any charge, worked out as the controller does while it runs."""
    channels = settings.channels if settings else ()
    names = {channel.number: channel.name for channel in channels}
    feet: dict[str, list[int]] = {}
    for channel in channels:
        feet.setdefault(str(channel.foot), []).append(channel.number)
    ledger = DoseLedger(names)
    strides = sorted((stride for stride in record.strides if stride.foot in feet), key=lambda stride: stride.t_end_ns)
    closed = 0
    for status in sorted(record.statuses, key=lambda status: status.t_ns):
        while closed < len(strides) and strides[closed].t_end_ns < status.t_ns:
            _close(ledger, feet, strides[closed].foot, strides[closed].t_start_ns, strides[closed].t_end_ns, origin_ns)
            closed += 1
        ledger.book(_since(status, origin_ns))
    for stride in strides[closed:]:
        _close(ledger, feet, stride.foot, stride.t_start_ns, stride.t_end_ns, origin_ns)
    return tuple(_row(dose, names) for _, dose in sorted(ledger.electrodes.items()) if dose.session_uc > 0.0)


def _since(s: StimStatus, origin_ns: int) -> StimStatus:
    """The answer by the session's own time; field by field, for there are hundreds of thousands."""
    return StimStatus(
        s.t_ns - origin_ns, s.channel, s.counter, s.on, s.current_ma, s.pulse_width_us, s.frequency_hz, s.pulses,
        s.charge_uc, s.fault,
    )  # fmt: skip


def _close(
    ledger: DoseLedger, feet: Mapping[str, list[int]], foot: str, start_ns: int, end_ns: int, origin_ns: int
) -> None:
    for number in feet[foot]:
        ledger.electrodes[number].close_step(start_ns - origin_ns, end_ns - origin_ns)


def _row(dose: ElectrodeDose, names: Mapping[int, str]) -> DoseRow:
    minutes = dose.by_minute_uc
    return DoseRow(
        channel=dose.channel,
        name=names.get(dose.channel, f"channel {dose.channel}"),
        pulses=dose.pulses,
        steps=len(dose.steps_uc),
        median_step_uc=median(dose.steps_uc) if dose.steps_uc else 0.0,
        greatest_step_uc=max(dose.steps_uc, default=0.0),
        by_minute_mc=tuple(1e-3 * minutes.get(minute, 0.0) for minute in range(max(minutes, default=-1) + 1)),
        session_mc=1e-3 * dose.session_uc,
        estimated=dose.estimated,
    )


def tuning_lines(tuning: Sequence[TuningRow], dose: Sequence[DoseRow]) -> list[str]:
    """Charge and tuning in two lines of each channel that tuned itself, for the table of a session."""
    lines = []
    for row in dose:
        own = [each for each in tuning if each.channel == row.channel]
        if not own:
            continue
        counted = " (estimated)" if row.estimated else ""
        lines.append(
            f"{row.name}: {row.median_step_uc:.0f} µC a step (median; most {row.greatest_step_uc:.0f}), "
            f"{max(row.by_minute_mc, default=0.0):.2f} mC in the fullest minute, {row.session_mc:.2f} in all{counted}"
        )
        changes = [each for each in own if each.kind in ("change", "roll_back")]
        skipped = sum(each.kind == "skip" for each in own)
        last = f"; last at {changes[-1].time_s:.0f} s: {changes[-1].text}" if changes else ""
        lines.append(f"{row.name}: tuning made {len(changes)} changes, skipped {skipped} strides{last}")
    return lines
