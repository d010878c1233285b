"""ZUPT-aided navigation: the path of a foot through a whole recording, forward and smoothed.

Source: Kumar et al., "Applying update using Kalman filter", after Fischer, Talkad Sukumar and Hazas (2013), "Tutorial:
implementing a pedestrian tracker using inertial sensors": strapdown integration, and an error-state filter for which a
resting foot's velocity is a measurement. Departures and additions:

- fifteen states instead of nine: the biases of gyroscope and accelerometer are estimated too;
- the resting foot turns about where it touches the ground: its velocity is ``w × r``, not zero. The arm ``r`` from
  there to the sensor is given, or taken as 6.5 cm straight up. It also creeps on the way it came, by 0.5 cm/s for the
  first second (optical recordings show the instep moving all through mid-stance);
- rest is not all or nothing: the measurement's noise grows with the rate, and neighbouring samples count together as
  one over the time for which they err alike, so that neither a looser threshold nor a higher sampling rate makes the
  filter sure of what it cannot know;
- trapezoids instead of rectangles; samples that clip, or jump faster than an accelerometer follows, count as noise;
- a rest at which the foot is sure to travel (beyond 4 standard deviations) is none: in a dragged or slow, even swing an
  inertial sensor reads like one at rest. Should it last, or nothing be measured for long, the filter is lost
  instead; its uncertainty grows by what it was wrong, and it takes the measurement;
- smoothing by an adjoint (Bierman 1973, "Fixed interval smoothing with discrete measurements") and the disturbances it
  shows (Koopman 1993): the estimates of Rauch, Tung and Striebel without inverting a covariance, which here is nearly
  singular (nothing measures heading, and position but weakly), and without keeping one for every sample."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from fes.estimation.numerics.filters import largest_in_blocks, likeness_of_lengths, rows_of_at_least
from fes.estimation.zupt.detectors import ZeroVelocityThresholds, at_rest, calibrate_zero_velocity, rate_energy
from fes.estimation.zupt.filter import Tape, ZuptSettings, forward, new_tape
from fes.estimation.zupt.smoother import smooth
from fes.estimation.zupt.thresholds import first_lasting, quietest_of_rests, rest_in_long_moves
from fes.signals import FloatArray, IntArray, Vector3

BoolArray = np.ndarray[Any, np.dtype[np.bool_]]
START_S = 0.1
LEVER_M = 0.065  # from the ground up to a sensor on the instep, as the foot turns about it
CLIPPED_SHARE = 0.995  # of the full scale
CLIPPED_SD = (0.3, 0.1)  # what a clipped sample may have missed, as a share of the full scale: force, rate
LEAST_RANGE = (30.0, 4.0)  # m/s², rad/s: a smaller greatest value is no full scale
STRIDE_BOUNDS_S = (0.5, 3.0)
SHORTEST_MOVE_S = 0.15
LEAST_REPETITION = 0.3  # of the rate, from one stride to the next, to speak of walking


@dataclass(frozen=True, slots=True)
class ZuptPath:
    """Where a foot was; N samples, world with z up and the heading of the first sample.

    It begins where the foot has rested for 0.1 s for the first time; earlier rows repeat that one.

    Attributes:
        t_ns: (N,) time stamps.
        position_m: (N, 3) from where it begins.
        velocity_mps: (N, 3).
        q_world_from_sensor: (N, 4), wxyz.
        gyr_bias_radps: (N, 3).
        acc_bias_mps2: (N, 3).
        covariance: (N, 15, 15) of the errors of position, velocity, rotation in the world, both biases; no rows of a
            smoothed path, which does not need it.
        rest: (N,) where the velocity was measured.
        smoothed: every sample knows the whole recording; else only what came before.
    """

    t_ns: IntArray
    position_m: FloatArray
    velocity_mps: FloatArray
    q_world_from_sensor: FloatArray
    gyr_bias_radps: FloatArray
    acc_bias_mps2: FloatArray
    covariance: FloatArray
    rest: BoolArray
    smoothed: bool

    def at(self, t_ns: IntArray) -> FloatArray:
        """Positions (M, 3) in m at M instants, linear between samples.

        Raises:
            ValueError: an instant outside the recording.
        """
        t = np.asarray(t_ns, dtype=np.int64)
        if len(t) and (t.min() < self.t_ns[0] or t.max() > self.t_ns[-1]):
            raise ValueError(f"instants {t.min()} … {t.max()} ns lie outside {self.t_ns[0]} … {self.t_ns[-1]} ns")
        since = (self.t_ns - self.t_ns[0]).astype(np.float64)
        asked = (t - self.t_ns[0]).astype(np.float64)
        return np.column_stack([np.interp(asked, since, self.position_m[:, j]) for j in range(3)])

    def stride_lengths(self, begin_ns: IntArray, end_ns: IntArray) -> FloatArray:
        """Horizontal distances (M,) in m between the instants ``begin_ns`` and ``end_ns``, (M,) each."""
        return np.asarray(np.hypot(*(self.at(end_ns) - self.at(begin_ns))[:, :2].T))

    def plan_m(self) -> FloatArray:
        """The path from above (N, 2) in m, turned so that the farthest point lies on the positive x axis."""
        flat = self.position_m[:, :2] - self.position_m[0, :2]
        far = flat[np.argmax(np.hypot(*flat.T))]
        distance = float(np.hypot(*far))
        if distance == 0.0:
            return flat
        c, s = far / distance
        return np.asarray(flat @ np.array([[c, -s], [s, c]]))


def zupt_path(
    t_ns: IntArray,
    acc_mps2: FloatArray,
    gyr_radps: FloatArray,
    *,
    calibration: ZeroVelocityThresholds | None = None,
    rest: BoolArray | None = None,
    lever_m: Vector3 | None = None,
    level_ground: bool = False,
    smoothed: bool = True,
    acc_range_mps2: float | None = None,
    gyr_range_radps: float | None = None,
    settings: ZuptSettings | None = None,
) -> ZuptPath:
    """Navigate through a recording.

    Args:
        t_ns: (N,) strictly increasing time stamps.
        acc_mps2: (N, 3) specific force.
        gyr_radps: (N, 3) angular rate.
        calibration: of the rest detector; found from the recording itself if not given. Its gyroscope bias is where
            the filter starts.
        rest: (N,) where the foot rests, instead of the detector's word. With it, ``calibration``, ``lever_m`` and
            both ranges given, the forward pass knows nothing of the future.
        lever_m: from the point of the ground about which the resting foot turns to the sensor, in the sensor frame;
            None: ``LEVER_M`` straight up, (0, 0, 0): a foot at rest does not move.
        level_ground: the foot rests at one height. Not on stairs or slopes.
        smoothed: use the future too.
        acc_range_mps2: the accelerometer's full scale; found from flat tops if not given.
        gyr_range_radps: the same of the gyroscope.
        settings: noise.

    Raises:
        ValueError: shapes or stamps that do not fit, values that are not finite, or too short for a calibration.
    """
    t = np.ascontiguousarray(t_ns, dtype=np.int64)
    acc, gyr = np.ascontiguousarray(acc_mps2, dtype=np.float64), np.ascontiguousarray(gyr_radps, dtype=np.float64)
    if t.ndim != 1 or len(t) < 3 or acc.shape != (len(t), 3) or gyr.shape != acc.shape:
        raise ValueError(f"need (N,), (N, 3), (N, 3) with N of 3 or more, got {t.shape}, {acc.shape}, {gyr.shape}")
    if not np.all(np.diff(t) > 0):
        raise ValueError("time stamps must increase strictly: drop doubled samples and sort the rest")
    if not (np.isfinite(acc).all() and np.isfinite(gyr).all()):
        raise ValueError("specific force and rate must be finite: fill or cut out what is missing")
    rate_hz = 1e9 / float(np.median(np.diff(t)))
    if calibration is None:
        calibration = calibrate_zero_velocity(acc, gyr, rate_hz)
    if rest is None:
        rest = with_quietest(at_rest(calibration, acc, gyr, rate_hz), gyr, rate_hz)
    rest = np.ascontiguousarray(rest, dtype=np.bool_)
    if rest.shape != t.shape:
        raise ValueError(f"rest has the shape {rest.shape} instead of {t.shape}")
    if lever_m is None:
        up = acc[rest].mean(axis=0) if rest.any() else acc.mean(axis=0)
        lever = LEVER_M * up / max(float(np.linalg.norm(up)), 1e-9)
    else:
        lever = np.array(lever_m, dtype=np.float64)
    tape = new_tape(len(t), covariance=not smoothed)
    acc_sd = clipped_sd(acc, acc_range_mps2, LEAST_RANGE[0], CLIPPED_SD[0])
    gyr_sd = clipped_sd(gyr, gyr_range_radps, LEAST_RANGE[1], CLIPPED_SD[1])
    first = first_rest(rest, rate_hz)
    part = slice(first, None)
    before = acc[max(first - round(START_S * rate_hz), 0) : first + 1].mean(axis=0)
    ours = Tape(*(rows[part] if len(rows) else rows for rows in tape))
    ours.gyr_bias[0] = calibration.gyr_bias_radps
    noise = settings or ZuptSettings()
    forward(
        t[part], acc[part], gyr[part], acc_sd[part], gyr_sd[part], rest[part], before, lever, level_ground, noise, ours
    )
    if smoothed:
        smooth(t[part], bool(rest[first]), noise, ours)
    for rows in tape[:6]:
        if len(rows):
            rows[:first] = rows[first]
    return ZuptPath(t, *tape[:6], rest=rest, smoothed=smoothed)


def first_rest(rest: BoolArray, rate_hz: float) -> int:
    """Where the filter begins: rest has lasted ``START_S`` for the first time, or else at the start.

    Never with the last sample: there would be no way from there.
    """
    return int(first_lasting(rest[:-1], round(START_S * rate_hz) + 1))


def stride_time_s(gyr_radps: FloatArray, rate_hz: float) -> float:
    """Typical time of one stride (s): the first strong peak of the rate's autocorrelation; 0 where nothing repeats."""
    step = max(round(rate_hz / 50.0), 1)  # 50 Hz are plenty
    count = len(gyr_radps) // step
    shortest, longest = (round(s * rate_hz / step) for s in STRIDE_BOUNDS_S)
    if shortest < 1 or count < 2 * longest:
        return 0.0
    lags, alike = np.arange(shortest - 1, longest + 2), np.empty(longest + 3 - shortest)
    whole = likeness_of_lengths(np.ascontiguousarray(gyr_radps), step, shortest - 1, alike)
    if whole == 0.0:
        return 0.0
    alike /= whole * (1.0 - lags / count)
    inner = alike[1:-1]
    top = (inner >= alike[:-2]) & (inner >= alike[2:])
    greatest = inner[top].max(initial=0.0)
    if greatest < LEAST_REPETITION:
        return 0.0
    return float(lags[1:-1][top & (inner >= 0.8 * greatest)][0] * step / rate_hz)


def with_quietest(
    rest: BoolArray, gyr_radps: FloatArray, rate_hz: float, energy: FloatArray | None = None
) -> BoolArray:
    """Add the quietest instant of a movement too long to be one swing: a fast foot rests less than any threshold says.

    ``rest`` (N,), ``gyr_radps`` (N, 3), ``energy`` (N,) of it where already known. What lasts longer than a stride
    holds a stance that the detector missed; it is sought where the rate's energy over 0.05 s is least, away from the
    ends, and counts as 0.02 s of rest. How much that is worth the measurement's noise says, which grows with the rate.
    """
    out = rest.copy()
    longest = 1.1 * stride_time_s(gyr_radps, rate_hz) * rate_hz
    if longest == 0.0:
        return out
    if energy is None:
        energy = rate_energy(gyr_radps, rate_hz)
    half, margin = max(round(0.01 * rate_hz), 1), round(0.32 * longest)
    rest_in_long_moves(out, energy, longest, half, margin)
    return out


def stance_instants(rest: BoolArray, gyr_radps: FloatArray, rate_hz: float) -> IntArray:
    """Sample numbers (M,) of the quietest instant of every rest, for strides between them.

    ``rest`` (N,), ``gyr_radps`` (N, 3). Rests less than ``SHORTEST_MOVE_S`` apart count as one. Quietest is the least
    rate energy over 0.05 s.
    """
    return least_in_rests(rest, rate_energy(gyr_radps, rate_hz), rate_hz)


def least_in_rests(rest: BoolArray, energy: FloatArray, rate_hz: float) -> IntArray:
    """As :func:`stance_instants`, of a rate energy (N,) already known."""
    out = np.empty(len(rest) // 2 + 1, np.int64)
    return out[: quietest_of_rests(rest, energy, SHORTEST_MOVE_S * rate_hz, out)].copy()


def clipped_sd(
    values: FloatArray, full_scale: float | None, least: float, share: float, largest: FloatArray | None = None
) -> FloatArray:
    """Extra standard deviation (N,) of samples (N, 3) at their full scale, in their unit; 0 of all others.

    An unknown full scale is the greatest value, if several samples stop there (within 0.1 %) and it is above ``least``.
    ``largest``: ``fes.estimation.numerics.filters.largest_in_blocks`` of them, where already known.
    """
    sd = np.zeros(len(values))
    if largest is None:
        largest = largest_in_blocks(values)
    top = float(largest.max(initial=0.0))
    rows, size = rows_of_at_least(CLIPPED_SHARE * (top if full_scale is None else full_scale), values, largest)
    if full_scale is None:
        if top < least or np.count_nonzero(size > 0.999 * top) < 3:
            return sd
        full_scale = top
    sd[rows[size >= CLIPPED_SHARE * full_scale]] = share * full_scale
    return sd
