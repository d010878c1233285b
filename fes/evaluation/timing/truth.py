"""What should have happened, from anything that knows: a simulation's truth, measured events, switches, force, a log.

Transitions by events: T1 heel off, T2 foot off, T3 initial contact, T4 foot flat; T5 and T6 by name only. The edges of
a channel that nobody measured are those that the plan itself makes of the true phases.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import numpy as np

from fes.config import Session
from fes.evaluation.reference.alignment import lag_by_trains
from fes.evaluation.reference.read import (
    EVENT_NAMES,
    TIME,
    companion_references,
    read_c3d,
    read_csv,
    switch_events,
    without_bounces,
)
from fes.evaluation.reference.table import ReferenceError, ReferenceEvent, Table, foot_of, read_columns
from fes.evaluation.timing.marks import (
    EDGES,
    Mark,
    by_foot,
    foot_of_sensor,
    marks_of_commands,
    marks_of_phases,
    marks_of_truth,
)
from fes.session_log import SessionRecord, read_session
from fes.signals import NS_PER_S, FloatArray
from fes.simulation.truth import load_truth
from fes.stimulation.plan import StimulationPlan
from fes.stimulation.walking import PAUSE_S
from statemachine.phases import Phase, PhaseChange, Transition

CONTACT_N: Final = 20.0  # a foot is on the plate above it; the usual threshold of gait laboratories
EDGE_S: Final = 1.0  # at a recording's ends a measured event may be cut off: not missed
PLAN_STEP_NS: Final = 1_000_000
MOST_LAG_S: Final = 10.0
IN_STEP_S: Final = 0.12  # a smaller lag may be the detection's own delay
_GAIT: Final = ("T1", "T2", "T3", "T4", "T5", "T6")
_OF_REFERENCE: Final = {"FO": "T2", "IC": "T3"}
_NAMES: Final = {
    "T1": ("t1", "heeloff", "heelrise", "ho", "preswing"),
    "T2": ("t2", "swing", *EVENT_NAMES["FO"]),
    "T3": ("t3", "loadingresponse", *EVENT_NAMES["IC"]),
    "T4": ("t4", "footflat", "ff", "stance"),
    "T5": ("t5", "heelputback"),
    "T6": ("t6", "rest"),
    "on": ("on", "stimon", "burston", "start"),
    "off": ("off", "stimoff", "burstoff", "stop"),
}
_HEEL: Final = re.compile(r"heel|cal|hs$")
_FOREFOOT: Final = re.compile(r"toe|ball|meta|mt\d?$|fore|hallux")
_FORCE: Final = re.compile(r"(fz|force|grf|_n$)")
_ROUND: Final = ((Phase.STANCE, "T1"), (Phase.PRE_SWING, "T2"), (Phase.SWING, "T3"), (Phase.LOADING_RESPONSE, "T4"))


class TimingError(ValueError):
    """There is nothing to compare with, or it cannot be compared; the text says why and what to do."""


@dataclass(frozen=True)
class ExpectedMarks:
    """What should have happened: ``source`` for people, its marks, and which of them may lack a partner.

    ``kinds``: what this truth can tell of, as (who, what); other marks are not judged by it. ``physical``: measured or
    simulated, not what a program once decided. ``span_ns``: from when to when it looked, None for all the time.
    """

    source: str
    marks: tuple[Mark, ...]
    kinds: frozenset[tuple[str, str]]
    optional: frozenset[Mark] = frozenset()
    physical: bool = True
    span_ns: tuple[int, int] | None = None
    notes: tuple[str, ...] = field(default=())

    def judged(self, found: Iterable[Mark]) -> list[Mark]:
        """Of what was found, what this truth can tell of."""
        begin, end = self.span_ns or (-(2**63), 2**63)
        return [mark for mark in found if (mark.who, mark.what) in self.kinds and begin <= mark.t_ns <= end]

    def shifted(self, lag_s: float) -> ExpectedMarks:
        """The same on a clock that is ``lag_s`` ahead."""
        by = round(lag_s * NS_PER_S)
        span = (self.span_ns[0] + by, self.span_ns[1] + by) if self.span_ns else None
        moved = {mark: replace(mark, t_ns=mark.t_ns + by) for mark in self.marks}
        optional = frozenset(moved[mark] for mark in self.optional)
        return replace(self, marks=tuple(moved.values()), optional=optional, span_ns=span)


def companion_truth(recording: Path) -> Path | None:
    """The truth that lies beside a recording under its name; None where there is none."""
    simulated = recording.with_name(recording.name.split(".", 1)[0] + ".truth.parquet")
    if simulated.is_file():
        return simulated
    wanted = (".events.csv", ".switch.csv", ".mat.csv", ".c3d")
    return next((path for path in companion_references(recording) if path.name.endswith(wanted)), None)


def read_truth(
    path: Path, session: Session, sensors: Iterable[str], *, plates: Mapping[int, str] | None = None
) -> ExpectedMarks:
    """What should have happened at these sensors, and at the session's channels of their feet.

    ``path``: a session log; a simulation's recording or its ``.truth.parquet``; C3D; or CSV of events, footfalls, foot
    switches or force. ``plates``: force plate of a C3D, counted from 1 → foot.

    TimingError, ReferenceError, SessionLogError: it cannot be used; says why.
    """
    feet = {foot_of_sensor(sensor) for sensor in sensors}
    if path.is_dir() or not path.is_file():
        raise TimingError(f"{path}: {'is a folder' if path.is_dir() else 'is not there'}. Name a truth's file.")
    if path.suffix == ".feslog":
        return expected_of_log(read_session(path), str(path))
    if path.suffix == ".c3d":
        return _measured(path, _c3d_marks(path, plates or {}), session, feet)
    name = path.name.split(".", 1)[0]
    if path.suffix == ".parquet" or (path.suffix == ".csv" and path.with_name(f"{name}.truth.parquet").is_file()):
        return _simulated(path, session, feet)
    if path.suffix not in (".csv", ".tsv", ".txt"):
        raise TimingError(
            f"{path}: is no truth known here. Name a .truth.parquet of a simulation, a .csv of events, foot switches "
            f"or force (t and left…, right…), a .c3d, or a session log (.feslog)."
        )
    return _measured(path, _csv_marks(path, feet), session, feet)


def expected_of_log(record: SessionRecord, source: str) -> ExpectedMarks:
    """What a session did: its transitions and the edges of its channels. Raises TimingError: it did nothing."""
    marks = by_foot((*marks_of_phases(record.phases), *marks_of_commands(record.commands)))
    if not marks:
        raise TimingError(f"{source}: this session has neither a transition nor a burst; name one with a walk in it.")
    who = {mark.who for mark in marks}
    kinds = {(each, what) for each in who for what in (EDGES if each.startswith("channel") else _GAIT)}
    return ExpectedMarks(source, marks, frozenset(kinds), physical=False)


def _simulated(path: Path, session: Session, feet: set[str]) -> ExpectedMarks:
    try:
        truth = load_truth(path)
    except FileNotFoundError as error:
        missing = Path(str(error).split(": ")[0]).name
        raise TimingError(
            f"{path}: is a recording without truth beside it ({missing} is not there). Name the file that knows: a "
            f".csv of events, switches or force, a .c3d, a session log (.feslog), or a .truth.parquet."
        ) from error
    except (ValueError, KeyError, OSError) as error:
        raise TimingError(f"{path}: its truth cannot be read: {error}") from error
    marks = marks_of_truth(truth, feet)
    if not marks:
        known = ", ".join(sorted(truth.feet)) or "no foot"
        raise TimingError(f"{path}: its truth has no step of {_and(feet)}; it knows {known}.")
    walking = {round(s.t_pre_swing_s * NS_PER_S) for s in truth.strides if s.walking}
    lifted = {mark for mark in marks if mark.what == "T1" and mark.t_ns not in walking}
    kinds = frozenset((foot, what) for foot in {mark.who for mark in marks} for what in _GAIT)
    expected = ExpectedMarks(f"the truth of {path.name}", tuple(marks), kinds)
    return _with_edges(expected, session, lifted)


def _csv_marks(path: Path, feet: set[str]) -> list[Mark]:
    """Marks of a CSV: of events by name, of switches and force by what they show, of footfalls by IC and FO."""
    table = read_columns(path)
    only = next(iter(feet)) if len(feet) == 1 else None
    if "event" in table.columns:
        return _events_by_name(table, only)
    time = table.first_of(*TIME)
    sided = [name for name in table.columns if foot_of(name.split("_")[0]) and not name.endswith(("_x", "_y", "_z"))]
    if time is not None and sided:
        t_s = table.numbers(time)
        if len(t_s) < 3 or not np.isfinite(t_s).all() or (np.diff(t_s) <= 0.0).any():
            raise TimingError(f"{path}: its times must be numbers that increase, three at least.")
        by_foot: dict[str, dict[str, FloatArray]] = {}
        for name in sided:
            by_foot.setdefault(foot_of(name.split("_")[0]) or "", {})[name] = table.numbers(name)
        return [mark for foot, signals in by_foot.items() for mark in marks_of_channels(str(path), foot, t_s, signals)]
    try:
        return _marks_of_events(read_csv(path, foot=only).events)
    except ReferenceError as error:
        if "no known kind" not in str(error):
            raise
        raise TimingError(
            f"{path}: its columns ({', '.join(table.columns)}) tell of no events. Needed are foot, event, t; channel, "
            f"event (on, off), t; t and left…, right… (foot switches, or force in N); or foot, t_contact, t_off."
        ) from error


def _events_by_name(table: Table, only: str | None) -> list[Mark]:
    time, channel = table.first_of(*TIME), table.first_of("channel")
    if time is None:
        raise TimingError(f"{table.path}: events need a column of times: t_s, or t_ms.")
    t_s, marks = table.numbers(time), []
    whose = table.columns.get(table.first_of("foot", "side", "leg", "limb") or "", [only or ""] * table.rows)
    for row, text in enumerate(table.columns["event"]):
        plain = re.sub(r"[^a-z0-9]", "", text.lower())
        number = table.columns[channel][row] if channel else ""
        known = EDGES if number else _GAIT
        what = next((what for what in known if plain in _NAMES[what]), None)
        if what is None:
            wanted = "on or off" if number else "IC, FO, heel off, foot flat, T1 … T6"
            raise TimingError(f"{table.line(row)}: {text!r} is no event known here; {wanted} are.")
        if not math.isfinite(t_s[row]):
            raise TimingError(f"{table.line(row)}: the time is empty.")
        foot = foot_of(whose[row])
        if not number and foot is None:
            raise TimingError(f"{table.line(row)}: {whose[row]!r} is no foot; left or right is, in a column 'foot'.")
        who = f"channel {number.lower().removeprefix('channel').strip()}" if number else str(foot)
        marks.append(Mark(round(float(t_s[row]) * NS_PER_S), who, what))
    return marks


def marks_of_channels(source: str, foot: str, t_s: FloatArray, signals: Mapping[str, FloatArray]) -> list[Mark]:
    """Marks of one foot from channels by name: foot switches (two levels, or pressure), or vertical force in N.

    Times (N,) increase. Contact is where the first switch closes or the force passes 20 N, foot off where the last
    opens. Switches at heel and forefoot show heel off (the heel opens, the forefoot stays) and foot flat as well.

    ReferenceError: none of the channels ever changes.
    """
    force = [values for name, values in signals.items() if _FORCE.search(name)]
    if force:
        return [Mark(round(t * NS_PER_S), foot, what) for t, what in _force_events(source, foot, t_s, force)]
    parts: list[list[Mark]] = []
    for pattern in (_HEEL, _FOREFOOT):
        own = [values for name, values in signals.items() if pattern.search(name.partition("_")[2])]
        parts.append(_marks_of_events(switch_events(source, foot, t_s, own)) if own else [])
    marks = _marks_of_events(switch_events(source, foot, t_s, list(signals.values())))
    if not all(parts):
        return marks
    heel, fore = ({what: sorted(m.t_ns for m in part if m.what == what) for what in ("T2", "T3")} for part in parts)
    contacts = [mark.t_ns for mark in marks if mark.what == "T3"]
    for begin, after in pairwise([*contacts, 2**62]):
        end = next((mark.t_ns for mark in marks if mark.what == "T2" and begin < mark.t_ns < after), None)
        lifts = [t for t in heel["T2"] if begin < t < after]
        closed = [next((t for t in part["T3"] if begin <= t < after), None) for part in (heel, fore)]
        if lifts and end is not None and lifts[-1] < end:
            marks.append(Mark(lifts[-1], foot, "T1"))
        if None not in closed and (not lifts or max(t for t in closed if t is not None) < lifts[-1]):
            marks.append(Mark(max(t for t in closed if t is not None), foot, "T4"))
    return marks


def _force_events(source: str, foot: str, t_s: FloatArray, forces: list[FloatArray]) -> list[tuple[float, str]]:
    """Where the sum of the forces' sizes passes 20 N upward (T3) and downward (T2), between the samples."""
    size = np.abs(np.nan_to_num(np.array(forces))).sum(axis=0)
    down = size >= CONTACT_N
    at = np.flatnonzero(np.diff(down.astype(np.int8)))
    if not len(at):
        most = float(size.max()) if len(size) else 0.0
        raise ReferenceError(
            f"{source}: the force below the {foot.replace('_', ' ')} never passes {CONTACT_N:g} N (at most "
            f"{most:.0f}); is it in N?"
        )
    share = (CONTACT_N - size[at]) / (size[at + 1] - size[at])
    times = t_s[at] + share * (t_s[at + 1] - t_s[at])
    return [(float(times[k]), "T3" if down[at[k] + 1] else "T2") for k in without_bounces(times)]


def _c3d_marks(path: Path, plates: Mapping[int, str]) -> list[Mark]:
    """Events of a C3D file; without any its force plates, or analog channels named after a foot."""
    try:
        return _marks_of_events(read_c3d(path).events)
    except ReferenceError as error:
        if "holds neither events" not in str(error):
            raise
    import ezc3d

    data: Mapping[str, Any] = ezc3d.c3d(str(path), extract_forceplat_data=bool(plates))
    analog = data["parameters"]["ANALOG"]
    rate_hz = float(data["header"]["analogs"]["frame_rate"])
    values = np.asarray(data["data"]["analogs"], np.float64)
    values = values.reshape(values.shape[1], -1)
    begin_s = int(data["header"]["points"]["first_frame"]) / float(data["header"]["points"]["frame_rate"] or rate_hz)
    labels = [re.sub(r"[\s.-]+", "_", str(label).strip().lower()) for label in analog["LABELS"]["value"]]
    by_foot: dict[str, dict[str, FloatArray]] = {}
    for number, foot in plates.items():
        platforms = data["data"]["platform"]
        if not 1 <= number <= len(platforms):
            raise TimingError(f"{path}: has {len(platforms)} force plates, no number {number}.")
        by_foot.setdefault(foot, {})[f"plate_{number}_fz"] = np.asarray(platforms[number - 1]["force"], np.float64)[2]
    if not plates:
        for label, signal in zip(labels, values, strict=False):
            if whose := foot_of(label.split("_")[0]):
                by_foot.setdefault(whose, {})[label] = signal
    if not by_foot:
        raise TimingError(
            f"{path}: holds no events, and none of its analog channels ({', '.join(labels[:20]) or 'none'}) is named "
            f"after a foot (left_heel, right_fz). Say which plate is whose: --plate 1=left."
        )
    marks = []
    for foot, signals in by_foot.items():
        t_s = begin_s + np.arange(len(next(iter(signals.values())))) / rate_hz
        marks += marks_of_channels(str(path), foot, t_s, signals)
    return marks


def _marks_of_events(events: Iterable[ReferenceEvent]) -> list[Mark]:
    return [Mark(round(e.t_s * NS_PER_S), e.foot, _OF_REFERENCE[e.what]) for e in events]


def _measured(path: Path, marks: Sequence[Mark], session: Session, feet: set[str]) -> ExpectedMarks:
    """Events that somebody measured; kinds that do not occur are not judged, nor what lies outside their time."""
    own = sorted(mark for mark in marks if mark.who in feet or mark.who.startswith("channel"))
    if not own:
        others = _and({mark.who for mark in marks}) if marks else "none"
        raise TimingError(f"{path}: has no event of {_and(feet)}, of which the recording tells; its events: {others}.")
    kinds = frozenset((mark.who, mark.what) for mark in own)
    span = own[0].t_ns - round(0.5 * NS_PER_S), own[-1].t_ns + round(0.5 * NS_PER_S)
    expected = ExpectedMarks(path.name, tuple(own), kinds, span_ns=span)
    return expected if any(mark.who.startswith("channel") for mark in own) else _with_edges(expected, session, set())


def _and(names: Iterable[str]) -> str:
    return " and ".join(f"the {name.replace('_', ' ')}" for name in sorted(names))


def _with_edges(expected: ExpectedMarks, session: Session, unpermitted: set[Mark]) -> ExpectedMarks:
    """With the edges that the plan makes of the true phases; the first strides of every walk need have none.

    ``unpermitted``: heel rises that begin no walk's stride. Edges that rest on events the truth lacks are left out.
    """
    added, optional, notes, kinds = list[Mark](), set[Mark](), list[str](), set[tuple[str, str]]()
    for channel in session.channels:
        known = {what for who, what in expected.kinds if who == channel.foot}
        if not known:
            continue
        who = f"channel {channel.number}"
        order = [phase for phase, _ in _ROUND]
        entry = {phase.name.lower(): _ROUND[order.index(phase) - 1][1] for phase in order}
        needs = {"on": {entry[channel.start_phase]}, "off": {entry[channel.stop_phase]}}
        after = order[(order.index(Phase[channel.stop_phase.upper()]) + 1) % 4]
        needs["off"] |= {entry[after.name.lower()]}
        edges, may_lack = _plan_edges(expected, session, channel.number, str(channel.foot), unpermitted)
        for what in EDGES:
            if lacking := sorted(needs[what] - known):
                notes.append(f"{who} {what} is not judged: the truth has no {' and '.join(lacking)}")
                continue
            kinds.add((who, what))
            mine = [mark for mark in edges if mark.what == what]
            added += mine
            optional |= {mark for mark in mine if mark in may_lack}
    return replace(
        expected,
        marks=tuple(sorted((*expected.marks, *added))),
        kinds=expected.kinds | kinds,
        optional=expected.optional | optional,
        notes=(*expected.notes, *notes),
    )


def _plan_edges(
    expected: ExpectedMarks, session: Session, number: int, foot: str, unpermitted: set[Mark]
) -> tuple[list[Mark], set[Mark]]:
    """Edges of one channel by the product's own plan on the true phases, and those of each walk's first strides."""
    changes, permitted = _true_changes([mark for mark in expected.marks if mark.who == foot], foot, unpermitted)
    plan = StimulationPlan(tuple(channel for channel in session.channels if channel.number == number))
    first = session.stimulation.strides_before_start + 1
    edges, may_lack, strides, last_ns = list[Mark](), set[Mark](), 0, -(2**62)
    for change, allowed, follows in zip(changes, permitted, [*changes[1:], None], strict=True):
        if change.destination == Phase.PRE_SWING:
            strides = strides + 1 if change.t_ns - last_ns < PAUSE_S * NS_PER_S else 1
            last_ns = change.t_ns
        early = strides <= first or change.t_ns - last_ns > PAUSE_S * NS_PER_S
        plan.on_phase(change, permitted=allowed)
        until_ns = min(follows.t_ns if follows else 2**62, change.t_ns + round(2.0 * NS_PER_S))
        for t_ns in range(change.t_ns, until_ns, PLAN_STEP_NS):
            if plan.due(t_ns, 1.0):
                on = plan.requests(t_ns, 1.0)[0].on
                edges.append(Mark(t_ns, f"channel {number}", "on" if on else "off"))
                may_lack |= {edges[-1]} if early else set()
    return edges, may_lack


def _true_changes(marks: Sequence[Mark], foot: str, unpermitted: set[Mark]) -> tuple[list[PhaseChange], list[bool]]:
    """Phase changes from marks; where a truth knows only some transitions, the others are put at their neighbours."""
    changes, permitted, phase = list[PhaseChange](), list[bool](), Phase.STANCE

    def go(t_ns: int, transition: Transition, destination: Phase, allowed: bool) -> None:
        nonlocal phase
        changes.append(PhaseChange(t_ns, foot, transition, phase, destination))
        permitted.append(allowed)
        phase = destination

    ends = {"T1": Phase.PRE_SWING, "T2": Phase.SWING, "T3": Phase.LOADING_RESPONSE, "T4": Phase.STANCE}
    for mark in sorted(marks):
        if mark.what in ("T5", "T6"):
            go(mark.t_ns, Transition[mark.what], Phase.STANCE, False)
            continue
        wanted = ends[mark.what]
        for _ in range(3):  # what lies between, at once
            following = Phase((int(phase) + 1) % 4)
            if following == wanted or phase == wanted:
                break
            go(mark.t_ns, Transition[f"T{int(phase) % 4 + 1}"], following, True)
        if phase != wanted:
            go(mark.t_ns, Transition[mark.what], wanted, mark not in unpermitted)
    return changes, permitted


def find_offset_s(expected: ExpectedMarks, found: Sequence[Mark]) -> tuple[float, str]:
    """Seconds to add to the truth's times so that its foot offs and contacts meet ours, and why not to believe it.

    TimingError: there is too little to find it by.
    """
    trains: list[list[FloatArray]] = [[], []]
    for kind in sorted(expected.kinds):
        if kind[1] not in ("T2", "T3", *EDGES):
            continue
        for side, marks in enumerate((expected.marks, found)):
            trains[side].append(np.array([1e-9 * m.t_ns for m in marks if (m.who, m.what) == kind]))
    enough = [k for k in range(len(trains[0])) if min(len(trains[0][k]), len(trains[1][k])) > 2]
    if not enough:
        raise TimingError(f"{expected.source}: fewer than three contacts or foot offs, too few to compare clocks by.")
    true, ours = ([train[k] for k in enough] for train in trains)
    apart_s = min(float(t.min()) for t in ours) - min(float(t.min()) for t in true)
    # clocks that have nothing to do with each other are first brought to begin together
    apart_s = apart_s if abs(apart_s) > MOST_LAG_S else 0.0
    try:
        lag = lag_by_trains([times + apart_s for times in true], ours, MOST_LAG_S, width_s=0.05)
    except ValueError as error:
        raise TimingError(f"{expected.source}: no offset of the clocks can be found: {error}.") from error
    return lag.lag_s + apart_s, lag.caveat


def check_clock(expected: ExpectedMarks, found: Sequence[Mark]) -> ExpectedMarks:
    """The truth with a note on its clock.

    TimingError: it tells of another time than the recording, or is off by so much that nothing could be said.
    """
    if not expected.marks or not found:
        return expected
    should, did = ((1e-9 * min(marks).t_ns, 1e-9 * max(marks).t_ns) for marks in (expected.marks, found))
    apart = did[0] > should[1] or did[1] < should[0]
    try:
        lag_s, caveat = find_offset_s(expected, found)
    except TimingError:
        lag_s, caveat = float("nan"), "it cannot be found"
    if apart:
        remedy = f"The events ask for --lag {lag_s:+.3f}" + (f", not for certain: {caveat}." if caveat else ".")
        remedy = remedy if math.isfinite(lag_s) else "Give --lag SECONDS."
        raise TimingError(
            f"{expected.source} tells of another time than this recording ({should[0]:.1f}–{should[1]:.1f} s and "
            f"{did[0]:.1f}–{did[1]:.1f} s): another recording's truth, or another clock. {remedy}"
        )
    if not caveat and abs(lag_s) > IN_STEP_S:
        raise TimingError(
            f"{expected.source} seems to be {lag_s:+.3f} s off the recording's clock. If its clock is another one, say "
            f"--sync fit or --lag {lag_s:+.3f}; if not, --lag 0."
        )
    return expected


def without_cut_ends(expected: ExpectedMarks, begin_ns: int, end_ns: int) -> ExpectedMarks:
    """The truth within a recording; in its first and last second nothing is missed."""
    if not expected.physical:
        return expected
    edge = round(EDGE_S * NS_PER_S)
    inside = tuple(mark for mark in expected.marks if begin_ns <= mark.t_ns <= end_ns)
    ends = {mark for mark in inside if mark.t_ns < begin_ns + edge or mark.t_ns > end_ns - edge}
    left_out = len(expected.marks) - len(inside)
    notes = (f"{left_out} events lie outside the recording and are left out",) if left_out else ()
    return replace(expected, marks=inside, optional=expected.optional | ends, notes=(*expected.notes, *notes))
