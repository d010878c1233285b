"""The sidecar: ``walk.toml`` beside ``walk.csv`` says which columns are which sensor's, in which units.

What is wrong with a sidecar, in lines of ``file:line: key = value: what is allowed``.
"""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal, Self, get_args

from pydantic import AfterValidator, BaseModel, Field, ValidationError, model_validator

from fes.config import Foot, FootGeometry, Positive, Settings
from fes.recording.tracks import RecordingError
from fes.recording.units import AccUnit, GyrUnit, TimeUnit, acc_factor, gyr_factor
from fes.signals import G_MPS2

_HEADER = re.compile(r"\s*\[([^\[\]]+)\]")
_KEY = re.compile(r"\s*([\w.\"'-]+)\s*=")


def explain_sidecar(error: ValidationError, model: type[BaseModel], path: Path, text: str) -> str:
    """Return one line per fault; ``model`` is what the text should have been and gives the names allowed."""
    lines_of = _lines_of(text)
    explained = []
    for fault in error.errors(include_url=False):
        place = tuple(str(part) for part in fault["loc"] if part != "[key]")
        message = fault["msg"].removeprefix("Value error, ")
        if fault["type"] == "missing":
            message = "is required and missing"
        elif place[:1] == ("sensors",) and len(place) == 2 and fault["type"] == "literal_error":
            message = (
                "which sensor is it? Write one of 'left_foot', 'right_foot', 'left_shank', 'right_shank' instead "
                "(or foot_a and foot_b for two feet of which nobody knows the side)"
            )
        elif place[-1:] == ("rate_hz",) and fault.get("input") == 0:
            message = "must be greater than 0: how many samples a second was the sensor set to?"
        elif fault["type"] == "tuple_type":
            message = 'must be a list of three column names, x, y, z: ["…", "…", "…"]'
        elif fault["type"] == "extra_forbidden":
            message = f"is not a setting; allowed are {', '.join(_names_in(model, place[:-1]))}"
        value = fault.get("input")
        shown = f" = {value!r:.80}" if isinstance(value, (str, int, float, list)) and place[-1:] != (value,) else ""
        line = next((lines_of[place[:size]] for size in range(len(place), 0, -1) if place[:size] in lines_of), 0)
        explained.append(f"{path}{f':{line}' if line else ''}: {'.'.join(place) or 'sidecar'}{shown}: {message}")
    return "\n".join(dict.fromkeys(explained))


def _names_in(model: Any, place: tuple[str, ...]) -> list[str]:
    """The settings of the table at a place: follow the models' fields, through mappings and options."""
    if isinstance(model, type) and issubclass(model, BaseModel):
        if not place:
            return list(model.model_fields)
        field = model.model_fields.get(place[0])
        return _names_in(field.annotation, place[1:]) if field else []
    inner = [part for part in get_args(model) if isinstance(part, type) and issubclass(part, BaseModel)]
    is_mapping = getattr(model, "__origin__", None) is dict
    return _names_in(inner[0], place[1:] if is_mapping else place) if inner else []


def _lines_of(text: str) -> dict[tuple[str, ...], int]:
    """Line number of every table header and of every key that begins a line, by its path."""
    lines_of: dict[tuple[str, ...], int] = {}
    table: tuple[str, ...] = ()
    for number, line in enumerate(text.split("\n"), start=1):
        if header := _HEADER.match(line):
            table = _parts(header[1])
            lines_of.setdefault(table, number)
        elif key := _KEY.match(line):
            lines_of.setdefault(table + _parts(key[1]), number)
    return lines_of


def _parts(dotted: str) -> tuple[str, ...]:
    return tuple(part.strip().strip("\"'") for part in dotted.split("."))


Sensor = Literal["left_foot", "right_foot", "left_shank", "right_shank", "foot_a", "foot_b"]
Axis = Literal["+x", "-x", "+y", "-y", "+z", "-z"]


def _three_names(names: tuple[str, ...]) -> tuple[str, ...]:
    if len(names) != 3:
        raise ValueError(f"names {len(names)} columns, must name three: x, y, z")
    return names


Columns = Annotated[tuple[str, ...], Field(strict=False), AfterValidator(_three_names)]  # TOML has no tuples


class Mounting(Settings):
    """How a sensor sits, as far as known: where, and which of its axes points forward and up with the foot flat."""

    place: str = ""
    forward: Axis | None = None
    up: Axis | None = None

    @model_validator(mode="after")
    def _axes_differ(self) -> Self:
        if self.forward and self.up and self.forward[1] == self.up[1]:
            raise ValueError(f"forward = {self.forward!r} and up = {self.up!r} lie along the same axis")
        return self


class SensorColumns(Settings):
    """One sensor's columns; what is not given here is taken from the top of the sidecar."""

    acc: Columns
    gyr: Columns
    acc_unit: AccUnit | None = None
    gyr_unit: GyrUnit | None = None
    rate_hz: Positive | None = None
    time_column: str | None = None
    time_unit: TimeUnit | None = None
    arrival_column: str | None = None
    acc_range_mps2: Positive | None = None
    acc_range_g: Positive | None = None
    gyr_range_radps: Positive | None = None
    gyr_range_degps: Positive | None = None
    mounting: Mounting | None = None
    file: str | None = None  # of its own, beside the recording's

    @model_validator(mode="after")
    def _given_once(self) -> Self:
        if self.file is not None and (not self.file or Path(self.file).name != self.file):
            raise ValueError(f"file = {self.file!r} must be the name of a file that lies beside the sidecar")
        names = (*self.acc, *self.gyr)
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise ValueError(f"column {twice[0]!r} is named twice; acc and gyr are six different columns")
        if self.acc_range_mps2 and self.acc_range_g:
            raise ValueError("acc_range_mps2 and acc_range_g are both given; keep one")
        if self.gyr_range_radps and self.gyr_range_degps:
            raise ValueError("gyr_range_radps and gyr_range_degps are both given; keep one")
        return self

    @property
    def acc_range(self) -> float | None:
        """Full scale in m/s², None if unknown."""
        return self.acc_range_g * G_MPS2 if self.acc_range_g else self.acc_range_mps2

    @property
    def gyr_range(self) -> float | None:
        """Full scale in rad/s, None if unknown."""
        return self.gyr_range_degps * gyr_factor("deg/s") if self.gyr_range_degps else self.gyr_range_radps


class CanLog(Settings):
    """For CAN logs: the DBC, relative to the sidecar; columns are then named ``Message.Signal``."""

    dbc: str = Field(min_length=1)


class Sidecar(Settings):
    """A whole sidecar."""

    name: str = ""
    subject: str = ""
    description: str = ""
    belt_speed_mps: Annotated[float, Field(gt=0, le=5)] | None = None
    acc_unit: AccUnit | None = None
    gyr_unit: GyrUnit | None = None
    rate_hz: Positive | None = None
    time_column: str | None = None
    time_unit: TimeUnit = "s"
    delimiter: Literal[",", ";", "\t", "|"] = ","
    decimal: Literal[".", ","] = "."
    encoding: str = "utf-8"
    skip_lines: int = Field(default=0, ge=0, le=10_000)
    header_lines: int = Field(default=1, ge=1, le=5)
    skip_lines_after_header: int = Field(default=0, ge=0, le=10_000)
    sensors: dict[Sensor, SensorColumns]
    geometry: dict[Foot, FootGeometry] = Field(default_factory=dict)
    can: CanLog | None = None
    extra: dict[str, Any] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _every_sensor_is_complete(self) -> Self:
        if not self.sensors:
            raise ValueError("names no sensor; give at least one table such as [sensors.left_foot]")
        if self.delimiter == self.decimal:
            raise ValueError('delimiter and decimal are both ","; one of them must be another')
        owner: dict[tuple[str | None, str], str] = {}
        for sensor, columns in self.sensors.items():
            for name in (*columns.acc, *columns.gyr):
                if (columns.file, name) in owner:
                    raise ValueError(f"column {name!r} is given to {owner[columns.file, name]} and to {sensor}")
                owner[columns.file, name] = sensor
            for key, allowed in (("acc_unit", '"m/s^2" or "g"'), ("gyr_unit", '"rad/s" or "deg/s"')):
                if getattr(columns, key) is None and getattr(self, key) is None:
                    raise ValueError(f"{key} is missing for {sensor}; say {key} = {allowed} at the top")
            if self.can is None and not self.time_of(sensor) and not self.rate_of(sensor):
                raise ValueError(
                    f"{sensor} has neither a time column nor a rate; say time_column = … or rate_hz = … at the top"
                )
        return self

    def time_of(self, sensor: Sensor) -> str | None:
        """The sensor's time column."""
        return self.sensors[sensor].time_column or self.time_column

    def time_unit_of(self, sensor: Sensor) -> str:
        """The unit of the sensor's time column."""
        return self.sensors[sensor].time_unit or self.time_unit

    def rate_of(self, sensor: Sensor) -> float | None:
        """The sensor's stated rate."""
        return self.sensors[sensor].rate_hz or self.rate_hz

    def acc_unit_of(self, sensor: Sensor) -> str | float:
        """The accelerometer's unit: a name, or m/s² per count."""
        unit = self.sensors[sensor].acc_unit
        return (unit if unit is not None else self.acc_unit) or "m/s^2"

    def gyr_unit_of(self, sensor: Sensor) -> str | float:
        """The gyroscope's unit: a name, or rad/s per count."""
        unit = self.sensors[sensor].gyr_unit
        return (unit if unit is not None else self.gyr_unit) or "rad/s"

    def factors_of(self, sensor: Sensor) -> tuple[float, float]:
        """(m/s² per accelerometer unit, rad/s per gyroscope unit)."""
        return acc_factor(self.acc_unit_of(sensor)), gyr_factor(self.gyr_unit_of(sensor))


def load_sidecar(path: Path) -> Sidecar:
    """Read and validate a sidecar that exists.

    Raises:
        RecordingError: not readable, not TOML, or settings that are not allowed; every fault is listed with file,
            line, key, value and what would be right.
    """
    if path.exists() and not path.is_file():  # a pipe would be waited for, without end
        raise RecordingError(f"{path}: is no file")
    try:
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise RecordingError(f"{path}: is not text (byte {error.start}). A sidecar is a TOML file in UTF-8.") from error
    try:
        data = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise RecordingError(f"{path}: is not valid TOML: {error}") from error
    try:
        return Sidecar.model_validate(data)
    except ValidationError as error:
        raise RecordingError(explain_sidecar(error, Sidecar, path, text)) from error
