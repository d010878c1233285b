"""Foot off and initial contact where the turning rate crosses half of what the walk reaches."""

import numpy as np
from scipy.signal import butter, sosfiltfilt

FAST = 0.5  # of the turning rate that only a twentieth of the samples exceeds
SHORTEST_S = 0.15
APART_S = 0.25


def threshold_swings(track, calibration):
    """FO and IC in s from the track's first sample."""
    smooth = butter(2, 6.0, fs=track.rate_hz, output="sos")
    rate_radps = np.linalg.norm(sosfiltfilt(smooth, track.gyr_radps, axis=0), axis=1)
    fast = np.concatenate(([False], rate_radps > FAST * np.quantile(rate_radps, 0.95), [False]))
    begins, ends = np.flatnonzero(fast[1:] & ~fast[:-1]), np.flatnonzero(~fast[1:] & fast[:-1]) - 1
    swings = []
    for begin, end in zip(begins.tolist(), ends.tolist(), strict=True):
        if swings and begin - swings[-1][1] < APART_S * track.rate_hz:
            swings[-1][1] = end
        else:
            swings.append([begin, end])
    swings = np.array([each for each in swings if each[1] - each[0] > SHORTEST_S * track.rate_hz], int).reshape(-1, 2)
    seconds = 1e-9 * (track.t_sensor_ns - track.t_sensor_ns[0])
    return {"FO": seconds[swings[:, 0]], "IC": seconds[swings[:, 1]]}
