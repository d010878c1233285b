"""Opening what a live session names: its sensors' lines, its stop button."""

from __future__ import annotations

from contextlib import ExitStack

from drivers.imu.open import ON_CAN, open_imus
from drivers.imu.port import ImuLost
from drivers.stimulator.bus import BusError
from fes.cli.common.exits import fail
from fes.config import ConfigError, Session, Switch
from fes.control.clock_sync import SensorClock
from fes.estimation.sensor_choice import phase_sensors
from fes.live.sensors import SensorStream


def open_sensors(session: Session, stack: ExitStack) -> list[SensorStream]:
    """Open every line that a sensor of the session is on; ``stack`` closes them.

    Raises:
        Problem: one cannot be opened.
    """
    try:
        ports = open_imus(session.sensors, session.bus)
    except (ImuLost, BusError, ConfigError, ValueError) as error:
        fail(error)
    phase_sensor_of = phase_sensors(str(device.sensor) for device in session.sensors)
    # what no channel follows must not stop the therapy of a sound foot; without channels there is none to stop
    needed = frozenset(phase_sensor_of[channel.foot] for channel in session.channels if channel.foot in phase_sensor_of)
    streams = []
    for port in ports:
        stream = SensorStream(port, SensorClock, ImuLost, needed)
        stack.callback(stream.close)
        streams.append(stream)
    return streams


def stop_switch_settings(text: str) -> Switch:
    """The stop button's settings from ``can_bit:0x1F0:3``, ``serial_cts:/dev/ttyUSB1``; ``:low`` behind it inverts.

    Raises:
        ConfigError: it is of another form.
    """
    source, *rest = text.split(":")
    pressed = rest.pop() if rest and rest[-1] in ("high", "low") else "high"
    where: dict[str, object] = {}
    try:
        if source == "can_bit":
            identifier, bit = rest
            where = {"identifier": int(identifier, 0), "bit": int(bit)}
        else:
            where = {"port": ":".join(rest)}
        return Switch.model_validate({"source": source, "pressed": pressed, **where})
    except ValueError as error:
        raise ConfigError(
            f"--stop-input {text}: must be can_bit:IDENTIFIER:BIT, serial_cts:PORT or serial_dsr:PORT, and may end in "
            f":low for a button that is pressed when the level is low"
        ) from error


def serial_ports_of(session: Session) -> list[str]:
    """The serial ports that the session's sensors and stimulator are on, each once."""
    ports = [each.port for each in session.sensors if each.device not in (*ON_CAN, "lsl")]
    ports += [session.stimulator.port] if session.stimulator.device not in ("can", "canopen") else []
    return list(dict.fromkeys(port for port in ports if "://" not in port))
