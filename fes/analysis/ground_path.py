"""Where a foot went over the ground: its path through a whole recording, for analysis after the fact.

The path is that of the smoothed ZUPT-aided filter (``fes.estimation.zupt.foot_trajectory``). Nothing measures heading
but the gyroscope, so it drifts; two feet that walk together tell what part of that they do not share. On a treadmill
the path is that over the belt.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from fes.estimation.foot.calibration import FootCalibration
from fes.estimation.numerics.ranks import median
from fes.estimation.zupt.decimation import ZuptSettings
from fes.estimation.zupt.foot_trajectory import FootSamples, foot_samples
from fes.estimation.zupt.trajectory import bend_ahead, over_ground, slopes
from fes.recording import Track
from fes.signals import FloatArray, IntArray

SETTINGS = ZuptSettings()
KEPT_HZ = 50.0
LEAST_STANCES = 12  # of either foot, to tell a drift of the headings from a turn
MOST_STANCES = 400  # of a long walk, evenly picked


@dataclass(frozen=True, slots=True)
class GroundPath:
    """The path of one foot's sensor; K samples of at most 50 Hz.

    ``position_m`` counts from its start: x ahead, towards where the foot first is 2 m away from there, y left, z up.
    """

    foot: str
    t_ns: IntArray  # (K,)
    position_m: FloatArray  # (K, 3)
    heading_rad: FloatArray  # (K,) of the toe, from x towards y; turns by less than half a turn between stances
    distance_m: float  # horizontal distances from stance to stance, summed; none across a gap
    stance_ns: IntArray  # (M,) the quietest instant of every stance
    seen_ns: IntArray  # (P, 2) where it begins and ends, and begins again after a gap, from where it was

    def __repr__(self) -> str:
        return f"GroundPath {self.foot}: {self.distance_m:.2f} m, ends {self.closure_m:.2f} m from its start"

    @property
    def closure_m(self) -> float:
        """Horizontal distance of the end from the start: the error, for who returned to where he set out."""
        return float(np.hypot(*self.position_m[-1, :2]))

    @property
    def height_gained_m(self) -> float:
        """How much higher the end is than the start; 0 but for small errors if the ground was said to be level."""
        return float(self.position_m[-1, 2])

    def places_at(self, t_ns: IntArray) -> FloatArray:
        """Rows (M, 4) of x, y, z (m) and heading (rad) at M instants; NaN in gaps, beyond the ends it stands still."""
        begin = self.t_ns[0]
        asked, known = (np.asarray(t - begin, dtype=np.float64) for t in (np.asarray(t_ns, np.int64), self.t_ns))
        columns = (*self.position_m.T, self.heading_rad)
        places = np.column_stack([np.interp(asked, known, column) for column in columns])
        unseen = (part := np.searchsorted(self.seen_ns[:, 0], t_ns, side="right")) > 0
        unseen &= (part < len(self.seen_ns)) & (np.asarray(t_ns) > self.seen_ns[part - 1, 1])
        places[unseen] = math.nan
        return places

    def at_rate(self, rate_hz: float = 10.0, origin_ns: int | None = None) -> tuple[IntArray, FloatArray]:
        """M instants, whole periods after the origin (None: the path's beginning), ns, and their :meth:`places_at`."""
        origin = int(self.t_ns[0]) if origin_ns is None else origin_ns
        spans_s = (np.clip(self.seen_ns, self.t_ns[0], self.t_ns[-1]) - origin) * 1e-9
        bounds = [(math.ceil(begin * rate_hz), math.floor((end + 1e-9) * rate_hz)) for begin, end in spans_s.tolist()]
        numbers = np.concatenate([np.arange(first, last + 1) for first, last in bounds])
        if len(bounds) > 1:  # two parts may meet
            numbers = np.unique(numbers)
        t_ns = origin + np.round(numbers * (1.0 / rate_hz) * 1e9).astype(np.int64)
        return t_ns, self.places_at(t_ns)


def ground_path(
    track: Track, calibration: FootCalibration, *, level: bool = True, foot: FootSamples | None = None
) -> GroundPath:
    """Follow one foot through a whole recording; its calibration says where the toe points.

    ``level``: the foot rests at one height; not on stairs and slopes. ``foot``: the same samples, already prepared.

    Raises:
        ValueError: the recording is too short, the foot never rests, or nothing comes of it.
    """
    if foot is None:
        ranges = track.acc_range_mps2, track.gyr_range_radps
        try:
            foot = foot_samples(track.t_sensor_ns, track.acc_mps2, track.gyr_radps, *ranges)
        except ValueError as error:
            raise ValueError(f"{track.sensor}: {error}") from error
    trajectory = foot.trajectory(SETTINGS, level=level)
    t_ns, stances, seen_ns = foot.t_ns, foot.stances(), foot.seen_ns()
    step = max(round(foot.rate_hz / KEPT_HZ), 1)
    kept = np.append(t_ns[:-1:step], t_ns[-1])
    if len(seen_ns) > 1:
        kept = _within(seen_ns, np.union1d(kept, seen_ns))
        stances = stances[np.isin(t_ns[stances], _within(seen_ns, t_ns[stances]))]
    stance_ns, position, heading = t_ns[stances], np.empty((len(kept), 3)), np.empty(len(kept))
    room = np.empty(len(trajectory.t_ns)), np.empty(len(stances))
    over_ground(*trajectory, calibration.forward(), stance_ns, kept, *room, position, heading)
    if not (np.isfinite(position).all() and np.isfinite(heading).all()):
        # the other foot's path would come out so too, for they share their drift
        raise ValueError("the path comes out as no number; check the units")
    x, y, _ = np.diff(trajectory.positions_at(stance_ns), axis=0).T
    part = np.searchsorted(seen_ns[:, 0], stance_ns, side="right")
    went_m = float(np.hypot(x, y)[part[1:] == part[:-1]].sum())
    return GroundPath(calibration.sensor, kept, position, heading, went_m, stance_ns, seen_ns)


def _within(spans_ns: IntArray, t_ns: IntArray) -> IntArray:
    """Those of M instants that lie within one of the spans (P, 2)."""
    part = np.searchsorted(spans_ns[:, 0], t_ns, side="right")
    kept: IntArray = t_ns[(part > 0) & (t_ns <= spans_ns[part - 1, 1])]
    return kept


def _unwrapped(angle: FloatArray) -> FloatArray:
    """Angles (K,) changed by whole turns, in place, so that no step is more than half of one: ``np.unwrap``, sooner."""
    turns = np.rint(np.diff(angle) * (0.5 / np.pi))
    if turns.any():
        angle[1:] -= 2.0 * np.pi * np.cumsum(turns)
    return angle


def continued(before: GroundPath, path: GroundPath, at_ns: int) -> GroundPath:
    """The path turned and shifted so that it goes on where the one before is at a time that both know.

    They are joined in the stance next to that time, where a foot has a heading for certain.
    """
    t_ns = path.stance_ns[[int(np.argmin(np.abs(path.stance_ns - at_ns)))]]
    turn = float(before.places_at(t_ns)[0, 3] - path.places_at(t_ns)[0, 3])
    c, s = float(np.cos(turn)), float(np.sin(turn))
    position = path.position_m @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]).T
    turned = replace(path, position_m=position, heading_rad=path.heading_rad + turn)
    return replace(turned, position_m=position + (before.places_at(t_ns) - turned.places_at(t_ns))[0, :3])


def without_relative_drift(left: GroundPath, right: GroundPath) -> tuple[GroundPath, GroundPath]:
    """Both feet's paths without the part of their heading's drift in which they differ.

    Two feet of one walker go in one direction, so their headings at stance differ by a constant (toes point outward)
    but for what a turn does for a moment. A drift per stride in that difference (the median slope over pairs of
    stances, Theil 1950, Sen 1968) is an error; nothing says whose, so each foot takes half. On a healthy walk before
    cameras, the errors were such mirror images: +0.56 and −0.48 °/s. Without enough strides both are returned as they
    are.
    """
    drift = _relative_drift(left, right)

    def turned(path: GroundPath, per_stride_rad: float) -> GroundPath:
        """Bent by an angle that grows from stance to stance, and turned to where it is 2 m away."""
        place, heading = np.empty(path.position_m.shape), np.empty(len(path.t_ns))
        bend_ahead(path.t_ns, left.stance_ns, per_stride_rad, path.position_m, path.heading_rad, place, heading)
        return replace(path, position_m=place, heading_rad=heading)

    return turned(left, -0.5 * drift), turned(right, 0.5 * drift)


def _relative_drift(left: GroundPath, right: GroundPath) -> float:
    """By how much the left heading runs away from the right one per stride (rad), positive to the left."""
    common = left.stance_ns[(left.stance_ns >= right.stance_ns[0]) & (left.stance_ns <= right.stance_ns[-1])]
    if len(common) < LEAST_STANCES:
        return 0.0
    right_heading = _unwrapped(right.places_at(right.stance_ns)[:, 3])
    since, known = ((t - common[0]).astype(np.float64) for t in (common, right.stance_ns))
    of_right = np.interp(since, known, right_heading)
    difference = _unwrapped(_unwrapped(left.places_at(common)[:, 3]) - of_right)
    count = min(len(common), MOST_STANCES)
    picked = np.linspace(0, len(common) - 1, count).round()
    difference = difference[picked.astype(int)]
    least = count // 4
    each = np.empty((count - least) * (count - least + 1) // 2)
    slopes(difference, picked, least, each)
    return median(each)
