"""``session.toml`` → validated settings; an error names file, line, key, value and what is allowed."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from fes import limits

Phase = Literal["stance", "pre_swing", "swing", "loading_response"]
PHASE_ORDER: tuple[Phase, ...] = ("stance", "pre_swing", "swing", "loading_response")
Foot = Literal["left_foot", "right_foot"]

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]


class ConfigError(ValueError):
    """The session file cannot be used; the message says where and what would be right."""


class Settings(BaseModel):
    """Base of all settings: frozen, and an unknown key is an error, not a silent typo."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class ChannelLimits(Settings):
    """What one channel may never exceed. Every entry is required: a missing limit means no stimulation."""

    max_current_ma: float = Field(gt=0, le=limits.MAX_CURRENT_MA)
    max_pulse_width_us: float = Field(gt=0, le=limits.MAX_PULSE_WIDTH_US)
    max_frequency_hz: float = Field(gt=0, le=limits.MAX_FREQUENCY_HZ)
    max_charge_per_phase_uc: float = Field(gt=0, le=limits.MAX_CHARGE_PER_PHASE_UC)
    max_current_density_ma_per_cm2: float = Field(gt=0, le=limits.MAX_CURRENT_DENSITY_MA_PER_CM2)
    max_rise_ma_per_s: float = Field(gt=0, le=limits.MAX_RISE_MA_PER_S)
    max_on_s: float = Field(gt=0, le=limits.MAX_ON_S)
    min_off_s: float = Field(ge=limits.MIN_OFF_S, le=10.0)


class Channel(Settings):
    """One pair of electrodes: which muscle, with what, in which part of the stride.

    The envelope rises over ``rise_s`` when the foot enters ``start_phase`` (plus ``start_delay_s``), holds,
    goes on ``extension_s`` past the entry into ``stop_phase``, and falls over ``fall_s``. It is off at once in
    any phase outside start … stop.
    """

    name: str = Field(min_length=1, max_length=60)
    number: int = Field(ge=0, le=7)
    foot: Foot
    muscle: str = "tibialis anterior"
    electrode_area_cm2: float = Field(gt=0, le=400)
    current_ma: float = Field(gt=0, le=limits.MAX_CURRENT_MA)
    pulse_width_us: float = Field(gt=0, le=limits.MAX_PULSE_WIDTH_US)
    frequency_hz: float = Field(gt=0, le=limits.MAX_FREQUENCY_HZ)
    start_phase: Phase = "pre_swing"
    start_delay_s: float = Field(default=0.0, ge=0, le=1.0)
    stop_phase: Phase = "loading_response"
    rise_s: float = Field(default=0.15, gt=0, le=1.0)
    extension_s: float = Field(default=0.06, ge=0, le=0.5)
    fall_s: float = Field(default=0.10, ge=0, le=1.0)
    never_with: tuple[int, ...] = ()
    limits: ChannelLimits

    @model_validator(mode="after")
    def _plan_fits_its_limits(self) -> Self:
        cap = self.limits
        charge = limits.charge_per_phase_uc(self.current_ma, self.pulse_width_us)
        density = limits.current_density_ma_per_cm2(
            self.current_ma, self.pulse_width_us, self.frequency_hz, self.electrode_area_cm2
        )
        checks = (
            (self.current_ma, cap.max_current_ma, "current_ma", "mA"),
            (self.pulse_width_us, cap.max_pulse_width_us, "pulse_width_us", "µs"),
            (self.frequency_hz, cap.max_frequency_hz, "frequency_hz", "Hz"),
            (charge, cap.max_charge_per_phase_uc, "current_ma · pulse_width_us", "µC per phase"),
            (density, cap.max_current_density_ma_per_cm2, "current density", "mA/cm² r.m.s."),
            (self.current_ma / self.rise_s, cap.max_rise_ma_per_s, "current_ma / rise_s", "mA/s"),
        )
        for value, most, what, unit in checks:
            if value > most:
                raise ValueError(f"{what} is {value:.4g} {unit}, over this channel's limit of {most:.4g} {unit}")
        if self.number in self.never_with:
            raise ValueError(f"never_with names the channel itself ({self.number})")
        if self.start_phase == self.stop_phase:
            raise ValueError(f"start_phase and stop_phase are both {self.start_phase!r}")
        return self


class Stimulation(Settings):
    """How often commands go out, for how long they hold, and when walking counts as walking."""

    command_rate_hz: float = Field(default=50.0, ge=20, le=100)
    validity_ms: int = Field(default=limits.MAX_VALIDITY_MS, ge=20, le=limits.MAX_VALIDITY_MS)
    max_data_age_ms: int = Field(default=limits.MAX_DATA_AGE_MS, ge=10, le=limits.MAX_DATA_AGE_MS)
    intensity: float = Field(default=1.0, ge=0, le=1)
    strides_before_start: int = Field(default=2, ge=0, le=20)
    min_stride_length_m: float = Field(default=0.15, ge=0, le=1.0)
    max_turn_deg: float = Field(default=35.0, gt=0, le=180)

    @model_validator(mode="after")
    def _validity_outlasts_the_period(self) -> Self:
        if self.validity_ms < 2.0 * 1000.0 / self.command_rate_hz:
            raise ValueError(
                f"validity_ms = {self.validity_ms} must be at least two command periods "
                f"({2000.0 / self.command_rate_hz:.0f} ms at command_rate_hz = {self.command_rate_hz:g})"
            )
        return self


class Bus(Settings):
    """Any bus that python-can knows; the defaults are virtual CAN over loopback multicast."""

    interface: str = "udp_multicast"
    channel: str = "239.74.163.2"
    options: dict[str, str | int | float | bool] = Field(default_factory=dict)


class FootGeometry(Settings):
    """Where toe and heel are, seen from the sensor with the foot flat: metres forward and up (down negative)."""

    toe_forward_m: float = Field(ge=-0.1, le=0.4)
    toe_up_m: float = Field(ge=-0.3, le=0.1)
    heel_forward_m: float = Field(ge=-0.4, le=0.1)
    heel_up_m: float = Field(ge=-0.3, le=0.1)


class Treadmill(Settings):
    """The belt, when there is one."""

    belt_speed_mps: float = Field(gt=0, le=5)


class Session(Settings):
    """All of one session's settings."""

    name: str = Field(min_length=1, max_length=120)
    subject: str = ""
    stimulation: Stimulation = Stimulation()
    channels: tuple[Channel, ...] = ()
    bus: Bus = Bus()
    treadmill: Treadmill | None = None
    geometry: dict[Foot, FootGeometry] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _channels_are_distinct(self) -> Self:
        numbers = [channel.number for channel in self.channels]
        if len(set(numbers)) != len(numbers):
            raise ValueError(f"channels must have different numbers, got {numbers}")
        for channel in self.channels:
            unknown = set(channel.never_with) - set(numbers)
            if unknown:
                raise ValueError(f"channel {channel.name!r}: never_with names no channel: {sorted(unknown)}")
        return self


def load_session(path: Path) -> Session:
    """Read and validate a session file.

    Raises:
        ConfigError: the file is missing, is not TOML, or holds a setting that is not allowed; every fault is
            listed with its line, key, value and what would be right.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}. Name an existing session file.") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: is not text (byte {error.start}). A session is a TOML file in UTF-8.") from error
    try:
        data = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{path}: is not valid TOML: {error}") from error
    return validate_session(data, path, text)


def validate_session(data: dict[str, Any], path: Path, text: str = "") -> Session:
    """Validate settings already parsed; ``path`` and ``text`` are for the messages.

    Raises:
        ConfigError: as for :func:`load_session`.
    """
    try:
        return Session.model_validate(data)
    except ValidationError as error:
        raise ConfigError(explain(error, path, text)) from error


def explain(error: ValidationError, path: Path, text: str) -> str:
    """Put a pydantic error into lines of ``file:line: key = value: what is allowed``."""
    lines = []
    for fault in error.errors(include_url=False):
        location = fault["loc"]
        key = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in location).lstrip(".")
        line = _line_of(text, location)
        message = fault["msg"].removeprefix("Value error, ")
        if fault["type"] == "missing":
            message = "is required and missing"
        elif fault["type"] == "extra_forbidden":
            message = "is not a setting; check the spelling"
        value = fault.get("input")
        shown = f" = {value!r}" if isinstance(value, (str, int, float, bool)) else ""
        place = f"{path}:{line}" if line else f"{path}"
        lines.append(f"{place}: {key or 'session'}{shown}: {message}")
    return "\n".join(lines)


def _line_of(text: str, location: tuple[int | str, ...]) -> int:
    """Best guess at the 1-based line of a key: the nth table header of its path, then the key below it."""
    lines = text.splitlines()
    at = 0
    found = 0
    for position, part in enumerate(location):
        if isinstance(part, int):
            continue
        index = location[position + 1] if position + 1 < len(location) else 0
        nth = index if isinstance(index, int) else 0
        pattern = re.compile(rf"^\s*(\[+[\w.\"]*\b{re.escape(part)}\]+|{re.escape(part)}\s*=)")
        for number in range(at, len(lines)):
            if pattern.match(lines[number]):
                if nth == 0:
                    found, at = number + 1, number + 1
                    break
                nth -= 1
    return found
