"""A SensorStim Capture2Go over Bluetooth LE, by bleak (extra ``ble``).

The settings' ``port`` is the sensor's name (``IMU_`` and its serial number) or its address; where it is a line
(``/dev/…``), notifications come over that, each after its length in two bytes, as a simulated radio sends them. Samples
are kept first in, first out: bad reception makes them late, not missing. How late is known by asking the sensor for its
time (CmdGetStatus) again and again: what it answers was its time after the question. It sends no status unasked, so
that each is an answer. Options: ``sync`` and ``sync_id`` as by cable, ``find_s`` (10): how long it is looked for,
``packed`` (false): eight samples a package, for less load on the radio; at 100 Hz the oldest is 70 ms old by then.

bleak runs in a thread with a loop of its own; every wait for it ends, since a radio that has gone may never answer.
"""

import asyncio
import contextlib
import importlib
import os
import select
import threading
import time
from abc import abstractmethod
from collections import deque
from collections.abc import Callable, Coroutine
from typing import Any, Final

from drivers.imu import capture2go_codec as c2g
from drivers.imu.capture2go_codec import Header, Package
from drivers.imu.capture2go_port import Capture2GoImu, Capture2GoPort
from drivers.imu.port import ImuLost, flag_option, seconds_option
from fes.config import ImuDevice
from fes.signals import NS_PER_S, RawSample

SERVICE: Final = "80030001-e629-4c98-9324-aa7fc0c66de7"
TO_SENSOR: Final = "80030002-e629-4c98-9324-aa7fc0c66de7"
FROM_SENSOR: Final = "80030003-e629-4c98-9324-aa7fc0c66de7"
NEEDS: Final = "Bluetooth LE needs the package bleak: pip install 'fes-gait[ble]'"
WRITE_S: Final = 1.0
LEAVE_S: Final = 3.0
QUEUED: Final = 10_000  # notifications, more than a minute's
FIRST_NS: Final = 2 * NS_PER_S  # in which the sensor is asked more often …
FIRST_PAUSE_NS: Final = NS_PER_S // 10  # … since of some twenty ways there one is short
PAUSE_NS: Final = NS_PER_S
UNANSWERED_NS: Final = 10 * NS_PER_S  # so late is no answer: what lies in the radio so long has stopped the session
_HINT: Final = "Is it switched on, charged and near, connected to nothing else, and Bluetooth on?"


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
        try:
            self._library: Any = importlib.import_module("bleak")
        except ImportError as error:
            raise ImuLost(f"{self._device.sensor}: {NEEDS}") from error
        self._decoder = c2g.NotificationDecoder(self._counts)
        self._heard: deque[bytes] = deque(maxlen=QUEUED)
        self._gone = False
        self._client: Any = None
        self._event = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._is_open = True
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, daemon=True)
        self._thread.start()
        try:
            find_s = seconds_option(self._device, "find_s", 10.0)
            self._await(self._connect(find_s), 3.0 * find_s)
            self._begin()
        except (ImuLost, ValueError):
            self._release()
            raise

    async def _connect(self, find_s: float) -> None:
        def is_it(found: Any, _: Any) -> bool:
            return self._device.port in (found.name, found.address)

        scanner = self._library.BleakScanner
        found = await scanner.find_device_by_filter(is_it, timeout=find_s, service_uuids=[SERVICE])
        if found is None:
            raise ImuLost(f"{self._name}: is not found. {_HINT}")
        self._client = self._library.BleakClient(found, disconnected_callback=self._lost, timeout=find_s)
        async with asyncio.timeout(find_s):
            await self._client.connect()
            await self._client.start_notify(FROM_SENSOR, self._notified)

    def _notified(self, _: Any, data: bytearray) -> None:
        self._heard.append(bytes(data))
        self._wake()

    def _lost(self, _: Any) -> None:
        self._gone = True
        self._wake()

    def _wake(self) -> None:
        if self._is_open:
            with contextlib.suppress(OSError):
                os.eventfd_write(self._event, 1)

    def _await(self, coroutine: Coroutine[Any, Any, None], seconds: float | None) -> None:
        """Its end, in the thread of bleak. ImuLost: whatever went wrong there, or it did not end in time."""
        future = asyncio.run_coroutine_threadsafe(coroutine, self._loop)
        try:
            future.result(seconds)
        except ImuLost:
            raise
        except Exception as error:  # bleak's own, the system's, those of D-Bus, TimeoutError
            future.cancel()
            raise ImuLost(f"{self._name}: {type(error).__name__}: {error}. {_HINT}") from error

    def _send(self, package: bytes) -> None:
        if self._gone or not self._is_open:
            raise ImuLost(f"{self._name}: the connection is gone. {_HINT}")
        self._await(self._client.write_gatt_char(TO_SENSOR, package, response=True), WRITE_S)

    def _send_soon(self, package: bytes) -> None:
        if self._is_open and not self._gone:
            future = self._client.write_gatt_char(TO_SENSOR, package, response=False)
            asyncio.run_coroutine_threadsafe(future, self._loop)  # one that fails is a question without an answer

    def _receive(self) -> list[Package]:
        with contextlib.suppress(BlockingIOError):
            os.eventfd_read(self._event)
        packages: list[Package] = []
        while self._heard:
            packages += self._decoder.feed(self._heard.popleft())
        if self._gone and not packages:
            raise ImuLost(f"{self._name}: the connection is gone. {_HINT}")
        return packages

    def _wait(self, seconds: float) -> None:
        select.select([self._event], [], [], seconds)

    @property
    def _name(self) -> str:
        return f"{self._device.sensor} on {self._device.port}"

    def fileno(self) -> int:
        """An eventfd that bleak's thread raises."""
        return self._event

    def close(self) -> None:
        """Stop it and leave; one that is gone is not waited for."""
        if self._is_open:
            self._end()
            self._release()

    def _release(self) -> None:
        if self._client is not None and not self._gone:
            with contextlib.suppress(ImuLost):
                self._await(self._client.disconnect(), LEAVE_S)
        self._is_open = False
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(LEAVE_S)
        if not self._thread.is_alive():
            self._loop.close()
        os.close(self._event)
