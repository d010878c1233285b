"""Walking bouts of a free-living or clinic day, and within them turns, stairs and slopes.

A bout is walking with at least two strides of each foot and no break of more than three seconds (Kluge et al. 2021, the
Mobilise-D consensus). A stride counts only where the feet alternate; legs that swing, tap or bounce while one sits do
so alone or at the same place. Of one foot alone three strides in a row and a true rest are asked for.

Turns: where the heading, the mean of both feet's, changes faster than 15°/s, to 45° at least (El-Gohary et al. 2014;
here 30°). Stairs and slopes by the height that a stride gained as the sensor alone shows it: a stair's pitch is 20 to
45° (EN 17210), a walkable slope is under 1 in 5.

Aggregates over bouts of several lengths are those of Mobilise-D (mobgap): all, 10 to 30 s, over 10, 30 and 60 s.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from statistics import median
from typing import Any, NamedTuple

import numpy as np

from fes.analysis.results import Analysis
from fes.estimation.strides.schema import Column
from fes.signals import NS_PER_S, FloatArray, IntArray, StrideResult

LONGEST_BREAK_S = 3.0
LEAST_OF_EACH_FOOT, LEAST_OF_ONE_FOOT = 2, 3
LEAST_LENGTH_M, LONGEST_STRIDE_S = 0.15, 4.0
MOST_RISE_M = 0.5  # of a stride: two steps of the steepest stairs
TURN_RATE_RADPS, LEAST_TURN_RAD = math.radians(15.0), math.radians(30.0)
AROUND_RADPS = math.radians(5.0)  # before and after: there one foot has turned and the other has not yet
RESTING_SHARE = 0.5  # more than this of each foot's strides rest; a pedal or a leg that swings never rests
LEAST_STAIRS_M, STAIRS_SLOPE, LEAST_SLOPE = 0.2, 0.2, 0.04
STAIRS_STRIDES, SLOPE_STRIDES = 2, 4  # that a stretch has at least
LEVEL, STAIRS_UP, STAIRS_DOWN, SLOPE_UP, SLOPE_DOWN = "level", "stairs_up", "stairs_down", "slope_up", "slope_down"
NO_REST = "no true rest"

BOUT_COLUMNS = (
    Column("bout", int, "", "counts the bouts from 1"),
    Column("begin_s", float, "s", "the first foot off"),
    Column("end_s", float, "s", "the last initial contact"),
    Column("duration_s", float, "s", "from begin to end"),
    Column("strides", int, "", "of both feet"),
    Column("distance_m", float, "m", "mean of the feet's summed stride lengths"),
    Column("cadence_per_min", float, "1/min", "120 s over the mean stride time in s"),
    Column("stride_time_s", float, "s", "mean, from initial contact to the next"),
    Column("stride_time_sd_s", float, "s", "its standard deviation"),
    Column("stride_length_m", float, "m", "mean"),
    Column("stride_length_sd_m", float, "m", "its standard deviation"),
    Column("speed_mps", float, "m/s", "mean stride length over mean stride time"),
    Column("turns", int, "", "of 30° and more"),
    Column("stairs_strides", int, "", "strides on stairs"),
    Column("slope_strides", int, "", "strides on slopes"),
)
TURN_COLUMNS = (
    Column("bout", int, "", "in which it is"),
    Column("begin_s", float, "s", "from then on the heading changes faster than 15°/s", "El-Gohary et al. 2014"),
    Column("end_s", float, "s", "until then"),
    Column("duration_s", float, "s", "from begin to end"),
    Column("angle_rad", float, "rad", "to the left positive"),
)
TERRAIN_COLUMNS = (
    Column("bout", int, "", "in which it is"),
    Column("begin_s", float, "s", "the first foot off on it"),
    Column("end_s", float, "s", "the last initial contact on it"),
    Column("terrain", str, "", "level, stairs_up, stairs_down, slope_up or slope_down"),
    Column("strides", int, "", "of both feet"),
    Column("height_gained_m", float, "m", "mean of the feet's summed rises"),
)
LENGTHS_S: Mapping[str, tuple[float, float]] = {
    "all": (0.0, math.inf),
    "10 to 30 s": (10.0, 30.0),
    "over 10 s": (10.0, math.inf),
    "over 30 s": (30.0, math.inf),
    "over 60 s": (60.0, math.inf),
}


@dataclass(frozen=True, slots=True)
class Stride:
    """What is kept of a stride of a long day; times in s."""

    foot: str
    begin_s: float
    end_s: float
    off_s: float
    contact_s: float
    length_m: float
    rise_m: float
    turn_rad: float
    rests: bool


@dataclass(frozen=True, slots=True)
class Turn:
    """``angle_rad``: to the left positive."""

    begin_s: float
    end_s: float
    angle_rad: float


class Stretch(NamedTuple):
    """Strides in a row on one ``terrain``."""

    begin_s: float
    end_s: float
    terrain: str
    strides: int
    height_gained_m: float


@dataclass(frozen=True)
class Bout:
    """From the first foot off to the last initial contact; ``strides`` by their contacts, both feet's."""

    strides: tuple[Stride, ...]

    @property
    def begin_s(self) -> float:
        """The first foot off."""
        return min(stride.off_s for stride in self.strides)

    @property
    def end_s(self) -> float:
        """The last initial contact."""
        return max(stride.contact_s for stride in self.strides)

    def feet(self) -> list[list[Stride]]:
        """Each foot's own."""
        names = dict.fromkeys(stride.foot for stride in self.strides)
        return [[stride for stride in self.strides if stride.foot == name] for name in names]

    def stride_times_s(self) -> FloatArray:
        """(K,) from contact to contact of each foot, none across a missing stride."""
        pairs = [(a.contact_s, b) for own in self.feet() for a, b in pairwise(own)]
        return np.array([b.contact_s - contact for contact, b in pairs if b.contact_s - contact < LONGEST_STRIDE_S])

    def turns(self) -> list[Turn]:
        """Where the heading changes faster than 15°/s, by 30° at least."""
        marks = np.unique([t for stride in self.strides for t in (stride.begin_s, stride.end_s)])
        middle = 0.5 * (marks[1:] + marks[:-1])
        rates, seen = np.zeros(len(middle)), np.zeros(len(middle))
        for own in self.feet():
            for stride in own:
                inside = (middle > stride.begin_s) & (middle < stride.end_s)
                rates[inside] += stride.turn_rad / (stride.end_s - stride.begin_s)
                seen[inside] += 1.0
        rates /= np.maximum(seen, 1.0)
        turning = np.where(np.abs(rates) >= AROUND_RADPS, np.sign(rates), 0.0)
        edges = np.flatnonzero(np.diff(turning, prepend=0.0, append=0.0))
        found = []
        for first, last in pairwise(edges.tolist()):
            fast = first + np.flatnonzero(np.abs(rates[first:last]) >= TURN_RATE_RADPS)
            angle = float(np.sum(rates[first:last] * np.diff(marks)[first:last]))
            if fast.size and abs(angle) >= LEAST_TURN_RAD:
                found.append(Turn(float(marks[fast[0]]), float(marks[fast[-1] + 1]), angle))
        return found

    def terrain(self) -> list[Stretch]:
        """Stretches of level ground, stairs and slopes, in order."""
        kinds = _without_short([_terrain_of(self.strides, k) for k in range(len(self.strides))])
        edges = [0, *(k for k in range(1, len(kinds)) if kinds[k] != kinds[k - 1]), len(kinds)]
        feet = len(self.feet())
        found = []
        for first, last in pairwise(edges):
            own = self.strides[first:last]
            rise = math.fsum(stride.rise_m for stride in own if math.isfinite(stride.rise_m)) / feet
            begin, end = min(s.off_s for s in own), max(s.contact_s for s in own)
            found.append(Stretch(begin, end, kinds[first], len(own), rise))
        return found

    def row(self, number: int) -> dict[str, Any]:
        """With the columns of :data:`BOUT_COLUMNS`."""
        times, lengths = self.stride_times_s(), np.array([stride.length_m for stride in self.strides])
        time = float(times.mean()) if times.size else math.nan
        on = dict.fromkeys((STAIRS_UP, STAIRS_DOWN, SLOPE_UP, SLOPE_DOWN, LEVEL), 0)
        for stretch in self.terrain():
            on[stretch.terrain] += stretch.strides
        return {
            "bout": number,
            "begin_s": self.begin_s,
            "end_s": self.end_s,
            "duration_s": self.end_s - self.begin_s,
            "strides": len(self.strides),
            "distance_m": float(lengths.sum()) / len(self.feet()),
            "cadence_per_min": 120.0 / time,
            "stride_time_s": time,
            "stride_time_sd_s": float(times.std(ddof=1)) if times.size > 1 else math.nan,
            "stride_length_m": float(lengths.mean()),
            "stride_length_sd_m": float(lengths.std(ddof=1)),
            "speed_mps": float(lengths.mean()) / time,
            "turns": len(self.turns()),
            "stairs_strides": on[STAIRS_UP] + on[STAIRS_DOWN],
            "slope_strides": on[SLOPE_UP] + on[SLOPE_DOWN],
        }


def kept_of(strides: Iterable[StrideResult]) -> list[Stride]:
    """Of all strides those that may be walking, by their contacts."""
    found = []
    for each in strides:
        lasts_s = (each.t_end_ns - each.t_start_ns) / NS_PER_S
        rise_m = each.free_rise_m
        if not each.valid or each.stride_length_m < LEAST_LENGTH_M or abs(rise_m) > MOST_RISE_M:
            continue
        off = each.t_start_ns if each.t_swing_ns is None else each.t_swing_ns
        contact = each.t_end_ns if each.t_loading_response_ns is None else each.t_loading_response_ns
        if (contact - off) / NS_PER_S > LONGEST_BREAK_S or (lasts_s > LONGEST_STRIDE_S and each.t_swing_ns is None):
            continue
        begin_s, end_s, off_s, contact_s = (1e-9 * t for t in (each.t_start_ns, each.t_end_ns, off, contact))
        rests = not each.reason.startswith(NO_REST)
        size = each.stride_length_m, rise_m, each.turn_rad
        found.append(Stride(each.foot, begin_s, end_s, off_s, contact_s, *size, rests))
    return sorted(found, key=lambda stride: stride.contact_s)


def bouts_of(strides: Sequence[Stride]) -> list[Bout]:
    """Bouts of these strides (of :func:`kept_of`), by time."""
    feet = {stride.foot for stride in strides}
    if len(feet) > 1:
        strides = _alternating(strides)
    found: list[list[Stride]] = []
    for stride in strides:
        if not found or stride.off_s - found[-1][-1].contact_s > LONGEST_BREAK_S:
            found.append([])
        found[-1].append(stride)
    return [Bout(tuple(own)) for own in found if _enough(own, feet)]


def _enough(strides: Sequence[Stride], feet: set[str]) -> bool:
    if len(feet) == 1:
        return sum(stride.rests for stride in strides) >= LEAST_OF_ONE_FOOT
    each = [[stride.rests for stride in strides if stride.foot == foot] for foot in feet]
    return all(len(own) >= LEAST_OF_EACH_FOOT and sum(own) > RESTING_SHARE * len(own) for own in each)


def _alternating(strides: Sequence[Stride]) -> list[Stride]:
    """Those before or after which the other foot went."""
    follows = [
        a.foot != b.foot and b.off_s - a.contact_s <= LONGEST_BREAK_S and b.contact_s > a.contact_s
        for a, b in pairwise(strides)
    ]
    return [
        stride for stride, before, after in zip(strides, [False, *follows], [*follows, False], strict=True)
        if before or after
    ]  # fmt: skip


def _terrain_of(strides: Sequence[Stride], k: int) -> str:
    """Of one stride, from the middle one of it and its neighbours."""
    near = [stride for stride in strides[max(k - 1, 0) : k + 2] if math.isfinite(stride.rise_m)]
    if not near:
        return LEVEL
    rise, length = median(stride.rise_m for stride in near), median(stride.length_m for stride in near)
    if abs(rise) >= LEAST_STAIRS_M and abs(rise) >= STAIRS_SLOPE * length:
        return STAIRS_UP if rise > 0.0 else STAIRS_DOWN
    if abs(rise) >= LEAST_SLOPE * length:
        return SLOPE_UP if rise > 0.0 else SLOPE_DOWN
    return LEVEL


def _without_short(kinds: list[str]) -> list[str]:
    """Stretches that are too short for stairs or a slope are level."""
    least = {STAIRS_UP: STAIRS_STRIDES, STAIRS_DOWN: STAIRS_STRIDES, LEVEL: 0}
    out, k = list(kinds), 0
    while k < len(kinds):
        end = k
        while end < len(kinds) and kinds[end] == kinds[k]:
            end += 1
        if end - k < least.get(kinds[k], SLOPE_STRIDES):
            out[k:end] = [LEVEL] * (end - k)
        k = end
    return out


def spans_ns(bouts: Sequence[Bout]) -> IntArray:
    """(M, 2) begins and ends of the bouts, ns; a microsecond of room, for times in s are rounded."""
    return (
        np.array([[bout.begin_s * 1e9 - 1e3, bout.end_s * 1e9 + 1e3] for bout in bouts]).reshape(-1, 2).astype(np.int64)
    )


def walking_only(analyses: Iterable[Analysis], kept: list[Stride]) -> Iterator[Analysis]:
    """Of a long day, chunk after chunk with only what is walking; ``kept`` gathers all strides that may be walking.

    A bout may go on in the next chunk, so that each waits for the one after.
    """
    waiting: Analysis | None = None
    before: list[Stride] = []
    here: list[Stride] = []
    for analysis in analyses:
        after = kept_of(analysis.strides)
        kept += after
        if waiting is not None:
            yield replace(waiting, walking_ns=spans_ns(bouts_of(before + here + after)))
        waiting, before, here = analysis, here, after
        del analysis
    if waiting is not None:
        yield replace(waiting, walking_ns=spans_ns(bouts_of(before + here)))


def bout_tables(bouts: Sequence[Bout]) -> dict[str, list[dict[str, Any]]]:
    """All tables by their names: a flat row per bout, per turn, per stretch of one terrain, per length of bouts."""
    rows = [bout.row(number) for number, bout in enumerate(bouts, 1)]
    return {
        "bouts": rows,
        "turns": turn_rows(bouts),
        "terrain": terrain_rows(bouts),
        "bouts_by_length": length_rows(rows),
    }


def turn_rows(bouts: Sequence[Bout]) -> list[dict[str, Any]]:
    """One flat row per turn."""
    return _rows(TURN_COLUMNS, bouts, Bout.turns, lambda t: (t.begin_s, t.end_s, t.end_s - t.begin_s, t.angle_rad))


def terrain_rows(bouts: Sequence[Bout]) -> list[dict[str, Any]]:
    """One flat row per stretch of one terrain."""
    return _rows(TERRAIN_COLUMNS, bouts, Bout.terrain, tuple)


def _rows(
    columns: Sequence[Column], bouts: Sequence[Bout], of: Callable[[Bout], list[Any]], values: Callable[[Any], Any]
) -> list[dict[str, Any]]:
    names = [column.name for column in columns]
    numbered = ((number, each) for number, bout in enumerate(bouts, 1) for each in of(bout))
    return [dict(zip(names, (number, *values(each)), strict=True)) for number, each in numbered]


def length_rows(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Over bouts of each length of :data:`LENGTHS_S`: how many, how long, how far; means and the 90th percentile.

    ``rows`` are of :data:`BOUT_COLUMNS`. A mean over bouts counts every bout once, however long.
    """
    found = []
    for name, (least, most) in LENGTHS_S.items():
        own = [row for row in rows if least <= row["duration_s"] <= most]
        sums = {f"{key}_sum": math.fsum(row[key] for row in own) for key in ("duration_s", "distance_m")}
        counts = {key: sum(row[key] for row in own) for key in ("strides", "turns", "stairs_strides", "slope_strides")}
        found.append({"length": name, "bouts": len(own), **sums, **counts} | _spread(own))
    return found


def _spread(rows: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    found = {}
    for key in ("duration_s", "cadence_per_min", "stride_time_s", "stride_length_m", "speed_mps"):
        values = np.array([row[key] for row in rows])
        values = values[np.isfinite(values)]
        found[f"{key}_mean"] = float(values.mean()) if values.size else math.nan
        found[f"{key}_p90"] = float(np.percentile(values, 90)) if values.size else math.nan
    return found
