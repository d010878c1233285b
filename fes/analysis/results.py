"""What an analysis found: phase changes, strides, events, paths and where toe and heel are, also as tables."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import repeat
from operator import attrgetter
from typing import Any

import numpy as np

from fes import __version__
from fes.analysis.ground_path import GroundPath
from fes.analysis.methods import CAUSAL_EVENT_COLUMNS, causal_event_rows
from fes.analysis.tables import Table
from fes.analysis.toe_and_heel import ToeAndHeel
from fes.config import Ground
from fes.estimation.clearance.clearance import FootPath
from fes.estimation.events.causal import Decision, Rule
from fes.estimation.events.offline import GaitEvents, foot_strike_angles
from fes.estimation.foot.block_results import TrackedBlock
from fes.estimation.foot.calibration import FootCalibration
from fes.estimation.sensor_choice import Calibration
from fes.estimation.strides import schema
from fes.estimation.strides.boundaries import UNSEEN_NS
from fes.estimation.strides.schema import Column
from fes.estimation.tracking.tracker import Outcome, SampleCounts
from fes.recording import Recording
from fes.recording.chunks import Chunk
from fes.recording.tracks import newer_samples
from fes.signals import NS_PER_S, IntArray, StrideResult
from fes.walk_record import Note, SampleArrays, WalkRecord
from statemachine.phases import PhaseChange, Transition

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
    Column("t_s", float, "s", "counted from the path's beginning"),
    *(next(column for column in schema.TABLE if column.name == name) for name in _PLACE),
)


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
    (:mod:`fes.analysis.own_methods`).
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
    causal_events: dict[str, list[tuple[Rule, Decision]]] = field(default_factory=dict)
    walking_ns: IntArray | None = None
    measured_strides: list[StrideResult] | None = None

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

    def _walked(self, begin_ns: int | None, end_ns: int | None) -> bool:
        """Whether it lies within one of the ``walking_ns``, where these are known."""
        if self.walking_ns is None:
            return True
        if begin_ns is None or end_ns is None:
            return False
        part = int(np.searchsorted(self.walking_ns[:, 0], begin_ns, side="right")) - 1
        return part >= 0 and end_ns <= int(self.walking_ns[part, 1])

    @cached_property
    def stride_paths(self) -> dict[str, list[FootPath]]:
        """Of each foot's valid strides, the trajectory at their own samples."""
        return {foot: block.paths().each() for foot, block in self.blocks.items()}

    def tables(self) -> dict[str, Table]:
        """Strides, phase changes, events and paths, each as a table with units; times and places in SI."""
        found: dict[str, tuple[Sequence[Column], list[dict[str, Any]]]] = {
            "strides": (schema.TABLE, self.stride_rows()),
            "phases": (PHASE_COLUMNS, self.phase_rows()),
            "events": (EVENT_COLUMNS, self.event_rows()),
            "path": (PATH_COLUMNS, self.path_rows()),
        }
        if self.causal_events:
            found["events_causal"] = CAUSAL_EVENT_COLUMNS, self.causal_event_rows()
        return {name: Table.from_rows(*table) for name, table in found.items()}

    def stride_rows(self) -> list[dict[str, Any]]:
        """One flat row per stride with the columns of ``fes.estimation.strides.schema.TABLE``.

        The phases' entries are those found off-line, NaN where there are none. ``x_m``, ``y_m``, ``z_m`` and
        ``heading_rad`` are where the stride ends on the foot's path, NaN without a path.
        """
        places = {}
        for foot, path in self.paths.items():
            ends_ns = np.array([stride.t_end_ns for stride in self.strides if stride.foot == foot], np.int64)
            places[foot] = iter(path.places_at(ends_ns).tolist())
        unknown = repeat((math.nan,) * len(_PLACE))
        rows = []
        for stride, found in zip(self.strides, self.offline_entries, strict=True):
            row = dict(zip(_PLACE, next(places.get(stride.foot, unknown)), strict=True))
            for name in _ENTRIES:
                entry = name.removesuffix("_ns")
                row[f"{entry}_s"], row[f"{entry}_live_s"] = _seconds(found.get(name)), _seconds(getattr(stride, name))
            row = schema.table_row(stride) | row
            rows.append({column.name: row[column.name] for column in schema.TABLE})
        return rows

    def phase_rows(self) -> list[dict[str, Any]]:
        """One flat row per phase change, by the live instants; T2 is foot off (FO), T3 initial contact (IC)."""
        found = {
            (foot, transition, live_ns): at_ns
            for foot, live in self._live_ns.items()
            for transition, times_ns in live.items()
            for live_ns, at_ns in zip(times_ns.tolist(), self._offline_ns(foot)[transition].tolist(), strict=True)
        }
        rows = []
        for change in self.phases:
            row = phase_row(change)
            both = {
                "t_s": _seconds(found.get((change.foot, change.transition, change.t_ns))),
                "t_live_s": row.pop("t_s"),
            }
            rows.append({"foot": row.pop("foot"), **both, **row})
        return rows

    def _offline_ns(self, foot: str) -> dict[Transition, IntArray]:
        """Of every swing of a foot (K,) when its T1 to T4 were by the events; ``UNSEEN_NS`` where they do not say."""
        events = self.events[foot]
        nowhere = np.full(len(events), UNSEEN_NS, np.int64)
        rise_ns, flat_ns = (nowhere if t is None else t for t in (events.heel_rise_ns, events.foot_flat_ns))
        return dict(zip(_ENTRIES.values(), (rise_ns, events.fo_ns, events.ic_ns, flat_ns), strict=True))

    @cached_property
    def _live_ns(self) -> dict[str, dict[Transition, IntArray]]:
        """By foot, of every swing (K,) when the live machine's T1 to T4 were; ``UNSEEN_NS`` where it did not see them.

        Of several between two mid-swings, as where a heel was put back, those next to the swing.
        """
        found = {}
        for foot, events in self.events.items():
            own = [change for change in self.phases if change.foot == foot]
            found[foot] = {which: np.full(len(events), UNSEEN_NS, np.int64) for which in _ENTRIES.values()}
            for which, at_ns in found[foot].items():
                fired = np.array([change.t_ns for change in own if change.transition is which], np.int64)
                swing = np.searchsorted(events.mid_swing_ns, fired)
                if which in (Transition.T3, Transition.T4):
                    swing, fired = swing[::-1] - 1, fired[::-1]
                of_one = (swing >= 0) & (swing < len(events))
                at_ns[swing[of_one]] = fired[of_one]
        return found

    @cached_property
    def offline_entries(self) -> list[dict[str, Any]]:
        """Of each of the ``strides`` when its phases began by the off-line events (``t_swing_ns`` …), as far as known.

        A stride with no swing that the events tell, or with two, has none; nor has a shank's.
        """
        every: list[dict[str, Any]] = [{} for _ in self.strides]
        for foot, events in self.events.items():
            own = [k for k, stride in enumerate(self.strides) if stride.foot == foot]
            ends = np.array([(self.strides[k].t_start_ns, self.strides[k].t_end_ns) for k in own], np.int64)
            swings = np.searchsorted(events.mid_swing_ns, ends.reshape(-1, 2))
            times = np.column_stack(list(self._offline_ns(foot).values())).tolist()
            for k, (first, last) in zip(own, swings.tolist(), strict=True):
                if last - first == 1:
                    entries = zip(_ENTRIES, times[first], strict=True)
                    every[k] = {name: at_ns for name, at_ns in entries if at_ns != UNSEEN_NS}
        return every

    def event_rows(self) -> list[dict[str, Any]]:
        """One flat row per swing, from foot off (FO) to initial contact (IC); found off-line, not causally."""
        rows = []
        for foot, events in self.events.items():
            calibration = self.calibrations[foot]
            assert isinstance(calibration, FootCalibration)
            t_ns, _, gyr = newer_samples(self.recording.tracks[foot])
            angles = foot_strike_angles(t_ns, gyr, events, calibration)
            own = np.array([self._walked(t_ns, t_ns) for t_ns in events.mid_swing_ns.tolist()], np.bool_)
            own &= True if self.chunk is None else self.chunk.owns(events.mid_swing_ns)
            live = (self._live_ns[foot][which] for which in (Transition.T2, Transition.T3))
            times = (events.fo_ns, events.mid_swing_ns, events.ic_ns, *live)
            seconds = (np.where(t[own] == UNSEEN_NS, math.nan, 1e-9 * t[own]) for t in times)
            names = [column.name for column in EVENT_COLUMNS[1:]]
            columns = [column.tolist() for column in (*seconds, angles[own])]
            rows += [{"foot": foot, **dict(zip(names, row, strict=True))} for row in zip(*columns, strict=True)]
        return sorted(rows, key=lambda row: row["t_foot_off_s"])

    def causal_event_rows(self) -> list[dict[str, Any]]:
        """One flat row per IC and FO as they would be known on-line; none unless the analysis was asked for them."""
        found = self.causal_events.items()
        rows = [row for foot, decisions in found for row in causal_event_rows(foot, decisions, self.events[foot])]
        return sorted(rows, key=lambda row: row["t_known_s"])

    def path_rows(self) -> list[dict[str, Any]]:
        """One flat row per foot and tenth of a second: place (m) and heading (rad) on its path."""
        return [
            row
            for foot, path in self.paths.items()
            for row in self._own_part(path).rows(origin_ns=self.path_begins_ns.get(foot))
            if self.walking_ns is None or self._on_path(foot, row["t_s"])
        ]

    def _on_path(self, foot: str, t_s: float) -> bool:
        t_ns = self.path_begins_ns.get(foot, int(self.paths[foot].t_ns[0])) + round(t_s * NS_PER_S)
        return self._walked(t_ns, t_ns)

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
        for k, (stride, entries) in enumerate(zip(self.strides, self.offline_entries, strict=True)):
            seen = [getattr(stride, name) for name in _ENTRIES]
            if None in seen or len(entries) < len(seen):
                continue
            own, to = fired[stride.foot], list(entries.values())
            low, high = np.searchsorted(own, seen[0]), np.searchsorted(own, seen[-1], side="right")
            before = own[low - 1] if low else stride.t_start_ns
            after = own[high] if high < len(own) else stride.t_end_ns
            if before < to[0] < to[1] < to[2] < to[3] < after:
                moved |= {(stride.foot, was): t_ns for was, t_ns in zip(seen, to, strict=True)}
                strides[k] = replace(stride, **entries)
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
        return WalkRecord(header, samples=samples, **found, complete=True, own_ns=part, live=live)


def _seconds(t_ns: int | None) -> float:
    return math.nan if t_ns is None or t_ns == UNSEEN_NS else 1e-9 * t_ns


def phase_row(change: PhaseChange) -> dict[str, Any]:
    """A phase change with the columns of :data:`LIVE_PHASE_COLUMNS`."""
    phases = change.source.name.lower(), change.destination.name.lower()
    names = (column.name for column in LIVE_PHASE_COLUMNS)
    return dict(zip(names, (change.foot, 1e-9 * change.t_ns, change.transition.name, *phases), strict=True))
