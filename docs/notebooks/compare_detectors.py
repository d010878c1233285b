# %% [markdown]
# # Comparing detectors
#
# Three things are detected in a foot's signals: when it rests (zero velocity, for the path), when it touches and
# leaves the ground (events, for the parameters), and which phase it is in (for the stimulation, at the moment itself).
# Here the detectors of each are held against the same truth, that of a bundled simulated walk. Figures on recordings
# of people are in [accuracy](../accuracy.md).

# %%
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import fes
from benchmarks.lib.real_sets import bundled_cases
from fes.estimation.zupt.detectors import Detector
from fes.estimation.zupt.thresholds import find_zero_velocity
from fes.simulation.truth import load_truth

path = Path("../../sim_inputs/both_feet_100hz.parquet")  # with its truth, which only the project's source holds
walk, truth = fes.read(path), load_truth(path)
foot = "left_foot"
track, pose = walk.tracks[foot], truth.feet[foot]

# %% [markdown]
# ## Zero velocity
#
# At rest is what moves slower than 0.1 m/s over the belt. F1 weighs what was missed and what was wrongly taken alike.

# %%
speed_mps = np.linalg.norm(np.gradient(pose.sensor_m, 1e-9 * pose.t_ns, axis=0), axis=1)
resting = np.interp(track.t_sensor_ns, pose.t_ns, speed_mps) < 0.1
scores = {}
for detector in Detector:
    _, found, _ = find_zero_velocity(track.acc_mps2, track.gyr_radps, track.rate_hz, detector)
    both = int(np.sum(found & resting))
    scores[detector.name] = 2.0 * both / (int(found.sum()) + int(resting.sum()))
    precision, recall = both / found.sum(), both / resting.sum()
    print(f"{detector.name:5} precision {precision:.3f}, recall {recall:.3f}, F1 {scores[detector.name]:.3f}")
assert min(scores.values()) > 0.5

# %% [markdown]
# ## Events, with the whole recording and at the moment
#
# `fes.analyse` knows what came after, `fes.replay` decides as a live session does. A late decision is a positive bias.

# %%
reference = fes.bundled_file("both_feet_100hz.strides.csv")
for name, estimate in (("off-line", fes.analyse(walk)), ("as in a session", fes.replay(walk))):
    for row in fes.evaluate(estimate, reference).table:
        if row["foot"] == "both feet" and row["quantity"] in ("initial_contact_s", "foot_off_s"):
            limits = f"{1e3 * row['lower_limit']:+.0f} … {1e3 * row['upper_limit']:+.0f} ms"
            print(f"{name:16} {row['quantity']:18} {1e3 * row['bias']:+.1f} ms ({limits}), n {row['n']}")

# %% [markdown]
# ## The same rules side by side
#
# `benchmarks/accuracy/events.py` runs every rule over every bundled walk, the peaks that Kumar et al. print among them.

# %%
import sys

sys.path.append(str(Path("../..").resolve()))
from benchmarks.accuracy import events

cases = [case for case in bundled_cases() if case.name == "bundled both_feet_100hz"]
results = {method: events.score(cases[0].name, cases, method) for method in events.METHODS}
for method, both in results.items():
    for one in both:
        numbers = f"{one.mean_ms:+.0f} ± {one.sd_ms:.0f} ms"
        print(f"{method:26} {one.event}: {one.found}/{one.true}, {one.extra} extra, {numbers}")

# %%
figure, axes = plt.subplots(layout="constrained")
for k, (_, both) in enumerate(results.items()):
    axes.errorbar([one.median_ms for one in both], [k - 0.1, k + 0.1], xerr=[one.sd_ms for one in both], fmt="o")
axes.set(yticks=range(len(results)), yticklabels=results, xlabel="median error, ms; bars: SD")
