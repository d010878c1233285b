"""The one way to make a session's gate, live and in replay."""

from __future__ import annotations

from collections.abc import Mapping

from fes.config import Session
from fes.gate.gate import SafetyGate
from fes.gate.line import RISE_STEP_MA
from fes.signals import Vector3


def gate_of(
    session: Session,
    up: Mapping[str, Vector3],
    driven_by: Mapping[str, str] | None = None,
    current_step_ma: float = RISE_STEP_MA,
) -> SafetyGate:
    """The gate with all that the session and the calibrations say.

    Args:
        session: its channels, its sensors and how old data may be.
        up: by sensor, its upward direction at calibration.
        driven_by: for a foot whose phases another sensor tells, that sensor.
        current_step_ma: the stimulator's.
    """
    return SafetyGate(
        session.channels,
        max_data_age_ms=session.stimulation.max_data_age_ms,
        validity_ms=session.stimulation.validity_ms,
        devices=session.sensors,
        up=up,
        driven_by=driven_by,
        current_step_ma=current_step_ma,
    )
