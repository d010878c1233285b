"""How often a foot swung, from the raw signals alone: what strides are counted against.

Nothing of the phase machine, of calibration or of the stride solver is used, and no constant of theirs, so that what
they miss is seen. A swing is one rise of the foot's pitch: in the air it turns toe-up, from about −60° at foot off to
about +20° before contact in sound gait (Winter 2009; Perry & Burnfield 2010). A slap at contact is a *fall* of the
pitch, a forefoot landing prolongs the rise, weight shifts turn the foot by a few degrees only.

- *up*: the median specific force of the quietest quarter of the samples;
- *axis*: of the angles about level axes (rates below 5 Hz, integrated, without what is slower than 0.15 Hz) the
  direction with the most variance; its sign by the foot's speed, which is skewed towards forward;
- *rises*: between turning points at least 3° apart. One of ``SURE`` of the typical rise (the median of the greater two
  thirds) is a swing; one of ``POSSIBLE`` may be one (a step on the spot), and so may one that the recording's end cuts.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from fes.signals import NS_PER_S, FloatArray, IntArray

GRID_HZ = 100.0
TURNING_HZ = 5.0  # the foot's pitch has little above (Winter 2009)
DRIFT_HZ, SPEED_HZ = 0.15, 0.3  # below the slowest strides; a speed drifts more than an angle
APART_RAD = float(np.radians(3.0))
SURE, POSSIBLE = 0.4, 0.15
LEAST_SURE_RAD, LEAST_POSSIBLE_RAD = float(np.radians(8.0)), float(np.radians(4.0))
MOST_RADPS = 40.0  # no foot turns faster: a spike
LEAST_S = 2.0
LONGEST_GAP_S, CLOSED_GAP_S = 1.0, 0.1  # of a longer gap, in which feet may have swung unseen, so much stays
PADDING_S = 10.0


@dataclass(frozen=True)
class Swings:
    """Mid-swings (ns): ``sure`` those that must be found, ``possible`` these and those that may be as well.

    ``begin_ns`` and ``end_ns`` are the recording's, or of what is looked at of it.
    """

    sure: IntArray
    possible: IntArray
    begin_ns: int
    end_ns: int

    def whole(self) -> IntArray:
        """The sure ones that the recording does not cut: it begins and ends half a usual stride away at least."""
        half_ns = 0.5 * float(np.median(np.diff(self.sure))) if len(self.sure) > 1 else 0.0
        return self.sure[(self.sure >= self.begin_ns + half_ns) & (self.sure <= self.end_ns - half_ns)]

    def outside(self, spans_ns: Iterable[tuple[int, int]]) -> IntArray:
        """Those of :meth:`whole` that are no span's: a stride has one swing, a second one in it is not its own."""
        spans, next_one, alone = sorted(spans_ns), 0, []
        for t_ns in self.whole().tolist():
            while next_one < len(spans) and spans[next_one][1] < t_ns:
                next_one += 1
            if next_one < len(spans) and spans[next_one][0] <= t_ns:
                next_one += 1
            else:
                alone.append(t_ns)
        return np.array(alone, np.int64)

    def walking_s(self, at_ns: IntArray) -> float:
        """Seconds about these of :meth:`whole`: half the way to each neighbour, half a usual stride at most."""
        every = self.whole()
        if len(every) < 2:
            return 0.0
        step_ns = np.diff(every).astype(np.float64)
        half_ns = 0.5 * np.minimum(step_ns, np.median(step_ns))
        edge = 0.5 * np.median(step_ns)
        share_ns = np.concatenate(([edge], half_ns)) + np.concatenate((half_ns, [edge]))
        return float(share_ns[np.isin(every, at_ns)].sum()) / NS_PER_S


def find_swings(t_ns: IntArray, acc_mps2: FloatArray, gyr_radps: FloatArray) -> Swings:
    """The swings of one foot, from its sensor's samples: times (N,) in ns, m/s² and rad/s (N, 3) in any axes."""
    none = np.empty(0, np.int64)
    begin, end = (int(t_ns.min()), int(t_ns.max())) if t_ns.size else (0, 0)
    if end - begin < LEAST_S * NS_PER_S:
        return Swings(none, none, begin, end)
    times, pitch = pitch_of(t_ns, acc_mps2, gyr_radps)
    points = turning_points(pitch, APART_RAD)
    spans = list(zip(points[0::2], points[1::2], strict=False))
    if not spans:
        return Swings(none, none, begin, end)
    whole = len(spans)
    if len(points) > 2 * whole:  # the recording ends before the foot falls again
        spans.append((points[-1], points[-1] + int(np.argmax(pitch[points[-1] :]))))
    rises = np.array([pitch[b] - pitch[a] for a, b in spans])
    typical = float(np.median(np.sort(rises[:whole])[whole // 3 :]))
    middle = [a + int(np.argmax(pitch[a : b + 1] >= 0.5 * (pitch[a] + pitch[b]))) for a, b in spans]
    at_ns = times[middle]
    sure = (rises >= max(SURE * typical, LEAST_SURE_RAD))[:whole]
    return Swings(at_ns[:whole][sure], at_ns[rises >= max(POSSIBLE * typical, LEAST_POSSIBLE_RAD)], begin, end)


def pitch_of(t_ns: IntArray, acc_mps2: FloatArray, gyr_radps: FloatArray) -> tuple[IntArray, FloatArray]:
    """Times (M,) of a grid that is even but for gaps, ns, and the pitch there (rad, toe-up positive; it drifts)."""
    newer = np.concatenate(([True], t_ns[1:] > np.maximum.accumulate(t_ns)[:-1]))
    sound = newer & np.isfinite(acc_mps2).all(axis=1) & (np.abs(gyr_radps).max(axis=1) < MOST_RADPS)
    if not sound.any():
        return t_ns[:0], np.zeros(0)
    t_s = (t_ns[sound] - t_ns[0]) / NS_PER_S
    steps_s = np.diff(t_s, prepend=t_s[0])
    left_out_s = np.cumsum(np.where(steps_s > LONGEST_GAP_S, steps_s - CLOSED_GAP_S, 0.0))
    t_s -= left_out_s
    grid_s = np.arange(0.0, t_s[-1], 1.0 / GRID_HZ)
    acc, gyr = (
        np.column_stack([np.interp(grid_s, t_s, axis) for axis in values[sound].T]) for values in (acc_mps2, gyr_radps)
    )
    slow = _between(gyr, 0.0, TURNING_HZ)
    size = np.linalg.norm(slow, axis=1)
    quiet = size <= np.percentile(size, 25)
    up = np.median(acc[quiet], axis=0)
    up /= max(float(np.linalg.norm(up)), 1e-9)
    slow -= np.median(slow[quiet], axis=0)
    angle = np.cumsum(slow - np.outer(slow @ up, up), axis=0) / GRID_HZ
    steady = _between(angle, DRIFT_HZ, np.inf)
    axis = np.linalg.eigh(np.cov(steady.T))[1][:, -1]
    turned = steady @ axis
    turned -= np.median(turned[quiet])
    force = np.cos(turned) * (acc @ np.cross(up, axis)) - np.sin(turned) * (acc @ up)  # level, if toe-up is positive
    speed = _between(np.cumsum(force - force.mean())[:, None] / GRID_HZ, SPEED_HZ, np.inf)[:, 0]
    if _skewed_down(speed):
        axis = -axis
    grid_s += left_out_s[np.searchsorted(t_s, grid_s, side="right") - 1]
    return t_ns[0] + np.rint(grid_s * NS_PER_S).astype(np.int64), angle @ axis


def _between(values: FloatArray, low_hz: float, high_hz: float) -> FloatArray:
    """Of (N, K) at ``GRID_HZ`` what lies between, as Butterworth's second order run both ways lets it through."""
    pad = min(round(PADDING_S * GRID_HZ), len(values) - 1)
    before, after = 2.0 * values[0] - values[pad:0:-1], 2.0 * values[-1] - values[-2 : -pad - 2 : -1]
    padded = np.concatenate((before, values, after))
    hz = np.fft.rfftfreq(len(padded), 1.0 / GRID_HZ)[:, None]
    gain = 1.0 / (1.0 + (hz / high_hz) ** 4)
    if low_hz:
        gain = gain * hz**4 / (hz**4 + low_hz**4)
    return np.asarray(np.fft.irfft(gain * np.fft.rfft(padded, axis=0), len(padded), axis=0)[pad : pad + len(values)])


def _skewed_down(values: FloatArray) -> bool:
    """Whether (N,), without its utmost percents, reaches further down than up."""
    cut = np.clip(values, *np.percentile(values, (1.0, 99.0)))
    return bool(np.mean((cut - cut.mean()) ** 3) < 0.0)


def turning_points(pitch: FloatArray, apart: float) -> list[int]:
    """Where (N,) turns, trough and peak by turns, first a trough: each at least ``apart`` from the one before."""
    found: list[int] = []
    values: list[float] = pitch.tolist()
    low = high = 0
    rising: bool | None = None
    for k, value in enumerate(values):
        if rising is not False and value > values[high]:
            high = k
        if rising is not True and value < values[low]:
            low = k
        if rising is not False and value < values[high] - apart:
            if rising:
                found.append(high)
            rising, low = False, k
        elif rising is not True and value > values[low] + apart:
            found.append(low)
            rising, high = True, k
    return found
