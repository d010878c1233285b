# %% [markdown]
# # Your own phase detector, by the same benchmarks
#
# A detector is a function: a sensor's track and its calibration in, the seconds of initial contact (IC) and foot off
# (FO) out. This one is the simplest that works on level ground: swing is where the foot turns fast, its ends are where
# the turning rate crosses a threshold, one half of what this walk reaches. Then it is judged as the program's own
# detectors are.

# %%
import sys
from pathlib import Path

import numpy as np
from scipy.signal import butter, sosfiltfilt

import fes
from benchmarks.lib.real_sets import bundled_cases

sys.path.append(str(Path("../..").resolve()))
from benchmarks.accuracy import events

# %%
FAST = 0.5  # of the turning rate that only a twentieth of the samples exceeds
SHORTEST_S = 0.15  # of a swing
BEFORE_NEXT_S = 0.25  # two swings that are closer are one


def threshold_swings(track, calibration):
    """IC and FO in s from the track's start, where the turning rate crosses ``FAST``."""
    smooth = butter(2, 6.0, fs=track.rate_hz, output="sos")
    rate_radps = np.linalg.norm(sosfiltfilt(smooth, track.gyr_radps, axis=0), axis=1)
    fast = np.concatenate(([False], rate_radps > FAST * np.quantile(rate_radps, 0.95), [False]))
    begins, ends = np.flatnonzero(fast[1:] & ~fast[:-1]), np.flatnonzero(~fast[1:] & fast[:-1]) - 1
    swings = []
    for begin, end in zip(begins, ends, strict=True):
        if swings and begin - swings[-1][1] < BEFORE_NEXT_S * track.rate_hz:
            swings[-1][1] = end
        else:
            swings.append([begin, end])
    long = [swing for swing in swings if swing[1] - swing[0] > SHORTEST_S * track.rate_hz]
    seconds = 1e-9 * (track.t_sensor_ns - track.t_sensor_ns[0])
    return {"FO": seconds[[begin for begin, _ in long]], "IC": seconds[[end for _, end in long]]}


walk = fes.read(fes.bundled_file("both_feet_100hz.parquet"))
calibration = fes.calibrate(walk).calibrations["left_foot"]
found = threshold_swings(walk.tracks["left_foot"], calibration)
print({name: len(times_s) for name, times_s in found.items()})

# %% [markdown]
# ## The benchmark of the events
#
# The same cases, the same tolerance and the same counts of what was missed and what is extra as in
# `python benchmarks/accuracy/events.py`.

# %%
events.METHODS["own"] = threshold_swings
cases = bundled_cases()
names = list(dict.fromkeys(case.name for case in cases))
table = {}
for name in names:
    mine = [case for case in cases if case.name == name]
    for method in ("causal, phase machine", "own"):
        for one in events.score(name, mine, method):
            table[name, method, one.event] = one
            print(
                f"{name:26} {method:22} {one.event}: {one.found}/{one.true}, {one.extra} extra, {one.mean_ms:+.0f} ms"
            )

# %% [markdown]
# It finds most swings, and it is much further from the truth where the foot goes on turning after the contact. What it
# finds where nobody walks is the other half of the judgement:

# %%
still = fes.read(Path("../../sim_inputs/not_walking.parquet"))
for foot, track in still.tracks.items():
    print(foot, len(threshold_swings(track, None)["IC"]), "swings in", f"{track.duration_s:.0f} s without walking")

# %% [markdown]
# As a part of a package with an entry point it is there in every analysis by its name, as
# `fes.analyse(walk, detector="own")`: see [extensions](../extensions.md).
