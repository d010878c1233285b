# needs: gaitmap_walk, stroke_treadmill
# %% [markdown]
# # The tables of the four papers
#
# Each table that Negård, Kumar, Wu and Wang with their co-workers print, beside what this program finds. Their
# recordings are not public. Negård's two patients are imitated by simulated walkers that come with the program. The
# others are replicated on public recordings of other people: read the columns side by side, not as the same
# experiment. `FES_DATA` names the folder of the recordings. How each method is built here is in
# [methods](../methods.md).

# %%
import os
import sys
from pathlib import Path

sys.path.append(str(Path("../..").resolve()))  # of the project's source, seen from this notebook
from benchmarks.accuracy import papers

data = Path(os.environ["FES_DATA"])

# %% [markdown]
# ## Negård et al.: phases and stride lengths while stimulated
#
# Table 1 is the duration of the four phases, Table 2 the errors against an ultrasonic system at 25 Hz. Estimate minus
# reference, with the reference's lag fitted, as they did.

# %%
for text in papers.negard():
    print(text)

# %% [markdown]
# ## Kumar et al.: initial contact and foot off by a ZUPT-aided filter
#
# They show figures and print no table. Here the instants are held against markers.

# %%
for text in papers.kumar(data):
    print(text)

# %% [markdown]
# ## Wang et al.: distance and parameters of hemiparetic gait
#
# The errors of each foot are kept: Wu's table has a column of the foot, too.

# %%
texts, errors = papers.wang(data)
for text in texts:
    print(text)

# %% [markdown]
# ## Wu et al.: an ankle sensor that never rests

# %%
for text in papers.wu(data, errors):
    print(text)
