"""What a shank does in walking: its swings, its mid-stances, and the orientation over one stride.

Source: Wu, Wang and Pottie, "A Non-ZUPT Gait Reconstruction Method for Ankle Sensors", section II-D. Departures from
the print, and why:

- Stance there is where the mean of ``|w|²`` over 0.1 s is below 2 rad²/s². At 1.6 m/s one sample in ten or twenty is
  below that, at 0.8 m/s more than three in ten. Here the swings are found first, each person's own, and the threshold
  is the larger of the print's and a share of this person's swing; a window not below it makes its stride invalid.
- Within it the print takes the 0.05 s of least variance of the gyroscope's energy. A strapped sensor wobbles on the
  soft tissue at 8–12 Hz for 0.2 s after contact, and 0.05 s fit into half a cycle of that. On the shanks of
  ``stroke_treadmill`` speed over belt spreads by 4.1 % (SD) with 0.05 s, and by 2.6 % with 0.2 s. Whether it is
  chosen by least variance or least energy made no difference there; energy is what makes the arm matter least.
- Orientation: the shank does not rest, so the accelerometer does not show gravity at any instant. Over a whole stride
  it does: the mean specific force in the world is gravity plus the change of velocity over the time.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fes.estimation.numerics.rotation import from_gravity
from fes.estimation.strides.constrained import orient
from fes.signals import G_MPS2, FloatArray, IntArray

STANCE_MEAN_S = 0.1
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


def moving_mean(x: FloatArray, window: int) -> FloatArray:
    """Centred mean over ``window`` samples along the first axis, shorter at the ends, same shape."""
    if window <= 1:
        return x
    total = np.cumsum(np.concatenate((np.zeros((1, *x.shape[1:])), x)), axis=0)
    index = np.arange(len(x))
    begin = np.maximum(index - window // 2, 0)
    end = np.minimum(index - window // 2 + window, len(x))
    count = (end - begin).reshape((-1,) + (1,) * (x.ndim - 1))
    return np.asarray((total[end] - total[begin]) / count)


def rotate_each(quaternions: FloatArray, vectors: FloatArray) -> FloatArray:
    """Rotate each sensor vector (N, 3) by its quaternion (N, 4) into the world."""
    axis = quaternions[:, 1:]
    t = 2.0 * np.cross(axis, vectors)
    return np.asarray(vectors + quaternions[:, :1] * t + np.cross(axis, t))


def swing_peaks(left_radps: FloatArray, rate_hz: float) -> IntArray:
    """Indices of mid-swing: where the shank swings forward fastest, once per swing.

    ``left_radps`` (N,) is the rate about the axis to the person's left; swing is negative.
    """
    swing = moving_mean(-left_radps, max(round(STANCE_MEAN_S * rate_hz), 1))
    brisk = swing[swing > 0.25 * swing.max(initial=0.0)]
    if len(brisk) == 0:
        return np.zeros(0, dtype=np.int64)
    level = SWING_SHARE * float(np.percentile(brisk, 90))
    above = np.concatenate(([False], swing > level, [False]))
    edges = np.flatnonzero(above[1:] != above[:-1])
    peaks: list[int] = []
    for begin, end in zip(edges[0::2], edges[1::2], strict=True):
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

    def ends_of(k: int) -> tuple[int | None, int | None]:
        """Where the stride before the stance between swings ``k`` and ``k + 1`` ends, and the one after it begins."""
        begin, gap = float(swings[k]), float(between[k])
        if gap <= PAUSE_PER_STRIDE * usual:
            at = quietest(begin + SEARCH[0] * gap, begin + SEARCH[1] * gap)
            return at, at
        return after(begin), before(begin + gap)

    def after(swing: float) -> int | None:
        return quietest(swing + SEARCH[0] * usual, swing + REACH * usual)

    def before(swing: float) -> int | None:
        return quietest(swing - REACH * usual, swing - (1.0 - SEARCH[1]) * usual)

    stances: list[tuple[int | None, int | None]] = [(None, before(float(swings[0])))]
    stances += [ends_of(k) for k in range(len(between))]
    stances.append((after(float(swings[-1])), None))
    spans: list[StrideSpan] = []
    for k, swing in enumerate(swings):
        first, last = stances[k][1], stances[k + 1][0]
        if first is not None and last is not None and first < swing < last:
            quiet = bool(coarse[first] < limit and coarse[last] < limit)
            spans.append(StrideSpan(first, int(swing), last, half, quiet))
    return spans


def still_spans(acc_mps2: FloatArray, gyr_radps: FloatArray, rate_hz: float) -> list[tuple[int, int]]:
    """Stretches (first, last index) of at least ``STILL_S`` during which the sensor neither turned nor shook."""
    window = max(round(0.25 * rate_hz), 2)
    shake = moving_mean(acc_mps2**2, window) - moving_mean(acc_mps2, window) ** 2
    rate = moving_mean(gyr_radps**2, window) - moving_mean(gyr_radps, window) ** 2
    slow = np.linalg.norm(moving_mean(gyr_radps, window), axis=1) < 3.0 * STILL_RATE_RADPS
    still = slow & (shake.sum(axis=1) < STILL_FORCE_MPS2**2) & (rate.sum(axis=1) < STILL_RATE_RADPS**2)
    edges = np.flatnonzero(np.diff(np.concatenate(([0], still.astype(np.int8), [0]))))
    pairs = zip(edges[0::2], edges[1::2], strict=True)
    return [(int(a), int(b) - 1) for a, b in pairs if b - a >= STILL_S * rate_hz]


def levelled(
    t_ns: IntArray,
    acc: FloatArray,
    gyr: FloatArray,
    span: tuple[int, int],
    lead: int,
    change_mps: FloatArray | None = None,
) -> FloatArray:
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
    span_s = 1e-9 * float(t_ns[last] - t_ns[first])
    quaternions = np.empty((len(t), 4))
    start = np.array(from_gravity(*force.mean(axis=0)))
    orient(t, rates, start, 0.0, 0.0, 1.0, 0.0, quaternions)
    world = rotate_each(quaternions[inner], force[inner])
    mean = (0.5 * (world[1:] + world[:-1]) * step).sum(axis=0) / step.sum()
    target = np.array([0.0, 0.0, G_MPS2])
    if change_mps is not None:
        target = target + change_mps / span_s
    w, x, y, z = from_gravity(*target)
    turn = _product(np.array([w, -x, -y, -z]), np.array(from_gravity(*mean)))
    start = _product(turn, start)
    orient(t, rates, start, 0.0, 0.0, 1.0, 0.0, quaternions)
    return quaternions


def _product(p: FloatArray, q: FloatArray) -> FloatArray:
    """Hamilton product of two quaternions (4,)."""
    vector = p[0] * q[1:] + q[0] * p[1:] + np.cross(p[1:], q[1:])
    return np.concatenate(([p[0] * q[0] - p[1:] @ q[1:]], vector))
