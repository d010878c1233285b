"""Wang et al. (2013), section 3: zero-velocity windows of both feet, and where a foot went between them.

The healthy foot's windows are where the mean energy of its acceleration without gravity over 0.1 s is below
0.025 m²/s⁴. A motion window shorter than half the mean one is removed, a zero-velocity window longer than twice the
mean one is split. The paper does not say how: here the threshold is halved until rests at least half a mean motion
window apart show; standing at the recording's ends stays. :func:`fitted_threshold` is its "proper threshold".

While the healthy foot swings the paretic one stands: its windows are the other's motion windows, shifted all alike (at
most a fifth of the usual stride, to where its energy is least), expanded while it is still, shrunk while it is not, of
one that would vanish its quietest 0.1 s; standing with both feet before and after is added.

Strapdown integration in the world, velocity zero in the windows; what is left of it at a motion window's end is taken
off in proportion to time. The visualization frame has z against gravity, y along the walk, x to its right. *Erratum*:
the printed ``x0`` is a cross product of unit vectors that are not perpendicular unless the walk is level.
"""

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from fes.estimation.foot.calibration import FootCalibration
from fes.estimation.numerics.filters import runs
from fes.estimation.numerics.rotation import rotate_all
from fes.estimation.orientation.body import smooth_orientation
from fes.recording import Track
from fes.recording.tracks import increasing
from fes.signals import G_MPS2, NS_PER_S, BoolArray, FloatArray, IntArray

ENERGY_WINDOW_S = 0.1
THRESHOLD_M2PS4 = 0.025
MERGE_SHARE = 0.5  # of the mean motion window
SPLIT_FACTOR = 2.0  # of the mean zero-velocity window
TIGHTENINGS = 6  # halvings of the threshold inside a window that is too long
LOOSENINGS = 10  # doublings of the printed threshold, where it finds too little
LEAST_REST_SHARE = 0.15  # of a recording of walking; healthy feet rest for about a third of the time


def energy(acc_world_mps2: FloatArray, rate_hz: float) -> FloatArray:
    """Mean energy (N,) in m²/s⁴ over 0.1 s, centred, of the acceleration without gravity (N, 3)."""
    count = max(round(ENERGY_WINDOW_S * rate_hz), 1) | 1
    each = np.einsum("ij,ij->i", acc_world_mps2, acc_world_mps2)
    known = np.convolve(np.ones(len(each)), np.ones(count), "same")
    return np.asarray(np.convolve(each, np.ones(count), "same") / known)


def between(windows: IntArray) -> IntArray:
    """The motion windows (K − 1, 2) between neighbouring zero-velocity windows (K, 2)."""
    return np.column_stack((windows[:-1, 1], windows[1:, 0])).astype(np.int64)


def merged(windows: IntArray) -> IntArray:
    """Without motion windows shorter than half their mean."""
    if len(windows) < 2:
        return windows
    gaps = windows[1:, 0] - windows[:-1, 1]
    return _kept(windows, gaps >= MERGE_SHARE * gaps.mean())


def split(windows: IntArray, energy_m2ps4: FloatArray, threshold_m2ps4: float) -> IntArray:
    """Windows longer than twice their mean, split at tighter thresholds."""
    if len(windows) < 2:
        return windows
    lengths = windows[:, 1] - windows[:, 0]
    inner = (windows[:, 0] > 0) & (windows[:, 1] < len(energy_m2ps4))
    usual = float(lengths[inner].mean()) if inner.any() else float(lengths.mean())
    least_gap = MERGE_SHARE * float((windows[1:, 0] - windows[:-1, 1]).mean())
    out: list[IntArray] = []
    for window, length, is_inner in zip(windows, lengths.tolist(), inner.tolist(), strict=True):
        long = is_inner and length > SPLIT_FACTOR * usual
        out.append(_chunks(window, energy_m2ps4, threshold_m2ps4, least_gap) if long else window[None])
    return np.concatenate(out)


def _kept(windows: IntArray, apart: BoolArray) -> IntArray:
    """The windows (K, 2) joined where those of the K − 1 gaps between them are not kept ``apart``."""
    return np.column_stack((windows[np.append(True, apart), 0], windows[np.append(apart, True), 1])).astype(np.int64)


def _chunks(window: IntArray, energy_m2ps4: FloatArray, threshold_m2ps4: float, least_gap: float) -> IntArray:
    begin, end = int(window[0]), int(window[1])
    for halvings in range(1, TIGHTENINGS + 1):
        found = runs(energy_m2ps4[begin:end] < threshold_m2ps4 * 0.5**halvings) + begin
        apart = found[1:, 0] - found[:-1, 1] >= least_gap
        if apart.any():
            parts = _kept(found, apart)
            parts[0, 0], parts[-1, 1] = begin, end
            return parts
    return window[None]


def still_windows(energy_m2ps4: FloatArray, threshold_m2ps4: float = THRESHOLD_M2PS4) -> IntArray:
    """Zero-velocity windows (K, 2) of a foot: thresholded, merged, split; first sample, one past the last."""
    found = runs(energy_m2ps4 < threshold_m2ps4)
    return split(merged(found), energy_m2ps4, threshold_m2ps4)


def fitted_threshold(energy_m2ps4: FloatArray) -> float:
    """The printed threshold, doubled until the foot rests for a plausible share of the recording (m²/s⁴)."""
    threshold = THRESHOLD_M2PS4
    for _ in range(LOOSENINGS):
        if float((energy_m2ps4 < threshold).mean()) >= LEAST_REST_SHARE:
            break
        threshold *= 2.0
    return threshold


MOST_SHIFT_SHARE = 0.2  # of the time from window to window


def mapped(
    healthy: IntArray,
    healthy_energy: FloatArray,
    paretic_energy: FloatArray,
    thresholds_m2ps4: tuple[float, float],
    rate_hz: float,
) -> tuple[IntArray, float]:
    """The paretic foot's zero-velocity windows (K, 2), and by how much (s) all were shifted, later positive.

    ``healthy`` (K, 2) are the other foot's; the energies (N,) in m²/s⁴ are of the same instants, see :func:`energy`;
    the thresholds are the healthy and the paretic foot's.
    """
    n = len(paretic_energy)
    if len(healthy) < 2:
        return np.zeros((0, 2), np.int64), 0.0
    windows = between(healthy)
    usual = float(np.median(np.diff(healthy.mean(axis=1))))
    shift = _shift(windows, paretic_energy, round(MOST_SHIFT_SHARE * usual))
    still = paretic_energy < thresholds_m2ps4[1]
    hold = max(round(ENERGY_WINDOW_S * rate_hz), 1)
    shifted = np.clip(windows + shift, 0, n)
    adjusted = [_fitted(int(a), int(b), paretic_energy, still, hold) for a, b in shifted if b > a]
    if adjusted:  # and standing with both feet before the first and after the last window
        first, last = min(begin for begin, _ in adjusted), max(end for _, end in adjusted)
        both = runs((healthy_energy < thresholds_m2ps4[0]) & still)
        for stands in (both[both[:, 1] <= first][:1], both[both[:, 0] >= last][-1:]):
            adjusted += [(int(a), int(b)) for a, b in stands if b - a >= hold and (a < hold or b > n - hold)]
    joined: list[list[int]] = []
    for begin, end in sorted(adjusted):
        if joined and begin <= joined[-1][1]:
            joined[-1][1] = max(joined[-1][1], end)
        else:
            joined.append([begin, end])
    return np.array(joined, dtype=np.int64).reshape(-1, 2), shift / rate_hz


def _shift(windows: IntArray, energy_m2ps4: FloatArray, most: int) -> int:
    """The common shift (samples) with the least mean energy; the smaller one where two are as good."""
    total = np.concatenate(([0.0], np.cumsum(energy_m2ps4)))
    best, found = np.inf, 0
    for shift in sorted(range(-most, most + 1), key=abs):
        moved = np.clip(windows + shift, 0, len(energy_m2ps4))
        count = int((moved[:, 1] - moved[:, 0]).sum())
        mean = float((total[moved[:, 1]] - total[moved[:, 0]]).sum()) / max(count, 1)
        if mean < best * (1.0 - 1e-9):
            best, found = mean, shift
    return found


def _fitted(begin: int, end: int, energy_m2ps4: FloatArray, still: BoolArray, hold: int) -> tuple[int, int]:
    """One window, expanded and shrunk."""
    first, last = begin, end
    while first < last and not still[first]:
        first += 1
    while last > first and not still[last - 1]:
        last -= 1
    if first == last:
        quiet = begin + int(np.argmin(energy_m2ps4[begin:end]))
        return max(quiet - hold // 2, begin), min(quiet + hold // 2 + 1, end)
    while first > 0 and still[first - 1]:
        first -= 1
    while last < len(still) and still[last]:
        last += 1
    return first, last


@dataclass(frozen=True, slots=True)
class Foot:
    """N evenly spaced samples of one foot, named after its sensor."""

    name: str
    rate_hz: float
    t_ns: IntArray  # (N,)
    acc_mps2: FloatArray  # (N, 3) acceleration without gravity in the world, z up
    forward: FloatArray  # (N, 3) unit vector towards the toe in the world

    def along_mps2(self) -> FloatArray:
        """Acceleration (N,) along where the toe points, level: the paper's y of a walk that goes straight ahead."""
        level = self.forward[:, :2] / np.maximum(np.hypot(self.forward[:, 0], self.forward[:, 1]), 1e-9)[:, None]
        return np.asarray(np.einsum("ij,ij->i", self.acc_mps2[:, :2], level))


def foot_of(track: Track, calibration: FootCalibration, t_ns: IntArray) -> Foot:
    """A track on a common time base, turned into the world.

    The paper takes the orientation that its sensor computes; here it is that of
    :func:`fes.estimation.orientation.body.smooth_orientation`, which knows of no zero-velocity window. The
    accelerometer's bias is taken off, for the threshold of 0.025 m²/s⁴ is as small as a bias of 0.16 m/s². ``t_ns``
    (N,) are evenly spaced instants within the track.
    """
    newer = increasing(track)
    known = (track.t_sensor_ns[newer] - t_ns[0]).astype(np.float64)
    asked = (t_ns - t_ns[0]).astype(np.float64)
    measured = (track.acc_mps2, calibration.acc_bias_mps2), (track.gyr_radps, calibration.gyr_bias_radps)
    acc, gyr = (
        np.column_stack([np.interp(asked, known, column) for column in values[newer].T]) - np.array(bias)
        for values, bias in measured
    )
    rate_hz = (len(t_ns) - 1) * NS_PER_S / float(t_ns[-1] - t_ns[0])
    q = smooth_orientation(acc, gyr, rate_hz).quaternion
    inverse = np.asarray(q * np.array([1.0, -1.0, -1.0, -1.0]))
    world = np.column_stack([np.einsum("ij,ij->i", acc, rotate_all(inverse, axis)) for axis in np.eye(3)])
    world[:, 2] -= G_MPS2
    return Foot(calibration.sensor, rate_hz, t_ns, world, rotate_all(q, calibration.forward()))


def common_times(tracks: list[Track]) -> IntArray:
    """Evenly spaced instants (N,) that all tracks cover, at the slowest one's rate.

    Raises:
        ValueError: they have less than two seconds in common.
    """
    begin, end = max(int(t.t_sensor_ns[0]) for t in tracks), min(int(t.t_sensor_ns[-1]) for t in tracks)
    step = round(NS_PER_S / min(track.rate_hz for track in tracks))
    if end - begin < 2 * NS_PER_S:
        names = " and ".join(track.sensor for track in tracks)
        raise ValueError(f"{names} have {max(end - begin, 0) / NS_PER_S:.1f} s in common: record both feet together")
    return np.arange(begin, end + 1, step, dtype=np.int64)


LEAST_DISTANCE_M = 0.3


@dataclass(frozen=True, slots=True)
class FootTrack:
    """One foot's reconstruction, named after its sensor; N samples."""

    name: str
    t_ns: IntArray  # (N,)
    position_m: FloatArray  # (N, 3)
    windows: IntArray  # (K, 2) zero-velocity windows: first sample, one past the last

    @property
    def centres(self) -> IntArray:
        """(K,) the samples in the middle of the windows: where strides begin and end (section 4.1)."""
        return np.asarray(self.windows.sum(axis=1) // 2, dtype=np.int64)

    def stride_lengths_m(self) -> FloatArray:
        """SL (K − 1,): distances between neighbouring centres, in space."""
        return np.asarray(np.linalg.norm(np.diff(self.position_m[self.centres], axis=0), axis=1))

    def height_changes_m(self) -> FloatArray:
        """(K − 1,) how much higher each stride ends."""
        return np.asarray(np.diff(self.position_m[self.centres, 2]))

    def swing_s(self) -> FloatArray:
        """SwingT (K − 1,): the motion windows."""
        return self._seconds(between(self.windows))

    def stance_s(self) -> FloatArray:
        """StanceT (K − 2,): the zero-velocity windows without the first and the last."""
        return self._seconds(self.windows[1:-1])

    def _seconds(self, windows: IntArray) -> FloatArray:
        period_s = float(np.median(np.diff(self.t_ns))) / NS_PER_S
        return np.asarray((windows[:, 1] - windows[:, 0]) * period_s)


def tracked(foot: Foot, windows: IntArray) -> FootTrack:
    """Integrate one foot between its zero-velocity windows (K, 2); before the first and after the last it stands still.

    Raises:
        ValueError: no window at all.
    """
    if len(windows) == 0:
        raise ValueError(f"{foot.name}: no zero-velocity window, so nothing can be integrated")
    t = (foot.t_ns - foot.t_ns[0]) / NS_PER_S
    velocity = np.zeros_like(foot.acc_mps2)
    for before, after in pairwise(windows.tolist()):
        begin, end = before[1] - 1, after[0]
        span = slice(begin, end + 1)
        steps = np.diff(t[span])[:, None]
        velocity_change = np.cumsum(0.5 * (foot.acc_mps2[span][1:] + foot.acc_mps2[span][:-1]) * steps, axis=0)
        share = (t[span][1:] - t[begin]) / (t[end] - t[begin])
        velocity[begin + 1 : end + 1] = velocity_change - share[:, None] * velocity_change[-1]
    position = np.zeros_like(velocity)
    position[1:] = np.cumsum(0.5 * (velocity[1:] + velocity[:-1]) * np.diff(t)[:, None], axis=0)
    return FootTrack(foot.name, foot.t_ns, position, windows)


def visualization_frame(up: FloatArray, direction: FloatArray) -> FloatArray:
    """Rotation (3, 3) from the initialization into the visualization frame: rows are x across, y along, z up.

    ``up`` (3,) is against gravity, as the accelerometer shows it at rest, ``direction`` (3,) from the walk's first to
    its last zero-velocity window.

    Raises:
        ValueError: the walk goes nowhere, or straight up.
    """
    z = up / np.linalg.norm(up)
    across = np.cross(-direction, z)
    size = float(np.linalg.norm(across))
    if not size >= LEAST_DISTANCE_M:
        raise ValueError(f"the walk leads only {size:.2f} m away: there is no direction of walking")
    # the paper's minus sign makes x point to the left of the walk; y is along it only with x to the right
    x = -across / size
    return np.array([x, np.cross(z, x), z])


def in_visualization_frame(track: FootTrack) -> FootTrack:
    """The track turned so that x is across the walk, y along it and z up.

    Where a walk ends where it began, the direction is that of its first half.

    Raises:
        ValueError: it leads nowhere.
    """
    centres = track.centres
    places = track.position_m[centres]
    far = np.linalg.norm(places[:, :2] - places[0, :2], axis=1)
    at = -1 if far[-1] >= 0.5 * far.max() else int(np.argmax(far))
    turn = visualization_frame(np.array([0.0, 0.0, 1.0]), places[at] - places[0])
    return replace(track, position_m=(track.position_m - places[0]) @ turn.T)
