"""A SensorStim Capture2Go over Bluetooth LE, by bleak (extra ``ble``).

The settings' ``port`` is the sensor's name (``IMU_`` and its serial number) or its address; where it is a line
(``/dev/…``), notifications come over that, each after its length in two bytes, as a simulated radio sends them. Samples
are kept first in, first out: bad reception makes them late, not missing. How late is known by asking the sensor for its
time (CmdGetStatus) again and again: what it answers was its time after the question. It sends no status unasked, so
that each is an answer. Options: ``sync`` and ``sync_id`` as by cable, ``find_s`` (10): how long it is looked for,
``packed`` (false): eight samples a package, for less load on the radio; at 100 Hz the oldest is 70 ms old by then.
"""

import time
from abc import abstractmethod
from collections.abc import Callable
from typing import Final

from drivers.imu import capture2go_codec as c2g
from drivers.imu.ble import BleConnection
from drivers.imu.capture2go_codec import Header, Package
from drivers.imu.capture2go_port import Capture2GoImu, Capture2GoPort
from drivers.imu.port import ImuLost, flag_option
from fes.config import ImuDevice
from fes.signals import NS_PER_S, RawSample

SERVICE: Final = "80030001-e629-4c98-9324-aa7fc0c66de7"
TO_SENSOR: Final = "80030002-e629-4c98-9324-aa7fc0c66de7"
FROM_SENSOR: Final = "80030003-e629-4c98-9324-aa7fc0c66de7"
FIRST_NS: Final = 2 * NS_PER_S  # in which the sensor is asked more often …
FIRST_PAUSE_NS: Final = NS_PER_S // 10  # … since of some twenty ways there one is short
PAUSE_NS: Final = NS_PER_S
UNANSWERED_NS: Final = 10 * NS_PER_S  # so late is no answer: what lies in the radio so long has stopped the session


class Capture2GoRadio(Capture2GoPort):
    """What is the same however the notifications come: the sensor is asked for its time."""

    status_every_s = 0

    def __init__(self, device: ImuDevice, clock_ns: Callable[[], int] = time.monotonic_ns) -> None:
        if flag_option(device, "packed", False):
            self.mode_field, self.kinds = "fullPackedMode", ("FULL_PACKED", "FULL_6D_PACKED")
        super().__init__(device, clock_ns)

    @abstractmethod
    def _send_soon(self, package: bytes) -> None:
        """Hand over one package without waiting for anything."""

    def _begin(self) -> None:
        self._told: list[tuple[str, int, int]] = []
        self._asked_ns: int | None = None  # the oldest question whose answer has not come
        self._sent_ns = self._began_ns = 0
        super()._begin()

    def read(self, t_ns: int) -> list[RawSample]:
        """As of every port; and it asks what is to be asked."""
        before = self._status
        found = super().read(t_ns)
        if self._asked_ns is not None and self._status is not before:
            self._told.append((self._device.sensor, self._asked_ns, self._status["timestamp"]))
            self._asked_ns = None
        self._began_ns = self._began_ns or t_ns
        pause_ns = FIRST_PAUSE_NS if t_ns - self._began_ns < FIRST_NS else PAUSE_NS
        if t_ns - self._sent_ns > (pause_ns if self._asked_ns is None else UNANSWERED_NS):
            # counted from before it is sent: whatever it waits for on its way, the bound stays true
            self._asked_ns = t_ns if self._asked_ns is None else self._asked_ns
            self._sent_ns = t_ns
            self._send_soon(c2g.pack(Header.CMD_GET_STATUS))
        return found

    def clock_answers(self) -> list[tuple[str, int, int]]:
        """See the base."""
        told, self._told = self._told, []
        return told


class Capture2GoBridge(Capture2GoRadio, Capture2GoImu):
    """Notifications over a line of bytes, each after its length (two bytes, the least significant first)."""

    baudrate = 921_600
    decoder = c2g.NotificationDecoder
    _send_soon = Capture2GoImu._send

    def _open(self) -> None:
        self._bytes = bytearray()
        super()._open()

    def _receive(self) -> list[Package]:
        self._bytes += self._line.read()
        packages: list[Package] = []
        while len(self._bytes) > 2 and len(self._bytes) >= (end := 2 + int.from_bytes(self._bytes[:2], "little")):
            packages += self._decoder.feed(bytes(self._bytes[2:end]))
            del self._bytes[:end]
        return packages


class Capture2GoBle(Capture2GoRadio):
    """:class:`~drivers.imu.port.ImuPort` for one Capture2Go by radio."""

    def _open(self) -> None:
        self._decoder = c2g.NotificationDecoder(self._counts)
        self._connection = BleConnection(self._device, FROM_SENSOR, [SERVICE])
        try:
            self._begin()
        except (ImuLost, ValueError):
            self._connection.close()
            raise

    def _send(self, package: bytes) -> None:
        self._connection.write(TO_SENSOR, package)

    def _send_soon(self, package: bytes) -> None:
        self._connection.write_soon(TO_SENSOR, package)

    def _receive(self) -> list[Package]:
        return [package for heard in self._connection.notifications() for package in self._decoder.feed(heard)]

    def _wait(self, seconds: float) -> None:
        self._connection.wait(seconds)

    @property
    def _name(self) -> str:
        return self._connection.name

    def fileno(self) -> int:
        """The connection's descriptor."""
        return self._connection.fileno()

    def close(self) -> None:
        """Stop it and leave; one that is gone is not waited for."""
        if self._connection.is_open:
            self._end()
            self._connection.close()
