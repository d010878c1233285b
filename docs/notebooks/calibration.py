# %% [markdown]
# # Building a calibration
#
# A calibration says where up and forward are in a sensor's own axes, what its gyroscope shows at rest, and how this
# person's foot turns. `fes.analyse` makes its own. Keep one where a later recording is too short to show it, or where
# every session of one person is to be judged by the same.

# %%
import tempfile
from pathlib import Path

import numpy as np

import fes

walk = fes.read(fes.bundled_file("both_feet_100hz.parquet"))
path = Path(tempfile.mkdtemp()) / "walk.calibration.json"
calibration = fes.calibrate(walk, path)
for sensor, own in calibration.calibrations.items():
    up, confidence = np.round(own.up, 3), own.axis_confidence
    print(f"{sensor}: up {up}, {own.strides} strides, confidence of the axis {confidence:.2f}")

# %% [markdown]
# Used again, from its file, it gives the strides that the walk's own gives.

# %%
own = fes.analyse(walk)
again = fes.analyse(walk, calibration=path)
assert len(own.strides) == len(again.strides)
difference_m = own.strides["stride_length_m"] - again.strides["stride_length_m"]
print(f"largest difference {1e3 * np.nanmax(np.abs(difference_m)):.3f} mm")

# %% [markdown]
# It does not matter how the sensor sits. Here the left one is turned by 40° about an axis across all of its own: the
# calibration finds another "up", the strides stay.

# %%
from scipy.spatial.transform import Rotation

turn = Rotation.from_rotvec(np.radians(40.0) * np.array([1.0, 1.0, 1.0]) / np.sqrt(3.0))
left = walk.tracks["left_foot"]
turned = fes.recording(turn.apply(left.acc_mps2), turn.apply(left.gyr_radps), left.rate_hz, "left_foot")
found = fes.calibrate(turned)
print("up before", np.round(calibration.calibrations["left_foot"].up, 3))
print("up turned", np.round(found.calibrations["left_foot"].up, 3))

# %%
expected = turn.apply(calibration.calibrations["left_foot"].up)
error_deg = np.degrees(np.arccos(np.clip(expected @ np.array(found.calibrations["left_foot"].up), -1.0, 1.0)))
print(f"{error_deg:.2f}° from where the turn puts it")
assert error_deg < 1.0

# %%
before = own.strides["stride_length_m"][own.strides["valid"] & (own.strides["foot"] == "left_foot")]
after_turn = fes.analyse(turned).strides
after = after_turn["stride_length_m"][after_turn["valid"]]
print(f"stride length {before.mean():.3f} m before, {after.mean():.3f} m turned")
assert abs(before.mean() - after.mean()) < 0.01

# %% [markdown]
# What cannot be calibrated says why. A sensor that only stands still shows no direction of walking:

# %%
standing = fes.recording(left.acc_mps2[:200], left.gyr_radps[:200], left.rate_hz, "left_foot")
try:
    fes.calibrate(standing)
except ValueError as error:
    print(error)
else:
    raise AssertionError("a calibration from standing still")
