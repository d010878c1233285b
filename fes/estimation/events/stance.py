"""Foot flat and heel rise off-line: where a stance's pitch comes to mid-stance's, and where it leaves it.

Between a contact and the next foot off the foot's pitch is that of its mid-stance, but for its landing and its roll
over the forefoot. The pitch is the mediolateral rate's integral over a few tenths of a second, so that a gyroscope's
drift is hundredths of a degree, and mid-stance's is the mean of a tenth of a second in the middle of the stance:

- *foot flat*: from then on until mid-stance the pitch is within ``FLAT_RAD`` of mid-stance's and turns more slowly than
  ``FLAT_RADPS``, so that a foot that lands on its forefoot, or slaps down and rebounds, is flat when that is over;
- *heel rise*: the last instant at which the foot has not yet turned toe-down by ``RISE_RAD`` from mid-stance.

No paper; foot-flat by angle and rate after Mariani et al. (2013). ``benchmarks/offline_phases.py`` holds both against
footswitches, and chooses the angles again without the walker that is judged.
"""

import numpy as np

from fes.estimation.foot.calibration import FootCalibration
from fes.estimation.strides.boundaries import UNSEEN_NS
from fes.signals import NS_PER_S, FloatArray, IntArray

FLAT_RAD, FLAT_RADPS, FLAT_OVER_S = np.radians(5.0), 1.0, 0.02  # the rate is the mean over so long on either side
RISE_RAD = np.radians(2.0)
AROUND_S = 0.05  # mid-stance's pitch is the mean over this much before and after
LONGEST_STANCE_S = 3.0  # of a longer one (standing) the parts next to contact and foot off count


def pitch_of(t_ns: IntArray, gyr_radps: FloatArray, calibration: FootCalibration) -> tuple[FloatArray, FloatArray]:
    """Seconds since the first sample (N,), and the pitch there: rad since then, toe-up positive; it drifts."""
    rate = (gyr_radps - np.array(calibration.gyr_bias_radps)) @ np.array(calibration.toe_down)
    seconds = (t_ns - t_ns[0]) / NS_PER_S
    return seconds, np.concatenate(([0.0], -np.cumsum(0.5 * (rate[1:] + rate[:-1]) * np.diff(seconds))))


def stance_instants(
    t_ns: IntArray, gyr_radps: FloatArray, fo_ns: IntArray, ic_ns: IntArray, calibration: FootCalibration,
    *, flat_rad: float = FLAT_RAD, rise_rad: float = RISE_RAD,
) -> tuple[IntArray, IntArray]:  # fmt: skip
    """Heel rise before each of K foot offs and foot flat after each of K contacts, ns; ``UNSEEN_NS`` where not seen.

    Args:
        t_ns: (N,) strictly increasing time stamps.
        gyr_radps: (N, 3) angular rate.
        fo_ns: (K,) foot off, each before …
        ic_ns: (K,) … its contact.
        calibration: of this foot.
        flat_rad: how near to mid-stance's pitch is flat.
        rise_rad: how far from it the heel has risen.
    """
    rises, flats = (np.full(len(ic_ns), UNSEEN_NS, np.int64) for _ in range(2))
    seconds, pitch = pitch_of(t_ns, gyr_radps, calibration)
    period_s = seconds[-1] / max(len(t_ns) - 1, 1)
    over, around = (max(round(span_s / period_s), 1) for span_s in (FLAT_OVER_S, AROUND_S))
    contacts, offs = np.searchsorted(t_ns, ic_ns), np.searchsorted(t_ns, fo_ns)
    for k, (first, last) in enumerate(zip(contacts[:-1].tolist(), offs[1:].tolist(), strict=True)):
        half = min(last - first, round(LONGEST_STANCE_S / period_s)) // 2
        if half <= around + over or first < over:
            continue
        landed, leaving = first + half, last - half
        off = pitch[first:landed] - pitch[landed - around : landed + around + 1].mean()
        turned = pitch[first + over : landed + over] - pitch[first - over : landed - over]
        moving = np.flatnonzero((np.abs(off) > flat_rad) | (np.abs(turned) > FLAT_RADPS * 2 * over * period_s))
        flats[k] = t_ns[first + (int(moving[-1]) + 1 if len(moving) else 0)]
        level = pitch[leaving - around : leaving + around + 1].mean()
        down = np.flatnonzero(pitch[leaving:last] > level - rise_rad)
        rises[k + 1] = t_ns[leaving + (int(down[-1]) if len(down) else 0)]
    return rises, flats
