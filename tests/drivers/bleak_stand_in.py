"""A stand-in for bleak, whose notifications come from a simulated radio in real time."""

from __future__ import annotations

import asyncio
import sys
import time
from types import SimpleNamespace
from typing import Any, ClassVar

import pytest

from drivers.simulated.imu.device import Radio


class Client:
    """What ports ask of bleak's client; how values are written and read is the kind's own."""

    radio: ClassVar[Radio]
    notifies: ClassVar[str]
    alive: ClassVar[bool] = True
    hangs: ClassVar[bool] = False

    def __init__(self, device: Any, disconnected_callback: Any, timeout: float) -> None:
        self._gone = disconnected_callback

    async def connect(self) -> None:
        if self.hangs:
            await asyncio.sleep(3600)

    async def start_notify(self, characteristic: str, callback: Any) -> None:
        assert characteristic == self.notifies
        self._task = asyncio.create_task(self._run(callback))

    async def _run(self, callback: Any) -> None:
        while self.alive:
            for message in self.radio.advance(time.monotonic_ns()):
                self.heard(message, callback)
            await asyncio.sleep(0.003)
        self._gone(self)

    def heard(self, message: bytes, callback: Any) -> None:
        callback(None, bytearray(message))

    async def disconnect(self) -> None:
        self._task.cancel()


def install(
    monkeypatch: pytest.MonkeyPatch, client: type[Client], name: str, address: str, services: list[str] | None
) -> None:
    """In bleak's place; one device is near, which is found by these services."""

    class Scanner:
        @staticmethod
        async def find_device_by_filter(is_it: Any, timeout: float, service_uuids: list[str] | None) -> Any:
            found = SimpleNamespace(name=name, address=address)
            return found if service_uuids == services and is_it(found, None) else None

    monkeypatch.setitem(sys.modules, "bleak", SimpleNamespace(BleakClient=client, BleakScanner=Scanner))
