"""A SensorStim Capture2Go over Bluetooth LE, by bleak (extra ``ble``): to record, not to stimulate by.

The settings' ``port`` is the sensor's name (``IMU_`` and its serial number) or its address. Samples come eight a
package, first in, first out, so that a walk is recorded whole: bad reception makes them late, not missing. How late
nobody knows: the least delayed one counts as new. Options: ``sync`` and ``sync_id`` as by cable, ``find_s`` (10): how
long it is looked for.

bleak runs in a thread with a loop of its own; every wait for it ends, since a radio that has gone may never answer.
"""

import asyncio
import contextlib
import importlib
import os
import select
import threading
from collections import deque
from collections.abc import Coroutine
from typing import Any, Final

from drivers.imu import capture2go_codec as c2g
from drivers.imu.capture2go_codec import Package
from drivers.imu.capture2go_port import Capture2GoPort
from drivers.imu.port import ImuLost, seconds_option

SERVICE: Final = "80030001-e629-4c98-9324-aa7fc0c66de7"
TO_SENSOR: Final = "80030002-e629-4c98-9324-aa7fc0c66de7"
FROM_SENSOR: Final = "80030003-e629-4c98-9324-aa7fc0c66de7"
NEEDS: Final = "Bluetooth LE needs the package bleak: pip install 'fes-gait[ble]'"
WRITE_S: Final = 1.0
LEAVE_S: Final = 3.0
QUEUED: Final = 10_000  # notifications, more than a minute's
_HINT: Final = "Is it switched on, charged and near, connected to nothing else, and Bluetooth on?"


class Capture2GoBle(Capture2GoPort):
    """:class:`~drivers.imu.port.ImuPort` for one Capture2Go by radio."""

    mode_field = "fullPackedMode"
    kinds = ("FULL_PACKED", "FULL_6D_PACKED")

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
