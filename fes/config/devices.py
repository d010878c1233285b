"""What is connected: the bus, the sensors, the stimulator, a foot switch."""

from __future__ import annotations

from typing import Literal, Self

from pydantic import Field, model_validator

from fes.config.base import Foot, SensorName, Settings

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
