"""Who walks in a campaign: a simulated patient who stands, walks a few strides, stands again, for ever."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from fes.calibrations import calibrate_drivers, save
from fes.patient.sensor import ImuModel
from fes.patient.session import Placement, new_session
from fes.patient.trials import HEALTHY
from fes.recording import Recording, write_recording

FOOT: Final = "right_foot"
RATE_HZ: Final = 100.0
STAND_BEFORE_S: Final = 1.0  # and the steps of the other foot: with the stand after it longer than a burst may last
STAND_AFTER_S: Final = 1.2
STANDS_S: Final = 2.0  # the foot is at rest for so long at the recording's beginning, and a little longer
STRIDES: Final = 3
SPEED_MPS: Final = 1.1
CALIBRATION_STRIDES: Final = 12
_SEED: Final = 11
_PLACEMENT: Final = Placement((0.070, -0.005, 0.068), (3.0, 21.0, -4.0))


def walker(folder: Path) -> tuple[Path, Path]:
    """Write the recording that the simulated sensor plays round and round, and its calibration; both paths."""
    recording, calibration = folder / "walker.parquet", folder / "walker.calibration.json"
    write_recording(_walk(STAND_BEFORE_S, STRIDES, STAND_AFTER_S), recording, overwrite=True)
    save(calibrate_drivers(_walk(4.0, CALIBRATION_STRIDES, 2.0)), calibration)
    return recording, calibration


def _walk(before_s: float, strides: int, after_s: float) -> Recording:
    session = new_session("walker", _SEED, {FOOT: _PLACEMENT})
    session.stand(before_s)
    session.walk({FOOT: HEALTHY}, strides, SPEED_MPS, ramp_s=0.8, early=False)
    session.stand(after_s)
    return session.recording(RATE_HZ, ImuModel(), "simulated")
