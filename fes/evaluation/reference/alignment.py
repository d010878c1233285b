"""A reference brought to the recording's clock and to the belt's frame.

The clocks are compared by what both saw: a foot's speed, contacts and foot-offs. Walking repeats itself, so that a lag
one stride off looks nearly as good as the right one: a lag is only believed where the signals are alike, the next best
lag is clearly worse, and both halves of the recording say the same. Where it is fitted to the very events that are then
judged, their mean error says nothing any more, and the result says so.

From the laboratory's frame to the belt's: Negård et al. (2005), Eq. (21), ``p_belt = p_lab + v t`` along the walk. The
walking direction is the horizontal axis along which the standing foot loses ``v t``; the speed that is left to it
afterwards tells whether direction and speed were right.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from fes.evaluation.agreement import NAN
from fes.evaluation.reference.compare import Estimate
from fes.evaluation.reference.table import EVENTS, POINTS, MarkerPath, Reference, ReferenceError
from fes.evaluation.timing.marks import pair_times
from fes.signals import NS_PER_S, FloatArray

GRID_S: Final = 0.01
LEAST_OVERLAP: Final = 0.5  # of the shorter signal
LEAST_LIKENESS: Final = 0.7
LEAST_LEAD: Final = 0.02
PEAK_S: Final = 0.3  # around the best lag: its own peak, not another
HALVES_S: Final = 0.05
WIDTH_S: Final = 0.03  # standard deviation of the bump that stands for an event


@dataclass(frozen=True, slots=True)
class Lag:
    """``t_recording = t_reference + lag_s``."""

    lag_s: float  # refined between grid points
    likeness: float  # correlation of the two signals there, −1…1
    residual: float  # what is left of the reference when the scaled recording is taken off, as a share of its RMS
    next_best: float  # the greatest correlation at any other peak
    halves_s: float  # lag of the later half minus lag of the earlier one; a drift of one clock shows here
    caveat: str = ""  # why the lag should not be believed; "" where it may


def event_trains(times_s: Sequence[FloatArray], grid_s: FloatArray, width_s: float = WIDTH_S) -> FloatArray:
    """One column per kind of event: a bump of ``width_s`` at each of its times, on a grid (N,); returns (N, K)."""
    out = np.zeros((len(grid_s), len(times_s)))
    for k, times in enumerate(times_s):
        for at in np.asarray(times, np.float64):
            near = slice(*np.searchsorted(grid_s, (at - 5.0 * width_s, at + 5.0 * width_s)).tolist())
            out[near, k] += np.exp(-0.5 * ((grid_s[near] - at) / width_s) ** 2)
    return out


def find_lag(
    reference_s: FloatArray, reference: FloatArray, recording_s: FloatArray, recording: FloatArray, most_s: float
) -> Lag:
    """Cross-correlate two signals of K columns, each on its own increasing times, up to ``most_s`` either way.

    Times are (N,) and (M,) in s, the signals (N, K) or (N,), (M, K) or (M,); NaN rows count as unknown.

    ValueError: nothing overlaps within that lag, or a signal never changes.
    """
    a, begin_a = _on_grid(reference_s, reference)
    b, begin_b = _on_grid(recording_s, recording)
    offset_s = begin_b - begin_a  # of the grids' first points
    first, last = (round((side * most_s - offset_s) / GRID_S) for side in (-1.0, 1.0))
    steps = np.arange(first, last + 1)
    likeness = np.array([_likeness(a, b, int(step)) for step in steps])
    if not np.isfinite(likeness).any():
        raise ValueError(f"the reference and the recording do not overlap with a lag of up to {most_s:g} s")
    best = int(np.nanargmax(likeness))
    lag_s = offset_s + GRID_S * (float(steps[best]) + _between(likeness, best))
    peak = float(likeness[best])
    away = np.abs(np.arange(len(steps)) - best) > round(PEAK_S / GRID_S)
    others = likeness[away & np.isfinite(likeness)]
    next_best = float(others.max()) if len(others) else NAN
    halves_s = _halves(a, b, int(steps[best]))
    caveat = ""
    if peak < LEAST_LIKENESS:
        caveat = f"the two signals are not much alike at any lag (correlation {peak:.2f})"
    elif np.isfinite(next_best) and peak - next_best < LEAST_LEAD:
        caveat = f"another lag fits nearly as well (correlation {peak:.3f} against {next_best:.3f})"
    elif np.isfinite(halves_s) and abs(halves_s) > HALVES_S:
        caveat = f"the later half asks for {1e3 * halves_s:+.0f} ms more than the earlier one: a clock drifts"
    return Lag(lag_s, peak, float(np.sqrt(max(1.0 - peak * peak, 0.0))), next_best, halves_s, caveat)


def _on_grid(times_s: FloatArray, values: FloatArray) -> tuple[FloatArray, float]:
    """Values (N, K) on an even grid, each column without its mean and of one size; and where the grid begins."""
    times_s, values = np.asarray(times_s, np.float64), np.asarray(values, np.float64)
    values = values[:, None] if values.ndim == 1 else values
    known = np.isfinite(values).all(axis=1) & np.isfinite(times_s)
    times_s, values = times_s[known], values[known]
    if len(times_s) < 3 or times_s[-1] - times_s[0] < 3.0 * GRID_S:
        raise ValueError("a signal for the lag needs at least three known values")
    begin = float(times_s[0])
    grid = begin + GRID_S * np.arange(int((times_s[-1] - begin) / GRID_S) + 1)
    out = np.column_stack([np.interp(grid, times_s, column) for column in values.T])
    out -= out.mean(axis=0)
    size = np.sqrt((out**2).mean(axis=0))
    if not (size > 0.0).any():
        raise ValueError("a signal for the lag never changes")
    return np.asarray(out / np.where(size > 0.0, size, 1.0)), begin


def _likeness(a: FloatArray, b: FloatArray, step: int) -> float:
    """Correlation of ``a[i]`` with ``b[i + step]`` where both are known; NaN where they hardly overlap."""
    low, high = max(0, -step), min(len(a), len(b) - step)
    if high - low < LEAST_OVERLAP * min(len(a), len(b)):
        return NAN
    x, y = a[low:high], b[low + step : high + step]
    x, y = x - x.mean(axis=0), y - y.mean(axis=0)
    size = float(np.sqrt((x * x).sum() * (y * y).sum()))
    return float((x * y).sum()) / size if size > 0.0 else NAN


def _between(likeness: FloatArray, best: int) -> float:
    """Where the top of a parabola through the three points around the best one lies, −0.5…0.5 grid points."""
    if not 0 < best < len(likeness) - 1:
        return 0.0
    left, top, right = likeness[best - 1 : best + 2]
    bend = left - 2.0 * top + right
    return float(np.clip(0.5 * (left - right) / bend, -0.5, 0.5)) if np.isfinite(bend) and bend < 0.0 else 0.0


def _halves(a: FloatArray, b: FloatArray, best: int) -> float:
    """Lag of the later half minus that of the earlier one (s), looked for near the best; NaN where too short."""
    low, high = max(0, -best), min(len(a), len(b) - best)
    middle, reach = (low + high) // 2, round(PEAK_S / GRID_S)
    if high - low < 20 * reach:
        return NAN
    found = []
    for begin, end in ((low, middle), (middle, high)):
        part = a[begin:end]
        steps = [step for step in range(best - reach, best + reach + 1) if begin + step >= 0 and end + step <= len(b)]
        if not steps:
            return NAN
        values = np.array([float((part * b[begin + step : end + step]).sum()) for step in steps])
        at = int(np.argmax(values))
        found.append(GRID_S * (steps[at] + _between(values, at)))
    return found[1] - found[0]


AXES: Final = {"+x": (1.0, 0.0), "-x": (-1.0, 0.0), "+y": (0.0, 1.0), "-y": (0.0, -1.0)}
MOST_LEFT_SHARE: Final = 0.25  # of the belt's speed: more left to the standing foot means a wrong direction or speed
STANDING_PERCENT: Final = 30.0
MOST_S: Final = 10.0
NEAR_S: Final = 0.15
# A smaller lag may come from what is compared: detectors, a marker beside the sensor, what a stride begins with.
IN_STEP_S: Final = {"speed": 0.03, "events": 0.03, "strides": 0.4}


@dataclass(frozen=True, slots=True)
class OnBelt:
    """A path in the belt's frame, the axis walked along, and the standing foot's median speed there (m/s)."""

    path: MarkerPath
    axis: str
    standing_mps: float


def to_belt(path: MarkerPath, belt: FloatArray, axis: str | None = None) -> OnBelt:
    """Move a path of the lab to the belt's frame.

    ``belt`` (N, 2) are times (s) and speed (m/s), which stays as it is before the first and after the last; ``axis``
    "+x", "-x", "+y" or "-y" is the direction of walking, None: found from the standing foot.

    ReferenceError: the standing foot does not move with the belt, along any axis or the one given.
    """
    run_m = _belt_run_m(belt, path.t_s)
    fastest = float(np.abs(belt[:, 1]).max())
    tried = []
    for name in [axis] if axis else list(AXES):
        moved = path.position_m.copy()
        moved[:, :2] += run_m[:, None] * np.array(AXES[name])
        candidate = replace(path, position_m=moved, frame="ground")
        tried.append(OnBelt(candidate, name, standing_speed(candidate)))
    best = min(tried, key=lambda each: each.standing_mps)
    if not best.standing_mps <= MOST_LEFT_SHARE * fastest:
        raise ReferenceError(
            f"the {path.point} marker of the {path.foot.replace('_', ' ')} does not stand still on the belt: with its "
            f"speed of {fastest:.2f} m/s taken off along {best.axis}, the standing foot still moves at "
            f"{best.standing_mps:.2f} m/s. Check the belt's speed, or say --frame ground if there was no treadmill"
        )
    return best


def looks_like_lab(path: MarkerPath, belt: FloatArray) -> bool:
    """Whether a path stays where the treadmill is, instead of going as far as the belt ran."""
    seen = np.flatnonzero(np.isfinite(path.position_m).all(axis=1))
    if len(seen) < 2:
        return False
    run_m = _belt_run_m(belt, path.t_s[seen])
    gone = float(np.linalg.norm(np.ptp(path.position_m[seen, :2], axis=0)))
    return gone < 0.5 * float(np.ptp(run_m))


def standing_speed(path: MarkerPath) -> float:
    """Median horizontal speed (m/s) over the slowest part of a path: what is left to a standing foot."""
    speed = horizontal_speed(path)
    speed = speed[np.isfinite(speed)]
    if not len(speed):
        return float("inf")
    return float(np.median(speed[speed <= np.percentile(speed, STANDING_PERCENT)]))


def horizontal_speed(path: MarkerPath, over_s: float = 0.08) -> FloatArray:
    """Horizontal speed (N,) in m/s, as a difference over ``over_s``; NaN at the ends and where the marker is unseen."""
    reach = max(round(0.5 * over_s * path.rate_hz), 1)
    speed = np.full(len(path.t_s), np.nan)
    if len(speed) > 2 * reach:
        step = path.position_m[2 * reach :, :2] - path.position_m[: -2 * reach, :2]
        speed[reach:-reach] = np.hypot(*step.T) / (path.t_s[2 * reach :] - path.t_s[: -2 * reach])
    return speed


def _belt_run_m(belt: FloatArray, t_s: FloatArray) -> FloatArray:
    """How far the belt has run at each time (N,), from the first of them."""
    knots = np.unique(np.concatenate([belt[:, 0], t_s]))
    speed = np.interp(knots, belt[:, 0], belt[:, 1])
    run = np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) * np.diff(knots))])
    at = np.interp(t_s, knots, run)
    return np.asarray(at - at[0])


@dataclass(frozen=True, slots=True)
class Synchrony:
    """How the reference's clock was brought to the recording's: ``t_recording = t_reference + applied_s``.

    ``by`` says what the lag was found from, ``found`` is what that gave, None where there was nothing to go by.
    """

    applied_s: float
    by: str
    found: Lag | None
    warnings: tuple[str, ...] = ()

    @property
    def fitted_to_events(self) -> bool:
        """Whether the events' own mean error went into the lag."""
        return self.by == "events" and self.found is not None and self.applied_s == self.found.lag_s != 0.0


def synchronise(
    reference: Reference, estimate: Estimate, *, fit: bool, given_s: float | None = None, most_s: float = MOST_S
) -> Synchrony:
    """Find the lag, and say which one to apply: the one given, the one found (``fit``), else none.

    ReferenceError: the lag is to be fitted, and cannot be, or cannot be believed.
    """
    try:
        by, found = _lag(reference, estimate, most_s)
    except ValueError as error:
        if fit:
            raise ReferenceError(f"no lag can be found: {error}. Give it: --lag SECONDS") from error
        return Synchrony(given_s or 0.0, "", None, (f"the clocks could not be checked: {error}",))
    if given_s is not None:
        off = abs(found.lag_s - given_s)
        warning = f"the lag given is {given_s:+.3f} s, the signals ask for {found.lag_s:+.3f} s"
        return Synchrony(given_s, by, found, (warning,) if off > IN_STEP_S[by] and not found.caveat else ())
    if fit:
        if found.caveat:
            raise ReferenceError(
                f"the lag of {found.lag_s:+.3f} s, found by {by}, cannot be believed: {found.caveat}. "
                f"Give it: --lag SECONDS, or search less far: --max-lag SECONDS"
            )
        return Synchrony(found.lag_s, by, found)
    warning = f"the clocks could not be checked: {found.caveat}" if found.caveat else ""
    if not warning and abs(found.lag_s) > IN_STEP_S[by]:
        where = f"{found.lag_s:+.3f} s off the recording's clock"
        warning = f"the reference seems to be {where}; --sync fit would take it off"
    return Synchrony(0.0, by, found, (warning,) if warning else ())


def _lag(reference: Reference, estimate: Estimate, most_s: float) -> tuple[str, Lag]:
    """By a marker's horizontal speed (a lever arm hardly changes it), else by events, else by where strides begin."""
    usable = [p for p in reference.paths if p.foot in estimate.feet and np.isfinite(p.position_m[:, 2]).sum() > 10]
    if usable:
        path = min(usable, key=lambda path: POINTS.index(path.point))
        times, speed = speed_of(estimate, path.foot)
        near = (path.t_s > times[0] - most_s - 1.0) & (path.t_s < times[-1] + most_s + 1.0)
        return "speed", find_lag(path.t_s[near], horizontal_speed(path)[near], times, speed, most_s)

    def both(pairs: list[tuple[list[float], FloatArray]]) -> tuple[list[FloatArray], list[FloatArray]]:
        """The reference's times that can be within the recording at any lag looked at, and ours, if enough of each."""
        begin_s, end_s = estimate.begin_s - most_s - 1.0, estimate.end_s + most_s + 1.0
        near = [(np.array([t for t in true if begin_s < t < end_s]), ours) for true, ours in pairs]
        enough = [(true, ours) for true, ours in near if len(true) > 2 and len(ours) > 2]
        return [true for true, _ in enough], [ours for _, ours in enough]

    true, ours = both(
        [
            (
                [e.t_s for e in reference.events if (e.foot, e.what) == (foot, what)],
                np.asarray(estimate.events.get(foot, {}).get(what, np.zeros(0))),
            )
            for foot in estimate.feet
            for what in EVENTS
        ]
    )
    if true:
        return "events", _refined(lag_by_trains(true, ours, most_s), true, ours)
    starts = {foot: [s.t_start_s for s in reference.strides if s.foot == foot] for foot in estimate.feet}
    mine = {foot: np.array([1e-9 * s.t_start_ns for s in estimate.strides_of(foot)]) for foot in estimate.feet}
    true, ours = both([(starts[foot], mine[foot]) for foot in estimate.feet])
    if not true:
        raise ValueError("the reference holds no events, marker's path or strides near the recording's time")
    return "strides", lag_by_trains(true, ours, most_s, width_s=0.1)


def lag_by_trains(
    true: Sequence[FloatArray], ours: Sequence[FloatArray], most_s: float, width_s: float = WIDTH_S
) -> Lag:
    """The lag of events by kind, each at times (N,) in s, none without any; errors as of :func:`find_lag`."""
    signals = []
    for parts in (true, ours):
        low, high = min(part.min() for part in parts), max(part.max() for part in parts)
        grid = np.arange(low - 0.5, high + 0.5, GRID_S)
        signals.append((grid, event_trains(parts, grid, width_s)))
    return find_lag(*signals[0], *signals[1], most_s)


def _refined(found: Lag, true: list[FloatArray], ours: list[FloatArray]) -> Lag:
    """The median difference of matched events: sharper than the peak of the correlation."""
    off: list[float] = []
    for expected, found_s in zip(true, ours, strict=True):
        moved = np.sort(expected) + found.lag_s
        stamps = [np.round(times * NS_PER_S).astype(np.int64) for times in (moved, np.sort(found_s))]
        off += [1e-9 * float(stamps[1][j] - stamps[0][i]) for i, j in pair_times(stamps[0], stamps[1], 1e9 * NEAR_S)]
    return replace(found, lag_s=found.lag_s + (float(np.median(off)) if off else 0.0))


def speed_of(estimate: Estimate, foot: str) -> tuple[FloatArray, FloatArray]:
    """Estimated horizontal speed of the sensor (N,) in m/s at times (N,): along the strides, 0 between them.

    ValueError: no valid stride with a way.
    """
    times, speeds = list[FloatArray](), list[FloatArray]()
    for stride in estimate.strides_of(foot):
        begin, end = stride.t_start_ns / NS_PER_S, stride.t_end_ns / NS_PER_S
        if times and begin <= times[-1][-1]:
            begin = float(times[-1][-1]) + 1e-3
        if not stride.valid or len(stride.trajectory_m) < 3 or end <= begin:
            continue
        at, fine = np.linspace(begin, end, len(stride.trajectory_m)), np.arange(begin, end, GRID_S)
        if len(fine) >= 10:
            way = np.column_stack([np.interp(fine, at, stride.trajectory_m[:, axis]) for axis in (0, 1)])
            times.append(fine[4:-4])
            speeds.append(np.hypot(*(way[8:] - way[:-8]).T) / (8 * GRID_S))
    if not times:
        raise ValueError(f"no valid stride of the {foot.replace('_', ' ')} was found")
    return np.concatenate(times), np.concatenate(speeds)
