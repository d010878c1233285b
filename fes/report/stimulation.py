"""Phases and stimulation of a session: when each foot was in which phase, what was commanded and delivered on each
channel, the charge, and what the tuning did.

A burst is a stretch in which a channel was commanded on without a break.
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from pydantic import ValidationError

from fes.config import PHASE_ORDER, Session
from fes.config import Phase as PhaseName
from fes.estimation.sensor_choice import phase_sensors
from fes.signals import NS_PER_S, BoolArray, FloatArray, IntArray, OperatorAct, StimCommand, StimStatus, StrideResult
from fes.stimulation.dose import DoseLedger, ElectrodeDose
from fes.stimulation.onset import FALSE_NS
from fes.stimulation.plan import BY_HAND_NS, LATEST_NS
from fes.stimulation.tuning.settings import OWN
from fes.walk_record import Note, WalkRecord
from statemachine.phases import Phase, PhaseChange

DEVICE_TAIL_NS = 100_000_000  # longest validity (60 ms) plus two command periods for the answer to come back
WIDTH_STEP_US = 2.0
SOURCE: Final = "tuning"
_CHANNEL: Final = re.compile(r"channel (\d+): ")
HARDLY: Final = 0.01  # mA, µs: less is rounding
HARDLY_S: Final = 1e-6  # likewise
STOPPED: Final = "tuning has stopped"  # as fes.stimulation.tuning.tuner words it where the foot does not answer
STILL: Final = "still going back"
SKIPPED: Final = " skipped: "  # the stride taught nothing
_KINDS: Final = (  # the first of which a phrase fits; any other text is a change
    ("change", ("; even until this speed is known: ", "; the session's own settings there: ")),
    ("hint", ("have taught nothing",)),
    ("skip", (SKIPPED,)),
    ("fault", ("something has changed that stimulation did not",)),
    ("identified", ("identified: ",)),
    ("suggestion", ("suggested: ",)),
    ("roll_back", ("rolled back", "back to the session's settings", STILL, STOPPED)),
    ("frozen", ("tuning is frozen", "tuning goes on")),
    ("hint", ("response per charge", "is not reached ", " and is left out: ")),
)


@dataclass(frozen=True)
class PhaseTimeline:
    """The phases of one foot over a session.

    ``start_ns`` (M,) and ``end_ns`` (M,) bound the intervals without gaps, ``phase`` (M,) holds the numbers of
    :class:`statemachine.phases.Phase`; ``change_ns`` (C,) and ``transition`` (C,) are the changes themselves.
    """

    foot: str
    start_ns: IntArray
    end_ns: IntArray
    phase: IntArray
    change_ns: IntArray
    transition: IntArray

    def time_in(self, phases: Sequence[Phase], start_ns: IntArray, end_ns: IntArray) -> FloatArray:
        """Seconds of each span [start, end) (N,) that the foot spent in one of ``phases``."""
        if self.start_ns.size == 0:
            return np.zeros(np.shape(start_ns))
        origin = int(self.start_ns[0])
        inside = np.isin(self.phase, [int(phase) for phase in phases])
        spent_s = np.concatenate([[0.0], np.cumsum(np.where(inside, self.end_ns - self.start_ns, 0))]) / NS_PER_S
        border_s = np.append(self.start_ns - origin, self.end_ns[-1] - origin) / NS_PER_S
        until = np.interp((end_ns - origin) / NS_PER_S, border_s, spent_s)
        return np.asarray(until - np.interp((start_ns - origin) / NS_PER_S, border_s, spent_s), dtype=np.float64)


def build_timeline(changes: Iterable[PhaseChange], foot: str, start_ns: int, end_ns: int) -> PhaseTimeline:
    """Lay the phase changes of ``foot`` end to end between the session's first and last instant.

    Before its first change a foot is in that change's source phase (stance when there is none at all).
    """
    own = sorted((change for change in changes if change.foot == foot), key=lambda change: change.t_ns)
    change_ns = np.array([change.t_ns for change in own], dtype=np.int64)
    first = own[0].source if own else Phase.STANCE
    starts = np.concatenate([np.array([min([start_ns, *change_ns[:1].tolist()])], dtype=np.int64), change_ns])
    last = max(end_ns, int(starts[-1]))
    phase = np.array([int(first), *(int(change.destination) for change in own)], dtype=np.int64)
    transition = np.array([int(change.transition) for change in own], dtype=np.int64)
    return PhaseTimeline(foot, starts, np.append(starts[1:], last), phase, change_ns, transition)


def phases_between(start: PhaseName, stop: PhaseName) -> tuple[Phase, ...]:
    """The phases from ``start`` through ``stop``, both included, in the order in which a stride passes them."""
    at = PHASE_ORDER.index(start)
    count = (PHASE_ORDER.index(stop) - at) % len(PHASE_ORDER) + 1
    return tuple(Phase((at + step) % len(PHASE_ORDER)) for step in range(count))


@dataclass(frozen=True)
class ChannelInfo:
    """Who a channel is: ``foot`` is "" and ``phases`` empty when the session's settings do not name it.

    ``phase_sensor``: the sensor whose phases time it, under whose name phases and strides are logged.
    """

    number: int
    name: str
    foot: str
    phase_sensor: str
    muscle: str
    start_phase: str
    stop_phase: str
    phases: tuple[Phase, ...]
    fall_s: float = 0.0
    foreseen: bool = False  # a burst may begin before the first of these phases


@dataclass(frozen=True)
class CommandColumns:
    """Commands of one channel in order of time, each (N,); ``until_ns`` is how long a command held."""

    t_ns: IntArray
    until_ns: IntArray
    on: BoolArray
    current_ma: FloatArray
    pulse_width_us: FloatArray
    frequency_hz: FloatArray

    def current_at(self, t_ns: IntArray) -> FloatArray:
        """Commanded current (N,) in mA in force at each time; 0 where off or lapsed."""
        return self._in_force(t_ns, self.current_ma)

    def charge_per_phase_at(self, t_ns: IntArray) -> FloatArray:
        """Commanded charge of one phase (N,) in µC in force at each time; 0 where off or lapsed."""
        return self._in_force(t_ns, 1e-3 * self.current_ma * self.pulse_width_us)

    @property
    def widths_vary(self) -> bool:
        """Whether the commands that are on differ in pulse width by more than a step of any device."""
        widths_us = self.pulse_width_us[self.on]
        return bool(widths_us.size and np.ptp(widths_us) > WIDTH_STEP_US)

    def _in_force(self, t_ns: IntArray, values: FloatArray) -> FloatArray:
        if self.t_ns.size == 0:
            return np.zeros(t_ns.shape)
        at = np.searchsorted(self.t_ns, t_ns, side="right") - 1
        in_force = (at >= 0) & (t_ns < self.until_ns[at]) & self.on[at]
        return np.where(in_force, values[at], 0.0)


@dataclass(frozen=True)
class StatusColumns:
    """What the stimulator said of one channel in order of time, each (N,)."""

    t_ns: IntArray
    on: BoolArray
    pulses: IntArray
    charge_uc: FloatArray


def session_settings(header: dict[str, Any]) -> Session | None:
    """The settings kept in a log's header, or None where they are absent or from another version."""
    try:
        return Session.model_validate(header.get("session"))
    except ValidationError:
        return None


def phase_sensors_of(header: Mapping[str, Any]) -> dict[str, str]:
    """By foot, the sensor that told its phases: a shank's where the log's calibrations hold none of the foot."""
    calibrated = header.get("calibration")
    return phase_sensors(calibrated) if isinstance(calibrated, Mapping) else {}


def channel_infos(
    settings: Session | None, commands: Sequence[StimCommand], sensor_of: Mapping[str, str]
) -> tuple[ChannelInfo, ...]:
    """All channels that the settings name or a command mentions, by number; ``sensor_of`` a foot tells its phases."""
    known = {}
    for c in settings.channels if settings else ():
        phases, sensor = phases_between(c.start_phase, c.stop_phase), sensor_of.get(c.foot, c.foot)
        known[c.number] = ChannelInfo(
            c.number, c.name, c.foot, sensor, c.muscle, c.start_phase, c.stop_phase, phases, c.fall_s,
            c.onset == "predicted",
        )  # fmt: skip
    for number in {command.channel for command in commands} - set(known):
        known[number] = ChannelInfo(number, f"channel {number}", "", "", "", "", "", ())
    return tuple(known[number] for number in sorted(known))


def _column(rows: Sequence[StimCommand | StimStatus], name: str, kind: type) -> npt.NDArray[Any]:
    return np.array([getattr(row, name) for row in rows], dtype=kind)


def command_columns(commands: Sequence[StimCommand], channel: int) -> CommandColumns:
    """Pick one channel's commands; a command holds until the next one or until its validity has run out."""
    own = sorted((command for command in commands if command.channel == channel), key=lambda command: command.t_ns)
    t_ns = _column(own, "t_ns", np.int64)
    until_ns = t_ns + _column(own, "validity_ms", np.int64) * 1_000_000
    until_ns[:-1] = np.minimum(until_ns[:-1], t_ns[1:])
    sizes = (_column(own, name, np.float64) for name in ("current_ma", "pulse_width_us", "frequency_hz"))
    return CommandColumns(t_ns, until_ns, _column(own, "on", np.bool_), *sizes)


def status_columns(statuses: Sequence[StimStatus], channel: int) -> StatusColumns:
    """Pick one channel's answers; charge is counted from pulses where the device counts only those."""
    own = sorted((status for status in statuses if status.channel == channel), key=lambda status: status.t_ns)
    charge_uc = [s.charge_uc or s.pulses * s.current_ma * s.pulse_width_us * 1e-3 for s in own]
    counts = _column(own, "t_ns", np.int64), _column(own, "on", np.bool_), _column(own, "pulses", np.int64)
    return StatusColumns(*counts, np.array(charge_uc, dtype=np.float64))


@dataclass(frozen=True)
class Burst:
    """One stretch of stimulation on one channel.

    ``charge_uc`` is the charge of one phase summed over all pulses, counted by the device where ``counted``
    and otherwise worked out from the commands (current · width · frequency · time). ``outside_s`` is the time
    in a phase in which the channel must be off, NaN when the channel's foot is not known. One that a person asked for
    is ``by_hand``, whatever its foot does; it is outside only when it outlasts what was asked for. Likewise one that
    began ``early``, as was foreseen, where that lasted longer than a false start may.
    """

    channel: int
    t_start_ns: int
    t_end_ns: int
    peak_current_ma: float
    pulses: float
    charge_uc: float
    counted: bool
    outside_s: float
    by_hand: bool = False
    early: bool = False

    @property
    def duration_s(self) -> float:
        """How long the burst lasted, seconds."""
        return (self.t_end_ns - self.t_start_ns) / NS_PER_S


def find_bursts(
    info: ChannelInfo,
    commands: CommandColumns,
    statuses: StatusColumns,
    timeline: PhaseTimeline | None,
    acts: Sequence[OperatorAct] = (),
) -> tuple[Burst, ...]:
    """Cut one channel's commands into bursts; a command that lapsed before the next one ends a burst too.

    ``acts`` are those of people, of which some asked for bursts.
    """
    on = commands.on
    if not on.any():
        return ()
    follows = np.zeros(on.size, dtype=np.bool_)
    follows[1:] = on[:-1] & (commands.until_ns[:-1] >= commands.t_ns[1:])
    first = np.flatnonzero(on & ~follows)
    number = np.cumsum(on & ~follows)[on] - 1
    last = np.append(np.flatnonzero(on)[np.flatnonzero(np.diff(number))], np.flatnonzero(on)[-1])
    start_ns, end_ns = commands.t_ns[first], commands.until_ns[last]

    peak_ma = np.zeros(first.size)
    np.maximum.at(peak_ma, number, commands.current_ma[on])
    pulse_share = (commands.frequency_hz * ((commands.until_ns - commands.t_ns) / NS_PER_S))[on]
    charge_share = pulse_share * (commands.current_ma * commands.pulse_width_us)[on] * 1e-3
    pulses = np.bincount(number, pulse_share, first.size)
    charge_uc = np.bincount(number, charge_share, first.size)
    counted = statuses.pulses.size > 0 and bool(statuses.pulses.any() or statuses.charge_uc.any())
    if counted:
        # An answer speaks of the time before it, so it may come just after the burst that it counts.
        owner = np.searchsorted(start_ns, statuses.t_ns, side="right") - 1
        ok = owner >= 0
        ok[ok] = statuses.t_ns[ok] <= end_ns[owner[ok]] + DEVICE_TAIL_NS
        pulses = np.bincount(owner[ok], statuses.pulses[ok].astype(np.float64), first.size)
        charge_uc = np.bincount(owner[ok], statuses.charge_uc[ok], first.size)

    judged_ns, by_hand = start_ns.copy(), np.zeros(first.size, dtype=np.bool_)
    for act in acts:
        at = int(np.searchsorted(start_ns, act.t_ns))
        under_way = at > 0 and end_ns[at - 1] > act.t_ns
        if act.action not in BY_HAND_NS or act.value != info.number or under_way or at == first.size:
            continue
        if start_ns[at] - act.t_ns <= LATEST_NS:
            by_hand[at] = True
            asked_ns = BY_HAND_NS[act.action] + round(info.fall_s * NS_PER_S) + DEVICE_TAIL_NS
            judged_ns[at] = min(start_ns[at] + asked_ns, end_ns[at])
    outside_s, early = np.full(first.size, np.nan), np.zeros(first.size, dtype=np.bool_)
    if timeline is not None and info.phases:
        if info.foreseen and timeline.start_ns.size:
            # early is what begins in the phase before, until the foot leaves that one or the start proves false
            span = np.maximum(np.searchsorted(timeline.start_ns, start_ns, side="right") - 1, 0)
            may_ns = np.minimum(np.minimum(start_ns + FALSE_NS, end_ns), timeline.end_ns[span])
            before = timeline.phase[span] == (int(info.phases[0]) - 1) % len(PHASE_ORDER)
            early = ~by_hand & before & ((may_ns - start_ns) / NS_PER_S > HARDLY_S)
            judged_ns = np.where(early, may_ns, judged_ns)
        outside_s = (end_ns - judged_ns) / NS_PER_S - timeline.time_in(info.phases, judged_ns, end_ns)
        outside_s = np.maximum(outside_s, 0.0).round(9)
    columns = (values.tolist() for values in (start_ns, end_ns, peak_ma, pulses, charge_uc, outside_s, by_hand, early))
    return tuple(
        Burst(info.number, start, end, peak, count, charge, counted, outside, asked, soon)
        for start, end, peak, count, charge, outside, asked, soon in zip(*columns, strict=True)
    )


def answers_without_command(commands: CommandColumns, statuses: StatusColumns) -> int:
    """How many answers say that the device was on when no command had it on for longer than a command may hold."""
    answered_on = statuses.t_ns[statuses.on]
    if answered_on.size == 0:
        return 0
    on_from, on_until = commands.t_ns[commands.on], commands.until_ns[commands.on]
    at = np.searchsorted(on_from, answered_on, side="right") - 1
    stray = at < 0
    stray[~stray] = answered_on[~stray] > on_until[at[~stray]] + DEVICE_TAIL_NS
    return int(stray.sum())


@dataclass(frozen=True)
class TuningRow:
    """One thing the tuning said; ``kind``: change, suggestion, roll_back, fault, frozen, hint, identified, skip."""

    time_s: float
    channel: int
    kind: str
    text: str

    @property
    def changes(self) -> bool:
        """Whether the next burst's settings changed with it."""
        return self.kind in ("change", "roll_back") or (self.kind == "fault" and "→" in self.text)


@dataclass(frozen=True)
class ReachRow:
    """How far one channel that tunes itself was commanded, and its tuning's upper bounds.

    ``spent_from_s``: when what the method moves was first as strong as its bound allows; NaN for never.
    """

    channel: int
    current_ma: float
    pulse_width_us: float
    most_ma: float
    most_us: float
    spent_from_s: float

    @property
    def within(self) -> bool:
        """Whether nothing was commanded beyond the bounds."""
        return self.current_ma <= self.most_ma + HARDLY and self.pulse_width_us <= self.most_us + HARDLY

    @property
    def text(self) -> str:
        """In words."""
        where = "never beyond the bounds of its tuning" if self.within else "BEYOND the bounds of its tuning"
        text = (
            f"at most {self.current_ma:.1f} mA and {self.pulse_width_us:.0f} µs, {where} ({self.most_ma:g} mA, "
            f"{self.most_us:g} µs)"
        )
        return text + (f"; at its upper bound first at {self.spent_from_s:.1f} s" if self.spent_from_s >= 0.0 else "")


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
            kind = next((kind for kind, phrases in _KINDS if any(each in text for each in phrases)), "change")
            rows.append(TuningRow((note.t_ns - origin_ns) / NS_PER_S, int(named[1]) if named else -1, kind, text))
    return tuple(rows)


def reach_rows(
    settings: Session | None, commands: Mapping[int, CommandColumns], origin_ns: int
) -> tuple[ReachRow, ...]:
    """Of every channel that tunes itself and was commanded on."""
    rows = []
    for channel in settings.channels if settings else ():
        tuned, own = channel.tuning, commands.get(channel.number)
        if tuned is None or tuned.mode == "off" or tuned.bounds is None or own is None or not own.on.any():
            continue
        most_ma, most_us = tuned.bounds.current_ma.high, tuned.bounds.pulse_width_us.high
        moved, most = (own.current_ma, most_ma) if tuned.method == "run_to_run" else (own.pulse_width_us, most_us)
        at_bound = own.t_ns[own.on & (moved >= OWN.spent * most)]
        spent_from_s = (int(at_bound[0]) - origin_ns) / NS_PER_S if at_bound.size else float("nan")
        peak_ma, peak_us = (float(values[own.on].max()) for values in (own.current_ma, own.pulse_width_us))
        rows.append(ReachRow(channel.number, peak_ma, peak_us, most_ma, most_us, spent_from_s))
    return tuple(rows)


def dose_rows(record: WalkRecord, settings: Session | None, origin_ns: int) -> tuple[DoseRow, ...]:
    """The ledger of every channel that was given any charge, worked out as the controller does while it runs."""
    channels = settings.channels if settings else ()
    names = {channel.number: channel.name for channel in channels}
    feet: dict[str, list[int]] = {}
    sensor_of = phase_sensors_of(record.header)
    for channel in channels:
        feet.setdefault(sensor_of.get(channel.foot, channel.foot), []).append(channel.number)
    ledger = DoseLedger(names)
    strides = sorted((stride for stride in record.strides if stride.foot in feet), key=lambda stride: stride.t_end_ns)

    def close(stride: StrideResult) -> None:
        for number in feet[stride.foot]:
            ledger.electrodes[number].close_step(stride.t_start_ns - origin_ns, stride.t_end_ns - origin_ns)

    closed = 0
    for s in sorted(record.statuses, key=lambda status: status.t_ns):
        while closed < len(strides) and strides[closed].t_end_ns < s.t_ns:
            close(strides[closed])
            closed += 1
        # by the session's own time; field by field, for there are hundreds of thousands
        sizes = s.current_ma, s.pulse_width_us, s.frequency_hz, s.pulses, s.charge_uc
        ledger.book(StimStatus(s.t_ns - origin_ns, s.channel, s.counter, s.on, *sizes, s.fault))
    for stride in strides[closed:]:
        close(stride)
    return tuple(_row(dose, names) for _, dose in sorted(ledger.electrodes.items()) if dose.session_uc > 0.0)


def _row(dose: ElectrodeDose, names: Mapping[int, str]) -> DoseRow:
    minutes, steps = dose.by_minute_uc, dose.steps_uc
    name = names.get(dose.channel, f"channel {dose.channel}")
    usual, most = median(steps) if steps else 0.0, max(steps, default=0.0)
    by_minute_mc = tuple(1e-3 * minutes.get(minute, 0.0) for minute in range(max(minutes, default=-1) + 1))
    known = by_minute_mc, 1e-3 * dose.session_uc, dose.estimated
    return DoseRow(dose.channel, name, dose.pulses, len(steps), usual, most, *known)


def tuning_lines(tuning: Sequence[TuningRow], dose: Sequence[DoseRow]) -> list[str]:
    """Charge and tuning in two lines of each channel that tuned itself, for the table of a session."""
    lines = []
    for row in dose:
        own = [each for each in tuning if each.channel == row.channel]
        if not own:
            continue
        steps = f"{row.median_step_uc:.0f} µC a step (median; most {row.greatest_step_uc:.0f})"
        times = f"{max(row.by_minute_mc, default=0.0):.2f} mC in the fullest minute, {row.session_mc:.2f} in all"
        lines.append(f"{row.name}: {steps}, {times}{' (estimated)' if row.estimated else ''}")
        changes = [each for each in own if each.changes]
        skipped = sum(SKIPPED in each.text for each in own)
        last = f"; last at {changes[-1].time_s:.0f} s: {changes[-1].text}" if changes else ""
        lines.append(f"{row.name}: tuning made {len(changes)} changes, skipped {skipped} strides{last}")
    return lines
