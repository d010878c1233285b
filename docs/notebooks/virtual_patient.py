# %% [markdown]
# # Closing the loop on a virtual patient
#
# A virtual patient with a drop foot walks on a treadmill. Its muscles answer to the current, so that the controller,
# the gate and the foot form one loop, as they do with a person. Nothing real is stimulated. What the model is made of
# is in [the virtual patient](../virtual_patient.md).

# %%
import tempfile
from pathlib import Path

import numpy as np

import fes

session = fes.load_session(fes.bundled_file("session.toml"))
plain = fes.simulate("moderate", seconds=30.0)
helped = fes.simulate("moderate", session=session, seconds=30.0)

# %% [markdown]
# The truth of each stride is known: how high the toe cleared the ground, whether it dragged, what charge went in.


# %%
def late(simulated, column):
    """The strides after the first ten seconds, when the ankle has met the current."""
    return simulated.strides[column][simulated.strides["t_foot_off_s"] > 10.0].astype(float)


for name, simulated in (("without", plain), ("stimulated", helped)):
    clearance_cm, charge_uc = 100.0 * late(simulated, "toe_clearance_m"), late(simulated, "charge_uc")
    print(f"{name:10} toe {np.nanmean(clearance_cm):5.2f} cm, {np.nanmean(charge_uc):6.0f} µC a stride")
assert np.nanmean(late(helped, "toe_clearance_m")) > np.nanmean(late(plain, "toe_clearance_m"))
assert not late(plain, "charge_uc").any()

# %%
import matplotlib.pyplot as plt

figure, axes = plt.subplots(layout="constrained")
for name, simulated in (("without", plain), ("stimulated", helped)):
    axes.plot(simulated.strides["t_foot_off_s"], 100.0 * simulated.strides["toe_clearance_m"], ".-", label=name)
axes.set(xlabel="time, s", ylabel="toe clearance, cm")
axes.legend(frameon=False)

# %% [markdown]
# The session log is that of a live session: its phases, its commands as the gate let them pass, its report.

# %%
log = helped.log
commands = log.commands
print(
    len(log.phases), "changes of phase;", int(commands["on"].sum()), "of", len(commands), "commands let current through"
)
assert log.record.complete
log.report(Path(tempfile.mkdtemp()) / "session.html")

# %% [markdown]
# How well the session saw the patient walk, against the truth that the simulation wrote:

# %%
from fes.simulation.truth import write_truth

folder = Path(tempfile.mkdtemp())
references = [path for path in write_truth(helped.truth, folder) if path.name.endswith(".strides.csv")]
for row in fes.evaluate(log, references).table:
    if row["foot"] == "both feet" and row["quantity"] in ("initial_contact_s", "foot_off_s", "stride_length_m"):
        limits = f"{row['lower_limit']:+.3f} … {row['upper_limit']:+.3f}"
        print(f"{row['quantity']:18} {row['bias']:+.3f}, {limits}, n {row['n']}")
