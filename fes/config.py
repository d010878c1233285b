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
    """Base of all settings: frozen; an unknown key is an error, not a silent typo, and so is ``"3"`` for a number."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, strict=True)


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
    never_with: tuple[int, ...] = Field(default=(), strict=False)  # TOML has lists, no tuples
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


class Phases(Settings):
    """How phases are told: swing begins at the peak of the toe-down rate (foot off), or when it turns to toe-up."""

    swing_begins: Literal["peak", "reversal"] = "peak"


class Session(Settings):
    """All of one session's settings."""

    name: str = Field(min_length=1, max_length=120)
    subject: str = ""
    stimulation: Stimulation = Stimulation()
    channels: tuple[Channel, ...] = Field(default=(), strict=False)
    phases: Phases = Phases()
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
        text = path.read_text(encoding="utf-8-sig")  # some editors put a mark in front
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
    lines_of = _lines_of(text)
    said = []
    for fault in error.errors(include_url=False):
        location = tuple(part for part in fault["loc"] if part != "[key]")
        message = fault["msg"].removeprefix("Value error, ")
        if location[:2] == ("bus", "options"):  # one fault per type that it might have been
            location, message = location[:3], "Input should be text, a number, true or false"
        elif fault["type"] == "missing":
            message = "is required and missing"
        elif fault["type"] == "extra_forbidden":
            message = f"is not a setting; allowed are {', '.join(_settings_beside(location))}"
        key = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in location).lstrip(".")
        value = fault.get("input")
        shown = f" = {value!r:.80}" if isinstance(value, (str, int, float, list)) else ""
        line = next((lines_of[location[:n]] for n in range(len(location), 0, -1) if location[:n] in lines_of), 0)
        place = f"{path}:{line}" if line else f"{path}"
        said.append(f"{place}: {key or 'session'}{shown}: {message}")
    return "\n".join(dict.fromkeys(said))


_TABLES: dict[tuple[str, ...], type[Settings]] = {
    (): Session,
    ("stimulation",): Stimulation,
    ("channels",): Channel,
    ("channels", "limits"): ChannelLimits,
    ("phases",): Phases,
    ("bus",): Bus,
    ("treadmill",): Treadmill,
    ("geometry",): FootGeometry,
}


def _settings_beside(location: tuple[int | str, ...]) -> list[str]:
    """The names allowed in the table that this key was found in."""
    names = tuple(part for part in location[:-1] if isinstance(part, str))
    return list(_TABLES[names[:1] if names[:1] == ("geometry",) else names].model_fields)


_HEADER = re.compile(r"\s*(\[\[?)([^\[\]]+)\]")
_KEY = re.compile(r"\s*([\w.\"'-]+)\s*=")


def _lines_of(text: str) -> dict[tuple[int | str, ...], int]:
    """1-based line of every table header and of every key that begins a line, by its place in the parsed data."""
    lines_of: dict[tuple[int | str, ...], int] = {}
    entries: dict[tuple[int | str, ...], int] = {}  # so far, of each array of tables
    table: tuple[int | str, ...] = ()
    in_string = False
    for number, line in enumerate(text.split("\n"), start=1):
        inside, in_string = in_string, in_string ^ bool((line.count('"""') + line.count("'''")) % 2)
        if inside:
            continue
        if header := _HEADER.match(line):
            table = ()
            *parents, last = _parts(header[2])
            for name in parents:
                table += (name,)
                table += (entries[table] - 1,) if table in entries else ()
            table += (last,)
            if header[1] == "[[":
                entries[table] = entries.get(table, 0) + 1
                table += (entries[table] - 1,)
            lines_of.setdefault(table, number)
        elif key := _KEY.match(line):
            lines_of.setdefault(table + _parts(key[1]), number)
    return lines_of


def _parts(dotted: str) -> tuple[str, ...]:
    return tuple(part.strip().strip("\"'") for part in dotted.split("."))
