"""Which sensor tells a foot's phases: the sensor on the foot; where there is none, the one on that side's shank.

With both, the foot drives, and the shank is only recorded.
"""

from collections.abc import Iterable, Mapping
from typing import Any, TypeAlias

import numpy as np

from fes.config import FootGeometry, Ground, Session
from fes.config.thresholds import changed_thresholds
from fes.estimation.foot.calibration import FootCalibration
from fes.estimation.foot.tracker import FootTracker
from fes.estimation.shank.calibration import ShankCalibration
from fes.estimation.shank.tracker import ShankTracker
from fes.estimation.strides.results import SENSOR_HEIGHT_M, StrideMaker, StrideSettings
from fes.estimation.tracking.tracker import Tracker
from fes.signals import FOOT_SENSORS, SHANK_SENSORS

Calibration: TypeAlias = FootCalibration | ShankCalibration
SHANK_OF = dict(zip(FOOT_SENSORS, SHANK_SENSORS, strict=True))


def phase_sensors(sensors: Iterable[str]) -> dict[str, str]:
    """Of these sensors the one that drives each foot, by foot; a foot that none of them can drive is left out."""
    worn = set(sensors)
    found: dict[str, str] = {}
    for foot, shank in SHANK_OF.items():
        if foot in worn:
            found[foot] = foot
        elif shank in worn:
            found[foot] = shank
    return found


def shank_phase_sensors(calibrations: Mapping[str, Calibration]) -> dict[str, str]:
    """By foot, the shank sensor that drives it; feet with a sensor of their own are left out."""
    return {foot: sensor for foot, sensor in phase_sensors(calibrations).items() if sensor != foot}


def tracker_of(session: Session, calibration: Calibration) -> Tracker:
    """The tracker for a sensor, with this session's settings; its thresholds are for sensors on feet."""
    at_reversal = session.phases.swing_begins == "reversal"
    if isinstance(calibration, ShankCalibration):
        return ShankTracker(calibration, incline=shank_incline(session.ground), swing_at_reversal=at_reversal)
    geometry = next((own for foot, own in session.geometry.items() if foot == calibration.sensor), None)
    maker = StrideMaker(calibration.sensor, stride_settings(calibration, geometry, session.ground))
    tracker = FootTracker(calibration, maker, swing_at_reversal=at_reversal)
    tracker.set_thresholds(changed_thresholds(tracker.thresholds, session.thresholds))
    return tracker


def shank_incline(ground: Ground) -> float | None:
    """What overrules a shank's calibration, which knows itself whether it was made on level ground."""
    return None if ground.level else ground.incline


def stride_settings(
    calibration: FootCalibration, geometry: FootGeometry | None = None, ground: Ground | None = None
) -> StrideSettings:
    """How a foot's strides are integrated; ``geometry`` says where toe and heel are, if that is known."""
    height_m = SENSOR_HEIGHT_M
    if geometry is not None:
        height_m = max(-0.5 * (geometry.toe_up_m + geometry.heel_up_m), 0.0)
    return StrideSettings(
        forward=calibration.forward(), up=np.array(calibration.up), sensor_height_m=height_m, geometry=geometry,
        incline=0.0 if ground is None else ground.incline,
    )  # fmt: skip


def calibration_from_dict(data: dict[str, Any]) -> Calibration:
    """Back from a session log or a calibration file; what the core would choke on is refused here.

    Raises:
        KeyError, TypeError, ValueError: it is not what ``to_dict`` made.
    """
    sensor = data["sensor"]
    if sensor not in (*FOOT_SENSORS, *SHANK_SENSORS):
        raise ValueError(f"{sensor!r} is no sensor")
    calibration = (ShankCalibration if sensor in SHANK_SENSORS else FootCalibration).from_dict(data)
    if not 10.0 <= float(calibration.rate_hz) <= 10_000.0:
        raise ValueError(f"rate_hz of {sensor} is {calibration.rate_hz}")
    axis = calibration.left if isinstance(calibration, ShankCalibration) else calibration.toe_down
    for name, vector in (("up", calibration.up), ("mediolateral axis", axis)):
        if len(vector) != 3 or not abs(float(np.linalg.norm(vector)) - 1.0) < 1e-3:
            raise ValueError(f"{name} of {sensor} is no unit vector")
    if not np.isfinite(np.array((*calibration.acc_bias_mps2, *calibration.gyr_bias_radps), float)).all():
        raise ValueError(f"a bias of {sensor} is not finite")
    return calibration
