"""Settings: one TOML file per session, validated before anything is opened."""

from fes.config.base import (
    PHASE_ORDER,
    ConfigError,
    Foot,
    NotNegative,
    Phase,
    Positive,
    SensorName,
    Settings,
    explain,
    read_toml,
)
from fes.config.channel import Channel, ChannelLimits, Stimulation
from fes.config.devices import Bus, FootSwitch, ImuDevice, Live, StimulatorDevice, Switch
from fes.config.session import FootGeometry, Phases, Session, Treadmill, load_session, validate_session
from fes.config.tuning import Band, Bounds, Tuning, TuningBounds

__all__ = [
    "PHASE_ORDER",
    "Band",
    "Bounds",
    "Bus",
    "Channel",
    "ChannelLimits",
    "ConfigError",
    "Foot",
    "FootGeometry",
    "FootSwitch",
    "ImuDevice",
    "Live",
    "NotNegative",
    "Phase",
    "Phases",
    "Positive",
    "SensorName",
    "Session",
    "Settings",
    "Stimulation",
    "StimulatorDevice",
    "Switch",
    "Treadmill",
    "Tuning",
    "TuningBounds",
    "explain",
    "load_session",
    "read_toml",
    "validate_session",
]
