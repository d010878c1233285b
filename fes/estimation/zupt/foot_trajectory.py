"""Where a foot's sensor went through a whole recording, by the off-line ZUPT filter.

The filter and its smoothing are those of ``fes.estimation.zupt.filter``, but from step to step
(``fes.estimation.zupt.decimated_filter``) instead of from sample to sample, for speed: some few times faster, and the
same stride lengths within a millimetre. A long recording is cut into stretches at long rests, so that memory does not
grow with it, and the stretches are joined there by place and heading.

Compiled paths over the ground, from a foot's way and bent by a turn that grows; :mod:`fes.analysis.ground_path` says
why.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from fes.estimation.numerics.filters import largest_in_blocks
from fes.estimation.numerics.jit import inlined, jit_fused
from fes.estimation.numerics.ranks import median
from fes.estimation.numerics.rotation import to_world
from fes.estimation.tracking.tracker import LARGEST_VALUE
from fes.estimation.zupt.decimated_filter import Steps, forward_steps, mean_at_rest, new_step_tape, steps_of
from fes.estimation.zupt.detectors import ZeroVelocityThresholds, find_zero_velocity
from fes.estimation.zupt.filter import ZuptSettings
from fes.estimation.zupt.per_sample import (
    CLIPPED_SD,
    LEAST_RANGE,
    LEVER_M,
    START_S,
    clipped_sd,
    first_rest,
    least_in_rests,
    with_quietest,
)
from fes.estimation.zupt.smoother import path_at, smooth_steps, turn_path
from fes.signals import FloatArray, IntArray

AHEAD_M = 2.0
TURN_RAD = 2.0 * math.pi


@inlined
def angle_of(sine: float, cosine: float) -> float:
    """The angle from its sine and cosine times whatever length: ``atan2``, sooner where it is small."""
    if abs(sine) < 0.125 * cosine:  # there the series lacks less than the last bit
        x = sine / cosine
        y = x * x
        z = y * y
        low, high = (1 / 3 - 1 / 5 * y) + z * (1 / 7 - 1 / 9 * y), (1 / 11 - 1 / 13 * y) + z * (1 / 15 - 1 / 17 * y)
        return x - x * y * (low + z * z * high)
    return math.atan2(sine, cosine)


@jit_fused
def headings(q: Any, axis: Any, out: Any) -> None:
    """Fill ``out`` (K,) with where an ``axis`` (3,) of the sensor points, from x towards y, by orientations (K, 4).

    In rad, without whole turns between neighbours.
    """
    x, y, z, heading, ahead, left = axis[0], axis[1], axis[2], 0.0, 1.0, 0.0
    for i in range(q.shape[0]):
        now_ahead, now_left, _ = to_world(q[i, 0], q[i, 1], q[i, 2], q[i, 3], x, y, z)
        sine, cosine = ahead * now_left - left * now_ahead, ahead * now_ahead + left * now_left
        if sine != 0.0 or cosine != 0.0:  # else it points straight up or down, and has no heading
            heading += angle_of(sine, cosine)
            ahead, left = now_ahead, now_left
        out[i] = heading


@jit_fused
def without_turns(t_ns: Any, heading: Any, stance_ns: Any, off: Any) -> None:
    """Take false whole turns out of headings (K,): a toe that points straight down between stances has none.

    ``off`` (M,) is room, one for each stance.
    """
    count, last = stance_ns.shape[0], t_ns.shape[0] - 1
    k, before, turned = 0, 0.0, 0.0
    for j in range(count):
        while k < last - 1 and t_ns[k + 1] <= stance_ns[j]:
            k += 1
        share = min(max((stance_ns[j] - t_ns[k]) / (t_ns[k + 1] - t_ns[k]), 0.0), 1.0)
        now = heading[k] + share * (heading[k + 1] - heading[k])
        if j > 0:
            turned -= TURN_RAD * math.floor((now - before) / TURN_RAD + 0.5)
        before, off[j] = now, turned
    j = 0
    for i in range(last + 1):
        while j < count - 1 and (stance_ns[j] + stance_ns[j + 1]) // 2 <= t_ns[i]:
            j += 1
        heading[i] += off[j]


@jit_fused
def keep(
    t_ns: Any, place: Any, velocity: Any, facing: Any, kept_ns: Any, position: Any, heading: Any
) -> None:  # fmt: skip
    """Fill the last two, (M, 3) and (M,), at instants (M,) that rise, as ``path_at``; the heading is linear between."""
    i, last = 0, t_ns.shape[0] - 1
    for k in range(last):
        per_ns, span_s = 1.0 / (t_ns[k + 1] - t_ns[k]), 1e-9 * (t_ns[k + 1] - t_ns[k])
        turn = facing[k + 1] - facing[k]
        x, y, z = place[k, 0], place[k, 1], place[k, 2]
        dx, dy, dz = place[k + 1, 0] - x, place[k + 1, 1] - y, place[k + 1, 2] - z
        ax, ay, az = span_s * velocity[k, 0], span_s * velocity[k, 1], span_s * velocity[k, 2]
        bx, by, bz = span_s * velocity[k + 1, 0], span_s * velocity[k + 1, 1], span_s * velocity[k + 1, 2]
        while i < kept_ns.shape[0] and (kept_ns[i] <= t_ns[k + 1] or k == last - 1):
            u = min(max((kept_ns[i] - t_ns[k]) * per_ns, 0.0), 1.0)
            share, begin, end = u * u * (3.0 - 2.0 * u), u * (1.0 - u) * (1.0 - u), u * u * (1.0 - u)
            position[i, 0] = x + share * dx + begin * ax - end * bx
            position[i, 1] = y + share * dy + begin * ay - end * by
            position[i, 2] = z + share * dz + begin * az - end * bz
            heading[i] = facing[k] + u * turn
            i += 1


@jit_fused
def first_beyond(position: Any, far2: float) -> int:
    """The first of the places (K, 3) that is so far away, squared (m²); -1 where none is."""
    for i in range(position.shape[0]):
        if position[i, 0] * position[i, 0] + position[i, 1] * position[i, 1] >= far2:
            return i
    return -1


@jit_fused
def look_ahead(position: Any, heading: Any) -> None:
    """Turn a path (K, 3), (K,) so that x points to where it first is 2 m away (at most as far as it goes)."""
    at, most2 = first_beyond(position, AHEAD_M * AHEAD_M), 0.0
    if at < 0:
        for i in range(position.shape[0]):
            most2 = max(most2, position[i, 0] * position[i, 0] + position[i, 1] * position[i, 1])
        at = max(first_beyond(position, 0.999 * 0.999 * most2), 0)
    angle = math.atan2(position[at, 1], position[at, 0])
    c, s = math.cos(angle), math.sin(angle)
    angle += TURN_RAD * math.floor((heading[0] - angle) / TURN_RAD + 0.5)
    for i in range(position.shape[0]):
        x, y = position[i, 0], position[i, 1]
        position[i, 0], position[i, 1] = c * x + s * y, c * y - s * x
        heading[i] -= angle


@jit_fused
def over_ground(
    t_ns: Any, place: Any, velocity: Any, q: Any, axis: Any, stance_ns: Any, kept_ns: Any, facing: Any, off: Any,
    position: Any, heading: Any,
) -> None:  # fmt: skip
    """Fill the last two, (M, 3) and (M,), with place and heading at the instants ``kept_ns`` (M,) of a foot's way (K,).

    x points to where the foot first is 2 m away. ``facing`` (K,) and ``off``, one for each stance, are room.
    """
    headings(q, axis, facing)
    without_turns(t_ns, facing, stance_ns, off)
    keep(t_ns, place, velocity, facing, kept_ns, position, heading)
    look_ahead(position, heading)


@jit_fused
def slopes(values: Any, places: Any, least: int, out: Any) -> None:
    """Fill ``out`` with the slopes between all pairs of N rising ``places`` at least so many places apart."""
    k, n = 0, values.shape[0]
    for i in range(n - least):
        for j in range(i + least, n):
            out[k] = (values[j] - values[i]) / (places[j] - places[i])
            k += 1


@inlined
def small_turn(angle: float) -> tuple[float, float]:
    """Cosine and sine of an angle, sooner where it is small."""
    x = angle * angle
    if x < 1e-4:  # there the series lack less than the last bit
        return 1.0 - x * (1 / 2 - x * (1 / 24 - 1 / 720 * x)), angle * (1.0 - x * (1 / 6 - 1 / 120 * x))
    return math.cos(angle), math.sin(angle)


@jit_fused
def bend(
    t_ns: Any, stance_ns: Any, per_stride_rad: float, position: Any, heading: Any, place: Any, turned: Any
) -> None:  # fmt: skip
    """Bend a path by an angle that grows by so much from stance to stance, linearly in time in between.

    ``t_ns`` (K,) and ``stance_ns`` (M,) rise; ``position`` (K, 3) and ``heading`` (K,) are the path, ``place`` and
    ``turned`` the same to be filled. Each piece of the path turns by the mean of the angles at its ends.
    """
    k, last, per_ns = -1, stance_ns.shape[0] - 1, 0.0
    c, s, middle, before = 1.0, 0.0, 0.0, 0.0
    x, y, from_x, from_y = position[0, 0], position[0, 1], position[0, 0], position[0, 1]
    for i in range(t_ns.shape[0]):
        while k < 0 or (k < last - 1 and stance_ns[k + 1] <= t_ns[i]):
            k += 1
            per_ns = 1.0 / (stance_ns[k + 1] - stance_ns[k]) if last > 0 else 0.0
        angle = per_stride_rad * (k + min(max((t_ns[i] - stance_ns[k]) * per_ns, 0.0), 1.0))
        turn = 0.5 * (before + angle)
        more = turn - middle  # hardly anything, so that its series are short
        before, middle = angle, turn
        cosine, sine = small_turn(more)
        c, s = c * cosine - s * sine, s * cosine + c * sine
        to_x, to_y = position[i, 0], position[i, 1]
        dx, dy = to_x - from_x, to_y - from_y
        from_x, from_y = to_x, to_y
        x += c * dx - s * dy
        y += s * dx + c * dy
        place[i, 0], place[i, 1], place[i, 2] = x, y, position[i, 2]
        turned[i] = heading[i] + angle


@jit_fused
def bend_ahead(
    t_ns: Any, stance_ns: Any, per_stride_rad: float, position: Any, heading: Any, place: Any, turned: Any
) -> None:  # fmt: skip
    """As :func:`bend`, and turned so that x points to where the path first is 2 m away."""
    bend(t_ns, stance_ns, per_stride_rad, position, heading, place, turned)
    look_ahead(place, turned)


STRETCH_S = 300.0
SEARCH_S = 30.0  # around the end of a stretch, for a rest to cut it at
LEAST_REST_S = 0.15  # of the rest to cut at: the filter begins once the foot has rested for 0.1 s
JOIN_S = 0.12  # after the cut: there both stretches know where the foot is

BoolArray = np.ndarray[Any, np.dtype[np.bool_]]


class Way(NamedTuple):
    """The smoothed way of one foot at K instants a few hundredths of a second apart, z up; it begins at 0, at rest."""

    t_ns: IntArray
    position_m: FloatArray
    velocity_mps: FloatArray
    q_world_from_sensor: FloatArray

    def at(self, t_ns: IntArray) -> FloatArray:
        """Positions (M, 3) in m at M instants that never go back; beyond the ends it stands still."""
        out = np.empty((len(t_ns), 3))
        path_at(self.t_ns, self.position_m, self.velocity_mps, np.ascontiguousarray(t_ns, np.int64), out)
        return out


class _Stretch(NamedTuple):
    """What is the same for all settings: the samples ``span``, their steps, which end at ``t_ns``, ``resting`` at rest.

    ``rows`` are the steps' in the whole way; the first ``known`` are those of the stretch before. ``lever`` and
    ``before`` (3,) are from the ground to the sensor, and the specific force where the foot sets out.
    """

    span: slice
    rows: slice
    known: int
    t_ns: IntArray
    steps: Steps
    lever: FloatArray
    before: FloatArray
    resting: int


@dataclass(slots=True, eq=False)
class FootSamples:
    """One foot's usable samples, and where it rests; N of them.

    Attributes:
        t_ns: (N,) strictly increasing time stamps.
        acc_mps2: (N, 3) specific force.
        gyr_radps: (N, 3) angular rate.
        rate_hz: one over the usual interval.
        calibration: of the rest detector.
        rest: (N,) where the foot rests.
        energy: (N,) of the rate over 0.05 s, (rad/s)².
        noise: (N,) twice: extra standard deviation of clipped samples, m/s² and rad/s.
    """

    t_ns: IntArray
    acc_mps2: FloatArray
    gyr_radps: FloatArray
    rate_hz: float
    calibration: ZeroVelocityThresholds
    rest: BoolArray
    energy: FloatArray
    noise: tuple[FloatArray, FloatArray]
    _parts: list[_Stretch] = field(default_factory=list)

    def stances(self) -> IntArray:
        """Sample numbers (M,) of the quietest instant of every rest."""
        return least_in_rests(self.rest, self.energy, self.rate_hz)

    def way(self, settings: ZuptSettings, *, level: bool) -> Way:
        """The foot's way by these settings; ``level``: it rests at one height."""
        if not self._parts:
            self._parts = self._cut()
        t_ns = np.concatenate([part.t_ns[part.known :] for part in self._parts])
        whole = Way(t_ns, np.empty((len(t_ns), 3)), np.empty((len(t_ns), 3)), np.empty((len(t_ns), 4)))
        for part in self._parts:
            last = slice(max(part.rows.start - 1, 0), part.rows.start + part.known)
            before = Way(t_ns[last], *(x[last].copy() for x in whole[1:]))
            own = Way(part.t_ns, *(x[part.rows] for x in whole[1:]))
            self._follow(part, settings, level, own)
            if part.rows.start:
                _join(before, own, part.known)
        return whole

    def _follow(self, part: _Stretch, settings: ZuptSettings, level: bool, own: Way) -> None:
        """Fill the stretch's ``own`` rows."""
        t_ns, gyr, rest = self.t_ns[part.span], self.gyr_radps[part.span], self.rest[part.span]
        tape = new_step_tape(len(part.t_ns), part.resting)._replace(
            position=own.position_m, velocity=own.velocity_mps, quaternions=own.q_world_from_sensor
        )
        bias = np.array(self.calibration.gyr_bias_radps)
        forward_steps(t_ns, gyr, rest, part.steps, part.before, part.lever, bias, level, settings, tape)
        smooth_steps(t_ns, part.steps.ends, bool(rest[0]), settings, tape)

    def _cut(self) -> list[_Stretch]:
        """The stretches, each beginning a little before the one before it ends."""
        parts: list[_Stretch] = []
        join = round(JOIN_S * self.rate_hz)
        for begin, end in pairwise([0, *_cuts(self.t_ns, self.rest, self.rate_hz), len(self.t_ns)]):
            parts.append(self._gathered(begin, min(end + join + 1, len(self.t_ns)), parts[-1] if parts else None))
        return parts

    def _gathered(self, begin: int, end: int, last: _Stretch | None) -> _Stretch:
        begin += first_rest(self.rest[begin:end], self.rate_hz)
        span, bias = slice(begin, end), self.calibration.gyr_bias_radps
        acc, gyr, rest, (acc_sd, gyr_sd) = self.acc_mps2[span], self.gyr_radps[span], self.rest[span], self.noise
        up = np.empty(3)
        if not mean_at_rest(acc, rest, up):
            up = acc.mean(axis=0)
        lever = LEVER_M * up / max(float(np.linalg.norm(up)), 1e-9)
        steps = steps_of(self.t_ns[span], acc, gyr, acc_sd[span], gyr_sd[span], rest, bias)
        t_ns = self.t_ns[span][steps.ends]
        known = 0 if last is None else int(np.searchsorted(t_ns, last.t_ns[-1], side="right"))
        first = 0 if last is None else last.rows.stop - known
        before = self.acc_mps2[max(begin - round(START_S * self.rate_hz), 0) : begin + 1].mean(axis=0)
        resting = int(np.count_nonzero(rest[steps.ends]))
        return _Stretch(span, slice(first, first + len(t_ns)), known, t_ns, steps, lever, before, resting)


def foot_samples(
    t_ns: IntArray,
    acc_mps2: FloatArray,
    gyr_radps: FloatArray,
    acc_range_mps2: float | None = None,
    gyr_range_radps: float | None = None,
) -> FootSamples:
    """Prepare a recording of one foot.

    Args:
        t_ns: (N,) time stamps; samples not newer than all before them are left out, and those that are not finite or
            larger than any sensor's.
        acc_mps2: (N, 3) specific force.
        gyr_radps: (N, 3) angular rate.
        acc_range_mps2: the accelerometer's full scale; found from flat tops if not given.
        gyr_range_radps: the same of the gyroscope.

    Raises:
        ValueError: too short, or the foot never rests.
    """
    t_ns = np.ascontiguousarray(t_ns, dtype=np.int64)
    acc, gyr = np.ascontiguousarray(acc_mps2, dtype=np.float64), np.ascontiguousarray(gyr_radps, dtype=np.float64)
    largest, given = [largest_in_blocks(x) for x in (acc, gyr)], len(t_ns)
    if not all((x < LARGEST_VALUE).all() for x in largest):
        usable = (np.abs(acc) < LARGEST_VALUE).all(axis=1) & (np.abs(gyr) < LARGEST_VALUE).all(axis=1)
        t_ns, acc, gyr = t_ns[usable], acc[usable], gyr[usable]
    if len(t_ns) < 3:
        raise ValueError(f"{len(t_ns)} samples make no path")
    steps_ns = t_ns[1:] - t_ns[:-1]
    if steps_ns.min() <= 0:
        newer = np.append(True, t_ns[1:] > np.maximum.accumulate(t_ns)[:-1])
        t_ns, acc, gyr = t_ns[newer], acc[newer], gyr[newer]
        steps_ns = t_ns[1:] - t_ns[:-1]
    if len(t_ns) < 3:
        raise ValueError(f"{len(t_ns)} samples make no path")
    if len(t_ns) < given:
        largest = [largest_in_blocks(x) for x in (acc, gyr)]
    rate_hz = 1e9 / median(steps_ns)
    calibration, rest, energy = find_zero_velocity(acc, gyr, rate_hz)
    rest = with_quietest(rest, gyr, rate_hz, energy)
    if not rest.any():
        raise ValueError("the foot never rests, so nothing holds a path; check the units")
    noise = (
        clipped_sd(acc, acc_range_mps2, LEAST_RANGE[0], CLIPPED_SD[0], largest[0]),
        clipped_sd(gyr, gyr_range_radps, LEAST_RANGE[1], CLIPPED_SD[1], largest[1]),
    )
    return FootSamples(t_ns, acc, gyr, rate_hz, calibration, rest, energy, noise)


def _cuts(t_ns: IntArray, rest: BoolArray, rate_hz: float) -> list[int]:
    """Where to cut: at the longest rest near the end of every stretch, if it is long enough."""
    total_s = 1e-9 * float(t_ns[-1] - t_ns[0])
    if total_s <= STRETCH_S + SEARCH_S:
        return []
    changes = np.flatnonzero(rest[1:] != rest[:-1]) + 1
    edges = np.concatenate((np.flatnonzero(rest[:1]), changes, np.flatnonzero(rest[-1:]) + len(rest)))
    begins, ends = edges[0::2], edges[1::2]
    seconds = 1e-9 * (t_ns[begins] - t_ns[0])
    cuts: list[int] = []
    last_s = 0.0
    while total_s - last_s > STRETCH_S + SEARCH_S:
        near = np.flatnonzero(np.abs(seconds - last_s - STRETCH_S) <= SEARCH_S)
        longest = near[np.argmax((ends - begins)[near])] if len(near) else -1
        last_s += STRETCH_S
        if longest >= 0 and ends[longest] - begins[longest] >= LEAST_REST_S * rate_hz:
            cuts.append(int(begins[longest]))
            last_s = float(seconds[longest])
    return cuts


def _join(before: Way, own: Way, known: int) -> None:
    """Turn and shift a stretch's own rows so that they go on where those before them end; the ``known`` stay theirs."""
    aw, ax, ay, az = before.q_world_from_sensor[-1].tolist()
    bw, bx, by, bz = own.q_world_from_sensor[max(known - 1, 0)].tolist()
    # by how much about the vertical the first frame differs: w and z of a ⊗ conj(b)
    w, z = aw * bw + ax * bx + ay * by + az * bz, az * bw - aw * bz + ay * bx - ax * by
    turn = 2.0 * math.atan2(z, w)
    c, s = math.cos(turn), math.sin(turn)
    (x, y, up), (to_x, to_y, to_up) = own.at(before.t_ns[-1:])[0].tolist(), before.position_m[-1].tolist()
    shift = np.array((to_x - c * x + s * y, to_y - s * x - c * y, to_up - up))
    turn_path(own.position_m, own.velocity_mps, own.q_world_from_sensor, turn, shift)
    for rows, first in zip(own[1:], before[1:], strict=True):
        rows[:known] = first[len(first) - known :]
