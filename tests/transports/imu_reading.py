"""What the tests of simulated sensors share: settings of one, and reading ports until a time or a loss."""

from __future__ import annotations

import select
import time
from collections.abc import Callable, Sequence

from drivers.imu.port import ImuLost, ImuPort, RawSample
from fes.config.devices import ImuDevice


def settings(kind: str, port: str, sensor: str = "right_foot", rate_hz: float = 100.0, **options: object) -> ImuDevice:
    values = {"sensor": sensor, "device": kind, "port": port, "rate_hz": rate_hz, "options": options}
    return ImuDevice.model_validate(values | {"acc_range_g": 16.0, "gyr_range_dps": 2000.0})


def collect(ports: Sequence[ImuPort], seconds: float) -> list[RawSample]:
    """Wait on all descriptors, and read all ports after each wait, for so long."""
    found: list[RawSample] = []
    end_s = time.monotonic() + seconds
    while time.monotonic() < end_s:
        select.select([number for port in ports if (number := port.fileno()) is not None], [], [], 0.01)
        for port in ports:
            found += port.read(time.monotonic_ns())
    return found


def collect_until(ports: Sequence[ImuPort], what: Callable[[], bool], seconds: float = 10.0) -> list[RawSample]:
    """Read until something is so, however long a busy machine takes, and a moment longer: it may become too much."""
    found: list[RawSample] = []
    end_s = time.monotonic() + seconds
    while not what():
        assert time.monotonic() < end_s, "it did not come"
        found += collect(ports, 0.02)
    return found + collect(ports, 0.1)


def until_lost(port: ImuPort, seconds: float = 5.0) -> str:
    end_s = time.monotonic() + seconds
    while time.monotonic() < end_s:
        try:
            collect([port], 0.05)
        except ImuLost as error:
            return str(error)
    return ""
