"""Where a foot's sensor went through a whole recording: the ZUPT-aided filter, smoothed.

A long recording is cut into stretches in long stances, so that memory does not grow with it, and the stretches are
joined there by position and heading. A gap ends a stretch too: where the foot went meanwhile nobody knows, and the next
one goes on from the same place in the same direction.
"""

import math
from dataclasses import dataclass, field
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from fes.estimation.numerics.filters import runs
from fes.estimation.numerics.jit import jit_fused
from fes.estimation.numerics.records import Mat, Vec
from fes.estimation.tracking.tracker import LARGEST_VALUE, RESTART_GAP_NS
from fes.estimation.zupt.decimation import Intervals, ZuptSettings, gather_intervals
from fes.estimation.zupt.detectors import Detector
from fes.estimation.zupt.filter import filter_intervals, new_tape, smooth_intervals
from fes.estimation.zupt.thresholds import (
    START_S,
    ZeroVelocityThresholds,
    find_zero_velocity,
    first_stance,
    stance_instants,
    with_missed_stances,
)
from fes.signals import BoolArray, FloatArray, IntArray

STRETCH_S = 300.0
SEARCH_S = 30.0  # around the end of a stretch, for a stance to cut it in
LEAST_STANCE_S = 0.15  # of the stance to cut in: the filter begins once zero velocity has lasted for 0.1 s
JOIN_S = 0.12  # after the cut: there both stretches know where the foot is
LEVER_M = 0.065  # from the ground up to a sensor on the instep, as the foot turns about it
CLIPPED_SHARE = 0.995  # of the full scale
CLIPPED_SD = (0.3, 0.1)  # what a clipped sample may have missed, as a share of the full scale: force, rate
LEAST_RANGE = (30.0, 4.0)  # m/s², rad/s: a smaller greatest value is no full scale


class Trajectory(NamedTuple):
    """The smoothed trajectory of one foot's sensor at K instants, z up; it begins at 0, in stance."""

    t_ns: IntArray
    position_m: FloatArray
    velocity_mps: FloatArray
    q_world_from_sensor: FloatArray

    def positions_at(self, t_ns: IntArray) -> FloatArray:
        """Positions (M, 3) in m at M instants that never go back; beyond the ends it stands still."""
        out = np.empty((len(t_ns), 3))
        positions_at(self.t_ns, self.position_m, self.velocity_mps, np.ascontiguousarray(t_ns, np.int64), out)
        return out


class _Stretch(NamedTuple):
    """What is the same for all settings: the samples ``span``, and their intervals, which end at ``t_ns``.

    ``rows`` are the intervals' in the whole trajectory; the first ``shared`` are those of the stretch before. ``lever``
    and ``start_force`` (3,) are from the ground to the sensor, and the specific force where the foot sets out.
    """

    span: slice
    rows: slice
    shared: int
    t_ns: IntArray
    intervals: Intervals
    lever: FloatArray
    start_force: FloatArray


@dataclass(slots=True, eq=False)
class FootSamples:
    """One foot's usable samples, and where its velocity is zero; N of them.

    Attributes:
        t_ns: (N,) strictly increasing time stamps.
        acc_mps2: (N, 3) specific force.
        gyr_radps: (N, 3) angular rate.
        rate_hz: one over the usual interval.
        thresholds: of the zero-velocity detector.
        zero_velocity: (N,) where the foot stands.
        energy: (N,) of the rate over 0.05 s, (rad/s)².
        noise: (N,) twice: extra standard deviation of clipped samples, m/s² and rad/s.
        per_sample: the filter goes from sample to sample, not over intervals of a few hundredths of a second.
    """

    t_ns: IntArray
    acc_mps2: FloatArray
    gyr_radps: FloatArray
    rate_hz: float
    thresholds: ZeroVelocityThresholds
    zero_velocity: BoolArray
    energy: FloatArray
    noise: tuple[FloatArray, FloatArray]
    per_sample: bool = False
    _stretches: list[_Stretch] = field(default_factory=list)

    def stances(self) -> IntArray:
        """Sample numbers (M,) of the quietest instant of every stance."""
        return stance_instants(self.zero_velocity, self.energy, self.rate_hz)

    def trajectory(self, settings: ZuptSettings, *, level: bool) -> Trajectory:
        """The foot's trajectory by these settings; ``level``: it always stands at one height."""
        if not self._stretches:  # each begins a little before the one before it ends
            join, n = round(JOIN_S * self.rate_hz), len(self.t_ns)
            gaps = np.flatnonzero(np.diff(self.t_ns) > RESTART_GAP_NS) + 1
            for first, stop in pairwise([0, *gaps.tolist(), n]):
                if not self.zero_velocity[first:stop].any() or stop - first <= join:
                    continue
                cuts = _cuts(self.t_ns[first:stop], self.zero_velocity[first:stop], self.rate_hz)
                for begin, end in pairwise([first, *(first + cut for cut in cuts), stop]):
                    self._stretches.append(self._stretch(begin, min(end + join + 1, stop)))
            if not self._stretches:
                raise ValueError("between its gaps the foot never rests, so nothing holds a path")
        t_ns = np.concatenate([stretch.t_ns[stretch.shared :] for stretch in self._stretches])
        whole = Trajectory(t_ns, np.empty((len(t_ns), 3)), np.empty((len(t_ns), 3)), np.empty((len(t_ns), 4)))
        for stretch in self._stretches:
            last = slice(max(stretch.rows.start - 1, 0), stretch.rows.start + stretch.shared)
            before = Trajectory(t_ns[last], *(x[last].copy() for x in whole[1:]))
            own = Trajectory(stretch.t_ns, *(x[stretch.rows] for x in whole[1:]))
            span, intervals, bias = stretch.span, stretch.intervals, np.array(self.thresholds.gyr_bias_radps)
            times, zero_velocity = self.t_ns[span], self.zero_velocity[span]
            tape = new_tape(len(stretch.t_ns), int(np.count_nonzero(zero_velocity[intervals.ends])))._replace(
                position=own.position_m, velocity=own.velocity_mps, quaternions=own.q_world_from_sensor
            )
            filter_intervals(
                times, self.gyr_radps[span], zero_velocity, intervals, stretch.start_force, stretch.lever, bias, level,
                settings, tape,
            )  # fmt: skip
            smooth_intervals(times, intervals.ends, bool(zero_velocity[0]), settings, tape)
            if stretch.rows.start:
                _join(before, own, stretch.shared)
        return whole

    def seen_ns(self) -> IntArray:
        """Rows (P, 2): where each part of the trajectory begins and ends; between them nobody knows.

        Before its first rest and after its end the foot stands still.
        """
        spans = [(int(each.t_ns[0]), int(each.t_ns[-1]), each.shared) for each in self._stretches]
        begins = [int(self.t_ns[0]), *(begin for begin, _, shared in spans[1:] if not shared)]
        lasts = [*(end for (_, end, _), (*_, shared) in pairwise(spans) if not shared), int(self.t_ns[-1])]
        return np.array([begins, lasts], np.int64).T

    def _stretch(self, begin: int, end: int) -> _Stretch:
        """The samples ``begin`` … ``end - 1``, from the first stance on, gathered."""
        begin += first_stance(self.zero_velocity[begin:end], self.rate_hz)
        span, last = slice(begin, end), self._stretches[-1] if self._stretches else None
        acc, zero_velocity, (acc_sd, gyr_sd) = self.acc_mps2[span], self.zero_velocity[span], self.noise
        up = acc[zero_velocity].mean(axis=0) if zero_velocity.any() else acc.mean(axis=0)
        intervals = gather_intervals(
            self.t_ns[span], acc, self.gyr_radps[span], acc_sd[span], gyr_sd[span], zero_velocity,
            self.thresholds.gyr_bias_radps, per_sample=self.per_sample,
        )  # fmt: skip
        t_ns = self.t_ns[span][intervals.ends]
        shared = 0 if last is None else int(np.searchsorted(t_ns, last.t_ns[-1], side="right"))
        first = 0 if last is None else last.rows.stop - shared
        start_force = self.acc_mps2[max(begin - round(START_S * self.rate_hz), 0) : begin + 1].mean(axis=0)
        lever = LEVER_M * up / max(float(np.linalg.norm(up)), 1e-9)
        return _Stretch(span, slice(first, first + len(t_ns)), shared, t_ns, intervals, lever, start_force)


def foot_samples(
    t_ns: IntArray, acc_mps2: FloatArray, gyr_radps: FloatArray, acc_range_mps2: float | None = None,
    gyr_range_radps: float | None = None, *, detector: Detector = Detector.SHOE, per_sample: bool = False,
) -> FootSamples:  # fmt: skip
    """Prepare a recording of one foot.

    Args:
        t_ns: (N,) time stamps; samples not newer than all before them are left out, and those that are not finite or
            larger than any sensor's.
        acc_mps2: (N, 3) specific force.
        gyr_radps: (N, 3) angular rate.
        acc_range_mps2: the accelerometer's full scale; found from flat tops if not given.
        gyr_range_radps: the same of the gyroscope.
        detector: of zero velocity; its threshold is found from the recording.
        per_sample: filter from sample to sample: many times slower, lengths within 2 mm.

    Raises:
        ValueError: too short, or the foot never rests.
    """
    t_ns = np.ascontiguousarray(t_ns, dtype=np.int64)
    acc, gyr = np.ascontiguousarray(acc_mps2, dtype=np.float64), np.ascontiguousarray(gyr_radps, dtype=np.float64)
    if not all(x.max(initial=0.0) < LARGEST_VALUE and x.min(initial=0.0) > -LARGEST_VALUE for x in (acc, gyr)):
        usable = (np.abs(acc) < LARGEST_VALUE).all(axis=1) & (np.abs(gyr) < LARGEST_VALUE).all(axis=1)
        t_ns, acc, gyr = t_ns[usable], acc[usable], gyr[usable]
    newer = np.append(True, t_ns[1:] > np.maximum.accumulate(t_ns)[:-1])[: len(t_ns)]
    if not newer.all():
        t_ns, acc, gyr = t_ns[newer], acc[newer], gyr[newer]
    if len(t_ns) < 3:
        raise ValueError(f"{len(t_ns)} samples make no path")
    rate_hz = 1e9 / float(np.median(np.diff(t_ns)))
    thresholds, detected, energy = find_zero_velocity(acc, gyr, rate_hz, detector)
    zero_velocity = with_missed_stances(detected, gyr, rate_hz, energy)
    if not zero_velocity.any():
        raise ValueError("the foot never rests, so nothing holds a path; check the units")
    acc_sd = clipped_sd(acc, acc_range_mps2, LEAST_RANGE[0], CLIPPED_SD[0])
    gyr_sd = clipped_sd(gyr, gyr_range_radps, LEAST_RANGE[1], CLIPPED_SD[1])
    return FootSamples(t_ns, acc, gyr, rate_hz, thresholds, zero_velocity, energy, (acc_sd, gyr_sd), per_sample)


def clipped_sd(values: FloatArray, full_scale: float | None, least: float, share: float) -> FloatArray:
    """Extra standard deviation (N,) of samples (N, 3) at their full scale, in their unit; 0 of all others.

    An unknown full scale is the greatest value, if several samples stop there (within 0.1 %) and it is above ``least``.
    """
    x, y, z = np.abs(values).T
    size = np.maximum(np.maximum(x, y), z)
    if full_scale is None:
        top = float(size.max(initial=0.0))
        if top < least or np.count_nonzero(size > 0.999 * top) < 3:
            return np.zeros(len(values))
        full_scale = top
    return np.where(size >= CLIPPED_SHARE * full_scale, share * full_scale, 0.0)


def _cuts(t_ns: IntArray, zero_velocity: BoolArray, rate_hz: float) -> list[int]:
    """Where to cut: in the longest stance near the end of every stretch, if it is long enough."""
    total_s = 1e-9 * float(t_ns[-1] - t_ns[0])
    if total_s <= STRETCH_S + SEARCH_S:
        return []
    begins, ends = runs(zero_velocity).T
    seconds = 1e-9 * (t_ns[begins] - t_ns[0])
    cuts, last_s = list[int](), 0.0
    while total_s - last_s > STRETCH_S + SEARCH_S:
        near = np.flatnonzero(np.abs(seconds - last_s - STRETCH_S) <= SEARCH_S)
        longest = near[np.argmax((ends - begins)[near])] if len(near) else -1
        last_s += STRETCH_S
        if longest >= 0 and ends[longest] - begins[longest] >= LEAST_STANCE_S * rate_hz:
            cuts.append(int(begins[longest]))
            last_s = float(seconds[longest])
    return cuts


def _join(before: Trajectory, own: Trajectory, shared: int) -> None:
    """Turn and shift a stretch's own rows so that they go on where those before end, whose the ``shared`` stay."""
    aw, ax, ay, az = before.q_world_from_sensor[-1].tolist()
    bw, bx, by, bz = own.q_world_from_sensor[max(shared - 1, 0)].tolist()
    # by how much about the vertical the first frame differs: w and z of a ⊗ conj(b)
    w, z = aw * bw + ax * bx + ay * by + az * bz, az * bw - aw * bz + ay * bx - ax * by
    turn = 2.0 * math.atan2(z, w)
    c, s = math.cos(turn), math.sin(turn)
    (x, y, up), (to_x, to_y, to_up) = own.positions_at(before.t_ns[-1:])[0].tolist(), before.position_m[-1].tolist()
    shift = np.array((to_x - c * x + s * y, to_y - s * x - c * y, to_up - up))
    turn_path(own.position_m, own.velocity_mps, own.q_world_from_sensor, turn, shift)
    for rows, first in zip(own[1:], before[1:], strict=True):
        rows[:shared] = first[len(first) - shared :]


@jit_fused
def positions_at(known_ns: Vec, position: Mat, velocity: Mat, asked_ns: Vec, out: Vec) -> None:
    """Fill ``out`` (M, 3) with the place at instants (M,), best in order: cubic between K places and velocities.

    Before the first and after the last the path stands still.
    """
    k, last = 0, known_ns.shape[0] - 1
    for i in range(asked_ns.shape[0]):
        while k > 0 and known_ns[k] >= asked_ns[i]:
            k -= 1
        while k < last - 1 and known_ns[k + 1] < asked_ns[i]:
            k += 1
        span_s = 1e-9 * (known_ns[k + 1] - known_ns[k])
        u = min(max(1e-9 * (asked_ns[i] - known_ns[k]) / span_s, 0.0), 1.0)
        share, begin, end = u * u * (3.0 - 2.0 * u), u * (1.0 - u) * (1.0 - u) * span_s, u * u * (1.0 - u) * span_s
        for j in range(3):
            step = position[k + 1, j] - position[k, j]
            out[i, j] = position[k, j] + share * step + begin * velocity[k, j] - end * velocity[k + 1, j]


@jit_fused
def turn_path(position: Mat, velocity: Mat, quaternions: Mat, turn: float, shift: Vec) -> None:
    """Turn K places, velocities, orientations about the vertical by ``turn`` (rad), then shift the places by (3,)."""
    c, s, w, z = math.cos(turn), math.sin(turn), math.cos(0.5 * turn), math.sin(0.5 * turn)
    for i in range(position.shape[0]):
        x, y = position[i, 0], position[i, 1]
        position[i, 0], position[i, 1] = c * x - s * y + shift[0], s * x + c * y + shift[1]
        position[i, 2] += shift[2]
        x, y = velocity[i, 0], velocity[i, 1]
        velocity[i, 0], velocity[i, 1] = c * x - s * y, s * x + c * y
        q0, q1, q2, q3 = quaternions[i, 0], quaternions[i, 1], quaternions[i, 2], quaternions[i, 3]
        quaternions[i, 0], quaternions[i, 1] = w * q0 - z * q3, w * q1 - z * q2
        quaternions[i, 2], quaternions[i, 3] = w * q2 + z * q1, w * q3 + z * q0
