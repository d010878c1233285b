"""What a live session's log begins with: all that its replay needs beside the events."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from fes import __version__
from fes.config import Session
from fes.controller import CURRENT_STEP_MA
from fes.driving import Calibration
from fes.replay import LOG_FORMAT

LIVE = "live"


def live_header(
    session: Session,
    calibrations: Mapping[str, Calibration],
    stim_session_id: int,
    created: str,
    t_ns: int,
    current_step_ma: float = CURRENT_STEP_MA,
) -> dict[str, Any]:
    """All that a replay of the log needs beside the events; ``t_ns`` is the monotonic clock at ``created``."""
    return {
        "format": LOG_FORMAT,
        "fes_version": __version__,
        "kind": LIVE,
        "created": created,
        "created_t_ns": t_ns,
        "recording": {
            "name": session.name,
            "rates_hz": {device.sensor: device.rate_hz for device in session.sensors},
            "belt_speed_mps": session.treadmill.belt_speed_mps if session.treadmill else None,
        },
        "session": session.model_dump(mode="json"),
        "calibration": {sensor: calibration.to_dict() for sensor, calibration in calibrations.items()},
        "stim_session_id": stim_session_id,
        "current_step_ma": current_step_ma,
        "heard": True,  # what a serial stimulator answered is in the log as it came, so that its bytes can be repeated
    }
