"""The gait parameters of a session log, and every drawable stride of a foot on the same points.

A log's strides were finished while the session ran: foot off and initial contact are the entries into swing and loading
response that the controller saw, orientation is kept as pitch only, and step lengths cannot be told. The definitions
are those of :mod:`fes.analysis.parameters`.

Drawn strides run from mid-stance to mid-stance, each in its own frame: x along the stride, y to the left, z up. Each is
stretched to have its heel rise and its foot flat where the foot's strides have them on the mean; without both, evenly.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from fes.analysis.parameters.contacts import Swings, no_swings
from fes.analysis.parameters.gait import (
    GaitParameters,
    neighbours,
    statistics_of,
    stride_parameters,
    symmetry,
    travelled,
    walk_of,
)
from fes.analysis.parameters.motion import MOTION_KEYS, shape_variations
from fes.analysis.parameters.steps import equalise_sides, steps_of
from fes.analysis.tables import by_column
from fes.estimation.strides.boundaries import UNSEEN_NS
from fes.signals import FOOT_SENSORS, NS_PER_S, FloatArray, StrideResult
from statemachine.phases import Phase

NAN = float("nan")
NO_STEP_LENGTHS = "the sensors of a session do not tell how far apart the feet are; fes analyse looks for it"
POINTS = 101
_ENTRIES: Final = (Phase.PRE_SWING, Phase.SWING, Phase.LOADING_RESPONSE, Phase.STANCE)


def gait_of_strides(strides: Sequence[StrideResult], belt_speed_mps: float = NAN) -> GaitParameters:
    """The parameters of all feet in ``strides``; of shanks there are none."""
    by_foot = {foot: _sorted_by_start(strides, foot) for foot in FOOT_SENSORS}
    every = {foot: own for foot, own in by_foot.items() if any(stride.valid for stride in own)}
    scales = equalise_sides({foot: by_column(own) for foot, own in every.items()})
    valid = {foot: [stride for stride in own if stride.valid] for foot, own in every.items()}
    swings = {foot: swings_by_phases(own) for foot, own in valid.items()}
    rows = {}
    for foot, own in valid.items():
        other = next((swings[name] for name in valid if name != foot), no_swings(0))
        columns, motion = by_column(own), _motion(own, swings[foot])
        steps = steps_of(columns, swings[foot], other)
        rows[foot] = stride_parameters(columns, motion, swings[foot], steps, scale=scales[foot])
    feet = {foot: statistics_of(own) for foot, own in rows.items()}
    belt = belt_speed_mps if math.isfinite(belt_speed_mps) else None
    walk = walk_of(map(travelled, rows.values()), belt)
    return GaitParameters(rows, feet, symmetry(feet), walk, None, NO_STEP_LENGTHS, scales)


def swings_by_phases(strides: Sequence[StrideResult]) -> Swings:
    """Of each stride (S,): foot off is T2, contact T3; none where it lacks one."""
    entries = np.array([(s.t_swing_ns, s.t_loading_response_ns) for s in strides], object).reshape(-1, 2)
    times = np.where(entries == None, UNSEEN_NS, entries).astype(np.int64)  # noqa: E711
    swings = no_swings(len(strides))
    seen = (times != UNSEEN_NS).all(axis=1) & (times[:, 0] < times[:, 1])
    swings.foot_off_ns[seen], swings.contact_ns[seen] = times[seen].T
    return swings


def _sorted_by_start(strides: Sequence[StrideResult], foot: str) -> list[StrideResult]:
    return sorted((stride for stride in strides if stride.foot == foot), key=lambda stride: stride.t_start_ns)


def _drawable(stride: StrideResult) -> bool:
    """Whether the stride is valid and has a whole path to draw."""
    path, pitch = stride.trajectory_m, stride.pitch_rad
    whole = len(path) > 1 and pitch.shape == (len(path),) and np.isfinite(path).all() and np.isfinite(pitch).all()
    return stride.valid and bool(whole)


def _motion(strides: Sequence[StrideResult], swings: Swings) -> dict[str, FloatArray]:
    """What the paths of one foot's S valid strides show, by key (S,); x is along the stride, y to the left already."""
    found = np.full((len(MOTION_KEYS), len(strides)), NAN)
    drawable, shapes = [_drawable(stride) for stride in strides], np.zeros((len(strides), POINTS, 6))
    for k, stride in enumerate(strides):
        if not drawable[k]:
            continue
        outward = stride.trajectory_m[:, 1] * (1.0 if stride.foot.startswith("left") else -1.0)
        pitch = stride.pitch_rad - stride.pitch_rad[0]
        found[:3, k] = np.abs(outward).max(), outward.max(), -pitch.min()
        if swings.seen[k]:
            since_ns = np.array((swings.foot_off_ns[k], swings.contact_ns[k])) - stride.t_start_ns
            places = np.linspace(0.0, float(stride.t_end_ns - stride.t_start_ns), len(pitch))
            found[3:5, k] = np.interp(since_ns.astype(np.float64), places, pitch)
        shares = np.linspace(0.0, 1.0, len(pitch))
        for axis in range(3):
            shapes[k, :, axis] = np.interp(np.linspace(0.0, 1.0, POINTS), shares, stride.trajectory_m[:, axis])
    pairs = neighbours(by_column(strides))
    pairs = pairs[np.array(drawable, np.bool_)[pairs].all(axis=1)]
    found[5, pairs[:, 1]] = shape_variations(shapes, pairs)[:, 0]
    return dict(zip(MOTION_KEYS, found, strict=True))


def by_distance(path_m: FloatArray) -> FloatArray | None:
    """A path (N, 3) at POINTS equal shares of its distance along x (POINTS, 3); None where it goes nowhere.

    By place and not by time: a foot that waits longer in stance would else smear the mean over the swing.
    """
    forward = np.maximum.accumulate(path_m[:, 0])
    if not forward[-1] > forward[0]:
        return None
    x = forward[0] + np.linspace(0.0, 1.0, POINTS) * (forward[-1] - forward[0])
    return np.column_stack((x, np.interp(x, forward, path_m[:, 1]), np.interp(x, forward, path_m[:, 2])))


@dataclass(frozen=True)
class FootCurves:
    """S strides of one foot at POINTS places: ``numbers`` (S,), ``path_m`` (S, POINTS, 3).

    ``pitch_rad`` (S, POINTS) is toe up positive, 0 at the start; ``speed_mps`` (S, POINTS) forwards, along the stride;
    ``entries_percent`` by phase the mean place of the entry into it, so stretched, only of phases that were seen.
    """

    foot: str
    numbers: tuple[int, ...]
    path_m: FloatArray
    pitch_rad: FloatArray
    speed_mps: FloatArray
    entries_percent: Mapping[Phase, float]

    @property
    def count(self) -> int:
        """How many strides there are."""
        return len(self.numbers)


def spread_of(values: FloatArray) -> FloatArray:
    """Standard deviation (n − 1) over the first axis; zero of a single row."""
    return np.asarray(values.std(axis=0, ddof=1) if len(values) > 1 else np.zeros(values.shape[1:]))


def foot_curves(
    strides: Sequence[StrideResult], gait: GaitParameters | None, feet: Sequence[str]
) -> dict[str, FootCurves]:
    """Of each of ``feet`` that has a stride to draw."""
    found = {}
    for foot in feet:
        own = [stride for stride in _sorted_by_start(strides, foot) if _drawable(stride)]
        if gait is not None and foot in gait.strides:
            rows = gait.strides[foot]
            steady = set(rows["number"][rows["steady"]].tolist())
            own = [stride for stride in own if stride.number in steady] or own
        own = [stride for stride in own if stride.t_end_ns > stride.t_start_ns]
        if own:
            found[foot] = _curves(foot, own)
    return found


def _curves(foot: str, strides: Sequence[StrideResult]) -> FootCurves:
    begin_ns = np.array([stride.t_start_ns for stride in strides])
    lasted_ns = np.array([stride.t_end_ns for stride in strides]) - begin_ns

    def shares(phase: Phase) -> FloatArray:
        """(S,) when in the stride an entry was, 0 … 1; NaN where it was not seen."""
        since = [getattr(stride, f"t_{phase.name.lower()}_ns") for stride in strides]
        at = [np.nan if t is None else t - begin for t, begin in zip(since, begin_ns.tolist(), strict=True)]
        return np.asarray(np.array(at, dtype=np.float64) / lasted_ns)

    entries = {phase: shares(phase) for phase in _ENTRIES}
    ends = np.column_stack((entries[Phase.PRE_SWING], entries[Phase.STANCE]))
    whole = np.isfinite(ends).all(axis=1) & (ends[:, 0] > 0.0) & (ends[:, 0] < ends[:, 1]) & (ends[:, 1] < 1.0)
    usual = ends[whole].mean(axis=0) if whole.any() else np.array([0.3, 0.7])
    at = np.linspace(0.0, 1.0, POINTS)
    paths, pitches, speeds = [], [], []
    for stride, own, stretched in zip(strides, ends, whole.tolist(), strict=True):
        to, since = ([0.0, *usual, 1.0], [0.0, *own, 1.0]) if stretched else ([0.0, 1.0], [0.0, 1.0])
        taken = np.interp(at, to, since)
        places = np.linspace(0.0, 1.0, len(stride.pitch_rad))
        seconds = (stride.t_end_ns - stride.t_start_ns) / NS_PER_S
        speed = np.gradient(stride.trajectory_m[:, 0], seconds / (len(places) - 1))
        paths.append(np.column_stack([np.interp(taken, places, column) for column in stride.trajectory_m.T]))
        pitches.append(np.interp(taken, places, stride.pitch_rad))
        speeds.append(np.interp(taken, places, speed))
    entered = {
        phase: 100.0 * float(np.mean([np.interp(s, [0.0, *own, 1.0], [0.0, *usual, 1.0]) for s, own in seen]))
        for phase, at_share in entries.items()
        if (seen := [(s, own) for s, own in zip(at_share[whole], ends[whole], strict=True) if np.isfinite(s)])
    }
    numbers = tuple(stride.number for stride in strides)
    return FootCurves(foot, numbers, np.array(paths), np.array(pitches), np.array(speeds), entered)
