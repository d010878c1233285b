"""Where a foot's sensor went through a whole recording, by the off-line ZUPT filter.

The filter and its smoothing are those of ``fes.estimation.zupt``, but from step to step (``fes.estimation.zupt_steps``)
instead of from sample to sample, for speed: some few times faster, and the same stride lengths within a millimetre.
A long recording is cut into stretches at long rests, so that memory does not grow with it, and the stretches are joined
there by place and heading.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from fes.estimation.filters import largest_in_blocks
from fes.estimation.ranks import median
from fes.estimation.rest import RestCalibration, find_rest
from fes.estimation.tracker import LARGEST_VALUE
from fes.estimation.zupt import (
    CLIPPED_SD,
    LEAST_RANGE,
    LEVER_M,
    START_S,
    clipped_sd,
    first_rest,
    least_in_rests,
    with_quietest,
)
from fes.estimation.zupt_kernel import ZuptSettings
from fes.estimation.zupt_step_filter import forward_steps, new_step_tape
from fes.estimation.zupt_step_smooth import path_at, smooth_steps, turn_path
from fes.estimation.zupt_steps import Steps, mean_at_rest, steps_of
from fes.signals import FloatArray, IntArray

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
    calibration: RestCalibration
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
    calibration, rest, energy = find_rest(acc, gyr, rate_hz)
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
