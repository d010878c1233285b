"""The sidecar: ``walk.toml`` beside ``walk.csv`` says which columns are which sensor's, in which units."""

from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, Field, ValidationError, model_validator

from fes.config import Foot, FootGeometry, Ground, Positive, Settings, explain, read_toml
from fes.recording.csv_layout import Dialect
from fes.recording.tracks import RecordingError
from fes.recording.units import SAMPLES, AccUnit, GyrUnit, TimeUnit, acc_factor, gyr_factor, time_factor_ns
from fes.signals import G_MPS2

Sensor = Literal["left_foot", "right_foot", "left_shank", "right_shank", "foot_a", "foot_b"]
WrapsAt = Annotated[int, Field(ge=2, le=2**62)]
Axis = Literal["+x", "-x", "+y", "-y", "+z", "-z"]


def _three_names(names: tuple[str, ...]) -> tuple[str, ...]:
    if len(names) != 3:
        raise ValueError(f"names {len(names)} columns, must name three: x, y, z")
    return names


_SHARED = ("acc_unit", "gyr_unit", "rate_hz", "time_column", "time_unit", "time_wraps_at")  # at the top, for all
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
    time_wraps_at: WrapsAt | None = None
    arrival_column: str | None = None
    acc_range_mps2: Positive | None = None
    acc_range_g: Positive | None = None
    gyr_range_radps: Positive | None = None
    gyr_range_dps: Positive | None = None
    mounting: Mounting | None = None
    file: str | None = None  # of its own, beside the recording's
    acc_file: str | None = None  # where the two triads are files of their own: in the folder or zip, or beside
    gyr_file: str | None = None
    gyr_time_column: str | None = None  # where it is called otherwise than the accelerometer's
    gravity_file: str | None = None  # whose columns of the same names are added to acc
    acc_sign: Literal[1, -1] = 1  # -1: at rest the axis that points up reads -1 g

    @model_validator(mode="after")
    def _given_once(self) -> Self:
        for key in ("file", "acc_file", "gyr_file", "gravity_file"):
            name = getattr(self, key)
            if name is not None and (name in ("", ".", "..") or set(name) & set("/\\:")):
                raise ValueError(
                    f"{key} = {name!r} must be the name alone of a file beside the sidecar, or in the folder or zip"
                )
        if (self.acc_file or self.gravity_file or self.gyr_time_column) and not self.gyr_file:
            raise ValueError("gyr_file is missing: the file that holds the gyroscope")
        for names in (self.acc, self.gyr) if self.gyr_file else ((*self.acc, *self.gyr),):
            twice = sorted({name for name in names if names.count(name) > 1})
            if twice:
                raise ValueError(f"column {twice[0]!r} is named twice; acc and gyr are six different columns")
        for one, other in (("acc_range_mps2", "acc_range_g"), ("gyr_range_radps", "gyr_range_dps")):
            if getattr(self, one) and getattr(self, other):
                raise ValueError(f"{one} and {other} are both given; keep one")
        return self

    @property
    def unit_ns(self) -> float:
        """Nanoseconds per unit of its times."""
        return time_factor_ns(self.time_unit or "s", self.rate_hz)

    @property
    def factors(self) -> tuple[float, float]:
        """(m/s² per accelerometer unit, with its sign, rad/s per gyroscope unit)."""
        return self.acc_sign * acc_factor(self.acc_unit or "m/s^2"), gyr_factor(self.gyr_unit or "rad/s")

    @property
    def acc_range(self) -> float | None:
        """Full scale in m/s², None if unknown."""
        return self.acc_range_g * G_MPS2 if self.acc_range_g else self.acc_range_mps2

    @property
    def gyr_range(self) -> float | None:
        """Full scale in rad/s, None if unknown."""
        return self.gyr_range_dps * gyr_factor("deg/s") if self.gyr_range_dps else self.gyr_range_radps


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
    time_wraps_at: WrapsAt | None = None  # a counter that begins anew at 0 after one less than this
    delimiter: Literal[",", ";", "\t", "|"] = ","
    decimal: Literal[".", ","] = "."
    encoding: str = "utf-8"
    skip_lines: int = Field(default=0, ge=0, le=10_000)
    header_lines: int = Field(default=1, ge=1, le=5)
    skip_lines_after_header: int = Field(default=0, ge=0, le=10_000)
    sensors: dict[Sensor, SensorColumns]
    geometry: dict[Foot, FootGeometry] = Field(default_factory=dict)
    ground: Ground = Ground()
    can: CanLog | None = None
    extra: dict[str, Any] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _every_sensor_is_complete(self) -> Self:
        if not self.sensors:
            raise ValueError("names no sensor; give at least one table such as [sensors.left_foot]")
        if self.delimiter == self.decimal:
            raise ValueError('delimiter and decimal are both ","; one of them must be another')
        owner: dict[tuple[str | None, ...], str] = {}
        for sensor, columns in self.sensors.items():
            acc = [(columns.file, columns.acc_file, name) for name in columns.acc]
            for place in (*acc, *((columns.file, columns.gyr_file, name) for name in columns.gyr)):
                if place in owner:
                    raise ValueError(f"column {place[-1]!r} is given to {owner[place]} and to {sensor}")
                owner[place] = sensor
            columns = self.columns_of(sensor)
            if columns.gyr_file and not columns.time_column:
                raise ValueError(f"{sensor} is of two files, which only times bring together: say time_column = …")
            for key, allowed in (("acc_unit", '"m/s^2" or "g"'), ("gyr_unit", '"rad/s" or "deg/s"')):
                if getattr(columns, key) is None:
                    raise ValueError(f"{key} is missing for {sensor}; say {key} = {allowed} at the top")
            if self.can is None and not columns.time_column and not columns.rate_hz:
                remedy = "say time_column = … or rate_hz = … at the top"
                raise ValueError(f"{sensor} has neither a time column nor a rate; {remedy}")
            if columns.time_column and columns.time_unit == SAMPLES and not columns.rate_hz:
                raise ValueError(f'{sensor}: time_unit = "samples" needs rate_hz: how many come in a second')
        return self

    @property
    def dialect(self) -> Dialect:
        """How the text of its CSV files is laid out."""
        return Dialect(**{field.name: getattr(self, field.name) for field in fields(Dialect)})

    def columns_of(self, sensor: Sensor) -> SensorColumns:
        """A sensor's columns, with what holds for all sensors where it does not say it itself."""
        columns = self.sensors[sensor]
        return columns.model_copy(update={key: getattr(self, key) for key in _SHARED if getattr(columns, key) is None})


def reword_sidecar_fault(fault: Mapping[str, Any], location: tuple[int | str, ...]) -> str:
    """What is allowed at a location of a sidecar, where there are better words than the usual ones; else ""."""
    if location[:1] == ("sensors",) and len(location) == 2 and fault["type"] == "literal_error":
        return (
            "which sensor is it? Write one of 'left_foot', 'right_foot', 'left_shank', 'right_shank' instead "
            "(or foot_a and foot_b for two feet of which nobody knows the side)"
        )
    if fault.get("input") == "?":
        return f"is not answered yet. {fault['msg']}"
    if location[-1:] == ("rate_hz",) and fault.get("input") == 0:
        return "must be greater than 0: how many samples a second was the sensor set to?"
    return 'must be a list of three column names, x, y, z: ["…", "…", "…"]' if fault["type"] == "tuple_type" else ""


def load_sidecar(path: Path) -> Sidecar:
    """Read and validate a sidecar that exists.

    Raises:
        RecordingError: not readable, not TOML, or settings that are not allowed; every fault is listed with file,
            line, key, value and what would be right.
    """
    if path.exists() and not path.is_file():  # a pipe would be waited for, without end
        raise RecordingError(f"{path}: is no file")
    data, text = read_toml(path, "sidecar", RecordingError)
    try:
        return Sidecar.model_validate(data)
    except ValidationError as error:
        raise RecordingError(explain(error, path, text, Sidecar, reword_sidecar_fault)) from None
