"""Where a foot went over the ground: its path through a whole recording, for analysis after the fact.

The path is that of the smoothed ZUPT-aided filter (``fes.estimation.zupt.foot_trajectory``). Nothing measures heading
but the gyroscope, so it drifts; two feet that walk together tell what part of that they do not share. On a treadmill
the path is that over the belt.

Also stride lengths as the mean of two solutions. A stride solved by itself forgets all that was before; the filter
knows the whole recording, but an end that is worse than it looks spoils neighbours too. They err for different reasons
(their errors correlate by 0.5 to 0.7), so their mean errs less than either; with equal weights, for a weight found from
recordings errs itself (Clemen 1989). Where the two are far apart the stride's own solution stays.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from fes.estimation.foot.calibration import FootCalibration
from fes.estimation.numerics.rotation import rotate_all
from fes.estimation.strides.integration import SOLVED
from fes.estimation.strides.results import Rows
from fes.estimation.zupt.decimation import ZuptSettings
from fes.estimation.zupt.foot_trajectory import FootSamples, Trajectory, foot_samples
from fes.recording import Track
from fes.signals import NS_PER_S, FloatArray, IntArray

SETTINGS = ZuptSettings()
KEPT_HZ = 50.0
AHEAD_M = 2.0
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
        columns = (*self.position_m.T, self.heading_rad)
        places = np.column_stack([_at(t_ns, self.t_ns, column) for column in columns])
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
    stance_ns = t_ns[stances]
    facing = _without_false_turns(trajectory.t_ns, _headings(trajectory, calibration.forward()), stance_ns)
    position, heading = trajectory.positions_at(kept), _at(kept, trajectory.t_ns, facing)
    position, heading = _pointing_ahead(position, heading)
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


def _at(asked_ns: IntArray, known_ns: IntArray, values: FloatArray) -> FloatArray:
    """Values (M,) at instants, linear between those (K,) at known ones, and as at the ends beyond them."""
    begin = known_ns[0]
    asked, known = ((np.asarray(t_ns, np.int64) - begin).astype(np.float64) for t_ns in (asked_ns, known_ns))
    return np.asarray(np.interp(asked, known, values))


def _headings(trajectory: Trajectory, axis: FloatArray) -> FloatArray:
    """Where an ``axis`` (3,) of the sensor points (K,), from x towards y, in rad without whole turns in between."""
    ahead, left, _ = rotate_all(trajectory.q_world_from_sensor, axis).T
    return np.unwrap(np.arctan2(left, ahead))


def _without_false_turns(t_ns: IntArray, heading: FloatArray, stance_ns: IntArray) -> FloatArray:
    """Headings (K,) without false whole turns: a toe that points straight down between stances (M,) has none."""
    at_stance = _at(stance_ns, t_ns, heading)
    off = np.unwrap(at_stance) - at_stance
    return heading + off[np.searchsorted((stance_ns[1:] + stance_ns[:-1]) // 2, t_ns, side="right")]


def _pointing_ahead(position: FloatArray, heading: FloatArray) -> tuple[FloatArray, FloatArray]:
    """A path (K, 3), (K,) turned so that x points to where it first is 2 m away (at most as far as it goes)."""
    x, y, z = position.T
    far2 = x * x + y * y
    at = int(np.argmax(far2 >= min(AHEAD_M**2, 0.998 * far2.max())))
    angle = math.atan2(y[at], x[at])
    c, s = math.cos(angle), math.sin(angle)
    angle += 2.0 * math.pi * math.floor((heading[0] - angle) / (2.0 * math.pi) + 0.5)
    return np.column_stack((c * x + s * y, c * y - s * x, z)), heading - angle


def _bent(path: GroundPath, stance_ns: IntArray, per_stride_rad: float) -> GroundPath:
    """Bent by an angle that grows by so much from stance to stance (M,), and turned to where it is 2 m away.

    Each part of the path turns by the mean of the angles at its ends.
    """
    strides = _at(path.t_ns, stance_ns, np.arange(float(len(stance_ns))))
    angle, (x, y, z) = per_stride_rad * strides, path.position_m.T
    mean = 0.5 * (angle[1:] + angle[:-1])
    steps = np.diff(x + 1j * y) * (np.cos(mean) + 1j * np.sin(mean))
    place = x[0] + 1j * y[0] + np.concatenate(([0.0], np.cumsum(steps)))
    position, heading = _pointing_ahead(np.column_stack((place.real, place.imag, z)), path.heading_rad + angle)
    return replace(path, position_m=position, heading_rad=heading)


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
    return _bent(left, left.stance_ns, -0.5 * drift), _bent(right, left.stance_ns, 0.5 * drift)


def _relative_drift(left: GroundPath, right: GroundPath) -> float:
    """By how much the left heading runs away from the right one per stride (rad), positive to the left."""
    common = left.stance_ns[(left.stance_ns >= right.stance_ns[0]) & (left.stance_ns <= right.stance_ns[-1])]
    if len(common) < LEAST_STANCES:
        return 0.0
    right_heading = np.unwrap(right.places_at(right.stance_ns)[:, 3])
    of_right = _at(common, right.stance_ns, right_heading)
    difference = np.unwrap(np.unwrap(left.places_at(common)[:, 3]) - of_right)
    count = min(len(common), MOST_STANCES)
    picked = np.linspace(0, len(common) - 1, count).round()
    difference = difference[picked.astype(int)]
    apart = range(count // 4, count)
    slopes = [(difference[k:] - difference[:-k]) / (picked[k:] - picked[:-k]) for k in apart]
    return float(np.median(np.concatenate(slopes)))


# A path that is to close its loops trusts its rests less. The creep is chosen for the mean: 2 mm/s there and 8 mm/s
# here make the 5 mm/s by which an instep creeps.
STRIDE_SETTINGS = ZuptSettings(drift_speed_mps=0.008, rest_speed_mps=0.005, rest_correlation_s=0.05)
LONGEST_S = 20.0
FAR_APART = 0.1  # share of the length
FAR_APART_M = 0.05


def lengths_along(foot: FootSamples, begin_ns: IntArray, end_ns: IntArray) -> FloatArray:
    """Horizontal distances (M,) in m from (M,) to (M,) by the smoothed filter; NaN for what lies outside."""
    begin, end = np.asarray(begin_ns, dtype=np.int64), np.asarray(end_ns, dtype=np.int64)
    lengths = np.full(len(begin), math.nan)
    inside = (begin >= foot.t_ns[0]) & (end <= foot.t_ns[-1]) & (begin < end) & (end - begin < LONGEST_S * NS_PER_S)
    if inside.any():
        path = foot.trajectory(STRIDE_SETTINGS, level=False)
        x, y, _ = (path.positions_at(end[inside]) - path.positions_at(begin[inside])).T
        lengths[inside] = np.hypot(x, y)
    return lengths


def fuse(rows: Rows, foot: FootSamples) -> FloatArray:
    """Give strides (K,) of one foot, as the compiled core leaves them, length and speed from both solutions, in place.

    Strides that are not valid stay, and those whose two lengths are farther apart than a tenth and 5 cm. Returns by how
    much each is longer than by itself (K,), for its trajectory ahead; see ``fes.estimation.strides.results``.
    """
    own_m = np.where(rows["outcome"] == SOLVED, rows["stride_length_m"], math.nan)
    lengths = mean_lengths(own_m, lengths_along(foot, rows["t_start_ns"], rows["t_end_ns"]))
    longer, k = np.ones(len(rows)), np.flatnonzero(lengths == lengths)
    own_m, lengths = own_m[k], lengths[k]
    longer[k] = lengths / own_m
    rows["speed_mps"][k] = rows["speed_mps"][k] * lengths / own_m
    rows["stride_length_m"][k] = lengths
    return longer


def mean_lengths(own_m: FloatArray, path_m: FloatArray) -> FloatArray:
    """Mean of the two lengths (K,); NaN where one is not known, or they are too far apart: the stride's own stays."""
    with np.errstate(invalid="ignore"):  # a comparison with NaN is false
        near = (own_m > 0.0) & (np.abs(path_m - own_m) <= np.maximum(FAR_APART * own_m, FAR_APART_M))
    return np.where(near, 0.5 * (own_m + path_m), math.nan)
