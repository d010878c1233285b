"""One connection over Bluetooth LE by bleak (extra ``ble``), or in its place over a line, for ports that never wait.

bleak runs in a thread with a loop of its own; every wait for it ends, since a radio that has gone may never answer.
"""

import asyncio
import contextlib
import importlib
import os
import select
import struct
import threading
import time
from collections import deque
from collections.abc import Coroutine, Sequence
from typing import Any, Final

from drivers.imu.line import ByteLine, LineOpener
from drivers.imu.port import ImuLost, seconds_option
from fes.config import ImuDevice
from fes.signals import NS_PER_S

NEEDS: Final = "Bluetooth LE needs the package bleak: pip install 'fes-gait[ble]'"
WRITE_S: Final = 1.0
READ_S: Final = 1.0
LEAVE_S: Final = 3.0
BRIDGE_BAUD: Final = 921_600
QUEUED: Final = 10_000  # notifications, more than a minute's
_HINT: Final = "Is it switched on, charged and near, connected to nothing else, and Bluetooth on?"


class BleConnection:
    """To the device whose name or address is the settings' ``port``; option ``find_s`` (10): how long it is looked for.

    ``notifies``: the characteristic whose notifications are queued; ``services``: what it must advertise.

    ImuLost: bleak is not installed, or the device is not found or does not answer in time.
    """

    def __init__(self, device: ImuDevice, notifies: str, services: Sequence[str] | None = None) -> None:
        self.name = f"{device.sensor} on {device.port}"
        try:
            self._library: Any = importlib.import_module("bleak")
        except ImportError as error:
            raise ImuLost(f"{device.sensor}: {NEEDS}") from error
        find_s = seconds_option(device, "find_s", 10.0)
        self._heard: deque[bytes] = deque(maxlen=QUEUED)
        self._gone = False
        self._client: Any = None
        self._event = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self.is_open = True
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, daemon=True)
        self._thread.start()
        try:
            self._await(self._connect(device.port, notifies, services, find_s), 3.0 * find_s)
        except BaseException:  # Ctrl-C during the search, too
            self.close()
            raise

    async def _connect(self, port: str, notifies: str, services: Sequence[str] | None, find_s: float) -> None:
        def is_it(found: Any, _: Any) -> bool:
            return port in (found.name, found.address)

        given = None if services is None else list(services)
        found = await self._library.BleakScanner.find_device_by_filter(is_it, timeout=find_s, service_uuids=given)
        if found is None:
            raise ImuLost(f"{self.name}: is not found. {_HINT}")
        self._client = self._library.BleakClient(found, disconnected_callback=self._lost, timeout=find_s)
        async with asyncio.timeout(find_s):
            await self._client.connect()
            await self._client.start_notify(notifies, self._notified)

    def _notified(self, _: Any, data: bytearray) -> None:
        self._heard.append(bytes(data))
        self._wake()

    def _lost(self, _: Any) -> None:
        self._gone = True
        self._wake()

    def _wake(self) -> None:
        if self.is_open:
            with contextlib.suppress(OSError):
                os.eventfd_write(self._event, 1)

    def _await(self, coroutine: Coroutine[Any, Any, Any], seconds: float | None) -> Any:
        """Its result, from the thread of bleak. ImuLost: whatever went wrong there, or it did not end in time."""
        future = asyncio.run_coroutine_threadsafe(coroutine, self._loop)
        try:
            return future.result(seconds)
        except ImuLost:
            raise
        except Exception as error:  # bleak's own, the system's, those of D-Bus, TimeoutError
            future.cancel()
            raise ImuLost(f"{self.name}: {type(error).__name__}: {error}. {_HINT}") from error

    def _must_be_there(self) -> None:
        if self._gone or not self.is_open:
            raise ImuLost(f"{self.name}: the connection is gone. {_HINT}")

    def write(self, characteristic: str, value: bytes) -> None:
        """Hand over a value and wait until it has arrived. ImuLost: it has not."""
        self._must_be_there()
        self._await(self._client.write_gatt_char(characteristic, value, response=True), WRITE_S)

    def write_soon(self, characteristic: str, value: bytes) -> None:
        """Hand over a value without waiting for anything; one that fails is a question without an answer."""
        if self.is_open and not self._gone:
            future = self._client.write_gatt_char(characteristic, value, response=False)
            asyncio.run_coroutine_threadsafe(future, self._loop)

    def read(self, characteristic: str) -> bytes:
        """A value. ImuLost: it does not come in time."""
        self._must_be_there()
        return bytes(self._await(self._client.read_gatt_char(characteristic), READ_S))

    def notifications(self) -> list[bytes]:
        """Those that have come; never waits. ImuLost: the connection is gone, and they are all read."""
        with contextlib.suppress(BlockingIOError):
            os.eventfd_read(self._event)
        heard = [self._heard.popleft() for _ in range(len(self._heard))]
        if self._gone and not heard:
            self._must_be_there()
        return heard

    def wait(self, seconds: float) -> None:
        """Until something comes, but no longer."""
        select.select([self._event], [], [], seconds)

    def fileno(self) -> int:
        """An eventfd that bleak's thread raises."""
        return self._event

    def close(self) -> None:
        """Leave, if it is still there; may be called twice."""
        if not self.is_open:
            return
        if self._client is not None and not self._gone:
            with contextlib.suppress(ImuLost):
                self._await(self._client.disconnect(), LEAVE_S)
        self.is_open = False
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(LEAVE_S)
        if not self._thread.is_alive():
            self._loop.close()
        os.close(self._event)


class BridgedConnection:
    """The same over a line of bytes, as a simulated radio sends it; ``opener`` may open another line.

    A record is the characteristic's number in its UUID, a length (two bytes each, the least significant first) and a
    value; one without a value asks for it.
    """

    def __init__(self, device: ImuDevice, notifies: str, opener: LineOpener = ByteLine) -> None:
        self._line = opener(device.sensor, device.port, BRIDGE_BAUD)
        self.name, self._notifies, self.is_open = self._line.name, _number(notifies), True
        self._bytes = bytearray()
        self._heard: list[bytes] = []

    def write(self, characteristic: str, value: bytes) -> None:
        """Hand over a value."""
        self._line.write(struct.pack("<HH", _number(characteristic), len(value)) + value)

    write_soon = write

    def read(self, characteristic: str) -> bytes:
        """A value. ImuLost: it does not come in time."""
        self.write(characteristic, b"")
        deadline_ns = time.monotonic_ns() + int(READ_S * NS_PER_S)
        while (left_ns := deadline_ns - time.monotonic_ns()) > 0:
            self._line.wait(left_ns / NS_PER_S)
            if (value := self._received().get(_number(characteristic))) is not None:
                return value
        raise ImuLost(f"{self.name}: does not answer")

    def _received(self) -> dict[int, bytes]:
        """Values that were asked for; notifications are put by."""
        self._bytes += self._line.read()
        values: dict[int, bytes] = {}
        while len(self._bytes) >= 4:
            number, size = struct.unpack_from("<HH", self._bytes)
            if len(self._bytes) < 4 + size:
                break
            value = bytes(self._bytes[4 : 4 + size])
            del self._bytes[: 4 + size]
            if number == self._notifies:
                self._heard.append(value)
            else:
                values[number] = value
        return values

    def notifications(self) -> list[bytes]:
        """Those that have come; never waits. ImuLost: the line is gone."""
        self._received()
        heard, self._heard = self._heard, []
        return heard

    def wait(self, seconds: float) -> None:
        """Until something comes, but no longer."""
        self._line.wait(seconds)

    def fileno(self) -> int:
        """The line's descriptor."""
        return self._line.fileno()

    def close(self) -> None:
        """Release the line."""
        self.is_open = False
        self._line.close()


def _number(characteristic: str) -> int:
    return int(characteristic[4:8], 16)


Connection = BleConnection | BridgedConnection


def connect(
    device: ImuDevice, notifies: str, services: Sequence[str] | None = None, opener: LineOpener = ByteLine
) -> Connection:
    """By radio, or over a line where the settings' ``port`` is one (``/dev/…``). ImuLost: as both say."""
    if "/" in device.port:
        return BridgedConnection(device, notifies, opener)
    return BleConnection(device, notifies, services)
