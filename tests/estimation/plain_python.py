"""Print the phase changes and strides of the first seconds of a bundled trial, calibrated on it, as JSON.

Once in one block and once live.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from fes.calibration.recording import calibrate_track
from fes.config import load_session
from fes.estimation.sensor_choice import tracker_of
from fes.recording import read_recording
from fes.signals import StrideResult

SECONDS = 16.0
FOLDER = Path(__file__).resolve().parents[2] / "sim_inputs"
COLUMNS = (
    "number", "t_start_ns", "t_end_ns", "stride_length_m", "speed_mps", "clearance_m", "turn_rad", "height_gained_m",
)  # fmt: skip


def main() -> None:
    track = read_recording(FOLDER / "both_feet_100hz.parquet").tracks["right_foot"]
    calibration = calibrate_track(track)
    n = int(np.searchsorted(track.t_sensor_ns, track.t_sensor_ns[0] + int(1e9 * SECONDS)))
    samples = track.t_sensor_ns[:n], track.acc_mps2[:n], track.gyr_radps[:n]
    block, live = (tracker_of(load_session(FOLDER / "session.toml"), calibration) for _ in range(2))
    outcomes = block.advance(*samples)
    for sample in zip(*(column.tolist() for column in samples), strict=True):
        outcomes += live.step(*sample)
    strides = [[getattr(each, name) for name in COLUMNS] for each in outcomes if isinstance(each, StrideResult)]
    changes = [
        [each.t_ns, each.transition, each.source, each.destination]
        for each in outcomes
        if not isinstance(each, StrideResult)
    ]
    print(json.dumps([changes, strides]))


if __name__ == "__main__":
    main()
