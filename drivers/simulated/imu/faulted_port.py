"""The faults of a simulated sensor, between the driver of a real one and whoever reads it: in a fault campaign only.

Of a line's faults all but ``garble``, whose frame every driver refuses: that is ``drop``. Of a sensor's all; further
``unsound`` (so many of the next samples are all NaN, as drivers pass on what a device calls unsound), ``drift`` (ppm
that its stamps run fast from now on), ``jump`` (its stamps, by so many seconds, once), ``reboot`` (now: silent for 0.3
s, then stamps from 0) and ``unplug`` (1: its line is gone, with every sensor on it; 0: it can be opened again).
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Final

from drivers.imu.port import NOT_A_NUMBER, ImuLost, ImuPort
from drivers.simulated.imu.faults import BOOT_NS, LASTING, SampleFaults
from drivers.simulated.lines import FaultValues, MessageFaults
from drivers.simulated.stimulator.firmware import NEVER
from fes.config import ImuDevice
from fes.signals import NS_PER_S, RawSample

CLOCK: Final = ("jump", "drift", "reboot")
UNTIL_ENDED: Final = (*LASTING, *sorted(MessageFaults.faults), "unsound", "drift", "unplug")
UNPLUGGED: Final = "unplugged by the fault campaign"


class StampFaults:
    """A device's clock with faults: its own time in ns in, what its stamps say out."""

    def __init__(self) -> None:
        self._offset_ns = self._since_ns = self._last_ns = 0
        self._drift = 0.0
        self._restarts = False

    def set(self, name: str, value: float) -> None:
        """``jump`` by seconds, once; ``drift`` in ppm from now on; ``reboot``: the next stamp is 0."""
        if name == "jump":
            self._offset_ns += round(value * NS_PER_S)
        elif name == "drift":
            self._offset_ns = self._ahead_ns(self._last_ns)
            self._since_ns, self._drift = self._last_ns, value * 1e-6
        else:
            self._restarts = True

    def stamp_ns(self, t_device_ns: int) -> int:
        """The next sample's."""
        self._last_ns = t_device_ns
        if self._restarts:
            self._restarts, self._since_ns, self._offset_ns = False, t_device_ns, -t_device_ns
        return t_device_ns + self._ahead_ns(t_device_ns)

    def _ahead_ns(self, t_device_ns: int) -> int:
        return self._offset_ns + round(self._drift * (t_device_ns - self._since_ns))


class _Faults:
    """One sensor's, from its line to its samples."""

    def __init__(self, device: ImuDevice) -> None:
        # within what it can measure its driver holds it; here nothing may change that has no fault
        self.samples = SampleFaults(device.rate_hz, device.acc_range_g, device.gyr_range_dps, within=math.inf)
        self.line = MessageFaults[RawSample]()
        self.stamps = StampFaults()
        self.counted = FaultValues(unsound=0.0)
        self.silent_until_ns = 0

    def sent(self, sample: RawSample) -> list[RawSample]:
        """The sample as the line gets it: twice where it is doubled."""
        twice = self.samples.doubled()
        t_device_ns = self.stamps.stamp_ns(sample.t_device_ns) + self.samples.ahead_ns()
        acc, gyr, _ = self.samples.shown(sample.acc_mps2, sample.gyr_radps)
        if self.counted.use_up("unsound"):
            acc = gyr = NOT_A_NUMBER
        return [replace(sample, t_device_ns=t_device_ns, acc_mps2=acc, gyr_radps=gyr)] * (2 if twice else 1)


class FaultedImu:
    """An open port with faults, that of :class:`~drivers.imu.port.ImuPort`; ``devices``: the settings of its sensors.

    Without a fault it gives every sample as the port does.
    """

    def __init__(self, port: ImuPort, devices: Sequence[ImuDevice]) -> None:
        self._port = port
        self.sensors = port.sensors
        self._faults: dict[str, _Faults] = {
            device.sensor: _Faults(device) for device in devices if device.sensor in port.sensors
        }
        self._unplugged = False

    @property
    def serials(self) -> Mapping[str, str]:
        """As the port's."""
        return self._port.serials

    @property
    def notices(self) -> Sequence[str]:
        """As the port's."""
        return self._port.notices

    def inject(self, t_ns: int, sensor: str, name: str, value: float) -> None:
        """Bring a fault of a sensor about, or with 0 end it. ValueError: no such fault, or a value that it has not."""
        faults = self._faults[sensor]
        if name == "unplug":
            self._unplugged = bool(value)
        elif name == "unsound":
            faults.counted[name] = value
        elif name in CLOCK:
            faults.stamps.set(name, value)
            if name == "reboot":
                faults.silent_until_ns = t_ns + BOOT_NS
        elif name in MessageFaults.faults:
            faults.line.set(name, value)
        else:
            faults.samples.set(name, value)

    def clear(self, t_ns: int, sensor: str) -> None:
        """End all faults of a sensor that last."""
        for name in UNTIL_ENDED:
            self.inject(t_ns, sensor, name, 0.0)

    def fileno(self) -> int | None:
        """As the port's; None, to be read at every tick, while a sample is held back."""
        waits = any(faults.line.next_deadline_ns() < NEVER for faults in self._faults.values())
        return None if waits or self._unplugged else self._port.fileno()

    def read(self, t_ns: int) -> list[RawSample]:
        """What has arrived by ``t_ns``, as the port's.

        Raises:
            ImuLost: the line broke, or is unplugged.
        """
        if self._unplugged:
            raise ImuLost(UNPLUGGED)
        out: list[RawSample] = []
        for sample in self._port.read(t_ns):
            faults = self._faults[sample.sensor]
            if t_ns >= faults.silent_until_ns:
                faults.line.send(t_ns, faults.sent(sample))
        for faults in self._faults.values():
            out += (replace(sample, t_host_ns=t_ns) for sample in faults.line.arrived(t_ns))
        return out

    def clock_answers(self) -> Sequence[tuple[str, int, int]]:
        """As the port's."""
        return self._port.clock_answers()

    def reopen(self) -> None:
        """As the port's. ImuLost: it is unplugged still."""
        if self._unplugged:
            raise ImuLost(UNPLUGGED)
        self._port.reopen()

    def close(self) -> None:
        """Release the line."""
        self._port.close()
