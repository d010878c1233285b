"""Foot-strike angle: pitch of the foot at IC relative to mid-stance, toe-up positive, from the mediolateral rate alone.

Between IC and mid-stance lie some 0.3 s, over which a gyroscope drifts by hundredths of a degree: no orientation
filter is needed, the instants decide. IC is the greatest pitch of a heel strike, so that some ms more or less hardly
matter. What matters is mid-stance: the middle *in time* between IC and FO, as in optical gait analysis, not the
quietest instant. A brisk walker's foot rolls on at 0.5 rad/s all through stance, and the quietest instant comes early
in it; that costs 6° in the fastest patient and 1° in the slowest. Against Vicon means of 13 runs of 4 patients the
quietest instant gives a correlation of 0.98 and an SD of 2.1°, the middle of stance 0.99 and 1.3°.
"""

from __future__ import annotations

import numpy as np

from fes.estimation.calibration import FootCalibration
from fes.estimation.events_offline import GaitEvents
from fes.signals import NS_PER_S, FloatArray, IntArray

AROUND_S = 0.05  # mid-stance's pitch is the mean over this much before and after
LONGEST_STANCE_S = 3.0  # of a longer one (standing) the first part counts: FO is another step's


def foot_strike_angles(
    t_ns: IntArray, gyr_radps: FloatArray, events: GaitEvents, calibration: FootCalibration
) -> FloatArray:
    """Angle (K,) in rad at each IC of ``events``, toe-up positive; NaN where the recording ends before mid-stance.

    Args:
        t_ns: (N,) strictly increasing time stamps, as given to ``find_events``.
        gyr_radps: (N, 3) angular rate.
        events: of this foot.
        calibration: of this foot.
    """
    rate = (gyr_radps - np.array(calibration.gyr_bias_radps)) @ np.array(calibration.toe_down)
    seconds = (t_ns - t_ns[0]) / NS_PER_S
    pitch = np.concatenate(([0.0], -np.cumsum(0.5 * (rate[1:] + rate[:-1]) * np.diff(seconds))))
    mean_of = np.concatenate(([0.0], np.cumsum(0.5 * (pitch[1:] + pitch[:-1]) * np.diff(seconds))))
    contact = (events.ic_ns - t_ns[0]) / NS_PER_S
    off = np.append((events.fo_ns[1:] - t_ns[0]) / NS_PER_S, np.inf)[: len(contact)]
    middle = contact + 0.5 * np.minimum(off - contact, LONGEST_STANCE_S)
    begin, end = (np.interp(middle + side, seconds, mean_of) for side in (-AROUND_S, AROUND_S))
    angle = np.interp(contact, seconds, pitch) - (end - begin) / (2.0 * AROUND_S)
    return np.asarray(np.where(middle + AROUND_S <= seconds[-1], angle, np.nan))
