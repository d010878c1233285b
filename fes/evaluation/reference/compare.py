"""What was estimated, by an analysis or in a session, paired with a reference; and what has no partner."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from typing import TYPE_CHECKING, Final

import numpy as np

from fes.evaluation.reference.table import EVENTS, Reference, ReferenceStride
from fes.evaluation.timing.marks import foot_of_sensor, pair_times
from fes.signals import NS_PER_S, FloatArray, StrideResult
from statemachine.phases import PhaseChange, Transition

if TYPE_CHECKING:
    from fes.analysis.results import Analysis
    from fes.session_log import SessionRecord

TOLERANCE_S: Final = 0.15
EDGE_S: Final = 1.0  # at a recording's ends a stride or event of the reference may be cut off: not missed
_INSTANT: Final = {"IC": "initial_contact_s", "FO": "foot_off_s"}
_OF_STRIDES: Final = frozenset(
    ("stride_length_m", "clearance_m", "toe_clearance_m", "heel_clearance_m", "height_gained_m", "speed_mps")
)


@dataclass(frozen=True, eq=False)
class Estimate:
    """Strides of both feet, and per foot the times (s) of IC and FO, and angles (rad) at some of the ICs.

    Feet are named left_foot and right_foot whatever sensor told them. ``begin_s`` and ``end_s`` are the recording's.
    ``ends``: by foot, how far from its start and how much higher (m) its path ended. ``level``: no stairs, no slope.
    """

    source: str
    how: str
    begin_s: float
    end_s: float
    strides: tuple[StrideResult, ...]
    events: Mapping[str, Mapping[str, FloatArray]]
    strike_rad: Mapping[str, tuple[FloatArray, FloatArray]]
    ends: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    level: bool = True

    @property
    def feet(self) -> tuple[str, ...]:
        """The feet of which anything is known."""
        return tuple(sorted({foot_of_sensor(stride.foot) for stride in self.strides} | set(self.events)))

    def strides_of(self, foot: str) -> list[StrideResult]:
        """One foot's strides by time, valid or not."""
        return [stride for stride in self.strides if foot_of_sensor(stride.foot) == foot]


def from_analysis(analysis: Analysis) -> Estimate:
    """Off-line: strides with the whole recording, IC and FO found backwards and forwards."""
    events: dict[str, dict[str, FloatArray]] = {}
    strike: dict[str, tuple[FloatArray, FloatArray]] = {}
    told = analysis.event_table()
    for foot, found in analysis.events.items():
        events[foot] = {"IC": 1e-9 * found.ic_ns.astype(float), "FO": 1e-9 * found.fo_ns.astype(float)}
        times, angles = (told[name][told["foot"] == foot] for name in ("t_initial_contact_s", "foot_strike_angle_rad"))
        strike[foot] = times, angles
    for sensor in {change.foot for change in analysis.phases} - set(analysis.events):
        events[foot_of_sensor(sensor)] = _of_phases(analysis.phases, sensor)
    tracks = list(analysis.recording.tracks.values())
    return Estimate(
        str(analysis.recording.path or analysis.recording.name),
        "off-line",
        1e-9 * min(int(track.t_sensor_ns[0]) for track in tracks),
        1e-9 * max(int(track.t_sensor_ns[-1]) for track in tracks),
        tuple(analysis.strides),
        events,
        strike,
        {foot: (path.closure_m, path.height_gained_m) for foot, path in analysis.paths.items()},
        analysis.ground.level,
    )


def from_session(record: SessionRecord, source: str) -> Estimate:
    """As it was decided in a session, causally: IC is T3 (T6 where no contact was seen), FO is T2."""
    sensors = sorted({change.foot for change in record.phases})
    times = [1e-9 * int(part.t_ns[k]) for part in record.samples.values() if len(part.t_ns) for k in (0, -1)]
    times = times or [1e-9 * change.t_ns for change in record.phases] or [0.0]
    events = {foot_of_sensor(sensor): _of_phases(record.phases, sensor) for sensor in sensors}
    return Estimate(source, "as decided in the session", min(times), max(times), tuple(record.strides), events, {})


def _of_phases(phases: Iterable[PhaseChange], sensor: str) -> dict[str, FloatArray]:
    which = {"IC": (Transition.T3, Transition.T6), "FO": (Transition.T2,)}
    mine = [change for change in phases if change.foot == sensor]
    return {
        what: np.array([1e-9 * change.t_ns for change in mine if change.transition in transitions])
        for what, transitions in which.items()
    }


@dataclass(frozen=True, slots=True)
class Pair:
    """One quantity of one foot, SI; ``t_s`` is when, on the recording's clock."""

    quantity: str
    foot: str
    t_s: float
    reference: float
    estimate: float


@dataclass(frozen=True, slots=True)
class Count:
    """How the matching of one kind (IC, FO, stride, swing) of one foot came out.

    ``left_out``: matched, but one of the sides says that its numbers must not be used.
    """

    what: str
    foot: str
    expected: int
    found: int
    missed: int
    extra: int
    left_out: int = 0


@dataclass(frozen=True, slots=True)
class Comparison:
    """All pairs and counts."""

    pairs: tuple[Pair, ...]
    counts: tuple[Count, ...]

    def joined(self, other: Comparison) -> Comparison:
        """Both together."""
        return Comparison(self.pairs + other.pairs, self.counts + other.counts)


def compare(reference: Reference, estimate: Estimate, *, tolerance_s: float = TOLERANCE_S) -> Comparison:
    """Hold events and strides of a reference, already on the recording's clock, against the estimate.

    Events of one kind and foot are paired one to one, nearest first, at most ``tolerance_s`` apart. A stride of the
    reference is paired with the estimated one whose swing lies in it. Only the time that both cover counts.
    """
    result = Comparison((), ())
    for foot in estimate.feet:
        result = result.joined(_events(reference, estimate, foot, tolerance_s))
        result = result.joined(_strides(reference, estimate, foot))
    return result


def _events(reference: Reference, estimate: Estimate, foot: str, tolerance_s: float) -> Comparison:
    pairs: list[Pair] = []
    counts: list[Count] = []
    partner: dict[str, dict[float, float]] = {}
    for what in EVENTS:
        true = np.array([event.t_s for event in reference.events if event.foot == foot and event.what == what])
        ours = np.sort(estimate.events.get(foot, {}).get(what, np.zeros(0)))
        if not len(true):
            continue
        begin, end = true.min() - tolerance_s, true.max() + tolerance_s
        ours = ours[(ours >= begin) & (ours <= end)]
        expected = true[(true >= estimate.begin_s - tolerance_s) & (true <= estimate.end_s + tolerance_s)]
        matched = pair_times(_nanoseconds(expected), _nanoseconds(ours), 1e9 * tolerance_s)
        inner = (expected > estimate.begin_s + EDGE_S) & (expected < estimate.end_s - EDGE_S)
        missed = int(inner.sum()) - sum(bool(inner[i]) for i, _ in matched)
        counts.append(Count(what, foot, len(matched) + missed, len(ours), missed, len(ours) - len(matched)))
        partner[what] = {float(expected[i]): float(ours[j]) for i, j in matched}
        pairs += [Pair(_INSTANT[what], foot, t, t, partner[what][t]) for t in sorted(partner[what])]
    pairs += _durations(reference, foot, partner)
    return Comparison(tuple(pairs), tuple(counts))


def _durations(reference: Reference, foot: str, partner: dict[str, dict[float, float]]) -> Iterator[Pair]:
    """Times between successive events of the reference, both of which were found."""
    mine = [event for event in reference.events if event.foot == foot]
    contacts = [event.t_s for event in mine if event.what == "IC"]
    ic, fo = partner.get("IC", {}), partner.get("FO", {})
    for t, after in pairwise(contacts):
        if after - t < 4.0 and t in ic and after in ic:
            yield Pair("stride_time_s", foot, t, after - t, ic[after] - ic[t])
    for first, second in pairwise(mine):
        if second.t_s - first.t_s > 4.0 or first.what == second.what:
            continue
        of_first, of_second = (ic, fo) if first.what == "IC" else (fo, ic)
        if first.t_s in of_first and second.t_s in of_second:
            name = "stance_time_s" if first.what == "IC" else "swing_time_s"
            ours = of_second[second.t_s] - of_first[first.t_s]
            yield Pair(name, foot, first.t_s, second.t_s - first.t_s, ours)


def _strides(reference: Reference, estimate: Estimate, foot: str) -> Comparison:
    mine = [s for s in reference.strides if s.foot == foot and s.values]
    if not mine:
        return Comparison((), ())
    ours = estimate.strides_of(foot)
    swings = np.array([swing_s(stride) for stride in ours])
    pairs: list[Pair] = []
    matched, missed, left_out = set[int](), 0, 0
    for true in mine:
        inside = [k for k in range(len(ours)) if true.t_start_s < swings[k] < true.t_end_s and k not in matched]
        if not inside:
            missed += estimate.begin_s + EDGE_S < true.t_start_s and true.t_end_s < estimate.end_s - EDGE_S
            continue
        # the one that shares most time with it
        shared = {
            k: min(true.t_end_s, 1e-9 * ours[k].t_end_ns) - max(true.t_start_s, 1e-9 * ours[k].t_start_ns)
            for k in inside
        }
        chosen = max(inside, key=shared.__getitem__)
        matched.add(chosen)
        if true.usable and ours[chosen].valid:
            pairs += _of_stride(true, ours[chosen], foot, estimate)
        else:
            left_out += 1
    begin, end = mine[0].t_start_s, max(stride.t_end_s for stride in mine)
    near = [k for k in range(len(ours)) if begin < swings[k] < end]
    extra = sum(k not in matched and ours[k].valid for k in near)
    count = Count("stride", foot, len(matched) + missed, len(matched) + extra, missed, extra, left_out)
    return Comparison(tuple(pairs), (count,))


def _of_stride(true: ReferenceStride, ours: StrideResult, foot: str, estimate: Estimate) -> Iterator[Pair]:
    at = 0.5 * (true.t_start_s + true.t_end_s)
    for name, value in true.values.items():
        found = float("nan")
        if name in _OF_STRIDES:
            found = float(getattr(ours, name))
        elif name == "foot_strike_rad" and foot in estimate.strike_rad:
            times, angles = estimate.strike_rad[foot]
            inside = np.flatnonzero((times > true.t_start_s) & (times <= true.t_end_s))
            found = float(angles[inside[0]]) if len(inside) else found
        elif name == "stride_time_s":
            found = 1e-9 * (ours.t_end_ns - ours.t_start_ns)
        if np.isfinite(found) and np.isfinite(value):
            yield Pair(name, foot, at, value, found)


def swing_s(stride: StrideResult) -> float:
    """The middle of a stride's swing, or of the stride where its phases are not known."""
    begin, end = stride.t_swing_ns, stride.t_loading_response_ns
    if begin is None or end is None:
        begin, end = stride.t_start_ns, stride.t_end_ns
    return 0.5 * (begin + end) / NS_PER_S


def _nanoseconds(seconds: FloatArray) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    return np.round(np.asarray(seconds) * NS_PER_S).astype(np.int64)
