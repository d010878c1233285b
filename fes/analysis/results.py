"""What an analysis found: phase changes, strides, events, paths and where toe and heel are, also as tables."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np

from fes import __version__
from fes.analysis.examination import sensor_findings, testimonies
from fes.analysis.ground_path import GroundPath
from fes.analysis.methods import CAUSAL_EVENT_COLUMNS, causal_event_rows
from fes.analysis.tables import Table, by_column, join_tables
from fes.analysis.toe_and_heel import ToeAndHeel
from fes.config import Ground
from fes.estimation.events.causal import Decision
from fes.estimation.events.offline import GaitEvents, foot_strike_angles
from fes.estimation.foot.calibration import FootCalibration
from fes.estimation.foot.tracker import TrackedBlock
from fes.estimation.sensor_choice import Calibration
from fes.estimation.strides import schema
from fes.estimation.strides.boundaries import UNSEEN_NS
from fes.estimation.strides.schema import Column
from fes.estimation.tracking.tracker import Outcome, SampleCounts
from fes.recording import Recording
from fes.recording.chunks import Chunk
from fes.recording.tracks import Track, newer_samples
from fes.signals import FloatArray, IntArray, StrideResult
from fes.walk_record import Finding, Note, SampleArrays, WalkRecord
from fes.witness import Lie, Testimony
from statemachine.phases import Phase, PhaseChange, Transition

_ENTRIES = {
    "t_pre_swing_ns": Transition.T1,
    "t_swing_ns": Transition.T2,
    "t_loading_response_ns": Transition.T3,
    "t_stance_ns": Transition.T4,
}
_PLACE = ("x_m", "y_m", "z_m", "heading_rad")
_FOOT = Column("foot", str, "", "the sensor that it is from")
LIVE_PHASE_COLUMNS = (
    _FOOT,
    Column("t_s", float, "s", "the sample at which the transition fired", schema.NEGARD),
    Column("transition", str, "", "T1 to T6; T2 is foot off, T3 initial contact", f"{schema.NEGARD}, Fig. 5"),
    Column("from", str, "", "the phase that ended"),
    Column("to", str, "", "the phase that began"),
)
PHASE_COLUMNS = (
    _FOOT,
    Column("t_s", float, "s", "when it was, found off-line; empty of T5 and T6, and where it was not found"),
    LIVE_PHASE_COLUMNS[1]._replace(name="t_live_s"),
    *LIVE_PHASE_COLUMNS[2:],
)
EVENT_COLUMNS = (
    _FOOT,
    Column("t_foot_off_s", float, "s", "foot off (FO)"),
    Column("t_mid_swing_s", float, "s", "mid-swing: the fastest turn between foot off and contact"),
    Column("t_initial_contact_s", float, "s", "initial contact (IC)"),
    Column("t_foot_off_live_s", float, "s", "when the live phase machine said so (T2); empty where it did not"),
    Column("t_initial_contact_live_s", float, "s", "the same of initial contact (T3)"),
    Column("foot_strike_angle_rad", float, "rad", "pitch of the foot at initial contact, toe up positive"),
)
PATH_COLUMNS = (
    _FOOT,
    Column("t_s", float, "s", "tenths of a second after the path's beginning, on the sensor's clock"),
    *(next(column for column in schema.TABLE if column.name == name) for name in _PLACE),
)
_PHASES = np.array([phase.name.lower() for phase in Phase], object)
_TRANSITIONS = np.array([transition.name for transition in Transition], object)
Flags = np.ndarray[Any, np.dtype[np.bool_]]


class Changes(NamedTuple):
    """C phase changes: (C,) of sensors' names, times, and the numbers of ``Transition`` and of the ``Phase`` s."""

    foot: np.ndarray[Any, np.dtype[np.object_]]
    t_ns: IntArray
    transition: IntArray
    source: IntArray
    destination: IntArray


@dataclass(frozen=True)
class Analysis:
    """What a recording shows: phase changes and strides of all feet by time, and what became of the samples.

    ``phases`` and the phases' entries in ``strides`` are at the instants of the live machine; rows and tables have
    those found off-line beside them (``t_s``, ``t_live_s``).

    Of a long recording it is one ``chunk``: phase changes, strides, rows and counts are that chunk's own; the samples,
    events and paths are those around it too, and the paths go on where the chunk before ended (they are counted from
    ``path_begins_ns``, where each foot's began). Phases and strides carry the name of their sensor: the foot's, or
    where there is none the shank's, for which there are no ``events`` and no path; ``no_path`` says why. ``points`` are
    toe and heel. ``blocks`` is what the feet's trackers found, as arrays, and ``outcomes`` what the shanks' found;
    phase changes, strides and the strides' trajectories are made from them when they are first asked for.
    ``walking_ns`` (M, 2), where given, are begins and ends of walking (:mod:`fes.analysis.bouts`): only that is told.
    ``measured_strides``, where given, are the strides with lengths by another method
    (:mod:`fes.analysis.own_methods`). ``raw`` are the tracks with what a frozen sensor repeated. ``corrections``: what
    was wrong with each sensor, of which the recording is free now; ``uncorrected`` are its key numbers as they were.
    ``anew`` analyses another recording as this one was.
    """

    recording: Recording
    calibrations: dict[str, Calibration]
    events: dict[str, GaitEvents] = field(default_factory=dict)
    counts: dict[str, SampleCounts] = field(default_factory=dict)
    paths: dict[str, GroundPath] = field(default_factory=dict)
    no_path: dict[str, str] = field(default_factory=dict)
    points: dict[str, ToeAndHeel] = field(default_factory=dict)
    ground: Ground = field(default_factory=Ground)
    blocks: dict[str, TrackedBlock] = field(default_factory=dict)
    outcomes: dict[str, list[Outcome]] = field(default_factory=dict)
    chunk: Chunk | None = None
    path_begins_ns: dict[str, int] = field(default_factory=dict)
    causal_events: dict[str, list[tuple[str, Decision]]] = field(default_factory=dict)
    walking_ns: IntArray | None = None
    measured_strides: list[StrideResult] | None = None
    raw: dict[str, Track] = field(default_factory=dict)
    corrections: Mapping[str, tuple[Lie, ...]] = field(default_factory=dict)
    uncorrected: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    anew: Callable[[Recording], "Analysis"] | None = None

    def __repr__(self) -> str:
        valid = sum(stride.valid for stride in self.strides)
        return f"Analysis of {self.recording!r}: {len(self.strides)} strides, {valid} of them valid"

    @cached_property
    def testimonies(self) -> dict[str, Testimony]:
        """What the witness says of every foot sensor (docs/witness.md)."""
        return testimonies(self)

    @cached_property
    def findings(self) -> tuple[Finding, ...]:
        """What is wrong with the sensors, what that does to the numbers, and what to do about it."""
        assert self.anew is not None
        return sensor_findings(self, self.anew)

    @cached_property
    def phases(self) -> list[PhaseChange]:
        """All feet's phase changes by time."""
        found = [change for block in self.blocks.values() for change in block.changes]
        found += [each for own in self.outcomes.values() for each in own if isinstance(each, PhaseChange)]
        return sorted((each for each in found if self._walked(each.t_ns, each.t_ns)), key=attrgetter("t_ns"))

    @cached_property
    def strides(self) -> list[StrideResult]:
        """All feet's strides by their beginnings."""
        if self.measured_strides is None:
            found = [stride for block in self.blocks.values() for stride in block.strides()]
            found += [each for own in self.outcomes.values() for each in own if isinstance(each, StrideResult)]
        else:
            found = self.measured_strides
        kept = (each for each in found if self._walked(each.t_swing_ns, each.t_loading_response_ns))
        return sorted(kept, key=attrgetter("t_start_ns"))

    @cached_property
    def stride_columns(self) -> Table:
        """What :attr:`strides` say, a row each and without an object for each: see ``tables.by_column``."""
        if self.measured_strides is None:
            shanks = (each for own in self.outcomes.values() for each in own if isinstance(each, StrideResult))
            blocks = [Table(schema.RESULT, block.columns()) for block in self.blocks.values()]
            found = join_tables([*blocks, by_column(list(shanks))])
        else:
            found = by_column(self.measured_strides)
        kept: Table = found[self._all_walked(found["t_swing_ns"], found["t_loading_response_ns"])]
        return kept.sorted_by("t_start_ns")

    def _walked(self, begin_ns: int | None, end_ns: int | None) -> bool:
        """Whether it lies within one of the ``walking_ns``, where these are known."""
        if self.walking_ns is None:
            return True
        ends = ([UNSEEN_NS if t_ns is None else t_ns] for t_ns in (begin_ns, end_ns))
        return bool(self._all_walked(*(np.array(t_ns, np.int64) for t_ns in ends))[0])

    def _all_walked(self, begin_ns: IntArray, end_ns: IntArray) -> Flags:
        """The same of (M,) times."""
        if self.walking_ns is None:
            return np.ones(len(begin_ns), np.bool_)
        part = np.searchsorted(self.walking_ns[:, 0], begin_ns, side="right")
        until_ns = np.concatenate(([UNSEEN_NS], self.walking_ns[:, 1]))[part]
        return np.asarray((end_ns <= until_ns) & (end_ns != UNSEEN_NS))

    def tables(self) -> dict[str, Table]:
        """Strides, phase changes, events and paths, each as a table with units; times and places in SI."""
        found = {
            "strides": self.stride_table(),
            "phases": self.phase_table(),
            "events": self.event_table(),
            "path": self.path_table(),
        }
        return found | ({"events_causal": self.causal_event_table()} if self.causal_events else {})

    def stride_table(self) -> Table:
        """A row a stride with the columns of ``fes.estimation.strides.schema.TABLE``.

        The phases' entries are those found off-line, NaN where there are none. ``x_m``, ``y_m``, ``z_m`` and
        ``heading_rad`` are where the stride ends on the foot's path, NaN without a path.
        """
        columns = self.stride_columns
        found = schema.table_columns({name: columns[name] for name in columns.names})
        for k, name in enumerate(_ENTRIES):
            entry = name.removesuffix("_ns")
            found[f"{entry}_live_s"], found[f"{entry}_s"] = found[f"{entry}_s"], _seconds(self.offline_entries[:, k])
        places = np.full((len(columns), len(_PLACE)), math.nan)
        for foot, path in self.paths.items():
            own = columns["foot"] == foot
            places[own] = path.places_at(columns["t_end_ns"][own])
        return Table(schema.TABLE, found | dict(zip(_PLACE, places.T, strict=True)))

    def phase_table(self) -> Table:
        """A row a phase change, by the live instants; T2 is foot off (FO), T3 initial contact (IC)."""
        found, t_ns = self._changes, np.full(len(self._changes.t_ns), UNSEEN_NS, np.int64)
        for foot, live in self._live.items():
            offline_ns = self._offline_ns(foot)
            for transition, at in live.items():
                seen = at >= 0
                t_ns[at[seen]] = offline_ns[transition][seen]
        columns = {
            "foot": found.foot,
            "t_s": _seconds(t_ns),
            "t_live_s": _seconds(found.t_ns),
            "transition": _TRANSITIONS[found.transition],
            "from": _PHASES[found.source],
            "to": _PHASES[found.destination],
        }
        return Table(PHASE_COLUMNS, columns)

    @cached_property
    def _changes(self) -> Changes:
        """All feet's phase changes by time, as :attr:`phases`, without an object for each."""
        found = [(foot, *block.change_columns()) for foot, block in self.blocks.items()]
        for foot, own in self.outcomes.items():
            rows = [(c.t_ns, c.transition, c.source, c.destination) for c in own if isinstance(c, PhaseChange)]
            found.append((foot, *np.array(rows, np.int64).reshape(-1, 4).T))
        feet = [np.full(len(t_ns), foot, object) for foot, t_ns, *_ in found]
        none = np.zeros((0, 4), np.int64)
        columns = np.concatenate([none, *(np.column_stack(own) for _, *own in found)]).T
        order = np.argsort(columns[0], kind="stable")
        order = order[self._all_walked(columns[0][order], columns[0][order])]
        return Changes(np.concatenate([np.zeros(0, object), *feet])[order], *(column[order] for column in columns))

    def _offline_ns(self, foot: str) -> dict[Transition, IntArray]:
        """Of every swing of a foot (K,) when its T1 to T4 were by the events; ``UNSEEN_NS`` where they do not say."""
        events = self.events[foot]
        nowhere = np.full(len(events), UNSEEN_NS, np.int64)
        rise_ns, flat_ns = (nowhere if t is None else t for t in (events.heel_rise_ns, events.foot_flat_ns))
        return dict(zip(_ENTRIES.values(), (rise_ns, events.fo_ns, events.ic_ns, flat_ns), strict=True))

    @cached_property
    def _live(self) -> dict[str, dict[Transition, IntArray]]:
        """By foot, of every swing (K,) which of the ``_changes`` was the live machine's T1 to T4; -1 where it saw none.

        Of several between two mid-swings, as where a heel was put back, those next to the swing.
        """
        found, changes = dict[str, dict[Transition, IntArray]](), self._changes
        for foot, events in self.events.items():
            mine = changes.foot == foot
            found[foot] = {which: np.full(len(events), -1, np.int64) for which in _ENTRIES.values()}
            for which, at in found[foot].items():
                fired = np.flatnonzero(mine & (changes.transition == which))
                swing = np.searchsorted(events.mid_swing_ns, changes.t_ns[fired])
                if which in (Transition.T3, Transition.T4):
                    swing, fired = swing[::-1] - 1, fired[::-1]
                of_one = (swing >= 0) & (swing < len(events))
                at[swing[of_one]] = fired[of_one]
        return found

    @cached_property
    def offline_entries(self) -> IntArray:
        """When the phases of each of the ``strides`` began by the off-line events (S, 4), ``UNSEEN_NS`` if not known.

        A stride with no swing that the events tell, or with two, has none; nor has a shank's.
        """
        columns = self.stride_columns
        found = np.full((len(columns), len(_ENTRIES)), UNSEEN_NS, np.int64)
        for foot, events in self.events.items():
            own = np.flatnonzero(columns["foot"] == foot)
            first, last = (
                np.searchsorted(events.mid_swing_ns, columns[end][own]) for end in ("t_start_ns", "t_end_ns")
            )
            one = last - first == 1
            found[own[one]] = np.column_stack(list(self._offline_ns(foot).values()))[first[one]]
        return found

    def event_table(self) -> Table:
        """A row a swing, from foot off (FO) to initial contact (IC); found off-line, not causally."""
        parts = [Table.from_rows(EVENT_COLUMNS, [])]
        for foot, events in self.events.items():
            calibration = self.calibrations[foot]
            assert isinstance(calibration, FootCalibration)
            t_ns, _, gyr = newer_samples(self.recording.tracks[foot])
            own = self._all_walked(events.mid_swing_ns, events.mid_swing_ns)
            own &= True if self.chunk is None else self.chunk.owns(events.mid_swing_ns)
            fired_ns = np.append(self._changes.t_ns, UNSEEN_NS)
            live = (fired_ns[self._live[foot][which]] for which in (Transition.T2, Transition.T3))
            times = (_seconds(each) for each in (events.fo_ns, events.mid_swing_ns, events.ic_ns, *live))
            columns = (np.full(len(events), foot, object), *times, foot_strike_angles(t_ns, gyr, events, calibration))
            names = (column.name for column in EVENT_COLUMNS)
            parts.append(Table(EVENT_COLUMNS, dict(zip(names, columns, strict=True)))[own])
        return join_tables(parts).sorted_by("t_foot_off_s")

    def causal_event_table(self) -> Table:
        """A row an IC and FO as they would be known on-line; none unless the analysis was asked for them."""
        found = self.causal_events.items()
        rows = [row for foot, decisions in found for row in causal_event_rows(foot, decisions, self.events[foot])]
        return Table.from_rows(CAUSAL_EVENT_COLUMNS, sorted(rows, key=lambda row: row["t_known_s"]))

    def path_table(self) -> Table:
        """A row a foot and tenth of a second: place (m) and heading (rad) on its path."""
        parts = [Table.from_rows(PATH_COLUMNS, [])]
        for foot, path in self.paths.items():
            t_ns, places = self._own_part(path).at_rate(origin_ns=self.path_begins_ns.get(foot))
            walked = self._all_walked(t_ns, t_ns)
            columns = (np.full(len(t_ns), foot, object), 1e-9 * t_ns, *places.T)
            names = (column.name for column in PATH_COLUMNS)
            parts.append(Table(PATH_COLUMNS, dict(zip(names, columns, strict=True)))[walked])
        return join_tables(parts)

    def _own_part(self, path: GroundPath) -> GroundPath:
        """The part of a path that is this chunk's own."""
        if self.chunk is None or self.chunk.whole:
            return path
        begin, end = max(self.chunk.begin_ns + 1, int(path.t_ns[0])), min(self.chunk.end_ns, int(path.t_ns[-1]))
        inner = path.t_ns[(path.t_ns > begin) & (path.t_ns < end)]
        t_ns = np.concatenate(([begin], inner, [end]))
        rows = path.places_at(t_ns)
        return replace(path, t_ns=t_ns, position_m=rows[:, :3], heading_rad=rows[:, 3])

    def path_summary(self) -> dict[str, dict[str, float]]:
        """Of every foot: how far it went, how far from its start it ended, and how much higher."""
        names = ("way_m", "end_from_start_m", "height_gained_m")
        numbers = {foot: (path.distance_m, path.closure_m, path.height_gained_m) for foot, path in self.paths.items()}
        return {foot: dict(zip(names, row, strict=True)) for foot, row in numbers.items()}

    def clock_notes(self) -> dict[str, str]:
        """By sensor, what was left out because its clock had gone back, in words."""
        late = {sensor: track.quality.late for sensor, track in self.recording.tracks.items() if track.quality.late}
        return {
            sensor: f"the last {n} samples are left out: the clock had jumped back there" for sensor, n in late.items()
        }

    def at_offline_instants(self) -> tuple[list[PhaseChange], list[StrideResult]]:
        """Phase changes and strides as of :attr:`phases` and :attr:`strides`, moved to the off-line events.

        What the phase machine did not see is not added, and a stride of which one of the four is not known, or would
        change places with the changes around it, is the same object as in :attr:`strides`.
        """
        moved: dict[tuple[str, int], int] = {}
        strides = list(self.strides)
        fired = {foot: np.array([c.t_ns for c in self.phases if c.foot == foot], np.int64) for foot in self.events}
        for k, (stride, to) in enumerate(zip(self.strides, self.offline_entries.tolist(), strict=True)):
            seen = [getattr(stride, name) for name in _ENTRIES]
            if None in seen or UNSEEN_NS in to:
                continue
            own = fired[stride.foot]
            low, high = np.searchsorted(own, seen[0]), np.searchsorted(own, seen[-1], side="right")
            before = own[low - 1] if low else stride.t_start_ns
            after = own[high] if high < len(own) else stride.t_end_ns
            if before < to[0] < to[1] < to[2] < to[3] < after:
                moved |= {(stride.foot, was): t_ns for was, t_ns in zip(seen, to, strict=True)}
                strides[k] = replace(stride, **dict(zip(_ENTRIES, to, strict=True)))
        phases = [replace(change, t_ns=moved.get((change.foot, change.t_ns), change.t_ns)) for change in self.phases]
        return sorted(phases, key=attrgetter("t_ns")), strides

    def walk_record(self, created: str = "") -> WalkRecord:
        """The walk as the report takes it; ``created`` is when, as an ISO time."""
        recording, worn = self.recording, self.recording.tracks
        header = {
            "fes_version": __version__,
            "kind": "analysis",
            "created": created,
            "recording": {
                "name": recording.name,
                "subject": recording.subject,
                "rates_hz": {sensor: track.rate_hz for sensor, track in worn.items()},
                "belt_speed_mps": recording.belt_speed_mps,
                "ranges": {n: {"acc": t.acc_range_mps2, "gyr": t.gyr_range_radps} for n, t in worn.items()},
            },
            "ground": {"level": self.ground.level, **self.ground.model_dump()},
            "toe_and_heel": {foot: points.to_json() for foot, points in self.points.items()},
            "calibration": {sensor: calibration.to_dict() for sensor, calibration in self.calibrations.items()},
        }
        samples = {
            sensor: SampleArrays(track.t_ns, track.t_sensor_ns, track.acc_mps2, track.gyr_radps)
            for sensor, track in worn.items()
            if sensor in self.calibrations
        }
        notes = [
            Note(int(worn[foot].t_ns[0]), "info" if points.measured else "warning", foot, points.describe())
            for foot, points in self.points.items()
        ]
        notes += [Note(int(worn[s].t_ns[-1]), "warning", s, text) for s, text in self.clock_notes().items()]
        part = None if self.chunk is None or self.chunk.whole else (self.chunk.begin_ns, self.chunk.end_ns)
        phases, strides = self.at_offline_instants()
        found: dict[str, Any] = {"phases": phases, "strides": strides, "notes": notes}
        live = self.phases, self.strides
        return WalkRecord(
            header, samples=samples, **found, complete=True, own_ns=part, live=live, findings=self.findings
        )


def _seconds(t_ns: IntArray) -> FloatArray:
    """Times (M,), NaN where there are none."""
    return np.where(t_ns == UNSEEN_NS, math.nan, 1e-9 * t_ns)


def phase_row(change: PhaseChange) -> dict[str, Any]:
    """A phase change with the columns of :data:`LIVE_PHASE_COLUMNS`."""
    phases = change.source.name.lower(), change.destination.name.lower()
    names = (column.name for column in LIVE_PHASE_COLUMNS)
    return dict(zip(names, (change.foot, 1e-9 * change.t_ns, change.transition.name, *phases), strict=True))
