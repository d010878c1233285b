"""A stride's length as twice the arc of a leg: what the foot turns in its swing, times the leg's length."""

import numpy as np

LEG_M = 0.9


def arc_length(track, calibration, t_start_s, t_end_s):
    """Lengths (K,) in m of the strides from ``t_start_s`` to ``t_end_s`` (K,); NaN for one that lasts over 3 s."""
    seconds = 1e-9 * (track.t_sensor_ns - track.t_sensor_ns[0])
    rate_radps = np.linalg.norm(track.gyr_radps, axis=1)
    turned_rad = np.concatenate(([0.0], np.cumsum(0.5 * (rate_radps[1:] + rate_radps[:-1]) * np.diff(seconds))))
    lengths_m = LEG_M * (np.interp(t_end_s, seconds, turned_rad) - np.interp(t_start_s, seconds, turned_rad)) / 2.0
    return np.where(t_end_s - t_start_s > 3.0, np.nan, lengths_m)
