"""The kinds of simulated sensor that speak over a line of bytes, by their names in a session's settings."""

from typing import Final

from drivers.simulated.imu.capture2go import Air, Capture2GoWire
from drivers.simulated.imu.device import SimulatedImu
from drivers.simulated.imu.movella_dot import MovellaDotWire
from drivers.simulated.imu.radio import Radio
from drivers.simulated.imu.wire import SERIAL, Wire, XbusWire, Ximu3Wire
from drivers.simulated.imu.witmotion import WitmotionWire

SERIAL_WIRES: Final = ("xbus", "ximu3", "capture2go", "capture2go_ble", "witmotion", "movella_dot")
BY_RADIO: Final = ("capture2go_ble", "movella_dot")  # whose notifications come over the line


def serial_wire(kind: str, rate_hz: float, serial: str = SERIAL, air: Air | None = None) -> Wire:
    """One sensor's; ``air`` for those that can hear each other by radio. ValueError: a rate that it has not."""
    if kind.startswith("capture2go"):
        return Capture2GoWire(rate_hz, air, serial)
    if kind in ("witmotion", "movella_dot"):
        return WitmotionWire(rate_hz) if kind == "witmotion" else MovellaDotWire(rate_hz)
    return XbusWire(rate_hz, serial) if kind == "xbus" else Ximu3Wire()


def on_its_line(kind: str, imu: SimulatedImu, t_ns: int) -> SimulatedImu | Radio:
    """The sensor, or the radio that it is behind."""
    whole = kind == "movella_dot"
    return Radio(imu, t_ns, framed=not whole, whole=whole) if kind in BY_RADIO else imu
