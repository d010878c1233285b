"""The whole evaluation: what can be held against a reference; clocks, frames, pairs, and their agreement.

Paths of markers against estimated strides: Negård et al. (2005), Eq. (22), between the instants at which the estimate
begins and ends the stride. A stride counts only where the marker was seen all along, stood still at both ends, and
really went somewhere; where the marker is not at the sensor, only if the foot did not turn.

An optical orientation against what the inertial sensor alone tells: the angle between the two directions of up in the
sensor's axes, which has nothing to do with heading, goes into words; Bland–Altman and the like, which need signed
quantities, get the angles of the sensor's x and z axes to the vertical.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from fes.evaluation.agreement import Differences, Interval, RegressionLine, differences, icc_2_1, regression_line
from fes.evaluation.reference.alignment import MOST_S, Synchrony, horizontal_speed, looks_like_lab, synchronise, to_belt
from fes.evaluation.reference.compare import EDGE_S, TOLERANCE_S, Comparison, Count, Estimate, Pair, compare, swing_s
from fes.evaluation.reference.read import kind_of, orientation_columns
from fes.evaluation.reference.table import POINTS, MarkerPath, Reference, ReferenceError, read_columns
from fes.recording import Recording, Track
from fes.signals import NS_PER_S, FloatArray, StrideResult

AROUND_S: Final = 0.025  # a marker's place is the median over this much before and after
STANDING_MPS: Final = 0.2  # a foot that is faster at a stride's end does not stand
SHORTEST_M: Final = 0.1
STRAIGHT_RAD: Final = math.radians(20.0)
JUMP_MPS: Final = 8.0  # no foot is that fast: the reference jumps
SWING_MPS: Final = 0.3
SWING_SHARE: Final = 0.35  # of the fastest swings: a belt that stands moves a marker in the belt's frame, but slower
SWING_S: Final = 0.15
HOLE_S: Final = 0.1
FEW_HZ: Final = 60.0  # below: the greatest height lies between samples


def compare_path(path: MarkerPath, estimate: Estimate) -> Comparison:
    """Pairs of stride length and clearance, and how many of the marker's swings were found.

    ``path`` is on the recording's clock, in the frame of the ground (or belt).
    """
    ours = estimate.strides_of(path.foot)
    if not ours or len(path.t_s) < 3:
        return Comparison((), ())
    speed = horizontal_speed(path)
    pairs: list[Pair] = []
    left_out = 0
    for stride in ours:
        found = _values(path, stride, speed) if stride.valid else {}
        if estimate.level:
            found.pop("height_gained_m", None)
        inside = path.t_s[0] <= 1e-9 * stride.t_start_ns and 1e-9 * stride.t_end_ns <= path.t_s[-1]
        left_out += inside and not found
        at = 0.5e-9 * (stride.t_start_ns + stride.t_end_ns)
        for name, value in found.items():
            estimated = float(getattr(stride, name))
            if np.isfinite(value) and np.isfinite(estimated):
                pairs.append(Pair(name, path.foot, at, value, estimated))
    swings = marker_swings(path, speed)
    expected = [t for t in swings if estimate.begin_s + EDGE_S < t < estimate.end_s - EDGE_S]
    bounds = [(1e-9 * s.t_start_ns, 1e-9 * s.t_end_ns) for s in ours]
    missed = sum(not any(begin < t < end for begin, end in bounds) for t in expected)
    near = [swing_s(s) for s in ours if s.valid]
    extra = sum(
        path.t_s[0] + EDGE_S < t < path.t_s[-1] - EDGE_S and not any(abs(t - other) < 0.5 for other in swings)
        for t in near
    )
    name = f"swing ({path.point})"
    count = Count(name, path.foot, len(expected), len(expected) - missed + extra, missed, extra, left_out)
    return Comparison(tuple(pairs), (count,))


def marker_swings(path: MarkerPath, speed: FloatArray) -> FloatArray:
    """The middle (s) of every time that the marker moved on for longer than ``SWING_S``."""
    known = speed[np.isfinite(speed)]
    least = max(SWING_MPS, SWING_SHARE * float(np.percentile(known, 99.0))) if len(known) else SWING_MPS
    moving = np.nan_to_num(speed, nan=0.0) > least
    edges = np.flatnonzero(np.diff(np.concatenate([[0], moving.astype(np.int8), [0]])))
    spans = [(float(path.t_s[a]), float(path.t_s[b - 1])) for a, b in zip(edges[::2], edges[1::2], strict=True)]
    joined: list[tuple[float, float]] = []
    for begin, end in spans:
        if joined and begin - joined[-1][1] < HOLE_S:
            joined[-1] = (joined[-1][0], end)
        else:
            joined.append((begin, end))
    return np.array([0.5 * (begin + end) for begin, end in joined if end - begin > SWING_S])


def _values(path: MarkerPath, stride: StrideResult, speed: FloatArray) -> dict[str, float]:
    """What the marker says of a stride; empty where it says nothing that can be used."""
    begin_s, end_s = stride.t_start_ns / NS_PER_S, stride.t_end_ns / NS_PER_S
    first, last = (int(np.argmin(np.abs(path.t_s - t))) for t in (begin_s, end_s))
    interval = 1.0 / path.rate_hz
    if max(abs(path.t_s[first] - begin_s), abs(path.t_s[last] - end_s)) > interval or last - first < 3:
        return {}
    rows, times = path.position_m[first : last + 1], path.t_s[first : last + 1]
    if not np.isfinite(rows).all() or np.diff(times).max() > HOLE_S:
        return {}
    if not (speed[first] < STANDING_MPS and speed[last] < STANDING_MPS):
        return {}
    if np.linalg.norm(np.diff(rows, axis=0), axis=1).max() > JUMP_MPS * interval:
        return {}
    start, end = _place(path, begin_s), _place(path, end_s)
    length = float(np.hypot(*(end - start)[:2]))
    if length < SHORTEST_M or (path.point != "sensor" and abs(stride.turn_rad) > STRAIGHT_RAD):
        return {}
    height = rows[:, 2] - start[2]
    found = {"stride_length_m": length, "height_gained_m": float(end[2] - start[2])}
    if path.point == "toe":
        lowest = _toe_clearance(stride, times, rows, height)
        return found if lowest is None else {**found, "toe_clearance_m": lowest}
    greatest = float(height.max())
    if len(times) >= 4 and (len(times) - 1) / (times[-1] - times[0]) <= FEW_HZ:  # it lies between the samples
        from scipy.interpolate import CubicSpline

        greatest = float(CubicSpline(times, height)(np.linspace(times[0], times[-1], 20 * len(times))).max())
    return {**found, "clearance_m" if path.point == "sensor" else "heel_clearance_m": greatest}


def _place(path: MarkerPath, at_s: float) -> FloatArray:
    """Where the marker stood (3,): median around a moment, of at least three samples."""
    reach = max(AROUND_S, 1.2 / path.rate_hz)
    low, high = np.searchsorted(path.t_s, (at_s - reach, at_s + reach))
    return np.asarray(np.nanmedian(path.position_m[int(low) : max(int(high), int(low) + 1)], axis=0))


def _toe_clearance(stride: StrideResult, times: FloatArray, rows: FloatArray, height: FloatArray) -> float | None:
    """Least height in mid-swing, by the definition of the estimate; None where the stride has no known swing."""
    from fes.estimation.clearance.clearance import mid_swing

    if stride.t_swing_ns is None or stride.t_loading_response_ns is None:
        return None
    low, high = np.searchsorted(times, (stride.t_swing_ns / NS_PER_S, stride.t_loading_response_ns / NS_PER_S))
    swing = slice(int(low), int(high) + 1)
    if len(times[swing]) < 5:
        return None
    t_ns = np.round(times[swing] * NS_PER_S).astype(np.int64)
    lowest, _ = mid_swing(t_ns, height[swing], rows[swing, :2])
    return float(height[swing][lowest])


@dataclass(frozen=True, slots=True)
class Quantity:
    """``factor`` from SI to ``unit``.

    An ``instant`` is a moment, or a single value of a whole walk: its size says nothing, only its error.
    """

    name: str
    label: str
    unit: str
    factor: float
    digits: int
    about: str
    instant: bool = False


_DEG: Final = 57.29577951308232

_TABLE: Final = (
    Quantity("initial_contact_s", "Initial contact", "ms", 1e3, 1, "when the foot touches the ground", True),
    Quantity("foot_off_s", "Foot off", "ms", 1e3, 1, "when the toe leaves the ground", True),
    Quantity("stride_time_s", "Stride time", "ms", 1e3, 1, "initial contact to the next of the same foot"),
    Quantity("stance_time_s", "Stance time", "ms", 1e3, 1, "initial contact to foot off"),
    Quantity("swing_time_s", "Swing time", "ms", 1e3, 1, "foot off to initial contact"),
    Quantity("stride_length_m", "Stride length", "cm", 100.0, 2, "horizontal distance of one foot in one stride"),
    Quantity("clearance_m", "Clearance, sensor", "cm", 100.0, 2, "greatest height of the sensor above its start"),
    Quantity("toe_clearance_m", "Clearance, toe", "cm", 100.0, 2, "least height of the toe in mid-swing"),
    Quantity("heel_clearance_m", "Clearance, heel", "cm", 100.0, 2, "greatest height of the heel"),
    Quantity("height_gained_m", "Height gained", "cm", 100.0, 2, "height of the stride's end above its start; stairs"),
    Quantity("foot_strike_rad", "Foot-strike angle", "deg", _DEG, 2, "sole at contact, toe-up positive"),
    Quantity("speed_mps", "Walking speed", "m/s", 1.0, 3, "stride length over stride time"),
    Quantity(
        "end_distance_m", "End from start", "cm", 100.0, 1, "horizontal distance from the walk's start to its end", True
    ),
    Quantity("end_height_m", "End above start", "cm", 100.0, 1, "height of the walk's end above its start", True),
    Quantity("inclination_x_rad", "Inclination of x", "deg", _DEG, 2, "angle of the sensor's x axis to the vertical"),
    Quantity("inclination_z_rad", "Inclination of z", "deg", _DEG, 2, "angle of the sensor's z axis to the vertical"),
)
QUANTITIES: Final = {quantity.name: quantity for quantity in _TABLE}
BOTH: Final = "both feet"


@dataclass(frozen=True, slots=True)
class Settings:
    """How to hold a reference against an estimate; ``belt_mps`` and ``belt_axis`` for a path in the lab's frame.

    ``compare_belt``: the walking speed against that of the belt, too (always, where the reference holds its speed).
    """

    frame: str = "auto"
    belt_mps: float | None = None
    belt_axis: str | None = None
    compare_belt: bool = False
    fit_lag: bool = False
    lag_s: float | None = None
    most_lag_s: float = MOST_S
    tolerance_s: float = TOLERANCE_S


@dataclass(frozen=True, slots=True)
class AgreementRow:
    """How well one quantity of one foot (or both) agrees, SI."""

    quantity: str
    foot: str
    reference_mean: float
    estimate_mean: float
    differences: Differences
    icc: Interval
    line: RegressionLine

    @property
    def about(self) -> Quantity:
        """Its label and unit."""
        return QUANTITIES[self.quantity]


@dataclass(frozen=True)
class Evaluation:
    """All of it; ``notes`` say what was assumed, ``warnings`` what may be wrong."""

    estimate: Estimate
    sources: tuple[str, ...]
    synchrony: Synchrony
    pairs: tuple[Pair, ...]
    counts: tuple[Count, ...]
    rows: tuple[AgreementRow, ...]
    notes: tuple[str, ...]
    warnings: tuple[str, ...]


def evaluate(estimate: Estimate, reference: Reference, settings: Settings | None = None) -> Evaluation:
    """Bring the reference to the recording's clock and the belt's frame, pair, and work out the agreement.

    ReferenceError: the reference fits nothing that was estimated.
    """
    chosen = settings or Settings()
    reference = _own_feet(reference, estimate)
    notes, paths = list(reference.notes), []
    for path in sorted(reference.paths, key=lambda path: POINTS.index(path.point)):  # the sensor's own marker first
        moved, said = _in_ground_frame(path, reference, chosen)
        paths.append(moved)
        notes += said
    reference = replace(reference, paths=tuple(paths))
    timeless = not (reference.events or reference.strides or reference.paths)  # a belt's speed, a walk's end
    if timeless and not chosen.fit_lag:
        synchrony = Synchrony(chosen.lag_s or 0.0, "", None)
    else:
        synchrony = synchronise(reference, estimate, fit=chosen.fit_lag, given_s=chosen.lag_s, most_s=chosen.most_lag_s)
    reference = reference.shifted(synchrony.applied_s)
    warnings = list(synchrony.warnings)
    comparison = compare(reference, estimate, tolerance_s=chosen.tolerance_s)
    for path in reference.paths:
        comparison = _added(comparison, compare_path(path, estimate))
    if chosen.compare_belt or len(reference.belt):
        comparison = _added(comparison, _belt_speed(reference, estimate, chosen))
    comparison = comparison.joined(_ends(reference, estimate))
    if not comparison.pairs:
        raise ReferenceError(
            f"{', '.join(reference.sources)}: nothing in it fits what was found in the recording; "
            f"{_spans(reference, estimate)}. Is it the same walk, on the same clock (--sync fit)?"
        )
    if synchrony.fitted_to_events:
        warnings.append("the lag was fitted to the events: their mean error says nothing, SD and durations do")
    pairs, counts = comparison.pairs, comparison.counts
    told = tuple(notes), tuple(warnings)
    return Evaluation(estimate, reference.sources, synchrony, pairs, counts, rows_of(pairs), *told)


def rows_of(pairs: tuple[Pair, ...]) -> tuple[AgreementRow, ...]:
    """A row for each quantity and foot, and one for both feet together where there are two."""
    rows = []
    for name in QUANTITIES:
        mine = [pair for pair in pairs if pair.quantity == name]
        feet = sorted({pair.foot for pair in mine})
        rows += [agreement(name, foot, [pair for pair in mine if pair.foot == foot]) for foot in feet]
        if len(feet) > 1:
            rows.append(agreement(name, BOTH, mine))
    return tuple(rows)


def agreement(quantity: str, foot: str, pairs: list[Pair]) -> AgreementRow:
    """The agreement of these pairs; of instants neither ICC nor line, for their size says nothing."""
    true, ours = (np.array([getattr(pair, side) for pair in pairs]) for side in ("reference", "estimate"))
    d = differences(true, ours)
    if QUANTITIES[quantity].instant:
        none = Interval(math.nan)
        return AgreementRow(quantity, foot, math.nan, math.nan, d, none, RegressionLine(none, none, math.nan, none))
    icc = icc_2_1(np.column_stack([true, ours]))
    return AgreementRow(quantity, foot, float(true.mean()), float(ours.mean()), d, icc, regression_line(true, ours))


def _own_feet(reference: Reference, estimate: Estimate) -> Reference:
    """Without what is of feet that the recording does not have. ReferenceError: nothing is left."""
    feet = set(estimate.feet)
    parts = ("events", "strides", "paths", "ends")
    others = {each.foot for part in parts for each in getattr(reference, part)} - feet
    if not others:
        return reference
    note = f"not looked at, for the recording has no such sensor: {', '.join(sorted(others))}"
    kept: dict[str, Any] = {name: tuple(one for one in getattr(reference, name) if one.foot in feet) for name in parts}
    left = replace(reference, **kept, notes=(*reference.notes, note))
    if not left:
        raise ReferenceError(
            f"{', '.join(reference.sources)}: tells of {', '.join(sorted(others))}, and the recording of "
            f"{', '.join(sorted(feet)) or 'no foot that could be followed'}"
        )
    return left


def _in_ground_frame(path: MarkerPath, reference: Reference, settings: Settings) -> tuple[MarkerPath, list[str]]:
    """The path in the frame of the ground or the belt, and what was done in words."""
    belt = reference.belt
    if not len(belt) and settings.belt_mps:
        belt = np.array([[path.t_s[0], settings.belt_mps], [path.t_s[-1], settings.belt_mps]])
    if settings.frame == "ground" or (settings.frame == "auto" and not len(belt)):
        return path, []
    if not len(belt):
        raise ReferenceError(
            "a path in the lab's frame needs the belt's speed: --belt-speed M/S, or a table t_s, speed_mps"
        )
    which = f"{path.foot.replace('_', ' ')}, {path.point}"
    if settings.frame == "auto" and not looks_like_lab(path, belt):
        return path, [f"{which}: goes as far as the belt, so taken as it is"]
    moved = to_belt(path, belt, settings.belt_axis)
    return moved.path, [
        f"{which}: moved to the belt's frame along {moved.axis} (Negård et al., "
        f"Eq. 21), where the standing foot is left with {100 * moved.standing_mps:.1f} cm/s"
    ]


def _belt_speed(reference: Reference, estimate: Estimate, settings: Settings) -> Comparison:
    """Each valid stride's speed against the belt's during it: right on average, not stride by stride."""
    pairs = []
    for foot in estimate.feet:
        for stride in estimate.strides_of(foot):
            begin, end, at = 1e-9 * stride.t_start_ns, 1e-9 * stride.t_end_ns, swing_s(stride)
            speed = settings.belt_mps or 0.0
            if len(reference.belt):
                t_s, known = reference.belt.T
                if begin < t_s[0] or end > t_s[-1]:
                    continue
                speed = float(np.interp(np.linspace(begin, end, 50), t_s, known).mean())
            if stride.valid and speed > 0.05:
                pairs.append(Pair("speed_mps", foot, at, speed, stride.speed_mps))
    return Comparison(tuple(pairs), ())


def _ends(reference: Reference, estimate: Estimate) -> Comparison:
    """Where whole walks ended; heights only where the ground was not said to be level."""
    pairs = []
    for end in reference.ends:
        if end.foot not in estimate.ends:
            continue
        values = (("end_distance_m", end.distance_m), ("end_height_m", math.nan if estimate.level else end.height_m))
        for (name, true), ours in zip(values, estimate.ends[end.foot], strict=True):
            if math.isfinite(true):
                pairs.append(Pair(name, end.foot, estimate.end_s, true, ours))
    return Comparison(tuple(pairs), ())


def _added(first: Comparison, second: Comparison) -> Comparison:
    """Both, every quantity of a foot from one source only: the first that gives it."""
    told = {(pair.quantity, pair.foot) for pair in first.pairs}
    return Comparison(
        first.pairs + tuple(pair for pair in second.pairs if (pair.quantity, pair.foot) not in told),
        first.counts + second.counts,
    )


def _spans(reference: Reference, estimate: Estimate) -> str:
    times = [t for stride in reference.strides for t in (stride.t_start_s, stride.t_end_s)]
    times += [e.t_s for e in reference.events] + [float(path.t_s[k]) for path in reference.paths for k in (0, -1)]
    span = f"{min(times):.1f}–{max(times):.1f} s" if times else "no time"
    return f"it covers {span}, the recording {estimate.begin_s:.1f}–{estimate.end_s:.1f} s"


PAIRS_HZ: Final = 10.0
LEAST: Final = 10


@dataclass(frozen=True, eq=False)
class OrientationReference:
    """Sensor to world, z up: ``t_s`` (N,) increasing, ``quaternion`` (N, 4) w, x, y, z, NaN where it was not seen.

    ``judged`` (N,): where it counts, as while the body moves. ``sensor`` is "" where the file names none.
    """

    source: str
    sensor: str
    t_s: FloatArray
    quaternion: FloatArray
    judged: npt.NDArray[np.bool_]


def only_orientations(paths: Sequence[Path]) -> bool:
    """Whether these references are tables of orientation, all of them."""
    tables = [path for path in paths if path.suffix.lower() in (".csv", ".txt", ".tsv") and path.is_file()]
    return bool(paths) and len(tables) == len(paths) and all(kind_of(read_columns(p)) == "orientation" for p in paths)


def read_orientation(path: Path) -> OrientationReference:
    """Read a table t, q_w, q_x, q_y, q_z, and perhaps sensor (or foot) and moving.

    ReferenceError: it cannot be read, or a quaternion is none.
    """
    table = read_columns(path)
    t_s, quaternion, judged = orientation_columns(table)
    seen = np.isfinite(quaternion).all(axis=1)
    size = np.linalg.norm(quaternion, axis=1)
    wrong = np.flatnonzero(seen & (np.abs(size - 1.0) > 0.05))
    if len(wrong):
        raise ReferenceError(
            f"{path}:{table.first_line + int(wrong[0])}: a quaternion has the length {size[wrong[0]]:.3f}, not 1"
        )
    names = {text.strip() for text in table.columns.get("sensor", table.columns.get("foot", []))}
    if len(names) > 1:
        raise ReferenceError(f"{path}: is of several sensors ({', '.join(sorted(names))}); a table for each, please")
    return OrientationReference(str(path), next(iter(names), ""), t_s, quaternion, judged & seen)


def evaluate_orientation(recording: Recording, references: Sequence[OrientationReference]) -> Evaluation:
    """Hold each reference against its sensor's orientation, off-line; the causal filter's error stands in the notes.

    ReferenceError: the recording has no such sensor, or both hardly overlap.
    """
    pairs: list[Pair] = []
    notes: list[str] = []
    for reference in references:
        own, said = _hold_against(recording, reference)
        pairs += own
        notes += said
    span = [float(t) for reference in references for t in (reference.t_s[0], reference.t_s[-1])]
    source = str(recording.path or recording.name)
    estimate = Estimate(source, "orientation, off-line", min(span), max(span), (), {}, {})
    notes.append("neighbouring samples are alike: the intervals of the table are far too narrow, SD and limits are not")
    sources, found = tuple(reference.source for reference in references), tuple(pairs)
    return Evaluation(estimate, sources, Synchrony(0.0, "", None), found, (), rows_of(found), tuple(notes), ())


def upward(quaternion: FloatArray) -> FloatArray:
    """The world's z axis in the sensor's axes (N, 3)."""
    w, x, y, z = quaternion.T
    up = np.column_stack((2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)))
    return np.asarray(up / np.linalg.norm(up, axis=1, keepdims=True))


def _hold_against(recording: Recording, reference: OrientationReference) -> tuple[list[Pair], list[str]]:
    from fes.estimation.orientation.body import smooth_orientation, track_orientation

    track = _track_of(recording, reference)
    t_s = 1e-9 * (track.t_sensor_ns - track.t_sensor_ns[0])
    index = np.searchsorted(t_s, reference.t_s - 0.5 / track.rate_hz)
    index = np.minimum(index, len(t_s) - 1)
    judged = reference.judged & (np.abs(t_s[index] - reference.t_s) <= 1.0 / track.rate_hz)
    if judged.sum() < LEAST:
        raise ReferenceError(
            f"{reference.source}: fewer than {LEAST} of its orientations fall on samples of {track.sensor}; both begin "
            "at 0 s?"
        )
    true = upward(reference.quaternion[judged])
    notes, off_line = [], np.zeros((0, 3))
    for how, run in (("causal", track_orientation), ("off-line", smooth_orientation)):
        samples = track.acc_mps2, track.gyr_radps, track.rate_hz
        path = run(*samples, acc_range_mps2=track.acc_range_mps2, gyr_range_radps=track.gyr_range_radps)
        off_line = upward(path.quaternion)[index[judged]]
        error = np.degrees(np.arctan2(np.linalg.norm(np.cross(off_line, true), axis=1), (off_line * true).sum(axis=1)))
        notes.append(
            f"{track.sensor}, {how}: the vertical is off by {np.sqrt(np.mean(error**2)):.2f}° (RMS of {len(error)} "
            f"samples), 95 % within {np.percentile(error, 95):.2f}°, worst {error.max():.2f}°"
        )
    times = reference.t_s[judged]
    every = max(round(1.0 / (PAIRS_HZ * float(np.median(np.diff(reference.t_s))))), 1)
    pairs = [
        Pair(name, track.sensor, float(times[k]), float(a[k]), float(b[k]))
        for name, axis in (("inclination_x_rad", 0), ("inclination_z_rad", 2))
        for a, b in [(np.arccos(np.clip(side[:, axis], -1.0, 1.0)) for side in (true, off_line))]
        for k in range(0, len(times), every)
    ]
    return pairs, notes


def _track_of(recording: Recording, reference: OrientationReference) -> Track:
    names = [reference.sensor] if reference.sensor else list(recording.tracks)
    if len(names) != 1 or names[0] not in recording.tracks:
        raise ReferenceError(
            f"{reference.source}: of which sensor is it? The recording has {', '.join(recording.tracks)}; add a column "
            "'sensor'"
        )
    return recording.tracks[names[0]]
