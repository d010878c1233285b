"""What a shank does in walking: its swings, its mid-stances, its orientation over a stride, its levels for the guards.

Source: Wu, Wang and Pottie, "A Non-ZUPT Gait Reconstruction Method for Ankle Sensors", section II-D. Departures from
the print:

- Stance there is where the mean of ``|w|²`` over 0.1 s is below 2 rad²/s², which at 1.6 m/s hardly a sample is. Here
  the swings are found first, and the threshold is the larger of the print's and a share of this person's swing.
- Within it the print takes the 0.05 s of least variance of the gyroscope's energy. A strapped sensor wobbles for 0.2 s
  after contact: with 0.2 s of least energy speed over belt spreads by 2.6 % (SD) instead of 4.1 %.
- The shank does not rest, so gravity shows at no instant. Over a whole stride it does: the mean specific force in the
  world is gravity plus the change of velocity over the time.

All levels are this walk's own; the bounds only keep a strange walk from making a guard useless.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from fes.estimation.numerics.filters import moving_mean, runs
from fes.estimation.numerics.records import new_core
from fes.estimation.numerics.rotation import from_gravity, rotate_all
from fes.estimation.shank import features
from fes.estimation.shank.features import ShankParameters
from fes.estimation.strides.integration import double_integral, integrate, orient
from fes.estimation.tracking.phase_features import usual_swing_s
from fes.signals import G_MPS2, FloatArray, IntArray
from statemachine.guards import Thresholds

STANCE_MEAN_S = 0.1
CONJUGATE = np.array([1.0, -1.0, -1.0, -1.0])
STANCE_LIMIT_RADPS = 2.0**0.5
STANCE_LIMIT_PER_SWING = 0.45  # of the swing's peak rate, where that is more
FINE_WINDOW_S = 0.2
FINE_WINDOW_PER_STRIDE = 0.2
SWING_SHARE = 0.5  # of the brisk swings' rate: above, the shank swings
SHORTEST_STRIDE_S = 0.5
SEARCH = (0.22, 0.75)  # of the time from mid-swing to mid-swing: where mid-stance may be
PAUSE_PER_STRIDE = 1.8  # the usual stride: a longer one stands still in between
REACH = 1.2  # strides: how far mid-stance is sought where there is no next swing
STILL_S = 0.8
STILL_RATE_RADPS = 0.06
STILL_FORCE_MPS2 = 0.3


@dataclass(frozen=True, slots=True)
class StrideSpan:
    """One stride of a shank: indices of the mid-stances around the swing, and half the width of their fine windows.

    ``quiet`` is whether both windows are below the person's stance threshold.
    """

    first: int
    swing: int
    last: int
    half: int
    quiet: bool


def turned_back(quaternion: FloatArray, vector: FloatArray) -> FloatArray:
    """A vector of the world (3,) in the sensor frame, by its quaternion (4,)."""
    return np.asarray(rotate_all(quaternion[None] * CONJUGATE, vector)[0])


def swing_peaks(left_radps: FloatArray, rate_hz: float) -> IntArray:
    """Indices of mid-swing: where the shank swings forward fastest, once per swing.

    ``left_radps`` (N,) is the rate about the axis to the person's left; swing is negative.
    """
    swing = moving_mean(-left_radps, max(round(STANCE_MEAN_S * rate_hz), 1))
    brisk = swing[swing > 0.25 * swing.max(initial=0.0)]
    if len(brisk) == 0:
        return np.zeros(0, dtype=np.int64)
    level = SWING_SHARE * float(np.percentile(brisk, 90))
    peaks: list[int] = []
    for begin, end in runs(swing > level):
        peak = int(begin + np.argmax(swing[begin:end]))
        if peaks and peak - peaks[-1] < SHORTEST_STRIDE_S * rate_hz:
            if swing[peak] > swing[peaks[-1]]:
                peaks[-1] = peak
        else:
            peaks.append(peak)
    return np.array(peaks, dtype=np.int64)


def stride_spans(gyr_radps: FloatArray, swings: IntArray, rate_hz: float) -> list[StrideSpan]:
    """The strides around the mid-swings, from quietest window of stance to quietest window of stance.

    ``gyr_radps`` (N, 3) free of bias. In a pause the last stride ends and the next begins in its own quiet window.
    """
    n = len(gyr_radps)
    if len(swings) < 2:
        return []
    between = np.diff(swings)
    usual = float(np.median(between))
    energy = np.einsum("ij,ij->i", gyr_radps, gyr_radps)
    half = max(round(0.5 * rate_hz * min(FINE_WINDOW_S, FINE_WINDOW_PER_STRIDE * usual / rate_hz)), 1)
    fine = moving_mean(energy, 2 * half + 1)
    coarse = moving_mean(energy, max(round(STANCE_MEAN_S * rate_hz), 1))
    peak = float(np.median(np.sqrt(coarse[swings])))
    limit = max(STANCE_LIMIT_RADPS, STANCE_LIMIT_PER_SWING * peak) ** 2

    def quietest(begin: float, end: float) -> int | None:
        a, b = max(round(begin), half), min(round(end), n - half)
        return None if b - a < 3 else int(a + np.argmin(fine[a:b]))

    def before(swing: float) -> int | None:
        return quietest(swing - REACH * usual, swing - (1.0 - SEARCH[1]) * usual)

    begins = [before(float(swings[0]))]  # of the stride around each swing
    ends: list[int | None] = []
    for begin, gap in zip(swings[:-1].astype(float).tolist(), between.astype(float).tolist(), strict=True):
        if gap <= PAUSE_PER_STRIDE * usual:
            ends.append(quietest(begin + SEARCH[0] * gap, begin + SEARCH[1] * gap))
            begins.append(ends[-1])
        else:
            ends.append(quietest(begin + SEARCH[0] * usual, begin + REACH * usual))
            begins.append(before(begin + gap))
    ends.append(quietest(float(swings[-1]) + SEARCH[0] * usual, float(swings[-1]) + REACH * usual))
    spans: list[StrideSpan] = []
    for first, swing, last in zip(begins, swings.tolist(), ends, strict=True):
        if first is not None and last is not None and first < swing < last:
            quiet = bool(coarse[first] < limit and coarse[last] < limit)
            spans.append(StrideSpan(first, swing, last, half, quiet))
    return spans


def still_spans(acc_mps2: FloatArray, gyr_radps: FloatArray, rate_hz: float) -> list[tuple[int, int]]:
    """Stretches (first, last index) of at least ``STILL_S`` during which the sensor neither turned nor shook."""
    window = max(round(0.25 * rate_hz), 2)
    shake = moving_mean(acc_mps2**2, window) - moving_mean(acc_mps2, window) ** 2
    rate = moving_mean(gyr_radps**2, window) - moving_mean(gyr_radps, window) ** 2
    slow = np.linalg.norm(moving_mean(gyr_radps, window), axis=1) < 3.0 * STILL_RATE_RADPS
    still = slow & (shake.sum(axis=1) < STILL_FORCE_MPS2**2) & (rate.sum(axis=1) < STILL_RATE_RADPS**2)
    return [(a, b - 1) for a, b in runs(still).tolist() if b - a >= STILL_S * rate_hz]


def levelled(
    t_ns: IntArray, acc: FloatArray, gyr: FloatArray, span: tuple[int, int], lead: int = 0,
    change_mps: FloatArray | None = None,
) -> FloatArray:  # fmt: skip
    """Orientation (n, 4) of the samples ``first − lead`` … ``last + lead``, upright over the stride ``span``.

    The mean specific force in the world from ``first`` to ``last`` is gravity plus the change of velocity,
    ``change_mps`` (3,) in the world, over the time. None stands for no change: steady walking.
    """
    first, last = span
    begin, end = first - lead, last + lead + 1
    t = np.ascontiguousarray(t_ns[begin:end])
    rates, force = gyr[begin:end], acc[begin:end]
    inner = slice(lead, len(t) - lead)
    step = np.diff(t[inner]).astype(float)[:, None]
    quaternions = np.empty((len(t), 4))
    start = np.array(from_gravity(*force.mean(axis=0)))
    orient(t, rates, start, 0.0, 0.0, 1.0, 0.0, quaternions)
    world = rotate_all(quaternions[inner], force[inner])
    mean = (0.5 * (world[1:] + world[:-1]) * step).sum(axis=0) / step.sum()
    target = np.array([0.0, 0.0, G_MPS2])
    if change_mps is not None:
        target = target + change_mps / (1e-9 * float(t_ns[last] - t_ns[first]))
    turn = _product(np.array(from_gravity(*target)) * CONJUGATE, np.array(from_gravity(*mean)))
    orient(t, rates, _product(turn, start), 0.0, 0.0, 1.0, 0.0, quaternions)
    return quaternions


def travelled(
    t_ns: IntArray, acc: FloatArray, gyr: FloatArray, span: tuple[int, int]
) -> tuple[FloatArray, FloatArray, FloatArray] | None:
    """Orientation (n, 4), velocity and position (n, 3) over one stride as if at rest, and as high, at both its ends.

    None where that cannot be.
    """
    part = slice(span[0], span[1] + 1)
    quaternions, zero = levelled(t_ns, acc, gyr, span), np.zeros(3)
    velocity, position, gamma = np.empty((len(quaternions), 3)), np.empty((len(quaternions), 3)), np.empty((2, 3))
    t = np.ascontiguousarray(t_ns[part])
    if not integrate(t, acc[part], quaternions, zero, zero, 0.0, velocity, position, gamma):
        return None
    return quaternions, velocity, position


def from_rest(t_ns: IntArray, acc: FloatArray, quaternions: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Velocity and position (n, 3) in the world that the specific force (n, 3) leads to from rest."""
    velocity, position = np.empty((len(acc), 3)), np.empty((len(acc), 3))
    zero = np.zeros(3)
    double_integral(np.ascontiguousarray(t_ns), acc, quaternions, zero, np.zeros((2, 3)), velocity, position)
    return velocity, position


def _product(p: FloatArray, q: FloatArray) -> FloatArray:
    """Hamilton product of two quaternions (4,)."""
    vector = p[0] * q[1:] + q[0] * p[1:] + np.cross(p[1:], q[1:])
    return np.concatenate(([p[0] * q[0] - p[1:] @ q[1:]], vector))


FLAT_TO_PEAK = 0.25  # the rest threshold lies this share of the way from mid-stance's rate to foot-off's …
RISE_TO_PEAK = 0.35  # … heel rise's this …
FLAT_BOUNDS_RADPS = (0.4, 2.5)  # … within these
STILL_PER_FLOOR = 1.8  # the ankle is still below this multiple of what it shows in mid-stance …
STILL_BOUNDS_MPS2 = (1.5, 8.0)  # … within these
SLOWED_SHARE = 0.4  # a shank's contact comes before its lean has quite come to a stop
SHARES = {  # where a shank is not as a foot: it leans on through contact and stance, and its pitch is no foot's
    "turn_rad": 0.07,
    "lifts_after": 0.25,
    "mid_swing_share": 0.55,
    "still_radps": 1.0,  # of its lean while the ankle stands
    "flat_rad": 0.07,
    "settled_share": 0.0,
    "settled_after_s": 0.03,
    "longest_loadings": 1.0,
}
LEAST_JOLT_MPS3 = 500.0
NEVER = Thresholds(
    push_off_radps=math.inf,
    fall_radps=math.inf,
    contact_jerk_mps3=math.inf,
    swing_turn_rad=math.inf,
    put_back_share=math.inf,
)


@dataclass(frozen=True, slots=True)
class ShankLevels:
    """Typical rates and times of one person's shank; see :class:`statemachine.guards.Thresholds`.

    Attributes:
        rest_lean_radps: the shank leans no faster while the foot is flat …
        heel_rise_radps: … and this fast as the heel rises.
        push_off_radps: greatest rate of lean at foot-off.
        fall_radps: from there to the greatest rate of swing.
        stride_s: from mid-stance to mid-stance.
        contact_jolt_mps3: jump of the force at contact.
        still_mps2: the ankle's force is no further from gravity while the foot is flat.
    """

    rest_lean_radps: float = 1.2
    heel_rise_radps: float = 1.5
    push_off_radps: float = 2.5
    fall_radps: float = 7.0
    stride_s: float = 1.2
    contact_jolt_mps3: float = 1300.0
    still_mps2: float = 2.0

    def thresholds(self, *, swing_at_reversal: bool = False) -> Thresholds:
        """The guards' thresholds for this shank; all others at their defaults."""
        rate = max(self.push_off_radps, 0.5 * self.fall_radps)
        return Thresholds(
            push_off_radps=self.push_off_radps,
            fall_radps=self.fall_radps,
            stride_s=self.stride_s,
            swing_s=usual_swing_s(self.stride_s),
            contact_jerk_mps3=self.contact_jolt_mps3,
            rest_share=self.rest_lean_radps / rate,
            heel_rise_share=self.heel_rise_radps / rate,
            slowed_share=SLOWED_SHARE,
            **SHARES,
            swing_at_reversal=swing_at_reversal,
        )


def trace_of(parameters: ShankParameters, t_ns: IntArray, acc_mps2: FloatArray, gyr_radps: FloatArray) -> FloatArray:
    """Rate of lean (rad/s), the ankle's force beyond gravity (m/s²) and jolt (m/s³) at each sample, as for the guards.

    ``t_ns`` (N,) strictly increasing, ``acc_mps2`` and ``gyr_radps`` (N, 3) as measured. Returns (N, 4).
    """
    core = new_core(features.CORE, parameters=parameters, thresholds=NEVER)[0]
    trace = np.zeros((len(t_ns), 4))
    bias = np.array([parameters.acc_bias_x_mps2, parameters.acc_bias_y_mps2, parameters.acc_bias_z_mps2])
    head = slice(0, max(round(1.0 / parameters.sample_s), 1))
    features.start(core, int(t_ns[0]), *(acc_mps2[head].mean(axis=0) - bias).tolist())
    core.state.phase = 2
    features.advance(core, t_ns, acc_mps2, gyr_radps, 0, len(t_ns), trace)
    return trace


def fit_levels(trace: FloatArray, spans: list[StrideSpan], rate_hz: float) -> ShankLevels:
    """Fit the levels to the strides of a walk; without any the defaults."""
    if not spans:
        return ShankLevels()
    lean, ankle, jolt = trace[:, 0], trace[:, 1], trace[:, 2]
    flat, still, peak, trough, contact, stride_s = [], [], [], [], [], []
    for span in spans:
        window = slice(max(span.first - span.half, 0), span.first + span.half + 1)
        flat.append(float(np.abs(lean[window]).mean()))
        still.append(float(np.median(ankle[window])))
        peak.append(float(lean[span.first : span.swing + 1].max()))
        trough.append(float(lean[span.first : span.last + 1].min()))
        contact.append(float(jolt[span.swing : span.last + 1].max()))
        stride_s.append((span.last - span.first) / rate_hz)
    floor, top = float(np.median(flat)), float(np.median(peak))
    return ShankLevels(
        rest_lean_radps=float(np.clip(floor + FLAT_TO_PEAK * (top - floor), *FLAT_BOUNDS_RADPS)),
        heel_rise_radps=float(np.clip(floor + RISE_TO_PEAK * (top - floor), *FLAT_BOUNDS_RADPS)),
        push_off_radps=top,
        fall_radps=float(np.median(np.array(peak) - np.array(trough))),
        stride_s=float(np.median(stride_s)),
        contact_jolt_mps3=max(float(np.median(contact)), LEAST_JOLT_MPS3),
        still_mps2=float(np.clip(STILL_PER_FLOOR * float(np.median(still)), *STILL_BOUNDS_MPS2)),
    )
