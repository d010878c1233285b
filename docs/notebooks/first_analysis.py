# %% [markdown]
# # A first analysis
#
# From a recording to strides, figures and a report, on a recording that comes with the program: a simulated walker on
# a treadmill, a sensor on each foot. Put your own file in its place; what a file needs is in
# [recordings](../recordings.md).

# %%
import tempfile
from pathlib import Path

import fes

walk = fes.read(fes.bundled_file("both_feet_100hz.parquet"))
for name, track in walk.tracks.items():
    print(name, f"{track.rate_hz:g} Hz, {track.duration_s:.0f} s", track.acc_mps2.shape)

# %% [markdown]
# The analysis finds how each sensor sits from the walk itself. It needs a second of standing still and five strides.

# %%
result = fes.analyse(walk)
result

# %% [markdown]
# Every table has named columns, as arrays. A stride that is not `valid` has its `reason`; its numbers do not count.

# %%
strides = result.strides
valid = strides["valid"]
for foot in ("left_foot", "right_foot"):
    own = strides["stride_length_m"][valid & (strides["foot"] == foot)]
    print(f"{foot}: {len(own)} strides, {own.mean():.2f} ± {own.std(ddof=1):.2f} m")

# %% [markdown]
# Figures are drawn by matplotlib (`pip install fes-gait[analysis,plot]`). Each takes or makes axes, and returns them.

# %%
result.plot.strides("stride_length_m")

# %%
result.plot.phases(begin_s=20.0, seconds=5.0)

# %%
result.plot.butterfly()

# %% [markdown]
# Gait parameters: means of each foot, the sides compared, and the walk's own. Their definitions are in
# [parameters](../parameters.md).

# %%
for row in result.parameters.summary:
    if row["parameter"] in ("cadence_per_min", "walking_speed_mps", "stride_length_m", "swing_s"):
        print(f"{row['of']:22} {row['parameter']:18} {row['value']:.3f} {row['unit']}")

# %% [markdown]
# This walker is simulated, so the truth is known. The agreement is estimate minus truth, with 95 % limits of agreement.

# %%
agreement = fes.evaluate(result, fes.bundled_file("both_feet_100hz.strides.csv"))
for row in agreement.table:
    if row["foot"] == "both feet" and row["quantity"] in ("stride_length_m", "stride_time_s"):
        print(row["quantity"], f"{row['bias']:+.4f} ({row['lower_limit']:+.4f} … {row['upper_limit']:+.4f})")

# %% [markdown]
# The report is one HTML file that can be printed or sent.

# %%
folder = Path(tempfile.mkdtemp())
result.report(folder / "walk.html")
