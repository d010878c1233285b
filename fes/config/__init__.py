"""Settings: one TOML file per session, validated before anything is opened."""

from fes.config.base import PHASE_ORDER, ConfigError, Foot, NotNegative, Phase, Positive, SensorName, Settings
from fes.config.channel import Channel, ChannelLimits, Stimulation
from fes.config.devices import Bus, FootSwitch, ImuDevice, StimulatorDevice
from fes.config.session import FootGeometry, Phases, Session, Treadmill, load_session, validate_session

__all__ = [
    "PHASE_ORDER",
    "Bus",
    "Channel",
    "ChannelLimits",
    "ConfigError",
    "Foot",
    "FootGeometry",
    "FootSwitch",
    "ImuDevice",
    "NotNegative",
    "Phase",
    "Phases",
    "Positive",
    "SensorName",
    "Session",
    "Settings",
    "Stimulation",
    "StimulatorDevice",
    "Treadmill",
    "load_session",
    "validate_session",
]
