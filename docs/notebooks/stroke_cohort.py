# needs: unseen_walkers/stroke_walks
# %% [markdown]
# # A stroke cohort with statistics
#
# Stroke survivors and healthy walkers, two minutes on the floor with turns, a sensor on each foot. The recordings are
# public (`fes import list` names where they come from) and no part of the program: `FES_DATA` names the folder that
# holds them. Of thousands of recordings `fes cohort` makes the same tables by many processes
# ([cohorts](../cohort.md)).

# %%
import os
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from scipy.stats import mannwhitneyu, spearmanr

import fes
from fes.datasets import read_file

folder = Path(os.environ["FES_DATA"]) / "unseen_walkers" / "stroke_walks"
paths = sorted(folder.glob("S*.npz"))
print(len(paths), "walks")

# %% [markdown]
# One row a person: medians of the valid strides, variability within the walk, and how far the sides differ. The
# symmetry index is the difference of the feet over their mean. Which side is paretic is not told, so its sign is left
# away.

# %%
PARAMETERS = ("stride_length_m", "stride_time_s", "speed_mps", "swing_s", "lift_m")


def person(path):
    imported = read_file("stroke_walks", path)
    table = fes.analyse(imported.recording).parameters.table
    left, right = (table["foot"] == foot for foot in ("left_foot", "right_foot"))
    row = {"name": path.stem, "group": imported.recording.extra["group"], "strides": len(table)}
    for name in PARAMETERS:
        values = table[name].astype(float)
        row[name] = np.nanmedian(values)
        sides = np.nanmedian(values[left]), np.nanmedian(values[right])
        row[f"{name} asymmetry"] = 100.0 * abs(sides[0] - sides[1]) / np.mean(sides)
    times_s = table["stride_time_s"].astype(float)
    row["stride_time_s CV"] = 100.0 * np.nanstd(times_s, ddof=1) / np.nanmean(times_s)
    return row


rows = [person(path) for path in paths]
groups = sorted({row["group"] for row in rows})
for group in groups:
    print(group, sum(row["group"] == group for row in rows), "persons")

# %% [markdown]
# Groups are compared by ranks (Mann and Whitney): walks of patients are not normally distributed, and the groups are
# small. The effect is Cliff's delta: +1 where every person of the first group lies above every one of the second. With
# so many parameters some will differ by chance, so p is adjusted by Holm's method.


# %%
def holm(p):
    """Adjusted p-values (N,), Holm 1979."""
    order, adjusted, largest = np.argsort(p), np.empty(len(p)), 0.0
    for rank, k in enumerate(order):
        largest = max(largest, min(1.0, (len(p) - rank) * p[k]))
        adjusted[k] = largest
    return adjusted


names = [name for name in rows[0] if name not in ("name", "group", "strides")]
samples = {name: [np.array([row[name] for row in rows if row["group"] == group]) for group in groups] for name in names}
tests = {name: mannwhitneyu(*pair) for name, pair in samples.items()}
adjusted = holm(np.array([test.pvalue for test in tests.values()]))
print(f"{'':26} {groups[0]:>12} {groups[1]:>12}   delta   p (Holm)")
for (name, pair), p in zip(samples.items(), adjusted, strict=True):
    delta = 2.0 * tests[name].statistic / (len(pair[0]) * len(pair[1])) - 1.0
    print(f"{name:26} {np.median(pair[0]):12.3f} {np.median(pair[1]):12.3f}  {delta:+.2f}   {p:.3f}")

# %%
figure, axes = plt.subplots(1, 3, figsize=(10, 3.5), layout="constrained")
for place, name in zip(axes, ("speed_mps", "swing_s asymmetry", "stride_time_s CV"), strict=True):
    place.boxplot(samples[name], tick_labels=groups)
    place.set_title(name)

# %% [markdown]
# Slow walkers vary more. The correlation is by ranks, too.

# %%
found = spearmanr([row["speed_mps"] for row in rows], [row["stride_time_s CV"] for row in rows])
print(f"speed and variability: rho {found.statistic:+.2f}, p {found.pvalue:.4f}")
