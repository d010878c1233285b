"""Settings: one TOML file per session, validated before anything is opened."""

from fes.config.base import PHASE_ORDER, ConfigError, Foot, Phase, Positive, Settings, explain, read_toml
from fes.config.channel import Band, Bounds, Channel, ChannelLimits, Stimulation, Tuning
from fes.config.session import (
    STEEPEST_PERCENT,
    WIRELESS,
    Bus,
    Exercise,
    FootGeometry,
    Ground,
    ImuDevice,
    Session,
    StimulatorDevice,
    Switch,
    load_exercise,
    load_session,
    refuse_blind_targets,
    validate_session,
)

__all__ = [
    "PHASE_ORDER", "STEEPEST_PERCENT", "WIRELESS", "Band", "Bounds", "Bus", "Channel", "ChannelLimits", "ConfigError",
    "Exercise", "Foot", "FootGeometry", "Ground", "ImuDevice", "Phase", "Positive", "Session", "Settings",
    "Stimulation", "StimulatorDevice", "Switch", "Tuning", "explain", "load_exercise", "load_session", "read_toml",
    "refuse_blind_targets", "validate_session",
]  # fmt: skip
