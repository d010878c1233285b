"""The kinds of simulated sensor that speak over a line of bytes, by their names in a session's settings."""

from typing import Final

from drivers.simulated.imu.capture2go import Air, Capture2GoWire
from drivers.simulated.imu.wire import SERIAL, Wire, XbusWire, Ximu3Wire

SERIAL_WIRES: Final = ("xbus", "ximu3", "capture2go")


def serial_wire(kind: str, rate_hz: float, serial: str = SERIAL, air: Air | None = None) -> Wire:
    """One sensor's; ``air`` for those that can hear each other by radio. ValueError: a rate that it has not."""
    if kind == "capture2go":
        return Capture2GoWire(rate_hz, air, serial)
    return XbusWire(rate_hz, serial) if kind == "xbus" else Ximu3Wire()
