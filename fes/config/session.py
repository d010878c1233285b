"""``session.toml`` → validated settings; an error names file, line, key, value and what is allowed.

What is connected: the bus, the sensors, the stimulator, a foot switch.
"""

from pathlib import Path
from typing import Any, Final, Literal, Self

from pydantic import Field, ValidationError, model_validator

from fes.config.base import ConfigError, Foot, SensorName, Settings, explain, read_toml
from fes.config.channel import Channel, Stimulation

Options = dict[str, str | int | float | bool]


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
    device: Literal["xbus", "xsens_can", "dbc_can", "ximu3", "lsl"]
    port: str = Field(default="bus", min_length=1)
    rate_hz: float = Field(gt=20, le=4000)
    acc_range_g: float = Field(gt=0, le=400)
    gyr_range_dps: float = Field(gt=0, le=10000)
    options: Options = Field(default_factory=dict)


class StimulatorDevice(Settings):
    """The stimulator; ``can`` is on the session's bus, the others have a serial ``port``."""

    device: Literal["can", "p24_low_level", "p24_mid_level", "rehastim2", "canopen"] = "can"
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


class Phases(Settings):
    """How phases are found: swing begins at the peak of the toe-down rate (foot off), or when it turns to toe-up."""

    swing_begins: Literal["peak", "reversal"] = "peak"


class Session(Settings):
    """All of one session's settings."""

    name: str = Field(min_length=1, max_length=120)
    subject: str = ""
    stimulation: Stimulation = Stimulation()
    channels: tuple[Channel, ...] = Field(default=(), strict=False)
    phases: Phases = Phases()
    bus: Bus = Bus()
    sensors: tuple[ImuDevice, ...] = Field(default=(), strict=False)
    stimulator: StimulatorDevice = StimulatorDevice()
    foot_switches: tuple[FootSwitch, ...] = Field(default=(), strict=False)
    treadmill: Treadmill | None = None
    geometry: dict[Foot, FootGeometry] = Field(default_factory=dict)
    live: Live = Field(default=Live(), exclude=True)  # of this machine; it changes no decision and is in no log

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
    return validate_session(data, path, text)


def validate_session(data: dict[str, Any], path: Path, text: str = "") -> Session:
    """Validate settings already parsed; ``path`` and ``text`` are for the messages.

    Raises:
        ConfigError: as for :func:`load_session`.
    """
    try:
        return Session.model_validate(data)
    except ValidationError as error:
        raise ConfigError(explain(error, path, text, Session)) from error
