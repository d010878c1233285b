"""``session.toml`` → validated settings; an error names file, line, key, value and what is allowed.

What is connected: the bus, the sensors, the stimulator, a foot switch.
"""

import math
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Final, Literal, Self

from pydantic import (
    AfterValidator,
    Field,
    SerializerFunctionWrapHandler,
    ValidationError,
    model_serializer,
    model_validator,
)

from fes import limits
from fes.config.base import ConfigError, Foot, SensorName, Settings, explain, read_toml
from fes.config.channel import Channel, Stimulation
from fes.config.thresholds import Value, check_thresholds

STEEPEST_PERCENT: Final = 25.0  # steeper than any treadmill goes
Options = dict[str, str | int | float | bool]
WIRELESS: Final = ("capture2go_ble", "movella_dot")
IMUS: Final = ("xbus", "xsens_can", "dbc_can", "ximu3", "capture2go", "witmotion", "lsl", *WIRELESS)
STIMULATORS: Final = ("can", "p24_low_level", "p24_mid_level", "rehastim2", "canopen")


def _known(name: str, *, own: tuple[str, ...], kind: str) -> str:
    """The name of a device of this program, or of one that an installed package brings (docs/extensions.md)."""
    if name in own:
        return name
    from fes.extensions import extension_names  # which packages there are is only looked for where it matters

    if name in (others := extension_names(kind)):
        return name
    *most, last = (repr(each) for each in (*own, *others))
    raise ValueError(f"Input should be {', '.join(most)} or {last}")


class Bus(Settings):
    """Any bus that python-can knows; the defaults are virtual CAN over loopback multicast."""

    interface: str = "udp_multicast"
    channel: str = "239.74.163.2"
    options: Options = Field(default_factory=dict)


class ImuDevice(Settings):
    """One inertial sensor: where it is worn, what it is, how it is reached, what it can measure.

    ``port``: a serial device, a python-serial URL (``socket://host:port``), an LSL stream's name, or ``bus`` for the
    session's CAN bus. The ranges tell a clipped sample from a true one.
    """

    sensor: SensorName
    device: Annotated[str, AfterValidator(partial(_known, own=IMUS, kind="sensor"))]
    port: str = Field(default="bus", min_length=1)
    rate_hz: float = Field(gt=20, le=4000)
    acc_range_g: float = Field(gt=0, le=400)
    gyr_range_dps: float = Field(gt=0, le=10000)
    options: Options = Field(default_factory=dict)


class StimulatorDevice(Settings):
    """The stimulator; ``can`` is on the session's bus, the others have a serial ``port``."""

    device: Annotated[str, AfterValidator(partial(_known, own=STIMULATORS, kind="stimulator"))] = "can"
    port: str = ""
    options: Options = Field(default_factory=dict)

    @model_validator(mode="after")
    def _serial_devices_have_a_port(self) -> Self:
        if self.device not in ("can", "canopen") and not self.port:
            raise ValueError(f"device {self.device!r} needs port, the serial line that it is on")
        return self


class Switch(Settings):
    """A switch: one bit of a CAN frame, or a serial line's input."""

    source: Literal["can_bit", "serial_cts", "serial_dsr"]
    port: str = Field(default="bus", min_length=1)
    identifier: int = Field(default=0, ge=0, le=0x7FF)
    bit: int = Field(default=0, ge=0, le=63)
    pressed: Literal["high", "low"] = "high"


class FootSwitch(Switch):
    """A switch under the foot.

    ``use``: ``compare`` only records how it differs from the sensor's phases, ``fallback`` lets it time the
    stimulation when the sensor's side has no usable phases.
    """

    foot: Foot
    use: Literal["compare", "fallback"] = "compare"


class Live(Settings):
    """What a live session needs beside its devices: emergency stops, and the folder that its results go below.

    Paths are seen from where ``fes`` is started. An empty ``stop_file`` is ``stop`` in the session's own folder.
    """

    stop_button: Switch | None = None
    stop_file: str = ""
    folder: str = Field(default="out", min_length=1)


LSL_LABELS: Final = ("acc_x", "acc_y", "acc_z", "gyr_x", "gyr_y", "gyr_z")  # options that name a stream's channels


class FootGeometry(Settings):
    """Where toe and heel are, seen from the sensor with the foot flat: metres forward, left and up (down negative)."""

    toe_forward_m: float = Field(ge=-0.1, le=0.4)
    toe_left_m: float = Field(default=0.0, ge=-0.15, le=0.15)
    toe_up_m: float = Field(ge=-0.3, le=0.1)
    heel_forward_m: float = Field(ge=-0.4, le=0.1)
    heel_left_m: float = Field(default=0.0, ge=-0.15, le=0.15)
    heel_up_m: float = Field(ge=-0.3, le=0.1)


class Treadmill(Settings):
    """The belt, when there is one."""

    belt_speed_mps: float = Field(gt=0, le=5)


class Ground(Settings):
    """What is walked on: level; an incline, in percent, uphill positive; or anything else (stairs, ramps both ways)."""

    incline_percent: float = Field(default=0.0, ge=-STEEPEST_PERCENT, le=STEEPEST_PERCENT)
    free: bool = False

    @model_validator(mode="after")
    def _one_of_them(self) -> Self:
        if self.free and self.incline_percent:
            raise ValueError("incline_percent and free = true are both given; a known incline is not free")
        return self

    @property
    def incline(self) -> float:
        """What it rises per horizontal distance, NaN where it is free."""
        return math.nan if self.free else 0.01 * self.incline_percent

    @property
    def level(self) -> bool:
        """Neither an incline nor free."""
        return self.incline == 0.0


class Phases(Settings):
    """How phases are found: swing begins at the peak of the toe-down rate (foot off), or when it turns to toe-up."""

    swing_begins: Literal["peak", "reversal"] = "peak"


class Exercise(Settings):
    """Bursts that come and go by the clock, for who lies or sits: all ``channels`` together (empty: every one).

    Each burst rises over ``rise_s``, holds for ``on_s`` and falls over ``fall_s``; ``off_s`` later comes the next.
    """

    on_s: float = Field(gt=0, le=limits.MAX_ON_S)
    off_s: float = Field(ge=limits.MIN_OFF_S, le=600)
    rise_s: float = Field(default=0.5, gt=0, le=1.0)
    fall_s: float = Field(default=0.5, ge=0, le=1.0)
    count: int = Field(ge=1, le=1000)
    channels: tuple[int, ...] = Field(default=(), strict=False)

    @property
    def burst_s(self) -> float:
        """From the first to the last current of a burst."""
        return self.rise_s + self.on_s + self.fall_s


class Session(Settings):
    """All of one session's settings. ``exercise`` is set in sessions of exercise alone, see :func:`load_exercise`."""

    name: str = Field(min_length=1, max_length=120)
    subject: str = ""
    stimulation: Stimulation = Stimulation()
    channels: tuple[Channel, ...] = Field(default=(), strict=False)
    phases: Phases = Phases()
    thresholds: dict[str, Value] = Field(default_factory=dict)
    bus: Bus = Bus()
    sensors: tuple[ImuDevice, ...] = Field(default=(), strict=False)
    stimulator: StimulatorDevice = StimulatorDevice()
    foot_switches: tuple[FootSwitch, ...] = Field(default=(), strict=False)
    treadmill: Treadmill | None = None
    ground: Ground = Ground()
    geometry: dict[Foot, FootGeometry] = Field(default_factory=dict)
    exercise: Exercise | None = None
    live: Live = Field(default=Live(), exclude=True)  # of this machine; it changes no decision and is in no log

    @model_validator(mode="after")
    def _thresholds_are_known_and_near_the_usual(self) -> Self:
        check_thresholds(self.thresholds)
        return self

    @property
    def by_radio(self) -> frozenset[str]:
        """The sensors whose samples come by radio."""
        return frozenset(str(device.sensor) for device in self.sensors if device.device in WIRELESS)

    @model_validator(mode="after")
    def _radio_has_limits_of_its_own(self) -> Self:
        """Old data are allowed only together with what makes them safe; the gate holds these limits by itself, too."""
        own, most = self.stimulation, limits.RADIO
        if not self.by_radio:
            if own.max_data_age_ms > limits.MAX_DATA_AGE_MS:
                raise ValueError(
                    f"max_data_age_ms = {own.max_data_age_ms} is over {limits.MAX_DATA_AGE_MS}; up to "
                    f"{most.max_data_age_ms} is only for sensors by radio ({', '.join(WIRELESS)})"
                )
            return self
        if self.channels and own.validity_ms > most.max_validity_ms:
            raise ValueError(f"by radio validity_ms is {most.max_validity_ms} at most, not {own.validity_ms}")
        for channel in self.channels:
            for name in ("max_on_s", "max_current_ma", "max_charge_per_phase_uc", "max_charge_per_minute_mc"):
                if (value := getattr(channel.limits, name)) > getattr(most, name):
                    raise ValueError(
                        f"channel {channel.name!r}: by radio {name} is {getattr(most, name):g} at most, not {value:g}"
                    )
            if channel.tuning is not None and channel.tuning.mode != "off":
                raise ValueError(f"channel {channel.name!r}: by radio nothing is tuned; leave out tuning")
        return self

    @model_validator(mode="after")
    def _channels_and_sensors_are_distinct(self) -> Self:
        numbers = [channel.number for channel in self.channels]
        if len(set(numbers)) != len(numbers):
            raise ValueError(f"channels must have different numbers, got {numbers}")
        for channel in self.channels:
            unknown = set(channel.never_with) - set(numbers)
            if unknown:
                raise ValueError(f"channel {channel.name!r}: never_with names no channel: {sorted(unknown)}")
        worn = [device.sensor for device in self.sensors]
        if len(set(worn)) != len(worn):
            raise ValueError(f"sensors must be worn in different places, got {worn}")
        return self

    @model_serializer(mode="wrap")
    def _without_what_is_absent(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """So that a session without exercise and thresholds reads, and identifies its replays, as it did before."""
        data: dict[str, Any] = handler(self)
        for name in ("exercise", "thresholds"):
            if not data.get(name):
                data.pop(name, None)
        return data

    @model_validator(mode="after")
    def _each_has_what_it_is_fed_by_for_itself(self) -> Self:
        """Two feet fed by one sensor walk in step; a line opened a second time takes on the second one's speed."""
        users: dict[tuple[str, ...], str] = {}

        def claim(who: str, *source: str) -> None:
            if source in users:
                raise ValueError(f"{who} and {users[source]} are both on {' '.join(source)}; each needs its own")
            users[source] = who

        if self.stimulator.device not in ("can", "canopen"):
            claim("the stimulator", "port", self.stimulator.port)
        for device in self.sensors:
            if device.device == "lsl":
                for label in LSL_LABELS:
                    claim(device.sensor, "LSL stream", device.port, "channel", str(device.options.get(label, label)))
            elif device.device not in ("xsens_can", "dbc_can"):  # of these the identifiers must differ
                claim(device.sensor, "port", device.port)
        switches: list[tuple[str, Switch]] = [(f"the foot switch of {each.foot}", each) for each in self.foot_switches]
        switches += [("the stop button", self.live.stop_button)] if self.live.stop_button else []
        for who, switch in switches:
            if switch.source == "can_bit":
                claim(who, "bit", f"{switch.bit} of identifier {switch.identifier:#x}")
                continue
            if user := users.get(("port", switch.port)):
                raise ValueError(f"{who} and {user} are both on port {switch.port}; each needs its own")
            claim(who, "input", switch.source, "of port", switch.port)
        return self


def load_session(path: Path) -> Session:
    """Read and validate a session file.

    Raises:
        ConfigError: the file is missing, is not TOML, or holds a setting that is not allowed; every fault is
            listed with its line, key, value and what would be right.
    """
    data, text = read_toml(path, "session", ConfigError)
    return validate_session(data, path, text).model_copy(update={"exercise": None})


def refuse_blind_targets(session: Session, path: Path) -> None:
    """For a walk whose session file is all that says where the sensors sit.

    Raises:
        ConfigError: a channel is to tune itself by the toe's clearance, and nothing says where its toe is.
    """
    for channel in session.channels:
        tuned = channel.tuning
        if tuned is None or tuned.mode == "off" or tuned.sensor_clearance_m is not None:
            continue
        if tuned.toe_clearance_m is not None and channel.foot not in session.geometry:
            raise ConfigError(
                f"{path}: channel {channel.name!r}: toe_clearance_m cannot be measured without "
                f"[geometry.{channel.foot}], which says where the sensor sits; add it, or sensor_clearance_m"
            )


def load_exercise(path: Path) -> Session:
    """The session of exercise that a session file describes: its [exercise] table's channels, without any sensor.

    Raises:
        ConfigError: as for :func:`load_session`; or there is no [exercise], or a burst of it would break a limit.
    """
    data, text = read_toml(path, "session", ConfigError)
    session = validate_session(data, path, text)
    exercise = session.exercise
    if exercise is None:
        raise ConfigError(f"{path}: has no [exercise] table with on_s, off_s and count")
    numbers = exercise.channels or tuple(channel.number for channel in session.channels)
    if unknown := sorted(set(numbers) - {channel.number for channel in session.channels}) or not numbers:
        raise ConfigError(f"{path}: exercise.channels: there is no channel {unknown if numbers else 'at all'}")
    channels = []
    for channel in (each for each in session.channels if each.number in numbers):
        if exercise.burst_s > channel.limits.max_on_s:
            least = f"rise_s + on_s + fall_s is {exercise.burst_s:g} s"
            raise ConfigError(
                f"{path}: exercise: {least}, over {channel.name!r}'s max_on_s = {channel.limits.max_on_s:g}"
            )
        if exercise.off_s < channel.limits.min_off_s:
            least = f"min_off_s = {channel.limits.min_off_s:g}"
            raise ConfigError(f"{path}: exercise.off_s = {exercise.off_s:g} is under {channel.name!r}'s {least}")
        if partners := sorted(set(channel.never_with) & set(numbers)):
            raise ConfigError(f"{path}: exercise.channels: {channel.name!r} is never_with {partners}; name one of them")
        ramps = {"rise_s": exercise.rise_s, "fall_s": exercise.fall_s, "start_delay_s": 0.0, "extension_s": 0.0}
        channels.append({**channel.model_dump(), **ramps, "never_with": (), "tuning": None, "onset": "detected"})
    age_ms = min(session.stimulation.max_data_age_ms, limits.MAX_DATA_AGE_MS)  # of no data; a radio's would be refused
    stimulation = {**session.stimulation.model_dump(), "max_data_age_ms": age_ms}
    changed = {"channels": channels, "sensors": (), "foot_switches": (), "stimulation": stimulation}
    return validate_session({**session.model_dump(), **changed}, path).model_copy(update={"live": session.live})


def validate_session(data: dict[str, Any], path: Path, text: str = "") -> Session:
    """Validate settings already parsed; ``path`` and ``text`` are for the messages.

    Raises:
        ConfigError: as for :func:`load_session`.
    """
    try:
        return Session.model_validate(data)
    except ValidationError as error:
        raise ConfigError(explain(error, path, text, Session)) from error
